"""JSON files with a checksum, for tables that only this package writes and reads.

A file contains a table. Its key ``sha256`` is the checksum of the other keys, so every changed digit is detected. Reading checks size, depth and numbers before
any value is used. A damaged or hostile file raises ``SealError`` with a one-line message.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from gpe_pl.errors import GpeError
from gpe_pl.files import json_text, regular_files
from gpe_pl.files.atomic import replace_text

SEAL = "sha256"
MOST_BYTES = 2**22
"""Maximum size of a file [bytes]. The largest table of the project has some tens of thousands."""


class SealError(GpeError, ValueError):
    """Raised for a file that is not JSON within the limits, or was changed after it was written; the message names it and says what to do."""


def write(path: Path, values: dict[str, Any]) -> None:
    """Write a table with its checksum.

    Raises:
        ValueError: a number is not finite.
    """
    replace_text(path, json.dumps(sealed(values), indent=1, sort_keys=True, allow_nan=False) + "\n")


def sealed(values: dict[str, Any]) -> dict[str, Any]:
    """Return a table with its checksum, which replaces an existing one."""
    own = {key: value for key, value in values.items() if key != SEAL}
    return {**own, SEAL: checksum(own)}


def checksum(values: dict[str, Any]) -> str:
    """Return the SHA-256 of values, independent of the order of their keys."""
    plain = json.loads(json.dumps(values, allow_nan=False))  # keys become text, so that they can be sorted
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def read(path: Path, advice: str) -> dict[str, Any]:
    """Read a table and check its checksum, which is not returned.

    Args:
        path: path of the file.
        advice: what to do if the file is damaged; becomes part of the message.

    Raises:
        SealError: the file was not written by ``write``, or was changed since.
        OSError: the file cannot be read.
    """
    values = parsed(path, advice)
    if not isinstance(values, dict):
        raise SealError(f"{path}: holds no table of settings; {advice}")
    seal = values.pop(SEAL, None)
    if seal is None:
        raise SealError(f"{path}: has no checksum, so it was not written by this package, or was changed; {advice}")
    if seal != checksum(values):
        raise SealError(f"{path}: was changed or damaged since it was written (checksum mismatch); {advice}")
    return values


def parsed(path: Path, advice: str) -> Any:
    """Read a JSON file with limited size and depth and only finite numbers.

    Raises:
        SealError: the file is not regular, is not JSON, or breaks a limit.
        OSError: the file cannot be read.
    """
    try:
        regular_files.check(path)
    except OSError as error:
        raise SealError(f"{path}: {error.strerror}; {advice}") from None
    with open(path, "rb") as file:
        content = file.read(MOST_BYTES + 1)
    try:
        if len(content) > MOST_BYTES:
            raise ValueError(f"larger than {MOST_BYTES} bytes")
        value = json_text.parsed(content)
        json.dumps(value, allow_nan=False)
    except ValueError as error:
        raise SealError(f"{path}: unreadable ({error}); {advice}") from None
    return value
