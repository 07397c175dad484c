"""JSON files that the project writes for itself: with a checksum, and read within bounds.

A file is a table whose key ``sha256`` holds the digest of the others, so that a digit that is changed is seen. What reads it bounds its size, its depth and
its numbers before it looks at a value: a damaged or hostile file ends in one typed line.
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
"""The largest table of the project has some tens of thousands."""


class SealError(GpeError, ValueError):
    """A file is no JSON within bounds, or not as it was written; the message names it and says what to do."""


def write(path: Path, values: dict[str, Any]) -> None:
    """Write a table with its seal; raises ``ValueError`` for numbers that are not finite."""
    replace_text(path, json.dumps(sealed(values), indent=1, sort_keys=True, allow_nan=False) + "\n")


def sealed(values: dict[str, Any]) -> dict[str, Any]:
    """A table with its seal, in place of one that it has."""
    own = {key: value for key, value in values.items() if key != SEAL}
    return {**own, SEAL: checksum(own)}


def checksum(values: dict[str, Any]) -> str:
    """SHA-256 of values, whatever the order of their keys."""
    plain = json.loads(json.dumps(values, allow_nan=False))  # keys become text, by which they are sorted
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def read(path: Path, advice: str) -> dict[str, Any]:
    """The table in a file, without its seal.

    Args:
        path: of the file.
        advice: what to do where it is damaged, for the message.

    Raises:
        SealError: it is not what ``write`` has written.
        OSError: it cannot be read.
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
    """The value in a JSON file, which has a bounded size and depth and only finite numbers.

    Raises:
        SealError: it is none.
        OSError: it cannot be read.
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
