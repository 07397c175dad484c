"""Faults of runs. Commands are killed, run out of disk space or find damaged files; then the same command runs again.

Commands run in the empty folder ``folder``, each for at most ``limit`` seconds. ``sound`` is the folder of an undisturbed run, and ``expected`` are the digests
of its results (``digests``).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gpe_pl.benchmarks.faults import isolation, stores
from gpe_pl.benchmarks.faults.verdict import GOOD, MAX_DETAIL, Fault, Verdict
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.rollout_cost import COST_FILE
from gpe_pl.learned.checkpoint_file import load_checkpoint
from gpe_pl.system.provenance import PROVENANCE

SAVED = (
    "state_dict",
    "current_model_state",
    "averaging_state",
    "optimizer_states",
    "lr_schedulers",
    "global_step",
    "simulator",
    "excursions",
    "skipped",
)
"""Entries of a training checkpoint that do not depend on its location."""


MEASURED = "results.json"
"""File of measured results of benchmarks; times vary, so only their number and the settings are compared."""
ONCE = ("convert",)
"""Commands that refuse to repeat finished work."""
TRACEBACK = re.compile(r".*\n?Traceback \(most recent call last\)[^\n]*(\n .*)*(\n.*)?")
"""A traceback with the line before, which tells whether it was ignored, and the line after, which names the error."""
LOCKS = (".*.lock", ".*.holder")
"""Patterns of lock files."""
MESSAGE_BYTES = 1000
"""Smallest file size that leaves room for a command's output, which goes to a file too; with less room its error would be cut off."""


class DiskSizeError(GpeError):
    """Raised for the size of a disk that would not fill up."""


@dataclass(frozen=True)
class Command:
    """A command, and the folders of its data and results.

    Attributes:
        name: name in the table of outcomes.
        module: module in ``python -m gpe_pl.{module}``.
        arguments: all arguments but the folders.
        data: folder of the data, or None if the command makes its own data.
        seconds: duration of the undisturbed command [s].
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    data: str | None = None
    seconds: float = math.inf

    def given(self, folder: Path) -> list[str]:
        """Return the arguments, including those that name the folders."""
        return [*self.arguments, f"paths.data={self.data or folder / 'data'}", f"paths.runs={folder / 'runs'}"]


# --- results of a command -----------------------------------------------------------------------------------------------------------------


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of results that must not depend on interruptions: data, metrics, tables, weights and the optimiser's state, bit for bit.

    Logs and provenance differ between the starts of a run, so they are left out. So are measured times.
    """
    found = {}
    for path in _final_files(folder):
        relative = path.relative_to(folder)
        if "log" not in relative.parts and path.name != PROVENANCE and path.is_file() and (digest := _digest_of(path)) is not None:
            found[str(relative)] = digest
    return found


def _digest_of(path: Path) -> str | None:
    """Return the digest of a file of results, or None for a file of no results."""
    if path.suffix == ".ckpt":
        stored = load_checkpoint(path)
        return _digest({key: stored[key] for key in SAVED})
    if path.name == MEASURED:
        values = json.loads(path.read_text(encoding="utf-8"))
        return _digest([values["settings"], len(values["records"])])
    if path.name == COST_FILE:
        return _digest(sorted(json.loads(path.read_text(encoding="utf-8"))))
    if path.suffix == ".json":
        values = json.loads(path.read_text(encoding="utf-8"))
        return _digest({k: v for k, v in values.items() if k != "folder"} if path.name == "report.json" else values)
    if path.with_name(MEASURED).exists():
        return "of what was measured"
    if path.suffix == ".h5" or path.name in ("metrics.csv", "table.csv", "table.md"):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    return None


def _digest(value: Any) -> str:
    sha = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, dict):
            for key in sorted(value, key=str):
                sha.update(f"{key}:".encode())
                add(value[key])
        elif isinstance(value, (list, tuple)):
            for each in value:
                add(each)
        elif isinstance(value, torch.Tensor):
            sha.update(
                f"{value.dtype}{tuple(value.shape)}".encode() + value.detach().contiguous().view(-1).view(torch.uint8).numpy().tobytes()
            )
        else:
            sha.update(repr(value).encode())

    add(value)
    return sha.hexdigest()


