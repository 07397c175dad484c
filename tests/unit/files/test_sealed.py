"""The project's internal files read back unchanged, or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpe_pl.files import json_text, sealed
from gpe_pl.files.sealed import SealError

VALUES = {"a": 1, "b": [0.1, -2e-300, "größe"], "c": {"d": None, "e": True}}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    sealed.write(path, VALUES)
    assert sealed.read(path, "x") == VALUES
    sealed.write(path, json.loads(path.read_text(encoding="utf-8")))  # again, with its seal
    assert sealed.read(path, "x") == VALUES
    with pytest.raises(ValueError, match="not JSON compliant"):
        sealed.write(path, {"a": float("nan")})
    assert sealed.read(path, "x") == VALUES


@given(st.data())
def test_every_changed_character_is_seen(data: st.DataObject) -> None:
    text = json.dumps(sealed.sealed(VALUES))
    place = data.draw(st.integers(0, len(text) - 1))
    changed = text[:place] + data.draw(st.sampled_from('0123456789abefnu.-e"[]{}, ')) + text[place + 1 :]
    try:
        found = json_text.parsed(changed)
        seal = found.pop(sealed.SEAL)
    except (ValueError, KeyError, TypeError, AttributeError):
        return
    assert seal != sealed.checksum(found) or found == VALUES


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "unreadable"),
        (b"\xff", "unreadable"),
        (b"[" * 10**6, "nested deeper than 64"),
        (b"[" * 100 + b"]" * 100, "nested deeper than 64"),
        (b'{"a":' * 70 + b"1" + b"}" * 70, "nested deeper than 64"),
        (b"1" * 10**5, "integer of 100000 digits"),
        (b"[-123456789012345678901]", "integer of 21 digits"),
        (b"[NaN]", "not JSON compliant"),
        (b"[-Infinity]", "not JSON compliant"),
        (b"[1e400]", "not JSON compliant"),
        (b"[1]", "holds no table"),
        (b'{"a": 1}', "has no checksum"),
        (b'{"a": 1, "sha256": "0"}', "was changed or damaged since it was written"),
        (b" " * (sealed.MOST_BYTES + 1), "larger than"),
    ],
)
def test_a_file_that_was_not_written_so_is_named_in_one_line(tmp_path: Path, content: bytes, what: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(SealError, match=rf"a\.json: .*{what}.*; do this$") as refused:
        sealed.read(path, "do this")
    assert len(str(refused.value)) < 400
