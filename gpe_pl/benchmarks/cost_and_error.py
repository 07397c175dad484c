"""Cost and error of simulators: the Pareto front, and comparisons at equal cost or at equal error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gpe_pl.metrics import Interval, bootstrap_ratio

Family = Literal["solver", "learned", "trivial"]

WINNING_HORIZONS = 2
"""Number of horizons at which a model has to be below the solvers' curve to win."""
FEWEST_SCENES = 5
"""Smallest number of scenes for a win. At one horizon the interval of two equal simulators is below 1 by chance in a tenth of comparisons of 5 scenes and in
5 % of 20, and more often over fewer."""

ROUNDING = 1 + 1e-9
"""Ratio of two costs or errors up to which they are equal."""


@dataclass
class Point:
    """Cost and error of one simulator.

    Attributes:
        name: name of the simulator.
        family: kind of simulator.
        seconds: computing time over simulated time, of each scene.
        mse: mean square error [m²] over the frames up to each horizon, of each scene; infinite if it failed.
        distance: energy distance [m] to the reference in the last frame, of each scene. It compares distributions, for times at which errors of single nodes
            carry no information.
        overhead: seconds of tuning, training and generating their data.
        teacher: of a learned model, the name of the solver whose solutions it was trained on.
    """

    name: str
    family: Family
    seconds: list[float] = field(default_factory=list)
    mse: dict[str, list[float]] = field(default_factory=dict)
    distance: list[float] = field(default_factory=list)
    overhead: float = 0.0
    teacher: str = ""

    def error(self, horizon: str) -> float:
        return float(np.mean(self.mse[horizon]))

    @property
    def cost(self) -> float:
        return float(np.median(self.seconds))


@dataclass(frozen=True)
class Comparison:
    """All simulators of a case, on the same scenes.

    Attributes:
        points: cost and error of each simulator.
        order: observed order of convergence of the reference.
        partial: solvers that are left out, because a scene does not exist at their resolution, and the number of scenes that they have.
    """

    points: list[Point]
    order: float
    partial: dict[str, int] = field(default_factory=dict)


def front(points: Sequence[Point], horizon: str) -> list[Point]:
    """Return the Pareto front: the points that no other point beats in both cost and error, from the cheapest on."""
    best: list[Point] = []
    for point in sorted(points, key=lambda p: (p.cost, p.error(horizon))):
        if np.isfinite(point.error(horizon)) and (not best or point.error(horizon) < best[-1].error(horizon)):
            best.append(point)
    return best


def hypervolume(points: Sequence[Point], horizon: str, worst: tuple[float, float]) -> float:
    """Return the area [decades²] between the Pareto front and ``worst``, a cost and an error, on logarithmic axes; larger is better."""
    area, limit = 0.0, worst[1]
    for point in front(points, horizon):
        if point.cost < worst[0] and point.error(horizon) < limit:
            area += float(np.log10(worst[0] / point.cost) * np.log10(limit / point.error(horizon)))
            limit = point.error(horizon)
    return area


def cost_at_error(points: Sequence[Point], error: float, horizon: str) -> float:
    """Return the cost at which the points reach an error, interpolated along their Pareto front on logarithmic axes.

    For larger errors than those of the front it is the lowest cost; for smaller errors it is infinite.
    """
    best = front(points, horizon)
    if not best or error < best[-1].error(horizon):
        return float("inf")
    if error >= best[0].error(horizon):
        return best[0].cost
    errors = np.log([p.error(horizon) for p in best[::-1]])
    costs = np.log([p.cost for p in best[::-1]])
    return float(np.exp(np.interp(np.log(error), errors, costs)))


def error_at_cost(points: Sequence[Point], cost: float, horizon: str) -> float:
    """Return the error that the points reach at a cost, interpolated as in ``cost_at_error``.

    For larger costs than those of the front it is the smallest error; for smaller costs it is infinite.
    """
    best = front(points, horizon)
    if not best or cost < best[0].cost:
        return float("inf")
    return float(np.exp(np.interp(np.log(cost), np.log([p.cost for p in best]), np.log([p.error(horizon) for p in best]))))