def incomplete(folder: Path) -> list[str]:
    """Return the files with final names that cannot be read."""
    found = []
    for path in _final_files(folder):
        try:
            if path.suffix == ".h5":
                stores.contents(path)
            elif path.suffix == ".ckpt":
                load_checkpoint(path)
            elif path.suffix == ".json":
                json.loads(path.read_text(encoding="utf-8"))
        except Exception as error:
            found.append(f"{path.name}: {error}")
    return found


def leftovers(folder: Path) -> list[str]:
    """Return temporary files and lock files, which a command removes unless it is killed."""
    return sorted(path.name for pattern in ("*.part*", *LOCKS) for path in folder.rglob(pattern))


def released(folder: Path) -> frozenset[str]:
    """Return lock files that killed commands have left; the system has released them, and the next command that needs one removes it."""
    return frozenset(path.name for pattern in LOCKS for path in folder.rglob(pattern))


def _final_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.name.startswith("."))


def finished(command: Command, folder: Path, expected: dict[str, str], limit: float, stays: frozenset[str] = frozenset()) -> Verdict:
    """Run a command to its end, and compare its results with ``expected``. Files named in ``stays`` may be left over."""
    return _judged(isolation.run(command.module, command.given(folder), limit), command, folder, expected, stays)


def _judged(ended: isolation.Ended, command: Command, folder: Path, expected: dict[str, str], stays: frozenset[str]) -> Verdict:
    """Return the verdict of a repeated command that has ended by itself: only one of ``ONCE`` may fail, and only if its results are those expected."""
    verdict = ended.verdict()
    may_be_done = command.module in ONCE and verdict.status == "refused"
    if ended.code != 0 and not may_be_done:
        return Verdict("different", f"does not resume: {verdict.status}: {verdict.detail}")
    return compared(folder, expected, verdict.detail, stays)


def compared(folder: Path, expected: dict[str, str], detail: str, stays: frozenset[str] = frozenset()) -> Verdict:
    """Compare what a command has left in a folder with ``expected``, as ``finished`` does. ``detail`` are the last words of the command."""
    if broken := incomplete(folder):
        return Verdict("half-written", "; ".join(broken))
    found = digests(folder)
    wrong = sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))
    if wrong:
        return Verdict("different", f"{', '.join(wrong)}; {detail}")
    left = [name for name in leftovers(folder) if name not in stays]
    return Verdict("half-written", f"left behind: {', '.join(left)}") if left else Verdict("harmless", "equal bit for bit")


SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
"""Signals that end a command early."""
ANSWER = 5.0
"""Time [s] within which a command has to end after a signal. Miniature commands take less than a second, also on slow machines."""


# --- kills --------------------------------------------------------------------------------------------------------------------------------


def kills(command: Command, folder: Path, count: int, in_a_row: int = 5, seed: int = 0, limit: float = 600.0) -> Iterator[Verdict]:
    """Kill a command at random moments, with SIGKILL, SIGTERM and SIGINT in turn, start it again, and after some kills let it finish.

    It has to end within ``ANSWER`` seconds of a signal, with an exit code other than 0 unless it had already written its results. A start that ends before its
    kill has to succeed, or to refuse finished work (``ONCE``). The final results are compared with those of an undisturbed run.

    Yield a verdict for each of ``count`` kills, which names its time. A run is killed at most ``in_a_row`` times before it may finish.
    """
    rng = np.random.default_rng(seed)
    whole = folder / "whole"
    started = time.monotonic()
    ended = isolation.run(command.module, command.given(whole), limit)
    duration = time.monotonic() - started
    if ended.code != 0:
        verdict = ended.verdict()
        yield Verdict("different", f"fails where nothing is wrong: {verdict.status}: {verdict.detail}")
        return
    expected, number = digests(whole), 0
    while number < count:
        own = folder / f"killed-{number}"
        moments: list[str] = []
        problem: Verdict | None = None
        while len(moments) < min(in_a_row, count - number):
            kind = SIGNALS[(number + len(moments)) % len(SIGNALS)]
            moment = float(rng.uniform(0.0, duration))
            found = _killed(command, own, folder / "output", kind, moment)
            if isinstance(found, isolation.Ended):
                if found.code == 0 and not moments:  # start over
                    duration *= 0.9
                    shutil.rmtree(own, ignore_errors=True)
                    continue
                if found.code != 0:
                    repeated = _judged(found, command, own, expected, released(own))
                    problem = problem or (None if repeated.status in GOOD else repeated)
                    moments = moments or ["not killed"]
                break
            moments.append(f"{kind.name} after {moment:.2f} s")
            problem = problem or found
        number += len(moments)
        verdict = problem or finished(command, own, expected, limit, released(own))
        for text in moments:
            yield Verdict(verdict.status, f"{text}; {verdict.detail}")
        shutil.rmtree(own, ignore_errors=True)


