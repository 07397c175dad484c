"""Reading of TFRecord files and the protocol buffers in them, without TensorFlow.

A record is a length n (uint64, little-endian), a checksum of these 8 bytes, n bytes of data, and a checksum of the data. A checksum is the CRC-32C c
(Castagnoli) as ``((c >> 15) | (c << 17)) + 0xa282ead8`` modulo 2³². The data are an ``Example`` (named features) or a ``SequenceExample`` (named features,
and named lists of features with one entry per frame). A feature is a list of byte strings, floats or integers.

Sources: TensorFlow, "TFRecord and tf.train.Example" (guide) and tensorflow/core/example/{example,feature}.proto; RFC 3720, appendix B.4, for the CRC;
"Encoding", the wire format of Protocol Buffers.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from gpe_pl.data.importers.source import MAX_TRAJECTORIES, ImportFailure, Refusal
from gpe_pl.files import regular_files

Feature = list[bytes] | np.ndarray
"""A feature's values: byte strings, or numbers as float32 or int64."""

_POLYNOMIAL = 0x82F63B78  # Castagnoli, bits reversed
_MASK = 0xA282EAD8
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5

MAX_NAMES = 128
"""Maximum number of features of an ``Example``. The supported formats have fewer than ten."""
MAX_STRINGS = 1024
"""Maximum number of strings in one feature. The features that are used have one."""
MAX_FIELDS = 2**22
"""Maximum number of fields with one number in a message, such as frames."""

_ENDS, _LONG, _WIRE, _SIZE, _MANY = range(1, 6)
FAULTS = {
    _ENDS: "it ends within a number",
    _LONG: "a number of more than 10 bytes",
    _WIRE: "wire type {what} at byte {place}",
    _SIZE: "a field of {what} bytes where {place} are left",
    _MANY: f"{{what}} fields of one kind, at most {MAX_FIELDS} are read",
}


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
    """Return the checksum of a record's length or data."""
    crc = int(_crc32c(np.frombuffer(data, np.uint8), _TABLE))
    return ((crc >> 15 | crc << 17) + _MASK) & 0xFFFFFFFF


@dataclass(frozen=True)
class Record:
    """The place of a record's data.

    Attributes:
        path: file.
        start: position of the data in the file [bytes].
        size: size of the data [bytes].
        fault: reason why this record and all later ones cannot be read; empty if it can be read.
    """

    path: Path
    start: int
    size: int
    fault: str = ""

    def read(self) -> bytes:
        """Read the data; raises ``Refusal`` if the record has a ``fault``, or if the data do not match their checksum."""
        if self.fault:
            raise Refusal(self.fault)
        with open(self.path, "rb") as file:
            file.seek(self.start)
            data, crc = file.read(self.size), file.read(4)
        if struct.pack("<I", masked_crc(data)) != crc:
            raise Refusal(f"checksum of the {self.size} bytes from {self.start} on does not match (CRC-32C)")
        return data


def records(path: Path) -> list[Record]:
    """Find all records of a file. If the structure of the file is damaged, the last record found has a ``fault``.

    Raises:
        ImportFailure: the file cannot be read, or has too many records.
    """
    try:
        regular_files.check(path)
        total = path.stat().st_size
        found: list[Record] = []
        with open(path, "rb") as file:
            start = 0
            while start < total:
                if len(found) == MAX_TRAJECTORIES:
                    raise ImportFailure(f"{path}: holds more than {MAX_TRAJECTORIES} records; each trajectory should be one record")
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


