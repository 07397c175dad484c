"""Damaged and hostile HDF5 files, archives and arrays."""

from __future__ import annotations

import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from gpe_pl.data.importers import ImportFailure
from tests import sources
from tests.refusals import WATER, convert, refused, unreadable
from tests.sources import DT, motion

# --- HDF5 ----------------------------------------------------------------------------------------------------------------------------------


def absurd(group: h5py.Group) -> None:
    del group["position"]
    group.create_dataset("position", shape=(10**6, 10**6, 2), dtype="f4", chunks=(1, 1000, 2))


def external(group: h5py.Group) -> None:
    del group["position"]
    group["position"] = h5py.ExternalLink("/etc/passwd", "/x")


def virtual(group: h5py.Group) -> None:
    del group["position"]
    layout = h5py.VirtualLayout((10, 20, 2), "f4")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (10, 20, 2))
    group.create_virtual_dataset("position", layout)


def replaced(key: str, value: Any) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        del group[key]
        if value is not None:
            group[key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (absurd, r"'position' claims 8000000000000 bytes, the file holds 0"),
        (external, "'position' is not an array inside this file"),
        (virtual, "'position' is not an array inside this file"),
        (replaced("position", None), "has no 'position'; there are 'particle_type'"),
        (replaced("position", np.array([b"x", b"y"])), r"'position' is .*S1.*\[2\], expected numbers \[frame, node, dim\]"),
        (replaced("position", motion()[..., :1]), r"position is \[10, 20, 1\] for 20 particle types in 2D"),
        (replaced("position", motion().astype(int)), "'position' is int64"),
        (replaced("particle_type", np.zeros(20)), r"'particle_type' is float64\[20\], expected integers \[node\]"),
        (replaced("particle_type", np.zeros(5, int)), r"position is \[10, 20, 2\] for 5 particle types"),
        (replaced("particle_type", np.full(20, 77)), "node 0 has type 77"),
        (replaced("position", motion()[:2]), "at least 3 frames"),
    ],
)
def test_a_group_that_cannot_be_used(tmp_path: Path, change: Callable[[h5py.Group], None], message: str) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(seed=k), np.zeros(20, int)) for k in range(4)])
    with h5py.File(path, "a") as file:
        change(file["00002"])
    text = unreadable(tmp_path, "lagrangebench")
    assert text.startswith("train, 00002")
    assert re.search(message, text), text


