"""Headers of foreign arrays are text with any content."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import h5py
import pytest

from gpe_pl.benchmarks.faults.side_files import raw_arrays
from gpe_pl.data.importers import hdf5, npz
from gpe_pl.data.importers.source import ImportFailure, Refusal
from gpe_pl.files import hdf5_arrays
from tests.refusals import convert, only_refusal

HEADERS = {
    "brackets": "[" * 9000,
    "signs": "-" * 9000 + "1",
    "nested tables": "{1:" * 3000 + "1" + "}" * 3000,
    "sums": "1" + "+1" * 4000,
    "digits": "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "9" * 5000 + ",)}",
    "a large shape": "{'descr': '<f4', 'fortran_order': False, 'shape': (" + "9" * 4000 + ", 0)}",
    "a shape of strings": "{'descr': '<f4', 'fortran_order': False, 'shape': ('a',)}",
    "a negative shape": "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}",
    "a nested type": "{'descr': " + "[('a', " * 300 + "'<f4'" + ")]" * 300 + ", 'fortran_order': False, 'shape': (1,)}",
    "no type": "{'descr': 5, 'fortran_order': False, 'shape': (1,)}",
    "a set": "{1, 2}",
    "an open string": "{'descr",
    "nothing": "",
}


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("what", HEADERS)
def test_a_header_that_is_none_is_a_refusal(tmp_path: Path, what: str, version: int) -> None:
    header = HEADERS[what].encode()
    size = struct.pack("<H" if version == 1 else "<I", len(header))
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pos.npy", b"\x93NUMPY" + bytes([version, 0]) + size + header)
    with pytest.raises(Refusal, match="'pos'") as refused:
        npz.read(path, "pos")
    assert len(str(refused.value)) < 5000


def test_a_directory_of_very_many_arrays_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "MAX_TRAJECTORIES", 10)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for k in range(11):
            archive.writestr(f"{k}.npy", b"")
    with pytest.raises(ImportFailure, match="holds 11 arrays, at most 10"):
        npz.names(tmp_path / "a.npz")
    monkeypatch.setattr(npz, "MAX_TRAJECTORIES", 11)
    assert len(npz.names(tmp_path / "a.npz")) == 11


def test_a_file_of_very_many_groups_is_not_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5, "MAX_TRAJECTORIES", 2)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for k in range(3):
            file.create_group(str(k))
    with pytest.raises(ImportFailure, match="holds 3 groups"):
        hdf5.groups(tmp_path / "a.h5")


def packed(path: Path, name: str, shape: str, size: int, dtype: str = "<f4") -> None:
    """Return an archive of one array of zeros, compressed to a thousandth."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}}}".encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        file.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        for _ in range(size // 2**24):
            file.write(bytes(2**24))


def test_an_array_that_unpacks_to_far_more_than_is_stored_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    packed(tmp_path / "a.npz", "pos", f"({2**22},)", 2**24)
    assert npz.read(tmp_path / "a.npz", "pos").shape == (2**22,)  # constants are fine where they are few
    monkeypatch.setattr(hdf5_arrays, "SPARE_UNPACKED", 2**20)  # half a gigabyte takes seconds to pack
    with pytest.raises(Refusal, match=rf"'pos' unpacks to {2**24 + 71} bytes from \d+, at most \d+ are read; write it with numpy.savez"):
        npz.read(tmp_path / "a.npz", "pos")


@pytest.mark.slow
@pytest.mark.parametrize(("key", "dtype"), [("frame_dt", "<f4"), ("materials", "<U1"), ("params_fluid", "<f4"), ("bounds", "<f4")])
def test_values_for_more_nodes_than_there_are_are_not_read(tmp_path: Path, key: str, dtype: str) -> None:
    raw_arrays(tmp_path / "raw")
    path = tmp_path / "raw" / "train" / "00.npz"
    packed(tmp_path / "large.npz", key, f"({2**22},)", 2**24, dtype)
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist() if name != f"{key}.npy"}
    with zipfile.ZipFile(tmp_path / "large.npz") as large, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {f"{key}.npy": large.read(f"{key}.npy"), **parts}.items():
            archive.writestr(name, content)
    report = convert(tmp_path, "arrays")
    assert f"{key}: has shape [4194304], at most 20 values are expected" in only_refusal(report)