@dataclass(frozen=True)
class _Message:
    """A protocol buffer message: the bytes ``start`` to ``stop`` of a record's data."""

    data: np.ndarray
    start: int
    stop: int

    def fields(self, number: int) -> np.ndarray:
        """Return wire type, start and size of each field [field, 3] with this number. An integer field has its value instead of the size.

        Raises:
            Refusal: the message is damaged.
        """
        rows, fault, detail = _fields(self.data, self.start, self.stop, number)
        if fault:
            what, place = (int(value) for value in detail)
            raise Refusal(f"not a protocol buffer: {FAULTS[fault].format(what=what % 2**64, place=place)}")
        return rows

    def messages(self, number: int) -> Iterator[_Message]:
        """Yield the messages in the fields with this number."""
        for wire, start, size in self.fields(number).tolist():
            if wire != _BYTES:
                raise Refusal("not a protocol buffer: a number where a message should be")
            yield _Message(self.data, start, start + size)

    def only(self, number: int) -> _Message:
        """Return the message in the first field with this number; empty if there is none."""
        return next(self.messages(number), _Message(self.data, 0, 0))

    def content(self) -> bytes:
        return self.data[self.start : self.stop].tobytes()

    def named(self) -> dict[str, _Message]:
        """Return the values of a map by their keys."""
        if (count := len(self.fields(1))) > MAX_NAMES:
            raise Refusal(f"holds {count} features, at most {MAX_NAMES} are read")
        entries = [(entry.alone(1).content(), entry.alone(2)) for entry in self.messages(1)]
        return {key.decode("utf-8", "replace"): value for key, value in entries}

    def alone(self, number: int) -> _Message:
        """Return the message in the only field with this number; empty if there is none. Several fields raise ``Refusal``."""
        if len(self.fields(number)) > 1:
            raise Refusal("not an Example: an entry of a map has several names or values")
        return self.only(number)

    def feature(self) -> Feature:
        for kind in (1, 2, 3):
            for values in self.messages(kind):
                rows = values.fields(1)
                if kind == 1:
                    if len(rows) > MAX_STRINGS:
                        raise Refusal(f"a feature holds {len(rows)} strings, at most {MAX_STRINGS} are read")
                    return [string.content() for string in values.messages(1)]
                if kind == 2:
                    return np.frombuffer(_joined(self.data, rows[rows[:, 0] != _VARINT]).tobytes(), "<f4")
                integers, is_whole = _integers(self.data, rows)
                if not is_whole:
                    raise Refusal("not a protocol buffer: a list of integers ends within a number, or has one of more than 10 bytes")
                return np.asarray(integers)
        return []


class Features(Mapping[str, Feature]):
    """Features by name. A feature is decoded when it is looked up; that raises ``Refusal`` if its data are damaged."""

    def __init__(self, features: _Message) -> None:
        self._named = features.named()

    def __getitem__(self, name: str) -> Feature:
        return self._named[name].feature()

    def __iter__(self) -> Iterator[str]:
        return iter(self._named)

    def __len__(self) -> int:
        return len(self._named)


class Frames:
    """Sequence of one feature per frame. A feature is decoded when it is looked up; that raises ``Refusal`` if its data are damaged."""

    def __init__(self, entries: _Message) -> None:
        self._data, self._rows = entries.data, entries.fields(1)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, frame: int) -> Feature:
        wire, start, size = self._rows[frame].tolist()
        if wire != _BYTES:
            raise Refusal("not a protocol buffer: a number where a message should be", frame)
        return _Message(self._data, start, start + size).feature()

    def __iter__(self) -> Iterator[Feature]:
        return (self[frame] for frame in range(len(self)))

    def strings(self, size: int) -> np.ndarray:
        """Return the bytes [frame, byte] of the leading frames, each of which is a single string of ``size`` bytes."""
        return np.asarray(_strings(self._data, self._rows, size))


def example(data: bytes) -> Features:
    """Return the features of an ``Example`` by name; raises ``Refusal`` on damaged data."""
    return Features(_whole(data).only(1))


def sequence_example(data: bytes) -> tuple[Features, dict[str, Frames]]:
    """Return the context features of a ``SequenceExample``, and its features per frame by name; raises ``Refusal`` on damaged data."""
    message = _whole(data)
    return Features(message.only(1)), {name: Frames(entries) for name, entries in message.only(2).named().items()}


def _whole(data: bytes) -> _Message:
    return _Message(np.frombuffer(data, np.uint8), 0, len(data))


@njit(cache=True)
@no_type_check
def _varint(data, place, stop):
    """Return a value modulo 2⁶⁴ as int64, and the position after it. A negative position is the code of a fault."""
    value = np.int64(0)
    for k in range(10):
        if place >= stop:
            return value, -_ENDS
        byte = np.int64(data[place])
        place += 1
        value |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return value, place
    return value, -_LONG