def ratio_at_cost(point: Point, solvers: Sequence[Point], horizon: str) -> Interval | None:
    """Return a simulator's mean error over that of the solvers at its cost, with its 95 % interval over paired scenes.

    The solvers' error of each scene is interpolated between the two solvers of the Pareto front with the next lower and the next higher cost, with the same
    weights in all scenes. If the simulator costs more than all solvers, the most expensive one is taken. If every solver costs more, it is the cheapest one
    where the simulator is better than that, with an interval below 1, and otherwise there is no comparison: return None.
    """
    best = front(solvers, horizon)
    if not best:
        return None
    if point.cost < best[0].cost:
        ratio = paired_ratio(point.mse[horizon], best[0].mse[horizon])
        return ratio if is_below(ratio) else None
    place = float(np.interp(np.log(point.cost), np.log([p.cost for p in best]), np.arange(len(best))))
    cheaper, dearer = (np.log(best[k].mse[horizon]) for k in (math.floor(place), math.ceil(place)))
    return paired_ratio(point.mse[horizon], np.exp(cheaper + (place % 1) * (dearer - cheaper)))


def is_below(ratio: Interval) -> bool:
    """Tell whether an interval of ratios lies below 1 by more than rounding."""
    return ratio.high * ROUNDING < 1


def paired_ratio(values: Sequence[float], reference: Sequence[float] | np.ndarray) -> Interval:
    """Return the ratio of the means of two errors over the same scenes, with its 95 % interval over scenes."""
    return bootstrap_ratio(np.array([values]), np.array([reference]), statistic=np.mean)


def winners(points: Sequence[Point], horizons: Sequence[str]) -> list[str]:
    """Return the learned models that win: their 95 % interval lies below the solvers' curve at equal time, at two horizons or more.

    A comparison of fewer than ``FEWEST_SCENES`` scenes has no winner.
    """
    solvers = [p for p in points if p.family == "solver"]
    found = []
    for point in (p for p in points if p.family == "learned"):
        ratios = [ratio_at_cost(point, solvers, h) for h in horizons]
        enough = all(len(point.mse[h]) >= FEWEST_SCENES for h in horizons)
        if enough and sum(ratio is not None and is_below(ratio) for ratio in ratios) >= WINNING_HORIZONS:
            found.append(point.name)
    return found


def is_as_accurate(point: Point, solvers: Sequence[Point], horizon: str) -> bool:
    """Tell whether no rollout failed and the error is at most that of the cheapest solver of the Pareto front, so that there is a solver of the same error."""
    best = front(solvers, horizon)
    return bool(best) and point.error(horizon) <= best[0].error(horizon)


def speed_up(point: Point, solvers: Sequence[Point], horizon: str) -> float:
    """Return the time of a solver of the same error over that of a model; above 1 the model is faster.

    It is infinite if no solver has so small an error, 0 if a rollout failed, and NaN if the model is cheaper and less accurate than every solver. A model that
    is less accurate and more expensive than the cheapest solver is compared with that one.
    """
    if not math.isfinite(point.error(horizon)):
        return 0.0
    ratio = cost_at_error(solvers, point.error(horizon), horizon) / point.cost
    return ratio if ratio < 1 or is_as_accurate(point, solvers, horizon) else math.nan


def break_even(point: Point, solvers: Sequence[Point], horizon: str, duration: float) -> float:
    """Return the number of rollouts of ``duration`` [s] after which the training of a model has paid off, compared with a solver of the same error.

    It is infinite if training never pays off, a rollout failed or every solver is more accurate, 0 if no solver has so small an error, and NaN if the training
    time is not known.
    """
    if not is_as_accurate(point, solvers, horizon):
        return float("inf")
    saved = (cost_at_error(solvers, point.error(horizon), horizon) - point.cost) * duration
    return float("inf") if saved <= 0 else point.overhead / saved  # of an infinite saving 0
