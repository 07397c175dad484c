"""Printable forms of text from files and command lines. Names in a hostile file must not control the terminal or imitate another message."""

from __future__ import annotations

import difflib
import io
import logging
import sys
import traceback
import warnings
from collections.abc import Iterable
from types import TracebackType

LONGEST = 4000
"""Longest message that is shown in full [characters]. A name can have tens of thousands."""


def printable(text: str) -> str:
    """Replace control characters, text directions, line ends and other characters that are not printable by escapes.

    Bytes of file names that Python could not decode are read as UTF-8 where they are valid UTF-8.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in _decoded(text))


def one_line(text: str, longest: int = LONGEST) -> str:
    """Return a message as one line of printable text.

    Line ends and tabs become spaces, empty lines are dropped, and other characters that are not printable become escapes. The middle of a message with more
    than ``longest`` characters is left out.
    """
    if len(text) > longest:
        head, tail = text[: longest * 3 // 4], text[-(longest // 4) :]
        text = f"{head} … ({len(text) - len(head) - len(tail)} characters) … {tail}"
    return printable(" ".join(part for line in _decoded(text).splitlines() if (part := line.strip())).replace("\t", " "))


def _decoded(text: str) -> str:
    """Decode bytes of file names that Python could not decode: as UTF-8 where they are valid UTF-8, else as escapes."""
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # the text is not a file name
        return text


class LogRecord(logging.LogRecord):
    """Log record whose message is one line of printable text."""

    def getMessage(self) -> str:
        return one_line(super().getMessage())


def speak_utf8() -> None:
    """Print UTF-8 from now on, whatever the locale. Characters that cannot be encoded become escapes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def clean_messages() -> None:
    """Make every log message and warning one line from now on, whatever handler writes it, and make tracebacks printable.

    A line that cannot be written to a log file, for example on a full disk, is lost. By default ``logging`` would print a traceback for each.
    """
    logging.raiseExceptions = False
    logging.setLogRecordFactory(LogRecord)
    warnings.formatwarning = _one_line_warning
    sys.excepthook = _print_traceback


def _one_line_warning(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    return one_line(f"{filename}:{lineno}: {category.__name__}: {message}") + "\n"


def _print_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    for line in "".join(traceback.format_exception(kind, error, trace)).split("\n"):
        print(printable(line), file=sys.stderr)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``; did you mean 'x'?`` with the known word that is most similar to one that is not known; an empty string if none is similar."""
    by_lower = {str(each).lower(): str(each) for each in known}
    swapped = [each for each in by_lower if sorted(each) == sorted(word.lower())]
    close = swapped or difflib.get_close_matches(word.lower(), by_lower, n=1, cutoff=0.6)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""
