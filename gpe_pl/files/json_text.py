"""Safe reading of untrusted JSON, with limits on length, depth and integers."""

from __future__ import annotations

import json
from typing import Any

MAX_CHARACTERS = 2**27
MAX_DEPTH = 64
MAX_DIGITS = 20
"""Digits of an integer; a 64-bit integer has no more."""


def parsed(text: str | bytes) -> Any:
    """Parse a JSON text. ``NaN`` and ``Infinity`` are accepted as numbers.

    Raises:
        ValueError: the text is not JSON, is longer than ``MAX_CHARACTERS``, is nested deeper than ``MAX_DEPTH``, or has an integer of more than
            ``MAX_DIGITS`` digits.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError(f"has {len(text)} characters, at most {MAX_CHARACTERS} are read")
    if isinstance(text, bytes):
        text = text.decode(json.detect_encoding(text))
    try:
        values = json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError(f"is nested deeper than {MAX_DEPTH}") from None
    if text.count("[") + text.count("{") > MAX_DEPTH and _depth(values) > MAX_DEPTH:
        raise ValueError(f"is nested deeper than {MAX_DEPTH}")
    return values


def _integer(digits: str) -> int:
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"has an integer of {len(digits.lstrip('-'))} digits, at most {MAX_DIGITS} are read")
    return int(digits)


def _depth(values: Any) -> int:
    """Return how deeply lists and objects are nested; counting stops just above ``MAX_DEPTH``."""
    depth, level = 0, [values]
    while level := [v for v in level if isinstance(v, (list, dict))]:
        depth += 1
        if depth > MAX_DEPTH:
            break
        level = [inner for v in level for inner in (v.values() if isinstance(v, dict) else v)]
    return depth
