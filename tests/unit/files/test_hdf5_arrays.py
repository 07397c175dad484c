"""Arrays in HDF5 files that expand far beyond their size, or lead elsewhere, are refused before they are read."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gpe_pl.data.importers import hdf5
from gpe_pl.data.importers.source import Refusal
from gpe_pl.data.validate import validate
from gpe_pl.trajectory.store import StoreError, read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

Make = Callable[[h5py.Group, str, np.ndarray], Any]


def huge_chunk(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write a chunk of 32 MiB, all of it constant; with a terabyte the file would be as small."""
    chunks = (2**23 // max(1, values[0].size), *values.shape[1:])
    group.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]), chunks=chunks, compression="gzip", compression_opts=1)


def bomb(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write a chunk that unpacks to 64 MiB."""
    dataset = group.create_dataset(name, values.shape, values.dtype, chunks=values.shape, compression="gzip")
    pack = zlib.compressobj(1)
    dataset.id.write_direct_chunk((0,) * values.ndim, b"".join(pack.compress(bytes(2**24)) for _ in range(4)) + pack.flush())


def constant(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write zeros: 600 MiB in 600 kiB."""
    row = values[0].size
    shape, chunk = (600 * 2**20 // values.itemsize // row, *values.shape[1:]), (2**20 // values.itemsize // row, *values.shape[1:])
    dataset = group.create_dataset(name, shape, values.dtype, chunks=chunk, compression="gzip")
    packed = zlib.compress(bytes(values.itemsize * row * chunk[0]), 9)
    for start in range(0, shape[0], chunk[0]):
        dataset.id.write_direct_chunk((start,) + (0,) * (values.ndim - 1), packed)


def many_chunks(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write chunks of one number each, few of them stored."""
    row = values[0].size
    dataset = group.create_dataset(name, (2**18 // row + 1, *values.shape[1:]), values.dtype, chunks=(1,) * values.ndim)
    dataset[: 400 // row] = 1


def growing(group: h5py.Group, name: str, values: np.ndarray) -> None:
    """Write an array that grows, as a simulation of unknown length does; it is valid."""
    group.create_dataset(name, data=values, maxshape=(None, *values.shape[1:]), chunks=(100, *values.shape[1:]), compression="gzip")


def filtered(**options: Any) -> Make:
    return lambda group, name, values: group.create_dataset(name, data=values, chunks=values.shape, **options)


def external(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group[name] = h5py.ExternalLink(str(Path(group.file.filename).with_name("pipe")), "/x")


def loop(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group[name] = h5py.SoftLink(f"{group.name}/{name}")


def virtual(group: h5py.Group, name: str, values: np.ndarray) -> None:
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(str(Path(group.file.filename).with_name("pipe")), "x", values.shape)
    group.create_virtual_dataset(name, layout)


def elsewhere(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group.create_dataset(name, values.shape, values.dtype, external=[(str(Path(group.file.filename).with_name("pipe")), 0, values.nbytes)])


REFUSED: list[tuple[Make, str]] = [
    (huge_chunk, r"holds \d+ bytes in 1 chunks \[\d+.*\] of 335544.. bytes in all"),
    (bomb, r"holds \d+ bytes, for which \d+ bytes are stored"),
    (constant, r"unpacks to \d+ bytes from \d+, at most \d+ are read"),
    (many_chunks, r"holds \d+ bytes in \d+ chunks \[1.*store it in larger chunks"),
    (filtered(scaleoffset=0), r"filters scaleoffset \(6\)|filters .*\(6\)"),
    (external, "not an array inside this file"),
    (loop, "not an array inside this file"),
    (virtual, "not an array inside this file"),
    (elsewhere, "not an array inside this file"),
]


@pytest.fixture
def shard(tmp_path: Path, trajectory: Trajectory) -> Path:
    path = tmp_path / "shard-00000.h5"
    write_shard(path, [trajectory])
    return path


@pytest.fixture
def pipe(tmp_path: Path) -> None:
    """Make a pipe, which blocks whoever opens it."""
    if not hasattr(os, "mkfifo"):
        pytest.skip("no named pipes here")
    os.mkfifo(tmp_path / "pipe")


@pytest.mark.slow
@pytest.mark.usefixtures("pipe")
@pytest.mark.parametrize(("make", "message"), REFUSED)
@pytest.mark.parametrize("key", ["pos", "mass"])
def test_what_takes_more_than_it_holds_is_refused(tmp_path: Path, shard: Path, key: str, make: Make, message: str) -> None:
    path = tmp_path / "other.h5"
    path.write_bytes(shard.read_bytes())
    with h5py.File(path, "r+") as file:
        values = file["00000"][key][()]
        del file["00000"][key]
        make(file["00000"], key, values)
    with pytest.raises(StoreError, match=rf"other.h5:00000: field '{key}' .*({message})"):
        read_trajectory(path, "00000")
    with hdf5.opened(path) as file, pytest.raises(Refusal, match=f"'{key}' .*({message})"):
        hdf5.array(file["00000"], key, ", ".join("abc"[: values.ndim]))
    assert any(message_of.startswith(f"{path}: 00000: field '{key}'") for message_of in map(str, validate([path]).violations))


@pytest.mark.parametrize(
    "make", [growing, filtered(), filtered(compression="gzip", shuffle=True, fletcher32=True), filtered(compression="lzf")]
)
def test_other_ways_of_storing_are_read(tmp_path: Path, shard: Path, trajectory: Trajectory, make: Make) -> None:
    with h5py.File(shard, "r+") as file:
        for key in ("pos", "mass"):
            values = file["00000"][key][()]
            del file["00000"][key]
            make(file["00000"], key, values)
    np.testing.assert_array_equal(read_trajectory(shard, "00000").pos, trajectory.pos)


@pytest.mark.usefixtures("pipe")
def test_optional_arrays_are_not_looked_for_in_other_files(tmp_path: Path, shard: Path) -> None:
    other = shard.rename(tmp_path / "other.h5")
    with h5py.File(other, "r+") as file:
        external(file["00000"], "cells", np.empty(0))
        external(file, "00009", np.empty(0))
    with pytest.raises(StoreError, match="field 'cells' is not an array inside this file"):
        read_trajectory(other, "00000")
    with pytest.raises(StoreError, match="'00009' is not a trajectory of this file"):
        read_trajectory(other, "00009")
    assert hdf5.groups(other) == [name for name in trajectory_names(other) if name != "00009"]


@pytest.mark.parametrize("value", [np.array(["2"], dtype=object), np.full(8000, 2), 2.0, h5py.Empty("i4")])
def test_a_version_that_is_no_number(shard: Path, value: Any) -> None:
    with h5py.File(shard, "r+") as file:
        file.attrs["schema_version"] = value
    with pytest.raises(StoreError, match="schema version None"):
        trajectory_names(shard)