@pytest.mark.parametrize("content", ["truncated", "text", "empty"])
def test_a_damaged_hdf5_file(tmp_path: Path, content: str) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(), np.zeros(20, int))])
    data = path.read_bytes()
    path.write_bytes({"truncated": data[: len(data) // 2], "text": b"hello", "empty": b""}[content])
    refused(tmp_path, "lagrangebench", "train.h5: .*not a readable HDF5 file")


def test_damage_within_an_array(tmp_path: Path) -> None:
    sources.lagrangebench_metadata(tmp_path / "raw")
    path = tmp_path / "raw" / "train.h5"
    sources.lagrangebench_h5(path, [(motion(seed=k), np.zeros(20, int)) for k in range(4)])
    with h5py.File(path) as file:
        info = file["00001/position"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[info.byte_offset + 20 : info.byte_offset + 60] = b"\x55" * 40
    path.write_bytes(data)
    assert "train, 00001: 'position' is damaged" in unreadable(tmp_path, "lagrangebench")


# --- archives ------------------------------------------------------------------------------------------------------------------------------


class Payload:
    """Object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("packed", [False, True])
def test_pickles_are_not_opened_unless_asked_for(tmp_path: Path, packed: bool) -> None:
    trace = tmp_path / "trace"
    sources.gns_metadata(tmp_path / "raw", motion())
    array = np.empty(2, dtype=object)
    array[:] = [Payload(trace), WATER]
    named: dict[str, Any] = {"gns_data" if packed else "simulation_trajectory_0": array}
    np.savez(tmp_path / "raw" / "train.npz", **named)
    refused(tmp_path, "gns", "is an array of Python objects, a pickle, which can run any code.*allow_pickle=true")
    assert not trace.exists()
    with pytest.raises(ImportFailure, match="no (training )?trajectory can be used"):
        convert(tmp_path, "gns", allow_pickle=True)
    assert trace.exists()  # the payload works


def test_pickles_in_own_arrays_are_never_opened(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    array = np.empty(1, dtype=object)
    array[0] = Payload(tmp_path / "trace")
    np.savez(tmp_path / "raw" / "a.npz", pos=array, frame_dt=DT, materials="sand", params_sand=30.0)
    refused(tmp_path, "arrays", "'pos' is an array of Python objects", allow_pickle=True)
    assert not (tmp_path / "trace").exists()


def headed(text: str) -> bytes:
    """Return an array file with a given header and four bytes of data."""
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode() + b"\0" * 4


def npy(shape: tuple[int, ...], data: bytes, dtype: str = "<f4") -> bytes:
    """Return an array file that claims a shape and has other data."""
    header = repr({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    ("member", "message"),
    [
        (npy((10**6, 10**6, 2), b"\0" * 64), r"'pos' claims float32\[1000000, 1000000, 2\], 8000000000000 bytes; the archive has 64"),
        (npy((3,), b"\0" * 12)[:-6], "'pos' claims"),
        (b"hello", "'pos' is damaged"),
        (b"\x93NUMPY\x07\x00" + b"\0" * 100, "has version"),
        (npy((4,), b"ab" * 4, "<U1"), "'pos' claims <U1"),
        (headed("(" * 5000), r"'pos' is damaged \(header: "),
        (headed("{'descr': [" + "(" * 50 + "], 'fortran_order': False, 'shape': (1,)}"), r"'pos' is damaged \(header: "),
        (headed("{'descr': '<f4', 'fortran_order': False, 'shape': (True,)}"), r"'pos' is damaged \(header: its shape is \(True,\)"),
        (headed("{'descr': '<f4', 'fortran_order': False, 'shape': (-1, -1)}"), r"'pos' is damaged \(header: its shape is \(-1, -1\)"),
        (headed("-" * 9000 + "1"), r"'pos' is damaged \(header: "),
    ],
)
def test_an_array_file_that_lies(tmp_path: Path, member: bytes, message: str) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(2):
        np.savez(tmp_path / "raw" / f"{k}.npz", pos=motion(seed=k), frame_dt=DT, materials="sand", params_sand=30.0)
    with np.load(tmp_path / "raw" / "0.npz") as arrays:
        others = {name: arrays[name] for name in arrays if name != "pos"}
    np.savez(tmp_path / "raw" / "2.npz", **others)
    with zipfile.ZipFile(tmp_path / "raw" / "2.npz", "a") as archive:
        archive.writestr("pos.npy", member)
    text = unreadable(tmp_path, "arrays")
    assert text.startswith("train, 2.npz: ")
    assert re.search(message, text), text


def test_an_archive_compressed_in_another_way(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    with zipfile.ZipFile(tmp_path / "raw" / "a.npz", "w", zipfile.ZIP_LZMA) as archive:
        for name in ("pos", "frame_dt", "materials", "params_sand"):
            archive.writestr(f"{name}.npy", npy((), b"\0" * 4))
    refused(tmp_path, "arrays", "is compressed in another way than NumPy does")


@pytest.mark.slow
def test_an_archive_that_blows_up(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    with zipfile.ZipFile(tmp_path / "raw" / "a.npz", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("pos.npy", npy((10**7,), b"\0" * 4 * 10**7))
        for name in ("frame_dt", "materials", "params_sand"):
            archive.writestr(f"{name}.npy", npy((), b"\0" * 4))
    refused(tmp_path, "arrays", "'pos' claims 40000128 bytes, the archive holds ")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pos": motion()[0]}, r"pos: has shape \[20, 2\], expected \[frame, node, dim\]"),
        ({"pos": np.full((5, 4, 2), np.inf)}, "frame 0: pos: frame 0, node 0 is inf"),
        ({"frame_dt": [0.1, 0.2]}, r"frame_dt has shape \[2\], expected one number"),
        ({"frame_dt": -0.1}, "frame_dt=-0.1: must be a positive number of seconds"),
        ({"materials": "mud"}, "materials: node 0 is 'mud'; known: sand"),
        ({"materials": 3}, "materials is int64, expected text"),
        ({"params_sand": np.ones(3)}, r"params\['sand'\]: has shape \[3\], expected \[node 20\]"),
        ({"params_sand": np.nan}, r"params\['sand'\]: node 0 is nan"),
        ({"params_snow": 5.0}, "params: has sand, snow, needs sand"),
        ({"positions": motion()}, "has an unknown key 'positions'; keys are params_MATERIAL, params_MATERIAL_NAME, cells_KIND, pos"),
        ({"periodic": [True, False]}, "a periodic axis needs bounds"),
        ({"boundary_normal": [[0, 1]]}, "has boundary arrays but no 'boundary_pos'"),
        ({"boundary_pos": [[0, 1]], "boundary_normal": [[0, 0]]}, "boundary normal: boundary_node 0 has length 0"),
        ({"cells": [[0, 1, 2]]}, "cell 0 has nodes of sand"),
        ({"cells_pentagon": [[0, 1, 2, 3, 4]]}, "cells: unknown kind 'pentagon'; in 2D there are line, triangle, quadrilateral"),
        ({"cells_tetrahedron": [[0, 1, 2, 3]]}, "cells: unknown kind 'tetrahedron'; in 2D there are line, triangle, quadrilateral"),
        ({"cells_quadrilateral": [[0, 1, 2, 2]]}, r"cell 0 has the nodes \[0, 1, 2, 2\]; they must be different ones"),
    ],
)
def test_own_arrays_that_do_not_fit(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "raw").mkdir()
    for k in range(4):
        values: dict[str, Any] = {"pos": motion(seed=k), "frame_dt": DT, "materials": "sand", "params_sand": 30.0}
        np.savez(tmp_path / "raw" / f"{k}.npz", **(values | changes if k == 3 else values))
    text = unreadable(tmp_path, "arrays")
    assert text.startswith("train, 3.npz")
    assert re.search(message, text), text
