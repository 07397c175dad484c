"""Isolated processes for faults and commands, so that a hang or crash affects no other.

They are forked from a process that has imported everything, so they start fast.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import runpy
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from gpe_pl.benchmarks.faults.verdict import GOOD, MAX_DETAIL, Fault, Verdict
from gpe_pl.errors import GpeError
from gpe_pl.system import early_interrupts

PRELOADED = [
    "torch",
    "lightning",
    "torch_geometric",
    "hydra",
    "h5py",
    "matplotlib.figure",
    "numba",
    "gpe_pl.data.datamodule",
    "gpe_pl.training.run",
    "gpe_pl.evaluation.rollouts",
    "gpe_pl.data.generation",
    "gpe_pl.solvers.scenes",
    "gpe_pl.solvers.mpm",
    "gpe_pl.models.gpe",
    "gpe_pl.reports.sweep_table",
]


HANG = 10.0
"""Time [s] beyond the undisturbed duration after which a fault counts as hung."""
CANARY = "canary"
"""Folder beside the attacked ones, which no fault may change."""


class IsolationError(GpeError):
    """Raised on a system that cannot isolate faults."""


def forks() -> Any:
    """Return a multiprocessing context whose processes start with everything imported.

    Raises:
        IsolationError: the system cannot fork processes (Windows).
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        raise IsolationError("suite=faults needs to fork processes, which this system cannot do; run it on Linux")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


# --- faults -------------------------------------------------------------------------------------------------------------------------------


def verdicts(faults: Sequence[Fault], limit: float = 60.0) -> Iterator[Verdict]:
    """Yield the verdict of each fault, in order.

    Args:
        faults: faults; each attacks in a separate folder, which is removed afterwards.
        limit: time [s] after which a fault counts as hung.
    """
    context = forks()
    first = 0
    while first < len(faults):
        ours, theirs = context.Pipe(duplex=False)
        folder = tempfile.mkdtemp(prefix="faults-")
        worker = context.Process(target=_attack, args=(faults[first:], theirs, folder))
        worker.start()
        theirs.close()
        try:
            for verdict in _received(ours, limit, len(faults) - first):
                first += 1
                yield verdict
            if first < len(faults):  # the worker did not survive this one
                worker.join(0.5)
                hung = worker.is_alive()
                worker.kill()
                worker.join()
                first += 1
                yield Verdict("hung", f"longer than {limit:g} s") if hung else Verdict("died", f"exit code {worker.exitcode}")
        finally:
            worker.kill()
            worker.join()
            shutil.rmtree(folder, ignore_errors=True)


def _received(connection: Connection, limit: float, count: int) -> Iterator[Verdict]:
    for _ in range(count):
        try:
            if not connection.poll(limit):
                return
            yield connection.recv()
        except EOFError:
            return


def _attack(faults: Sequence[Fault], answers: Connection, folder: str) -> None:
    with open(os.devnull, "wb") as null:  # the output of a fault is not needed
        os.dup2(null.fileno(), 1)
        os.dup2(null.fileno(), 2)
    canary = Path(folder) / CANARY
    for number, fault in enumerate(faults):
        verdict = _watched(fault, Path(folder) / str(number), canary)
        if verdict.status == "hung":  # the machine may have been busy, so try again
            verdict = _watched(fault, Path(folder) / str(number), canary)
        answers.send(verdict)


def _watched(fault: Fault, own: Path, canary: Path) -> Verdict:
    """Attack in a new folder beside another folder. A fault that takes too long, or changes the other folder, gets a verdict for that."""
    own.mkdir()
    shutil.rmtree(canary, ignore_errors=True)
    (canary / "checkpoints").mkdir(parents=True)
    for name in ("metrics.csv", "checkpoints/best.ckpt", "checkpoints/last.ckpt"):
        (canary / name).write_text("somebody else's", encoding="utf-8")
    before, started = _contents(canary), time.monotonic()
    try:
        verdict = fault.attack(own)
    except Exception as error:
        verdict = Verdict("traceback", f"{type(error).__name__}: {error}"[:MAX_DETAIL])
    seconds = time.monotonic() - started
    shutil.rmtree(own, ignore_errors=True)
    if (after := _contents(canary)) != before:
        return Verdict("outside", f"changed: {', '.join(sorted(str(name) for name, _ in before ^ after))}; {verdict.detail}"[:MAX_DETAIL])
    if verdict.status in GOOD and seconds > fault.seconds + HANG:
        return Verdict("hung", f"{seconds:.0f} s, where nothing is wrong {fault.seconds:.0f} s; {verdict.detail}"[:MAX_DETAIL])
    return verdict


def _contents(folder: Path) -> set[tuple[Path, bytes]]:
    return {(path.relative_to(folder), path.read_bytes() if path.is_file() else b"") for path in folder.rglob("*")}


# --- commands -----------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """End of a command: its exit code (negative for a signal, None if stopped at its time limit) and its output."""

    code: int | None
    output: str

    def verdict(self, on_success: str = "harmless") -> Verdict:
        """Return the verdict: ``on_success`` if the command succeeded, ``refused`` if it failed with a line of error and without a traceback."""
        lines = [line for line in self.output.splitlines() if line.strip()]
        last = lines[-1][:MAX_DETAIL] if lines else ""
        if self.code is None:
            return Verdict("hung", last)
        if self.code == 0:
            return Verdict(on_success, last)  # type: ignore[arg-type]
        if self.code < 0:
            return Verdict("died", f"signal {-self.code}")
        is_readable = "Traceback (most recent call last)" not in self.output and any(line.startswith("error: ") for line in lines)
        return Verdict("refused" if is_readable else "traceback", last)


def start(command: str, arguments: Sequence[str], output: Path, prepare: Callable[[], Any] | None = None) -> Any:
    """Start ``python -m gpe_pl.{command} {arguments}`` as a process that prints to a file; it first calls ``prepare``."""
    output.touch()  # the file exists even if the process is killed before it prints
    process = forks().Process(target=_run_to_exit, args=(command, list(arguments), str(output), prepare))
    process.start()
    return process


def run(command: str, arguments: Sequence[str], limit: float = 600.0, prepare: Callable[[], Any] | None = None) -> Ended:
    """Run a command as ``start`` does, until its end or a time limit [s]."""
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        output = Path(folder) / "output"
        process = start(command, arguments, output, prepare)
        process.join(limit)
        code = process.exitcode
        end(process)
        return Ended(code, output.read_text(encoding="utf-8", errors="replace"))


def end(process: Any) -> None:
    """Kill a process and wait for its end."""
    with contextlib.suppress(ProcessLookupError):
        process.kill()
    process.join()


def _run_to_exit(*arguments: Any) -> None:
    """Run a command and the functions of ``atexit``: a process of multiprocessing ends without them, and would leave locks behind."""
    try:
        _run_command(*arguments)
    finally:
        atexit._run_exitfuncs()


def _run_command(command: str, arguments: list[str], output: str, prepare: Callable[[], Any] | None) -> None:
    early_interrupts.catch()  # as `python -m` does
    with open(output, "wb", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.environ.pop("HYDRA_FULL_ERROR", None)  # inherited from the attacking command; it would show tracebacks
    if prepare is not None:
        prepare()
    sys.argv = [command, *arguments]
    runpy.run_module(f"gpe_pl.{command}", run_name="__main__", alter_sys=True)


def waited(process: Any, seconds: float) -> bool:
    """Wait for a process; tell whether it has ended."""
    process.join(seconds)
    return process.exitcode is not None
