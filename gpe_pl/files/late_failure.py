"""A file for libraries that crash when writing fails. Data that do not fit on the disk stay in memory, and the error can be raised afterwards."""

from __future__ import annotations

import io
import os
from pathlib import Path


class LateFailure(io.RawIOBase):
    """A new file with random access whose writing never raises.

    Attributes:
        error: the first error of writing, or None; ``check`` raises it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.error: OSError | None = None
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0))
        self._place = self._size = 0
        self._kept: list[tuple[int, bytes]] = []

    def check(self) -> None:
        """Raise the first error of writing, if there was one."""
        if self.error is not None:
            raise self.error

    def write(self, data: object) -> int:
        content = memoryview(data).cast("B")  # type: ignore[arg-type]
        start, self._place = self._place, self._place + len(content)
        self._size = max(self._size, self._place)
        written = 0
        try:
            while self.error is None and written < len(content):
                os.lseek(self._file, start + written, os.SEEK_SET)
                written += os.write(self._file, content[written:])
        except OSError as error:
            self.error = error
        if written < len(content):
            self._kept.append((start + written, bytes(content[written:])))
        return len(content)

    def readinto(self, buffer: object) -> int:
        target = memoryview(buffer).cast("B")  # type: ignore[arg-type]
        count = max(0, min(len(target), self._size - self._place))
        os.lseek(self._file, self._place, os.SEEK_SET)
        stored = os.read(self._file, count)
        target[: len(stored)] = stored
        target[len(stored) : count] = bytes(count - len(stored))
        for start, content in self._kept:
            first, last = max(start, self._place), min(start + len(content), self._place + count)
            if first < last:
                target[first - self._place : last - self._place] = content[first - start : last - start]
        self._place += count
        return count

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._place = offset + (0, self._place, self._size)[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def truncate(self, size: int | None = None) -> int:
        self._size = self._place if size is None else size
        try:
            if self.error is None:
                os.ftruncate(self._file, self._size)
        except OSError as error:
            self.error = error
        return self._size

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def close(self) -> None:
        if not self.closed:
            os.close(self._file)
        super().close()
