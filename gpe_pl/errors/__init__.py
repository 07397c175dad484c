"""Base class of all errors that a user can act on. Commands print such an error as one line, without a traceback."""

from __future__ import annotations

from typing import Any

from gpe_pl.errors.printable import one_line


class GpeError(Exception):
    """Base class of errors whose message says what is wrong and what to do.

    A message may quote files and command lines. It is therefore shown as one line of printable text.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())

    def __reduce__(self) -> tuple[Any, ...]:  # errors cross process boundaries, also those with an ``__init__`` of their own
        return _rebuilt, (type(self), self.args), self.__dict__


def _rebuilt(kind: type[GpeError], args: tuple[Any, ...]) -> GpeError:
    """Return an error of a class without a call of its ``__init__``."""
    return kind.__new__(kind, *args)
