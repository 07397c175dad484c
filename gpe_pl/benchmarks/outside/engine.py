"""What the modules of other engines share: their error, and the last lines of their output."""

from __future__ import annotations

from gpe_pl.errors import GpeError


class EngineError(GpeError, RuntimeError):
    """Raised when another engine fails; the message has its last lines."""


def last_lines(text: str, count: int = 4) -> str:
    """Return the last lines of a text that are not empty, on one line."""
    return " / ".join([line.strip() for line in text.splitlines() if line.strip()][-count:])