def _killed(command: Command, own: Path, output: Path, kind: signal.Signals, moment: float) -> isolation.Ended | Verdict | None:
    """Start a command, and send it a signal after a time [s]. Return its end if that came first, else what was wrong after the signal, or None."""
    process = isolation.start(command.module, command.given(own), output)
    try:
        if isolation.waited(process, moment):
            return isolation.Ended(process.exitcode, output.read_text(encoding="utf-8", errors="replace"))
        sent = time.time()
        os.kill(process.pid, kind)
        if not isolation.waited(process, ANSWER):
            return Verdict("hung", f"goes on for {ANSWER:g} s after {kind.name}")
    finally:
        isolation.end(process)
    said = TRACEBACK.search(output.read_text(encoding="utf-8", errors="replace"))
    if kind is not signal.SIGKILL and said:
        return Verdict("traceback", " ".join(said.group().split())[-MAX_DETAIL:])
    if broken := incomplete(own):
        return Verdict("half-written", "; ".join(broken))
    if process.exitcode == 0 and any((own / name).stat().st_mtime > sent for name in digests(own)):
        return Verdict("hung", f"goes on to its end after {kind.name}")
    return None


# --- damaged files of a run ---------------------------------------------------------------------------------------------------------------


def damaged_file(command: Command, sound: Path, name: str, damage: Callable[[bytes], bytes], limit: float, folder: Path) -> Verdict:
    """Damage the file ``name`` among the results of a command, and repeat the command. It must refuse, or give sound results."""
    return changed_file(command, sound, name, partial(_damaged_bytes, damage), limit, folder)


def _damaged_bytes(damage: Callable[[bytes], bytes], path: Path) -> None:
    path.write_bytes(damage(path.read_bytes()))


def changed_file(command: Command, sound: Path, name: str, change: Callable[[Path], None], limit: float, folder: Path) -> Verdict:
    """Change or replace the file ``name`` among the results of a command, and repeat the command, as in ``damaged_file``.

    The verdict is ``unread`` if the command succeeds, leaves the file as it is, and readers refuse the file. All other results are compared.
    """
    for part in sound.iterdir():
        (shutil.copytree if part.is_dir() else shutil.copy)(part, folder / part.name)
    change(folder / name)
    ended = isolation.run(command.module, command.given(folder), limit)
    if ended.code != 0:
        return ended.verdict()
    wrong, refused = [], ""
    for relative, expected in digests(sound).items():
        path = folder / relative
        try:
            is_equal = path.is_file() and (_digest_of(path) == expected or _have_equal_content(sound / relative, path))
        except GpeError as error:
            is_equal = relative == name or path.read_bytes() == (sound / relative).read_bytes()  # or refused because of the file beside it
            refused = str(error)
        if not is_equal:
            wrong.append(relative)
    if wrong:
        return Verdict("accepted", f"no error, but {', '.join(sorted(wrong))} differ")
    return Verdict("unread", f"not needed; readers say: {refused}"[:MAX_DETAIL]) if refused else Verdict("harmless")


def _have_equal_content(sound: Path, damaged: Path) -> bool:
    """Tell whether two files are shards of equal content. Their bytes may differ, because some bytes have no meaning."""
    return sound.suffix == ".h5" and damaged.exists() and stores.contents(sound) == stores.contents(damaged)


def damage_faults(command: Command, sound: Path, count: int, seed: int, limit: float) -> list[Fault]:
    """Return ``count`` random damages to files among the results of a command, other than pictures and logs."""
    rng = np.random.default_rng(seed)
    names = sorted(digests(sound))
    kinds = list(stores.damages(4 * count, seed))
    found = []
    for _ in range(count if names else 0):
        name, (kind, what, damage) = names[int(rng.integers(len(names)))], kinds[int(rng.integers(len(kinds)))]
        attack = partial(damaged_file, command, sound, name, damage, limit)
        found.append(Fault(f"file of a run, {kind}", f"{command.name}: {name}, {what}", attack, command.seconds))
    return found


# --- disks --------------------------------------------------------------------------------------------------------------------------------


