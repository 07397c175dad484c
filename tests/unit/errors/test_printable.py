"""Foreign text is shown without effects."""

from __future__ import annotations

import io
import logging
import sys
import warnings

import pytest

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import LONGEST, LogRecord, clean_messages, did_you_mean, one_line, printable
from gpe_pl.files.markdown import table_row
from gpe_pl.trajectory.store import StoreError

HOSTILE = "sand\x1b[2K\rerror: forged\nerror: forged\u202e\u2028\x9b31m"


def test_a_message_is_one_line_that_steers_no_terminal() -> None:
    assert one_line(HOSTILE) == "sand\\x1b[2K error: forged error: forged\\u202e \\x9b31m"
    assert one_line("  two  spaces\n\n  and a\ttab\n") == "two  spaces and a tab"
    assert one_line("Δt = 3 µs, 'größe' 数") == "Δt = 3 µs, 'größe' 数"
    assert printable("a\nb") == "a\\nb"
    assert printable("größe".encode().decode("ascii", "surrogateescape")) == "größe"  # as in an ASCII locale
    assert printable("\udcff \ud800") == "\\udcff \\ud800"


def test_long_messages_lose_their_middle() -> None:
    text = one_line("begin " + "\x1b" * 60_000 + " end", 100)
    assert text.startswith("begin ") and text.endswith(" end") and "(59910 characters)" in text
    assert len(one_line(str(StoreError("x" * 10**6)))) < 2 * LONGEST
    assert one_line(" " * 10**6 + "\n" * 10**6) == "… (1996000 characters) …"  # would take minutes if its time were quadratic


@pytest.mark.parametrize("error", [GpeError, StoreError])
def test_errors_are_printable_wherever_they_are_shown(error: type[Exception]) -> None:
    assert str(error(HOSTILE)).isprintable()
    assert str(error("plain")) == "plain"


def test_log_lines_are_printable_whatever_handler_writes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    before, stream = logging.getLogRecordFactory(), io.StringIO()
    for module, name in ((warnings, "formatwarning"), (sys, "excepthook")):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored
    logger, handler = logging.getLogger("gpe_pl.shown"), logging.StreamHandler(stream)
    logger.addHandler(handler)
    try:
        clean_messages()
        assert logging.getLogRecordFactory() is LogRecord
        logger.warning("name: %s", HOSTILE)
    finally:
        logging.setLogRecordFactory(before)
        logger.removeHandler(handler)
    assert stream.getvalue() == f"name: {one_line(HOSTILE)}\n"


def test_warnings_and_tracebacks_of_others_are_printable(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    before = logging.getLogRecordFactory()
    for module, name in ((warnings, "formatwarning"), (sys, "excepthook")):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored
    clean_messages()
    logging.setLogRecordFactory(before)
    assert warnings.formatwarning(HOSTILE, UserWarning, "a.py", 3) == f"a.py:3: UserWarning: {one_line(HOSTILE)}\n"
    try:
        raise RuntimeError("name\x1b[2K\u202e")
    except RuntimeError as error:
        sys.excepthook(type(error), error, error.__traceback__)
    assert capsys.readouterr().err.rstrip().endswith("RuntimeError: name\\x1b[2K\\u202e")


def test_cells_of_tables_are_printable() -> None:
    assert table_row(["a\nb", "\x1b[31m"]) == "| a\\nb | \\x1b[31m |"


@pytest.mark.parametrize(
    ("word", "answer"),
    [("sadn", "; did you mean 'sand'?"), ("tyni", "; did you mean 'Tiny'?"), ("SAND", "; did you mean 'sand'?"), ("medium", ""), ("", "")],
)
def test_a_similar_word_is_offered(word: str, answer: str) -> None:
    assert did_you_mean(word, ["snow", "sand", "Tiny", "paper"]) == answer
