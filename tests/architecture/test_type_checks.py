"""The tests check types and shapes of every function of the package at run time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError

from gpe_pl.trajectory.trajectory import Trajectory
from tests.type_checks import checked, typed

if TYPE_CHECKING:
    from nowhere import Unknown  # type: ignore[import-not-found]

Rows = Float[np.ndarray, "n dim"]
check = checked(typechecker=typed)


@check
def shifted(rows: Rows, by: Float[np.ndarray, " dim"], num_times: int = 1, like: Unknown = None) -> Rows:
    return (rows + num_times * by)[: -1 if like == "short" else None]


@check
def as_text(number: int, how: Callable[[int], str] = str) -> str:
    return how(number)


@check
def numbers(rows: Rows) -> Iterator[float]:
    yield from rows[0]


@check
@dataclasses.dataclass
class Cloud:
    pos: Rows
    vel: Rows
    name: str = ""


ROWS, BY = np.zeros((3, 2)), np.zeros(2)


def test_what_fits_passes() -> None:
    assert shifted(ROWS, BY).shape == (3, 2) and as_text(3) == "3" and list(numbers(ROWS)) == [0.0, 0.0]
    assert Cloud(ROWS, ROWS).name == ""
    assert shifted(np.zeros((4, 3)), np.zeros(3)).shape == (4, 3)  # names of lengths belong to one call


@pytest.mark.parametrize(
    "call",
    [
        lambda: shifted(ROWS, np.zeros(3)),
        lambda: shifted(ROWS, BY, like="short"),
        lambda: shifted(ROWS, BY, 1.5),  # type: ignore[arg-type]
        lambda: shifted(ROWS.astype(int), BY),
        lambda: as_text("3"),  # type: ignore[arg-type]
        lambda: as_text(3, float),  # type: ignore[arg-type]
        lambda: numbers(BY),
        lambda: Cloud(ROWS, ROWS[:2]),
        lambda: Cloud(ROWS, ROWS, 3),  # type: ignore[arg-type]
        lambda: Trajectory.from_numpy(np.zeros((3, 4, 2), np.float32), "0.01", "sand", {"sand": 30.0}),  # type: ignore[arg-type]
    ],
)
def test_what_does_not_fit_is_refused(call: Callable[[], object]) -> None:
    with pytest.raises(TypeCheckError):
        call()


def test_checks_can_be_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    assert shifted(ROWS, np.zeros((1, 2))).shape == (3, 2) and as_text("3") == "3"  # type: ignore[arg-type]