@njit(cache=True)
@no_type_check
def _field(data, place, stop):
    """Return number, wire type, start, and size or value of a field, and the position after it. A negative position is the code of a fault."""
    key, place = _varint(data, place, stop)
    number, wire, value = (key >> 3) & 0x1FFFFFFFFFFFFFFF, key & 7, np.int64(0)
    if place < 0:
        return number, wire, place, value, place
    if wire == _VARINT:
        start = place
        value, place = _varint(data, place, stop)
        return number, wire, start, value, place
    if wire == _BYTES:
        value, place = _varint(data, place, stop)
        if place < 0:
            return number, wire, place, value, place
    elif wire == _FIXED64:
        value = np.int64(8)
    elif wire == _FIXED32:
        value = np.int64(4)
    else:
        return number, wire, place, wire, -_WIRE
    if value < 0 or value > stop - place:
        return number, wire, stop - place, value, -_SIZE
    return number, wire, place, value, place + value


@njit(cache=True)
@no_type_check
def _fields(data, start, stop, wanted):
    """Return the rows of ``_Message.fields``, the code of a fault (0: none), and the value and position of the fault."""
    count, place = 0, start
    rows, detail = np.empty((0, 3), np.int64), np.zeros(2, np.int64)
    while place < stop:
        number, _, begin, value, place = _field(data, place, stop)
        if place < 0:
            detail[0], detail[1] = value, begin
            return rows, -place, detail
        count += number == wanted
    if count > MAX_FIELDS:
        detail[0] = count
        return rows, _MANY, detail
    rows, count, place = np.empty((count, 3), np.int64), 0, start
    while place < stop:
        number, wire, begin, value, place = _field(data, place, stop)
        if number == wanted:
            rows[count, 0], rows[count, 1], rows[count, 2] = wire, begin, value
            count += 1
    return rows, 0, detail


@njit(cache=True)
@no_type_check
def _joined(data, rows):
    """Return the bytes of fields, one after the other."""
    joined, end = np.empty(rows[:, 2].sum(), np.uint8), 0
    for k in range(len(rows)):
        start, size = rows[k, 1], rows[k, 2]
        field, own = data[start : start + size], joined[end : end + size]
        for n in range(size):
            own[n] = field[n]
        end += size
    return joined


@njit(cache=True)
@no_type_check
def _integers(data, rows):
    """Return the integers in fields, and whether all were complete. A field contains one or several integers."""
    count = 0
    for k in range(len(rows)):
        if rows[k, 0] == _VARINT:
            count += 1
        elif rows[k, 0] == _BYTES:
            for place in range(rows[k, 1], rows[k, 1] + rows[k, 2]):
                count += data[place] < 0x80
    integers, count = np.empty(count, np.int64), 0
    for k in range(len(rows)):
        if rows[k, 0] == _VARINT:
            integers[count] = rows[k, 2]
            count += 1
        elif rows[k, 0] == _BYTES:
            place, stop = rows[k, 1], rows[k, 1] + rows[k, 2]
            while place < stop:
                value, place = _varint(data, place, stop)
                if place < 0:
                    return integers, False
                integers[count] = value
                count += 1
    return integers, True


@njit(cache=True)
@no_type_check
def _strings(data, rows, size):
    """Return the bytes [frame, byte] of the leading frames in fields, each of which is a single string of ``size`` bytes in the usual encoding."""
    starts = np.empty(len(rows), np.int64)
    count = 0
    for k in range(len(rows)):
        stop = rows[k, 1] + rows[k, 2]
        number, wire, start, num_bytes, place = _field(data, rows[k, 1], stop)
        if rows[k, 0] != _BYTES or number != 1 or wire != _BYTES or place != stop:
            break
        number, wire, start, num_bytes, place = _field(data, start, stop)
        if number != 1 or wire != _BYTES or num_bytes != size or place != stop:
            break
        starts[k] = start
        count += 1
    strings = np.empty((count, size), np.uint8)
    for k in range(count):
        own, field = strings[k], data[starts[k] : starts[k] + size]
        for n in range(size):
            own[n] = field[n]
    return strings
