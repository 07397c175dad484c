"""Safe reading of untrusted HDF5 files.

An array is read only if it lies inside the file, and if reading needs little more memory and time than its size suggests.

HDF5 takes chunk shapes and filters from the file and always unpacks whole chunks. A small file can therefore unpack to gigabytes.
"""

from __future__ import annotations

import math
from typing import Any

import h5py

from gpe_pl.files.json_text import MAX_CHARACTERS

LARGEST_DEFLATE_RATIO = 1032
"""Largest compression ratio of deflate (RFC 1951: two bits encode 258 bytes)."""
LARGEST_RATIO, SPARE_UNPACKED = 64, 2**29
"""An array may unpack to ``LARGEST_RATIO`` times its stored bytes plus ``SPARE_UNPACKED`` bytes. Without this limit, megabytes of compressed constants would
become gigabytes in memory."""

FILTERS = {
    h5py.h5z.FILTER_DEFLATE: "gzip",
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_FLETCHER32: "fletcher32",
    h5py.h5z.FILTER_LZF: "lzf",
}
"""Accepted filters. Each unpacks to at most ``LARGEST_DEFLATE_RATIO`` times the stored bytes. HDF5 would load programs for unknown filters."""

SPARE_BYTES = 2**24
"""Bytes that chunks may take beyond eight times their array. Chunks of a growing array are larger than the array at first."""
SPARE_CHUNKS = 2**17
"""Number of chunks that an array of any size may have."""
BYTES_PER_CHUNK = 2**10
"""Minimum mean size of all chunks beyond ``SPARE_CHUNKS`` [bytes]. Finding smaller chunks takes longer than reading them."""


def dataset_in(group: h5py.Group, name: str) -> h5py.Dataset | None:
    """Return the array ``name`` if the file itself holds it, else None. Links are not followed, because they could lead into another file."""
    found = group[name] if is_own(group, name) else None
    return found if isinstance(found, h5py.Dataset) and not found.is_virtual and not found.external else None


def is_own(group: h5py.Group, name: str) -> bool:
    """Whether ``name`` exists in the file itself; False for soft and external links."""
    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def is_named(group: h5py.Group, name: str) -> bool:
    """Whether ``name`` exists, as an object or as a link. The operator ``in`` would open the file that a link leads to."""
    return group.get(name, getlink=True) is not None


def attribute(owner: h5py.HLObject, name: str) -> Any:
    """Return an attribute that is one integer or one text of fixed length (as bytes), else None.

    Other types may refer to any place in the file. None is also returned for texts longer than ``MAX_CHARACTERS``.
    """
    if name not in owner.attrs:
        return None
    stored = owner.attrs.get_id(name)
    return owner.attrs[name] if stored.shape == () and stored.dtype.kind in "iuS" and stored.dtype.itemsize <= MAX_CHARACTERS else None


def most_unpacked(stored: int) -> int:
    """Return the maximum number of bytes that ``stored`` bytes may unpack to."""
    return min(stored * LARGEST_DEFLATE_RATIO, stored * LARGEST_RATIO + SPARE_UNPACKED)


def obstacle(dataset: h5py.Dataset) -> str | None:
    """Return why reading an array would take too much memory or time, or None if it is safe to read."""
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
    # A stored chunk may unpack to more than a chunk holds. The part of a chunk beyond the array's edge is constant and compresses well.
    if filters and stored > 1.05 * size + unpacked / 128 + 64 * count + 4096:
        return f"holds {size} bytes, for which {stored} bytes are stored: too many for its filters"
    return None


def _filters(dataset: h5py.Dataset) -> list[tuple[int, str]]:
    """Return code and name of each filter of an array."""
    properties = dataset.id.get_create_plist()
    found: list[tuple[int, Any, Any, bytes]] = [properties.get_filter(k) for k in range(properties.get_nfilters())]
    return [(code, FILTERS.get(code) or f"{name.decode('utf-8', 'replace')[:40] or 'unknown'} ({code})") for code, _, _, name in found]
