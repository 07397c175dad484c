"""Faults and their verdicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from gpe_pl.errors import GpeError

Status = Literal[
    "refused",  # a typed, readable error
    "harmless",  # the result is the undisturbed one, or sound
    "unread",  # the command did not read a damaged file that readers refuse, and its other results are the undisturbed ones
    "changed",  # no error, and results that may differ, because a setting differs that may be given
    "accepted",  # no error, and a result that cannot be trusted
    "traceback",  # an error without a type that a user could act on
    "executed",  # a payload ran
    "outside",  # a file changed in a folder that does not belong to the command
    "half-written",  # an incomplete file has a final name
    "different",  # the resumed result differs from that of an undisturbed run
    "hung",  # takes too long, or goes on after a signal that ends commands
    "died",
]
GOOD: tuple[Status, ...] = ("refused", "harmless", "unread", "changed")
BAD: tuple[Status, ...] = ("accepted", "traceback", "executed", "outside", "half-written", "different", "hung", "died")

T = TypeVar("T")
MAX_DETAIL = 300


@dataclass(frozen=True)
class Verdict:
    """Outcome of a fault: a ``status``, and the message or reason as ``detail``."""

    status: Status
    detail: str = ""


@dataclass(frozen=True)
class Fault:
    """A deliberate fault.

    Attributes:
        kind: kind of the fault, a row in the table of outcomes.
        name: exact description, with which the fault can be repeated.
        attack: function that injects the fault in an empty folder and returns the verdict; can be pickled.
        seconds: duration of the same action without the fault [s].
    """

    kind: str
    name: str
    attack: Callable[[Path], Verdict]
    seconds: float = 0.0


def verdict_of(action: Callable[[], T], is_sound: Callable[[T], bool]) -> Verdict:
    """Run an action that must either be refused with a ``GpeError`` or have a sound result."""
    try:
        result = action()
    except GpeError as error:
        text = " ".join(str(error).split())
        return Verdict("refused" if text else "traceback", text[:MAX_DETAIL])
    except Exception as error:
        return Verdict("traceback", f"{type(error).__name__}: {' '.join(str(error).split())}"[:MAX_DETAIL])
    return Verdict("harmless") if is_sound(result) else Verdict("accepted", "no error, and the result is wrong")
