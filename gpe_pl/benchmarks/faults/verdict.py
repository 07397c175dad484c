"""What a fault is, what may come of it, and what must not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from gpe_pl.errors import GpeError

Status = Literal[
    "refused",  # with a typed, readable error
    "harmless",  # the result is what it would have been, or as sound as any
    "accepted",  # silently: a result that cannot be trusted
    "traceback",  # an error of no type that a user could act on
    "executed",  # a payload ran
    "outside",  # a file changed in a folder that is none of the command's
    "half-written",  # something incomplete lies where something complete belongs
    "different",  # what was resumed is not what an undisturbed run gives
    "hung",
    "died",
]
GOOD: tuple[Status, ...] = ("refused", "harmless")
BAD: tuple[Status, ...] = ("accepted", "traceback", "executed", "outside", "half-written", "different", "hung", "died")

T = TypeVar("T")
MAX_DETAIL = 300


@dataclass(frozen=True)
class Verdict:
    """What came of a fault: a status, and the message or reason."""

    status: Status
    detail: str = ""


@dataclass(frozen=True)
class Fault:
    """Something wrong, done on purpose.

    Attributes:
        kind: row of the matrix.
        name: what exactly, so that it can be done again.
        attack: does it in an empty folder and says what came of it; can be pickled.
        seconds: that the same takes where nothing is wrong.
    """

    kind: str
    name: str
    attack: Callable[[Path], Verdict]
    seconds: float = 0.0


def judge(action: Callable[[], T], is_sound: Callable[[T], bool]) -> Verdict:
    """Do what must either be refused with a ``GpeError`` or have a sound result."""
    try:
        result = action()
    except GpeError as error:
        text = " ".join(str(error).split())
        return Verdict("refused" if text else "traceback", text[:MAX_DETAIL])
    except Exception as error:
        return Verdict("traceback", f"{type(error).__name__}: {' '.join(str(error).split())}"[:MAX_DETAIL])
    return Verdict("harmless") if is_sound(result) else Verdict("accepted", "no error, and the result is wrong")
