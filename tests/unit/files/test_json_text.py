"""JSON from files: texts that would take long to read, or fill a message, are refused."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest

from gpe_pl.files.json_text import MAX_DEPTH, parsed


@pytest.mark.parametrize("values", [{"a": [1, -2.5, None, True, "ü[{"]}, [], 18446744073709551615, [[]] * 1000, "[" * 1000])
def test_what_json_writes_is_read(values: Any) -> None:
    text = json.dumps(values)
    assert parsed(text) == values
    assert parsed(text.encode()) == values


def test_numbers_that_are_none_are_read() -> None:
    """NaN and infinity have a meaning in some fields; the callers check which."""
    assert math.isnan(parsed("NaN")) and parsed("-Infinity") == -math.inf


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "Expecting value"),
        ("{", "Expecting property name"),
        (b"\xff\xfe\xfa", "codec can't decode"),
        ("[" * 100_000, "nested deeper than 64"),
        ('{"a":' * 500 + "1" + "}" * 500, "nested deeper than 64"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "nested deeper than 64"),
        ("[1, -" + "9" * 100_000 + "]", "an integer of 100000 digits"),
        ("1" * 21, "an integer of 21 digits"),
        (" " * (2**27 + 1), "has 134217729 characters"),
    ],
)
def test_what_is_refused(text: str | bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parsed(text)


def test_the_deepest_that_is_read() -> None:
    values: Any = parsed("[" * MAX_DEPTH + "]" * MAX_DEPTH)
    for _ in range(MAX_DEPTH - 1):
        (values,) = values
    assert values == []
