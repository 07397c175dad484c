"""Headers of arrays that others wrote are text, and can hold anything."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import pytest

from gpe_pl.data.importers import npz
from gpe_pl.data.importers.source import Refusal

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
