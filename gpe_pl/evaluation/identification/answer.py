"""Answers: values of the unknowns of one scene with their intervals, as a line for readers and as a file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.calibration import Calibration, Known
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.evaluation.identification.unknowns import Unknown
from gpe_pl.files import sealed

ADVICE = "delete the file and identify the scene again"
MODEL, SOLVER = "model", "solver"
POOR = 1.0
"""Typical distance of rollouts from the motion, from which on an answer carries a warning [spacings]."""
FOLDER = "scenes"
"""Subfolder of a results folder with one file per scene and simulator."""


class AnswerError(GpeError, ValueError):
    """Raised for a file with an answer that this version cannot read."""


@dataclass(frozen=True)
class Value:
    """Answer for one unknown.

    Attributes:
        name, label, unit, is_log: as in ``Unknown``.
        bounds: bounds of the search.
        raw: value with the smallest misfit.
        estimate, low, high: corrected value and ends of its interval.
        at_bound: ``lower`` or ``upper`` if ``raw`` lies at a bound, else empty.
        truth: stored value; None if it is unknown.
        text: estimate with unit, and interval, for readers.
    """

    name: str
    label: str
    unit: str
    is_log: bool
    bounds: tuple[float, float]
    raw: float
    estimate: float
    low: float
    high: float
    at_bound: str
    truth: float | None
    text: str

    @property
    def short(self) -> str:
        return self.text.partition(" (")[0]

    def coordinate(self, value: float) -> float:
        """Return the coordinate in which intervals are measured: the value, or its natural logarithm."""
        return math.log(value) if self.is_log else value


@dataclass(frozen=True)
class Answer:
    """Answer for one scene by one simulator.

    Attributes:
        scene: name of the scene.
        observed: digest of the observed motion (``Observations.digest``).
        simulator: ``model`` or ``solver``.
        values: answers for the unknowns.
        level: nominal coverage of the intervals.
        num_calibration: number of scenes that the intervals were calibrated on; 0 if they are not calibrated.
        method: ``gradient`` or ``derivative_free``.
        gradients: result of the check of gradients; empty if there was none.
        misfit: smallest misfit.
        is_unfinished: whether the search stopped at its largest number of evaluations, so that other values may fit better.
        num_windows, length: number of rollouts, and of frames of each.
        num_evaluations, num_gradients: numbers of misfits and gradients that were computed.
        seconds, processor_seconds: time of the search and the intervals.
        tried: values of the unknowns and the misfit, for every misfit of the search.
    """

    scene: str
    observed: str
    simulator: str
    values: tuple[Value, ...]
    level: float
    num_calibration: int
    method: str
    gradients: str
    misfit: float
    num_windows: int
    length: int
    num_evaluations: int
    num_gradients: int
    seconds: float
    processor_seconds: float
    tried: tuple[tuple[float, ...], ...]
    is_unfinished: bool = False

    def __getitem__(self, name: str) -> Value:
        """Return the answer for an unknown by its name, such as ``sand.friction_angle``."""
        return next(value for value in self.values if value.name == name)

    @property
    def warning(self) -> str:
        """What a reader should know about the fit; empty if the search has ended and the rollouts are nearer than ``POOR`` to the motion."""
        error = math.exp(self.misfit / 2)
        found = [] if error < POOR else [f"{self.simulator} does not fit: its rollouts are {error:.2g} spacings away from the motion"]
        found += [f"{self.simulator} stopped at search.max_evaluations, other values may fit better"] if self.is_unfinished else []
        return "; ".join(found)

    def __str__(self) -> str:
        lines = [f"{value.label} {value.text}" + (f", at the {value.at_bound} bound" if value.at_bound else "") for value in self.values]
        lines += [self.warning] if self.warning else []
        return "; ".join(lines) + ("" if self.num_calibration else " [interval not calibrated]")

    def write(self, folder: Path) -> None:
        """Write the answer to a file in a results folder."""
        path = answer_path(folder, self.scene, self.simulator)
        path.parent.mkdir(parents=True, exist_ok=True)
        sealed.write(path, asdict(self))


def answer_path(folder: Path, scene: str, simulator: str) -> Path:
    """Return the path of an answer's file in a results folder."""
    return folder / FOLDER / f"{scene}_{simulator}.json"


