"""Text that may hold what a file or a command line says, as it is shown: names in a hostile file must not steer a terminal, nor look like another message."""

from __future__ import annotations

import io
import logging
import sys
import traceback
import warnings
from types import TracebackType

LONGEST = 4000
"""Characters of a message. Names can have tens of thousands."""


def printable(text: str) -> str:
    """The text with its control characters, text directions, line ends and whatever else is not shown as escapes."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in _decoded(text))


def one_line(text: str, longest: int = LONGEST) -> str:
    """A message as one line: spaces for line ends, escapes for what is not shown, and the middle left out where it is longer than ``longest``."""
    if len(text) > longest:
        head, tail = text[: longest * 3 // 4], text[-(longest // 4) :]
        text = f"{head} … ({len(text) - len(head) - len(tail)} characters) … {tail}"
    return printable(" ".join(part for line in _decoded(text).splitlines() if (part := line.strip())).replace("\t", " "))


def _decoded(text: str) -> str:
    """Names of files that Python has read in another encoding than UTF-8, as UTF-8 where they are."""
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # not from the name of a file
        return text


class LogRecord(logging.LogRecord):
    """A record whose message is one line."""

    def getMessage(self) -> str:
        return one_line(super().getMessage())


def speak_utf8() -> None:
    """What this process prints from now on is UTF-8 whatever the locale, and what cannot be encoded an escape."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")


def clean_messages() -> None:
    """From now on what this process logs and warns of is one line, whatever handler writes it, and the lines of its tracebacks are printable.

    A line that cannot be written to a log file, as on a full disk, is lost; ``logging`` would print a traceback for each.
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
