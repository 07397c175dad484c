"""The base of all errors that a user can act on; entry points print them in one line, without a traceback."""

from __future__ import annotations

from gpe_pl.printable import one_line


class GpeError(Exception):
    """The message names what is wrong and what to do. It may quote files and command lines, so it is shown as one line of printable text."""

    def __str__(self) -> str:
        return one_line(super().__str__())
