"""What may be read of an HDF5 file that anyone may have written: its own arrays, if reading them takes about what they hold.

HDF5 takes chunk shapes and filters from the file. A chunk is always unpacked as a whole, so a few numbers can stand for gigabytes.
"""

from __future__ import annotations

import math
from typing import Any

import h5py

from gpe_pl.files.json_text import MAX_CHARACTERS

LARGEST_DEFLATE_RATIO = 1032
"""Deflate cannot compress better than this (RFC 1951: 258 bytes by two bits)."""
LARGEST_RATIO, SPARE_UNPACKED = 64, 2**29
"""What is stored unpacks to no more than so many times its bytes, and so many more: constants in a file of megabytes would be gigabytes in memory."""

FILTERS = {
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
    h5py.h5z.FILTER_LZF: "lzf",
}
"""Filters that are known to unpack no more than ``LARGEST_DEFLATE_RATIO`` times what is stored; others may be programs that HDF5 would load."""

SPARE_BYTES = 2**24
"""That chunks may take beyond a few times their array, which those of a growing array do."""
SPARE_CHUNKS = 2**17
BYTES_PER_CHUNK = 2**10
"""On average, of all chunks beyond ``SPARE_CHUNKS``: to look up smaller ones takes longer than to read them."""


def dataset_in(group: h5py.Group, name: str) -> h5py.Dataset | None:
    """The array of that name which this file itself holds; None where there is something else. Follows no link: it could lead into another file."""
    found = group[name] if is_own(group, name) else None
    return found if isinstance(found, h5py.Dataset) and not found.is_virtual and not found.external else None


def is_own(group: h5py.Group, name: str) -> bool:
    """Whether something of that name lies in the file, rather than a link to elsewhere or nothing."""
    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def is_named(group: h5py.Group, name: str) -> bool:
    """Whether there is something of that name, without following it; ``in`` would open a file that a link leads to."""
    return group.get(name, getlink=True) is not None


def attribute(owner: h5py.HLObject, name: str) -> Any:
    """A number or text (bytes) of fixed length; None where there is something else, which may refer to anywhere in the file, or more than can be meant."""
    if name not in owner.attrs:
        return None
    stored = owner.attrs.get_id(name)
    return owner.attrs[name] if stored.shape == () and stored.dtype.kind in "iuS" and stored.dtype.itemsize <= MAX_CHARACTERS else None


def most_unpacked(stored: int) -> int:
    """Bytes that so many stored ones may unpack to."""
    return min(stored * LARGEST_DEFLATE_RATIO, stored * LARGEST_RATIO + SPARE_UNPACKED)


def obstacle(dataset: h5py.Dataset) -> str | None:
    """Why an array cannot be read without more memory or time than it is worth; None where it can."""
    stored, size = dataset.id.get_storage_size(), dataset.nbytes
    if size > stored * LARGEST_DEFLATE_RATIO or stored > dataset.file.id.get_filesize():
        return f"claims {size} bytes, the file holds {min(stored, dataset.file.id.get_filesize())}"
    if size > most_unpacked(stored):
        return f"unpacks to {size} bytes from {stored}, at most {most_unpacked(stored)} are read; store it without compression"
    filters = _filters(dataset)
    unknown = [name for code, name in filters if code not in FILTERS]
    if unknown or len({code for code, _ in filters}) < len(filters):
        return f"is stored with the filters {', '.join(name for _, name in filters)}; known are {', '.join(FILTERS.values())}, each once"
    if dataset.chunks is None:
        return None
    count = math.prod(-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    unpacked = count * math.prod(dataset.chunks) * dataset.dtype.itemsize
    if unpacked > 8 * size + SPARE_BYTES:
        return f"holds {size} bytes in {count} chunks {list(dataset.chunks)} of {unpacked} bytes in all; store it in smaller chunks"
    if count > SPARE_CHUNKS + size // BYTES_PER_CHUNK:
        return f"holds {size} bytes in {count} chunks {list(dataset.chunks)}; store it in larger chunks"
    # what is beyond the array's edge in a chunk is constant, and compresses well; a stored chunk may unpack to more than a chunk holds
    if filters and stored > 1.05 * size + unpacked / 128 + 64 * count + 4096:
        return f"holds {size} bytes, for which {stored} bytes are stored: too many for its filters"
    return None


def _filters(dataset: h5py.Dataset) -> list[tuple[int, str]]:
    """Code and name of each filter."""
    properties = dataset.id.get_create_plist()
    found: list[tuple[int, Any, Any, bytes]] = [properties.get_filter(k) for k in range(properties.get_nfilters())]
    return [(code, FILTERS.get(code) or f"{name.decode('utf-8', 'replace')[:40] or 'unknown'} ({code})") for code, _, _, name in found]