def read_answer(path: Path) -> Answer:
    """Read an answer that ``Answer.write`` wrote.

    Raises:
        SealError: the file was changed.
        AnswerError: another version of the package wrote it.
    """
    found: dict[str, Any] = sealed.read(path, ADVICE)
    found.setdefault("is_unfinished", False)  # earlier versions did not say
    is_own = found.keys() == Answer.__dataclass_fields__.keys()
    if not is_own or any(value.keys() != Value.__dataclass_fields__.keys() for value in found["values"]):
        raise AnswerError(f"{path}: is an answer of another version; {ADVICE}")
    values = tuple(Value(**{**value, "bounds": tuple(value["bounds"])}) for value in found.pop("values"))
    return Answer(values=values, tried=tuple(map(tuple, found.pop("tried"))), **found)


def read_answers(folder: Path, simulator: str) -> list[Answer]:
    """Read all answers of one simulator in a results folder, in the order of their scenes."""
    return [read_answer(path) for path in sorted((folder / FOLDER).glob(f"*_{simulator}.json"))]


def value_of(unknown: Unknown, z: float, profile: Profile, calibration: Calibration) -> Value:
    """Return the answer for an unknown.

    Args:
        unknown: the unknown.
        z: its value with the smallest misfit, as a number from 0 to 1.
        profile: misfits of other values.
        calibration: correction and interval. Values that are impossible become the nearest possible ones.
    """
    raw = float(unknown.at(z))
    estimate, low, high = (unknown.possible(unknown.value(end)) for end in calibration.interval(unknown.coordinate(raw), profile))
    text = f"{unknown.text(estimate)} ({100 * calibration.level:g} %: {low:.3g}–{high:.3g})"
    if unknown.unit == "Pa":
        text = f"{unknown.text(estimate)} ({100 * calibration.level:g} %: {unknown.text(low)}–{unknown.text(high)})"
    truth, bounds = unknown.truth if math.isfinite(unknown.truth) else None, (unknown.low, unknown.high)
    return Value(
        unknown.name, unknown.label, unknown.unit, unknown.is_log, bounds, raw, estimate, low, high, unknown.bound_of(z), truth, text
    )


def known_of(answers: Iterable[Answer]) -> dict[str, list[Known]]:
    """Return answers whose truth is known, by name of the unknown. All bodies of a scene have the same unknown and scene."""
    found: dict[str, list[Known]] = {}
    for answer in answers:
        for k, value in enumerate(answer.values):
            if value.truth is not None:
                low, high = map(value.coordinate, value.bounds)
                profile = Profile.of(((value.coordinate(row[k]), row[-1]) for row in answer.tried), (low, high))
                truth = next((end for end in value.bounds if np.float32(end) == np.float32(value.truth)), value.truth)  # stored in float32
                known = Known(value.coordinate(value.raw), value.coordinate(truth), profile, answer.scene)
                found.setdefault(value.name.partition("#")[0], []).append(known)
    return found


def side_by_side(answers: Mapping[str, Answer]) -> Sequence[str]:
    """Return one line per unknown, with the answers of all simulators: ``friction angle of sand 31.2° (90 %: 30.1–32.4), solver 31°``."""
    first, *others = answers.values()
    lines = []
    for value in first.values:
        parts = [f"{value.label} {value.text}" + ("" if first.num_calibration else " [interval not calibrated]")]
        parts += [f"{other.simulator} {other[value.name].short}" for other in others]
        notes = [
            f"{answer.simulator} at the {answer[value.name].at_bound} bound" for answer in answers.values() if answer[value.name].at_bound
        ]
        notes += [answer.warning for answer in answers.values() if answer.warning]
        lines.append(", ".join(parts) + (f"; {', '.join(notes)}" if notes else ""))
    return lines
