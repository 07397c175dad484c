"""PyTorch archives that would take far more memory or time than their size are refused before they are read."""

from __future__ import annotations

import io
import pickle
import shutil
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gpe_pl.learned import checkpoint_archive
from gpe_pl.learned.checkpoint_archive import check_archive, check_pickle, check_values
from gpe_pl.learned.checkpoint_file import CheckpointError, load_checkpoint

CONTENT = {
    "state_dict": OrderedDict(a=torch.zeros(3, 2), b=torch.nn.Parameter(torch.ones(2, dtype=torch.float64))),
    "optimizer_states": [
        {"state": {0: {"step": torch.tensor(3.0), "exp_avg": torch.zeros(2)}}, "groups": [{"betas": (0.9, 0.95), "foreach": None}]}
    ],
    "epoch": 3,
    "score": -1.5,
    "large": 2**40,
    "name": "ü",
}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    torch.save(CONTENT, tmp_path / "sound.ckpt")
    return tmp_path / "sound.ckpt"


def rewritten(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    """Rewrite an archive with other or additional members."""
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    top = next(iter(parts)).partition("/")[0]
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in {**parts, **{f"{top}/{name}": content for name, content in members.items()}}.items():
            archive.writestr(name, content)


def compressed(path: Path) -> None:
    """Write an archive of a thousandth of its unpacked size."""
    rewritten(path, {"more": bytes(2**24)}, zipfile.ZIP_DEFLATED)


def crowded(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        for k in range(checkpoint_archive.MOST_MEMBERS):
            archive.writestr(str(k), b"")


def overlapping(path: Path) -> None:
    """Write an archive in which two members share their bytes."""
    rewritten(path, {"twin": bytes(2**16)})
    with zipfile.ZipFile(path, "a") as archive:
        twin = next(member for member in archive.infolist() if member.filename.endswith("/twin"))
        archive.filelist.extend([twin] * 3)
        archive.writestr("last", b"")  # so that the directory is written again


class Called:
    """Object that is pickled as a call."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


def calling(function: Callable[..., Any], *arguments: Any) -> Callable[[Path], None]:
    return lambda path: rewritten(path, {"data.pkl": pickle.dumps({"a": Called(function, *arguments)}, 2)})


def tuples(path: Path) -> None:
    """Return a key whose hash takes 2^60 steps: nested tuples, each containing the next twice."""
    key: Any = (1,)
    parts = io.BytesIO()
    for _ in range(60):
        key = (key, key)
    pickler = pickle.Pickler(parts, 2)
    pickler.dump([key, 1])
    body = parts.getvalue().removeprefix(b"\x80\x02]q\x00(").removesuffix(b"e.")
    rewritten(path, {"data.pkl": b"\x80\x02}(" + body + b"u."})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (compressed, "is compressed, which PyTorch never does"),
        (crowded, r"\d+ members, at most"),
        (overlapping, "its members share their bytes"),
        (calling(bytearray, 10**12), "a pickle with (__builtin__|builtins) bytearray"),
        (calling(torch.FloatStorage, 10**12), "a pickle that calls torch FloatStorage|a pickle with"),
        (tuples, "tuples nested more than 16 levels deep"),
        (lambda path: rewritten(path, {"data.pkl": b"\x80\x02h\x07."}), "a pickle that is damaged"),
        (
            lambda path: rewritten(path, {"data.pkl": b"\x80\x02" + b"N" * checkpoint_archive.MOST_PICKLE_BYTES}),
            "bytes beside its tensors",
        ),
    ],
)
def test_what_would_take_hours_or_gigabytes_is_refused(archive: Path, change: Callable[[Path], None], message: str) -> None:
    change(archive)
    with pytest.raises(ValueError, match=message):
        check_archive(archive)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(archive)


def test_what_pytorch_writes_is_read(archive: Path, tmp_path: Path) -> None:
    loaded = load_checkpoint(archive)
    assert loaded.keys() == CONTENT.keys()
    assert torch.equal(loaded["state_dict"]["b"], torch.ones(2, dtype=torch.float64))
    shutil.move(archive, tmp_path / "moved.ckpt")
    check_archive(tmp_path / "moved.ckpt")


def shared(levels: int) -> Any:
    value: Any = [1]
    for _ in range(levels):
        value = [value, value]
    return value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"a": shared(31)}, "more than 1048576 values"),
        ({"a": [*range(2**21)]}, "more than 1048576 values"),
        ({"a": torch.zeros(1).expand(10**12)}, r"a tensor \[1000000000000\] has fewer values"),
    ],
)
def test_what_nothing_should_go_through_is_refused(values: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_values(values)


def test_deep_values_are_refused() -> None:
    value: Any = 1
    for _ in range(100):
        value = {"a": value}
    with pytest.raises(ValueError, match="nested more than 32 levels deep"):
        check_values(value)


def test_sound_values_are_accepted() -> None:
    check_values(CONTENT)
    check_pickle(pickle.dumps({"a": [1, 2.0, ("b", None, True)]}, 2))
