"""TFRecord files and the protocol buffers in them, read without TensorFlow.

A record is a length n (uint64, little-endian), a checksum of these 8 bytes, n bytes of data, and a checksum of the data. A checksum is the CRC-32C c
(Castagnoli) as ``((c >> 15) | (c << 17)) + 0xa282ead8`` modulo 2³². The data are an ``Example`` (named features) or a ``SequenceExample`` (named features,
and named lists of features with one entry per frame), where a feature is a list of byte strings, floats or integers.

Sources: TensorFlow, "TFRecord and tf.train.Example" (guide) and tensorflow/core/example/{example,feature}.proto; RFC 3720, appendix B.4, for the CRC;
"Encoding", the wire format of Protocol Buffers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from numba import njit

from gpe_pl.data.importers.source import ImportFailure, Refusal

Feature = list[bytes] | np.ndarray
"""Byte strings, or numbers as float32 or int64."""

_POLYNOMIAL = 0x82F63B78  # Castagnoli, bits reversed
_MASK = 0xA282EAD8
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def _table() -> np.ndarray:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ np.uint32(_POLYNOMIAL), table >> 1)
    return table


_TABLE = _table()


@njit(cache=True)
@no_type_check
def _crc32c(data, table):
    crc = np.uint32(0xFFFFFFFF)
    for k in range(data.size):
        crc = table[(crc ^ data[k]) & np.uint32(0xFF)] ^ (crc >> np.uint32(8))
    return crc ^ np.uint32(0xFFFFFFFF)


def masked_crc(data: bytes) -> int:
    """Checksum of a record's length or data."""
    crc = int(_crc32c(np.frombuffer(data, np.uint8), _TABLE))
    return ((crc >> 15 | crc << 17) + _MASK) & 0xFFFFFFFF


@dataclass(frozen=True)
class Record:
    """Where a record's data lie; ``fault`` says why it and all that follows cannot be read."""

    path: Path
    start: int
    size: int
    fault: str = ""

    def read(self) -> bytes:
        """The data; raises ``Refusal`` where they do not match their checksum."""
        if self.fault:
            raise Refusal(self.fault)
        with open(self.path, "rb") as file:
            file.seek(self.start)
            data, crc = file.read(self.size), file.read(4)
        if struct.pack("<I", masked_crc(data)) != crc:
            raise Refusal(f"checksum of the {self.size} bytes from {self.start} on does not match (CRC-32C)")
        return data


def records(path: Path) -> list[Record]:
    """All records of a file. Where its structure breaks, the last one says so; what comes after cannot be found."""
    try:
        total = path.stat().st_size
        found = []
        with open(path, "rb") as file:
            start = 0
            while start < total:
                head = file.read(12)
                if len(head) < 12:
                    found.append(Record(path, start, 0, f"the file ends within the head of a record at {start}: truncated"))
                    break
                (size,) = struct.unpack("<Q", head[:8])
                if struct.pack("<I", masked_crc(head[:8])) != head[8:]:
                    found.append(
                        Record(
                            path, start, 0, f"checksum of the length at {start} does not match (CRC-32C), so nothing after it can be found"
                        )
                    )
                    break
                if start + 12 + size + 4 > total:
                    left = total - start - 12
                    found.append(
                        Record(path, start, 0, f"the record at {start} has {size} bytes of data, the file has {left} left: truncated")
                    )
                    break
                found.append(Record(path, start + 12, size))
                start += 12 + size + 4
                file.seek(start)
    except OSError as error:
        raise ImportFailure(f"{path}: cannot be read ({error.strerror})") from None
    return found


# --- protocol buffers ----------------------------------------------------------------------------------------------------------------------


def example(data: bytes) -> dict[str, Feature]:
    """Features of an ``Example`` by name; raises ``Refusal``."""
    return _features(_only(memoryview(data), 1))


def sequence_example(data: bytes) -> tuple[dict[str, Feature], dict[str, list[Feature]]]:
    """Context features, and lists of features with an entry per frame, of a ``SequenceExample``; raises ``Refusal``."""
    message = memoryview(data)
    lists: dict[str, list[Feature]] = {}
    for number, value in _fields(_only(message, 2)):
        if number == 1:
            name, entries = _entry(value)
            lists[name] = [_feature(entry) for n, entry in _fields(entries) if n == 1]
    return _features(_only(message, 1)), lists


def _features(message: memoryview) -> dict[str, Feature]:
    found = {}
    for number, value in _fields(message):
        if number == 1:
            name, feature = _entry(value)
            found[name] = _feature(feature)
    return found


def _entry(message: Any) -> tuple[str, memoryview]:
    """Key and value of an entry of a map."""
    parts = dict(_fields(message))
    key, value = parts.get(1, memoryview(b"")), parts.get(2, memoryview(b""))
    if not isinstance(key, memoryview) or not isinstance(value, memoryview):
        raise Refusal("not an Example: an entry of a map has no name or value")
    return bytes(key).decode("utf-8", "replace"), value


def _feature(message: Any) -> Feature:
    for kind, values in _fields(message):
        if kind == 1:
            return [bytes(value) for number, value in _fields(values) if number == 1 and isinstance(value, memoryview)]
        if kind == 2:
            parts = [value for number, value in _fields(values, packed=True) if number == 1]
            return np.frombuffer(b"".join(bytes(part) for part in parts), "<f4")
        if kind == 3:
            integers: list[int] = []
            for number, value in _fields(values):
                if number == 1:
                    integers += list(_varints(value)) if isinstance(value, memoryview) else [value]
            return np.array([n - 2**64 if n >= 2**63 else n for n in integers], np.int64)
    return []


def _only(message: memoryview, wanted: int) -> memoryview:
    """The message in a field; empty where there is none."""
    for number, value in _fields(message):
        if number == wanted:
            if not isinstance(value, memoryview):
                break
            return value
    return memoryview(b"")


def _fields(message: Any, packed: bool = False) -> Iterator[tuple[int, Any]]:
    """Numbers and values of a message's fields: integers, or bytes; those of 4 bytes too if ``packed``."""
    if not isinstance(message, memoryview):
        raise Refusal("not a protocol buffer: a number where a message should be")
    place = 0
    while place < len(message):
        key, place = _varint(message, place)
        number, wire = key >> 3, key & 7
        if wire == _VARINT:
            value, place = _varint(message, place)
            yield number, value
            continue
        if wire == _BYTES:
            size, place = _varint(message, place)
        elif wire in (_FIXED64, _FIXED32):
            size = 8 if wire == _FIXED64 else 4
        else:
            raise Refusal(f"not a protocol buffer: wire type {wire} at byte {place}")
        if place + size > len(message):
            raise Refusal(f"not a protocol buffer: a field of {size} bytes where {len(message) - place} are left")
        if wire == _BYTES or packed:
            yield number, message[place : place + size]
        place += size


def _varint(message: memoryview, place: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            raise Refusal("not a protocol buffer: it ends within a number")
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, place
    raise Refusal("not a protocol buffer: a number of more than 10 bytes")


def _varints(message: memoryview) -> Iterator[int]:
    place = 0
    while place < len(message):
        value, place = _varint(message, place)
        yield value
