"""What keeps a sound shard from being read does not get it deleted; a shard of another place is made again."""

from __future__ import annotations

import errno
import fcntl
import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest

from gpe_pl.data.generation import discard_damaged, generate
from gpe_pl.trajectory.store import ReadError
from tests.unit.data.test_generation import SPEC, contents


@pytest.mark.slow
def test_shards_that_the_machine_cannot_read_now_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    again = generate(tmp_path, SPEC)
    before, opened = contents(again), h5py.File
    with open(again / "train" / "shard-00000.h5", "rb") as viewer:
        fcntl.flock(viewer, fcntl.LOCK_EX)
        discard_damaged(tmp_path, SPEC)
    for error in (OSError(errno.EMFILE, "too many"), OSError(errno.EIO, "disk"), MemoryError("1.2 GiB")):

        def fails(*_: Any, error: Exception = error, **__: Any) -> None:
            raise error

        monkeypatch.setattr(h5py, "File", fails)
        for use in (discard_damaged, generate):
            with pytest.raises(ReadError, match=r"shard-0000\d\.h5: cannot be read"):
                use(tmp_path, SPEC)
        monkeypatch.setattr(h5py, "File", opened)
    assert contents(again) == before


@pytest.mark.slow
def test_a_shard_that_was_copied_from_another_split_is_made_again(tmp_path: Path) -> None:
    folder = generate(tmp_path, SPEC)
    before = contents(folder)
    shutil.copy(folder / "val" / "shard-00000.h5", folder / "test" / "shard-00000.h5")
    generate(tmp_path, SPEC)
    assert contents(folder) == before