def limit_file_size(size: int) -> None:
    """Limit the size of all files that this process writes from now on; writes then fail as on a full disk, with another error number."""
    import resource  # not available on Windows

    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[bool]:
    """Mount a file system of ``size`` bytes on a folder; yield whether this worked, which needs the right to mount."""
    folder.mkdir(parents=True)
    done = (
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], capture_output=True, check=False).returncode
        == 0
    )
    try:
        yield done
    finally:
        if done:
            subprocess.run(["umount", "-l", str(folder)], capture_output=True, check=False)


def full_disk(command: Command, size: int, expected: dict[str, str], limit: float, folder: Path) -> Verdict:
    """Run a command on a disk of ``size`` bytes, which fills up. Then make room, and run the same command to its end.

    Without the right to mount a disk, the size of single files is limited instead.
    """
    with small_disk(folder / "disk", size) as is_mounted:
        own = folder / "disk"
        prepare = None if is_mounted else partial(limit_file_size, size)
        verdict = isolation.run(command.module, command.given(own), limit, prepare).verdict("accepted")
        if verdict.status != "refused":
            return verdict
        if broken := incomplete(own):
            return Verdict("half-written", "; ".join(broken))
        if is_mounted:
            subprocess.run(["mount", "-o", f"remount,size={2**28}", str(own)], check=True, capture_output=True)
        again = finished(command, own, expected, limit)
        how = f"{size} bytes" if is_mounted else f"{size} bytes per file, for want of the right to mount"
        return again if again.status != "harmless" else Verdict("refused", f"{how}: {verdict.detail}; then {again.detail}")


def file_limit(command: Command, size: int, expected: dict[str, str], limit: float, folder: Path) -> Verdict:
    """Run a command while no file may exceed ``size`` bytes; then run it again without this limit, as in ``full_disk``."""
    verdict = isolation.run(command.module, command.given(folder), limit, partial(limit_file_size, size)).verdict("accepted")
    if verdict.status != "refused":
        return verdict
    if broken := incomplete(folder):
        return Verdict("half-written", "; ".join(broken))
    again = finished(command, folder, expected, limit)
    return again if again.status != "harmless" else Verdict("refused", f"{verdict.detail}; then {again.detail}")


def read_only(command: Command, limit: float, folder: Path) -> Verdict:
    """Run a command in a folder that is not writable."""
    with small_disk(folder / "disk", 2**20) as is_mounted:
        own = folder / "disk"
        if is_mounted:
            subprocess.run(["mount", "-o", "remount,ro", str(own)], check=True, capture_output=True)
        elif os.geteuid() == 0:  # permissions do not restrict root
            return Verdict("harmless", "not done, for want of the right to mount")
        else:
            own.chmod(0o555)
        verdict = isolation.run(command.module, command.given(own), limit).verdict("accepted")
        if not is_mounted:
            own.chmod(0o777)
        return verdict


def file_in_the_way(command: Command, limit: float, folder: Path) -> Verdict:
    """Run a command with a file in place of its output folder."""
    (folder / ("data" if command.data is None else "runs")).write_text("a file", encoding="utf-8")
    return isolation.run(command.module, command.given(folder), limit).verdict("accepted")


def disk_faults(command: Command, sizes: Sequence[int], sound: Path, expected: dict[str, str], limit: float) -> list[Fault]:
    """Return faults of full disks, of limited file sizes [bytes], and of folders that are not writable.

    Raises:
        DiskSizeError: a size has room for the largest file of the undisturbed run.
    """
    largest = max(path.stat().st_size for path in sound.rglob("*") if path.is_file())
    found = []
    for size in sizes:
        if size >= largest:
            raise DiskSizeError(f"disk_sizes of {command.name}: {size} bytes have room for its largest file, of {largest} bytes; give less")
        found.append(
            Fault("disk full", f"{command.name}, {size} bytes", partial(full_disk, command, size, expected, limit), 2 * command.seconds)
        )
        if size >= MESSAGE_BYTES:
            attack = partial(file_limit, command, size, expected, limit)
            found.append(Fault("file too large", f"{command.name}, {size} bytes", attack, 2 * command.seconds))
    found.append(Fault("folder not writable", f"{command.name}, read-only", partial(read_only, command, limit), command.seconds))
    found.append(
        Fault("folder not writable", f"{command.name}, a file in the way", partial(file_in_the_way, command, limit), command.seconds)
    )
    return found
