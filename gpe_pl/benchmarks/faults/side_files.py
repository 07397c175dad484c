"""Faults of the small files beside runs and data, and of archives of arrays."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.benchmarks.faults import runs
from gpe_pl.benchmarks.faults.runs import Command
from gpe_pl.benchmarks.faults.verdict import MAX_DETAIL, Fault, Verdict, verdict_of
from gpe_pl.data.importers import ImportSettings, import_dataset
from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.training.budget import within_budget
from gpe_pl.training.run import TrainingSettings

Change = Callable[[Path], None]

NUMBER = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?(e[-+]?\d+)?(?![\w.])")
_DEPTH, _HUGE = 100_000, "1" + 5000 * "0"
_LONG_NAME = "x" * 60_000
_TEXTS: dict[str, bytes] = {
    "empty": b"",
    "blank": b"\n",
    "null": b"null",
    "a number": b"7",
    "a list": b"[1, 2]",
    "another table": b'{"a": 1}',
    "deep lists": b"[" * _DEPTH,
    "deep tables": b'{"a":' * _DEPTH + b"1" + b"}" * _DEPTH,
    "a huge integer": f'{{"a": {_HUGE}}}'.encode(),
    "a huge exponent": b'{"a": 1e999}',
    "NaN": b'{"a": NaN}',
    "Latin-1": '{"Länge": "Größe"}'.encode("latin-1"),
    "a long name": f'{{"{_LONG_NAME}": 1}}'.encode(),
    "a long name in a column": f"{_LONG_NAME},b\n1,2\n".encode(),
    "zeros": bytes(1000),
    "escapes": b'{"\\u001b]0;x\\u0007\\u001b[2J": "\\u001b[31m"}',
}
"""Contents that replace a whole file."""
_NUMBERS = {"NaN": b"NaN", "infinity": b"Infinity", "0": b"0", "negative": b"-1", "text": b'"soon"', "a huge integer": _HUGE.encode()}
"""Texts that replace a number."""
_VALUES: dict[str, Any] = {
    "null": None,
    "a list": [[1]],
    "a table": {"a": 1},
    "text": "x",
    "a long text": _LONG_NAME,
    "deep": json.loads("[" * 500 + "]" * 500),
}
"""Values that replace a value in a table with a matching checksum."""


def _text(name: str, path: Path) -> None:
    path.write_bytes(_TEXTS[name])


def _truncated(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def _number(seed: int, text: bytes | None, path: Path) -> None:
    """Replace a number by another text; without a text, change its first digit that is not 0. A file without a number is truncated."""
    content = path.read_bytes()
    found = list(NUMBER.finditer(content))
    if not found:
        return _truncated(path)
    match = found[int(np.random.default_rng(seed).integers(len(found)))]
    old = match.group()
    new = re.sub(rb"[1-9]", lambda digit: b"%d" % (int(digit.group()) % 9 + 1), old, count=1) if text is None else text
    path.write_bytes(content[: match.start()] + (b"5" if new == old else new) + content[match.end() :])
    return None


def _value(seed: int, name: str, path: Path) -> None:
    """Replace a value in a table by one of another type, with a matching checksum."""
    values = json.loads(path.read_bytes())
    keys = sorted(set(values) - {sealed.SEAL})
    key = keys[int(np.random.default_rng(seed).integers(len(keys)))]
    path.write_text(json.dumps(sealed.sealed({**values, key: _VALUES[name]})), encoding="utf-8")


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(target: str, path: Path) -> None:
    path.unlink()
    path.symlink_to(target)


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def changes(is_table: bool, seed: int = 0) -> Iterator[tuple[str, Change]]:
    """Yield the name and function of every way to damage a small file.

    Args:
        is_table: whether the file is a JSON table. Further changes then replace a value by one of another type.
        seed: determines which number or value is replaced.
    """
    for name in _TEXTS:
        yield name, partial(_text, name)
    yield "truncated", _truncated
    for name, text in {**_NUMBERS, "another digit": None}.items():
        yield f"a number: {name}", partial(_number, seed, text)
    for name in _VALUES if is_table else ():
        yield f"a value: {name}", partial(_value, seed, name)
    yield "a folder", _folder
    for target in ("nothing", "/dev/zero", "/dev/null", ".."):
        yield f"a link to {target}", partial(_link, target)
    yield "a pipe", _fifo


# --- files of commands ----------------------------------------------------------------------------------------------------------------------

SMALL = (".json", ".csv", ".sha256")


def command_faults(command: Command, sound: Path, count: int, seed: int, limit: float) -> list[Fault]:
    """Return at most ``count`` random changes of small files that a command has left, each followed by the same command."""
    names = sorted(str(path.relative_to(sound)) for path in sound.rglob("*") if path.suffix in SMALL and "log" not in path.parts)
    every = [(name, what, change) for name in names for what, change in changes(name.endswith(".json"), seed)]
    chosen = np.random.default_rng(seed).permutation(len(every))[:count]
    return [
        Fault(
            "file beside a run",
            f"{command.name}: {name}: {what}",
            partial(runs.changed_file, command, sound, name, change, limit),
            command.seconds,
        )
        for name, what, change in (every[k] for k in sorted(chosen))
    ]


# --- step times -----------------------------------------------------------------------------------------------------------------------------

KEY, SECONDS = "sand tiny GPE 0", 0.25


def _steps(path: Path) -> int:
    return within_budget(TrainingSettings(num_steps=10, budget_minutes=1.0, val_interval=10), path, KEY, lambda _: SECONDS).num_steps


def read_changed_times(change: Change, folder: Path) -> Verdict:
    """Convert a time budget to steps with a changed file of step times."""
    sealed.write(folder / "sound.json", {KEY: SECONDS, "other": 0.125})
    path = folder / "step_times.json"
    shutil.copy(folder / "sound.json", path)
    change(path)
    return verdict_of(lambda: _steps(path), lambda found: found == _steps(folder / "sound.json"))


# --- archives of arrays ---------------------------------------------------------------------------------------------------------------------


def raw_arrays(folder: Path, num_frames: int = 8, num_nodes: int = 20) -> None:
    """Make a small source of ``format=arrays``: falling fluid, in three splits."""
    rng = np.random.default_rng(0)
    for split, count in {"train": 3, "val": 1, "test": 1}.items():
        (folder / split).mkdir(parents=True)
        for k in range(count):
            start, vel = rng.uniform(0.3, 0.7, (num_nodes, 2)), rng.normal(0, 0.1, (num_nodes, 2))
            time = 0.01 * np.arange(num_frames)[:, None, None]
            pos = start + time * vel + 0.5 * time**2 * np.array([0.0, -9.81])
            np.savez(
                folder / split / f"{k:02d}.npz",
                pos=pos.astype(np.float32),
                frame_dt=0.01,
                materials="fluid",
                params_fluid=1e-3,
                bounds=[[0.0, 1.0], [0.0, 1.0]],
                gravity=[0.0, -9.81],
                spacing=0.05,
                connectivity_radius=0.1,
            )


def _member(name: str, header: str, path: Path) -> None:
    """Replace the bytes of one array of an archive, or add a member."""
    with zipfile.ZipFile(path) as archive:
        parts = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for each, old in {**parts, name: _HEADERS[header]}.items():
            archive.writestr(each, old)


def _npy(header: str | bytes, content: bytes = bytes(64), version: bytes = b"\x01\x00") -> bytes:
    text = header.encode() if isinstance(header, str) else header
    return b"\x93NUMPY" + version + min(len(text), 65535).to_bytes(2, "little") + text + content


def _array(value: Any) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(value))
    return file.getvalue()


_HEADERS: dict[str, bytes] = {
    "brackets": _npy("[" * 60_000),
    "parentheses": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 9000),
    "a huge integer": _npy(f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({_HUGE},)}}"),
    "a huge shape": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000, 2)}"),
    "a negative shape": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 20, 2)}"),
    "a shape of floats": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (nan, 2)}"),
    "another order": _npy("{'descr': '<f4', 'fortran_order': 'soon', 'shape': (2,)}"),
    "objects": _npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"cos\nsystem\n(S'true'\ntR."),
    "text": _array("soon"),
    "complex numbers": _array(np.full((8, 20, 2), 1j)),
    "dates": _array(np.zeros((8, 20, 2), "datetime64[s]")),
    "no axes": _array(1.0),
    "nothing in it": _array(np.zeros((0, 20, 2))),
    "a long name": _npy(f"{{'{_LONG_NAME}': 1}}"),
    "Latin-1": _npy("{'descr': '<f4', 'größe': 1}".encode("latin-1")),
    "not a number": _array(np.full((8, 20, 2), np.nan)),
    "a version of later": _npy("{}", version=b"\x09\x00"),
    "empty": b"",
}


SOUND = {("params_fluid", "no axes"), ("frame_dt", "no axes")}
"""Changed archives that are valid."""


def archive_changes() -> Iterator[tuple[str, Change]]:
    """Yield name and function of every change of an archive of arrays."""
    for key in ("pos", "frame_dt", "materials", "bounds", "params_fluid"):
        for name in _HEADERS:
            if (key, name) not in SOUND:
                yield f"{key}: {name}", partial(_member, f"{key}.npy", name)
    for name in (f"{_LONG_NAME}.npy", "../../canary/x.npy", "/x.npy", "\x1b[2J.npy", "params_lava.npy", "boundary_vel.npy"):
        yield f"a member {name[:20]!r}", partial(_member, name, "no axes")
    for name in ("empty", "zeros", "Latin-1"):
        yield name, partial(_text, name)
    yield "truncated", _truncated
    yield "a folder", _folder
    for target in ("nothing", "/dev/zero"):
        yield f"a link to {target}", partial(_link, target)
    yield "a pipe", _fifo


def converted(raw: Path, change: Change, folder: Path) -> Verdict:
    """Import a source with one changed archive. It must be refused, or the report must name the archive as left out."""
    source = folder / "raw"
    shutil.copytree(raw, source)
    change(source / "train" / "00.npz")
    settings = ImportSettings(format="arrays", source=str(source), name="own")
    try:
        report = import_dataset(folder, settings)
    except GpeError as error:
        return Verdict("refused", " ".join(str(error).split())[:MAX_DETAIL])
    except Exception as error:
        return Verdict("traceback", f"{type(error).__name__}: {error}"[:MAX_DETAIL])
    named = [str(event) for event in report.refusals if event.trajectory == "00.npz"]
    return Verdict("refused", named[0][:MAX_DETAIL]) if named else Verdict("accepted", "no error, and nothing was left out")


def faults(raw: Path) -> list[Fault]:
    """Return changed files of step times, and changed archives of arrays in a source."""
    found = [Fault("file of step times", name, partial(read_changed_times, change)) for name, change in changes(is_table=True)]
    return found + [Fault("archive of arrays", name, partial(converted, raw, change)) for name, change in archive_changes()]
