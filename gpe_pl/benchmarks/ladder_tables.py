"""Tables and sentences of ``runtime_vs_error``: a summary of all cases, and for each case errors, times, and where learned models win or lose."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gpe_pl.benchmarks.cost_and_error import (
    FEWEST_SCENES,
    ROUNDING,
    WINNING_HORIZONS,
    Comparison,
    Point,
    break_even,
    cost_at_error,
    error_at_cost,
    front,
    is_as_accurate,
    is_below,
    paired_ratio,
    ratio_at_cost,
    speed_up,
    winners,
)
from gpe_pl.benchmarks.solver_rungs import DATA, MODULI, NODES
from gpe_pl.files.markdown import table_row
from gpe_pl.metrics import Interval, bootstrap_interval

BALLISTIC = "ballistic"
REPEATED = ", repeated predictions"


def summary(cases: Mapping[str, Sequence[Point]]) -> str:
    """Return a table with a row per case: what the model that is nearest to winning lacks, and the verdict.

    The nearest model has the smallest geometric mean, over horizons, of its error relative to that of a solver of the same cost. Failed rollouts make this
    ratio infinite. Horizons without a comparison do not count (``ratio_at_cost``).
    """
    horizons = list(dict.fromkeys(h for points in cases.values() for h in points[0].mse))
    header = ["case", "nearest model", *(f"error @{h}" for h in horizons), "time at equal error", "verdict"]
    lines = ["### Summary", "", table_row(header), "|" + "---|" * len(header)]
    for case, points in cases.items():
        solvers = [p for p in points if p.family == "solver"]
        learned = [p for p in points if p.family == "learned"]
        nearest = min(learned, key=lambda p: _mean_ratio(p, solvers))
        own = [h for h in horizons if h in nearest.mse]
        faster = [speed_up(nearest, solvers, h) for h in own]
        cells = [_ratio(ratio_at_cost(nearest, solvers, h), len(nearest.mse[h])) if h in own else "–" for h in horizons]
        lines.append(table_row([case, nearest.name, *cells, _times(faster), _verdict(nearest, solvers, own)]))
    note = (
        "Error: that of the nearest model over that of a solver of the same cost, with its 95 % interval over paired scenes. Time: that of the model over that "
        "of a solver of the same error, at the horizons in this order; above 1 the model is slower, 0 means that no solver is as accurate, – that "
        "the model is cheaper and less accurate than every solver, and inf that a rollout of the model failed. Where every solver costs more, errors are "
        "compared with the cheapest one if the model is better than that. Bold: the interval lies below 1."
    )
    return "\n".join([*lines, "", note])


def _mean_ratio(point: Point, solvers: Sequence[Point]) -> float:
    """Return the geometric mean over horizons of a model's error relative to that of a solver of the same cost; infinite if there is no comparison."""
    if not all(np.isfinite(values).all() for values in point.mse.values()):
        return math.inf
    ratios = [ratio.estimate for h in point.mse if (ratio := ratio_at_cost(point, solvers, h)) is not None]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else math.inf


def _verdict(point: Point, solvers: Sequence[Point], horizons: Sequence[str]) -> str:
    """Say at how many horizons a model is better, worse, or neither."""
    if winners([*solvers, point], horizons):
        return "**wins**"
    ratios = [ratio_at_cost(point, solvers, h) for h in horizons]
    failed = [not np.isfinite(point.error(h)) for h in horizons]
    worse = sum(has_failed or (ratio is not None and ratio.low > 1) for ratio, has_failed in zip(ratios, failed, strict=True))
    if worse:
        return f"loses at {worse} of {len(horizons)}"
    apart = sum(ratio is None for ratio in ratios)
    return f"cheaper and less accurate than every solver at {apart} of {len(horizons)}" if apart else "level"


def _times(faster: Sequence[float]) -> str:
    """Return the times of a model over those of a solver of the same error, the reciprocals of ``speed_up``."""
    return ", ".join("–" if math.isnan(ratio) else f"{1 / ratio if ratio else math.inf:.2g}" for ratio in faster)


def section(case: str, comparison: Comparison, num_trajectories: int) -> str:
    """Return the section of a case: errors and times of all simulators, and where learned models win or lose.

    Args:
        case: name of the case.
        comparison: all simulators.
        num_trajectories: number of scenes.
    """
    points = comparison.points
    horizons = [*points[0].mse]
    solvers = [p for p in points if p.family == "solver"]
    header = ["", "time per simulated second", *(f"MSE @{h}" for h in horizons), "energy distance [mm]"]
    lines = [table_row(header), "|" + "---|" * len(header)]
    best = {DATA, NODES} | {p.name for h in horizons for p in front(solvers, h)}
    shown = [p for p in points if p.family != "solver" or p.name in best]
    for point in sorted(shown, key=lambda p: (("solver", "learned", "trivial").index(p.family), -p.cost)):
        cells = [_interval(point.mse[h], 1e3) for h in horizons]
        lines.append(table_row([point.name, f"{point.cost:.3g}", *cells, f"{1e3 * np.mean(point.distance):.3g}"]))
    note = (
        f"{num_trajectories} scenes. MSE ×1e-3 [m²] to the solver at half the spacing of the data's, whose observed order of convergence is "
        f"{comparison.order:.1f} (positions, first 20 frames): mean and 95 % interval over scenes. `{DATA}` is the error in the "
        "training data. Times: processor time of one core, warm, neighbour search and features included. Those of learned models include the solver "
        "that computes the frames before their first."
    )
    if len(shown) < len(points):
        note += f" Of the solvers, {len(points) - len(shown)} are only in `results.json`: at each horizon, another one is at least as fast and as accurate."
    if comparison.partial:
        counts = ", ".join(f"{name} ({num_scenes})" for name, num_scenes in comparison.partial.items())
        note += f" Left out, because they cannot solve all of the scenes (number of scenes that they solve): {counts}."
    lost = ["", *_ratios(points, horizons), "", "**Where the learned models lose**: time of a solver of the same error over theirs", ""]
    lost += [table_row(["", *(f"@{h}" for h in horizons)]), "|" + "---|" * (1 + len(horizons))]
    for point in (p for p in points if p.family == "learned"):
        lost.append(table_row([point.name, *(_against(point, solvers, h) for h in horizons)]))
    lost += [
        "",
        "**Break-even**: seconds of simulation after which tuning, training and their data have paid off, against a solver of the same error",
        "",
    ]
    after = {p.name: [break_even(p, solvers, h, duration=1.0) for h in horizons] for p in points if p.family == "learned"}
    if np.isinf([*after.values()]).all():
        lost.append("Never, for any of the models.")
    else:
        lost += [table_row(["", *(f"@{h}" for h in horizons)]), "|" + "---|" * (1 + len(horizons))]
        lost += [table_row([name, *map(_pays_off, values)]) for name, values in after.items()]
    return "\n".join([f"### {case}", "", *lines, "", note, "", "**At equal error**", "", *verdicts(points, horizons), *lost])


def _ratios(points: Sequence[Point], horizons: Sequence[str]) -> Iterator[str]:
    """Yield a table of learned models against the solvers at equal time and against the solver of their labels, and who wins."""
    solvers = [p for p in points if p.family == "solver"]
    learned = [p for p in points if p.family == "learned"]
    hard = of_own_moduli(solvers)
    yield from (
        "**At equal time**: error over that of a solver of the same cost, and over that of the solver of the model's labels at its own cost",
        "",
    )
    yield table_row(["", "against", *(f"@{h}" for h in horizons)])
    yield "|" + "---|" * (2 + len(horizons))
    for point in learned:
        yield table_row(
            [point.name, "solver of the same cost", *(_ratio(ratio_at_cost(point, solvers, h), len(point.mse[h])) for h in horizons)]
        )
        if hard != solvers:
            yield table_row(
                [point.name, "the same, moduli of the data", *(_ratio(ratio_at_cost(point, hard, h), len(point.mse[h])) for h in horizons)]
            )
        for teacher in (p for p in solvers if p.name == point.teacher):
            to_teacher = (_ratio(paired_ratio(point.mse[h], teacher.mse[h]), len(point.mse[h])) for h in horizons)
            yield table_row([point.name, "solver of its labels", *to_teacher])
    winning = winners(points, horizons)
    rule = f"A model wins if the 95 % interval over paired scenes lies below 1 at equal time, at {WINNING_HORIZONS} horizons or more."
    yield from ("", f"{rule} {'**' + ', '.join(winning) + '** wins.' if winning else 'None does.'}")
    if hard != solvers:
        winning = winners([*hard, *learned], horizons)
        found = f"{', '.join(winning)} would win" if winning else "none would win, either"
        yield from ("", f"If the solver had to keep the elastic moduli of the data, {found}.")
    yield from ("", _superiority(learned, solvers, horizons))


def _superiority(learned: Sequence[Point], solvers: Sequence[Point], horizons: Sequence[str]) -> str:
    """Return a sentence about emulator superiority: which models are closer to the reference than the solver that made their labels."""
    by_name = {p.name: p for p in solvers}
    if min((len(point.mse[h]) for point in learned for h in horizons), default=FEWEST_SCENES) < FEWEST_SCENES:
        return f"Emulator superiority (closer to the reference than the solver of its labels): fewer than {FEWEST_SCENES} scenes are too few to say."
    closer = []
    for point in (p for p in learned if p.teacher in by_name):
        below = [h for h in horizons if is_below(paired_ratio(point.mse[h], by_name[point.teacher].mse[h]))]
        closer += [f"{point.name} (@{', @'.join(below)})"] if below else []
    found = f"{'; '.join(closer)}: the interval lies below 1" if closer else "no model is, at any horizon"
    return f"Emulator superiority (closer to the reference than the solver of its labels): {found}."


def of_own_moduli(solvers: Sequence[Point]) -> list[Point]:
    """Return the solvers whose elastic moduli are those of the data."""
    return [p for p in solvers if MODULI not in p.name]


def _ratio(interval: Interval | None, num_scenes: int) -> str:
    """Return the table cell of a ratio over so many scenes; bold if it is below 1 and the scenes are enough to say so."""
    if interval is None:
        return "every solver costs more"
    text = f"{interval.estimate:.2f} [{interval.low:.2f}, {interval.high:.2f}]"
    return f"**{text}**" if is_below(interval) and num_scenes >= FEWEST_SCENES else text


def _pays_off(seconds: float) -> str:
    return "never" if math.isinf(seconds) else "not known" if math.isnan(seconds) else f"{seconds:.3g}"


def _against(point: Point, solvers: Sequence[Point], horizon: str) -> str:
    """Return the table cell that compares a model with the solvers at equal error; below 1 the model is slower."""
    needed = cost_at_error(solvers, point.error(horizon), horizon)
    if needed <= point.cost:
        return f"{needed / point.cost:.2g}"
    if np.isinf(needed):
        return "**more accurate than every solver that was run**"
    if point.error(horizon) > front(solvers, horizon)[0].error(horizon):
        return "cheaper and less accurate than every solver that was run"
    return f"**{needed / point.cost:.2g}**"


def verdicts(points: Sequence[Point], horizons: Sequence[str]) -> Iterator[str]:
    """Yield one line per horizon: whether a learned model lies below the solvers' front, or what the nearest model lacks."""
    solvers = [p for p in points if p.family == "solver"]
    learned = [p for p in points if p.family == "learned"]
    for horizon in horizons:
        comparable = [p for p in learned if is_as_accurate(p, solvers, horizon)]
        gain = {p.name: cost_at_error(solvers, p.error(horizon), horizon) / p.cost for p in comparable}
        if not gain:
            yield f"- @{horizon}: {_none_as_accurate(learned, front(solvers, horizon)[0], horizon)}"
            continue
        nearest = max(comparable, key=lambda p: gain[p.name])
        if gain[nearest.name] > ROUNDING:
            ahead = [name for name, value in gain.items() if value > ROUNDING]
            yield f"- @{horizon}: **below the solver's curve**: {', '.join(ahead)}."
            continue
        error = error_at_cost(solvers, nearest.cost, horizon)
        yield (
            f"- @{horizon}: no learned model passes below the solver's curve. Nearest is {nearest.name}: it would have to be "
            f"{_rounded(1 / gain[nearest.name])} times faster, or {_rounded(nearest.error(horizon) / error)} times more accurate at its cost."
        )


def _none_as_accurate(learned: Sequence[Point], cheapest: Point, horizon: str) -> str:
    nearest = min(learned, key=lambda p: p.error(horizon))
    return (
        f"no learned model is as accurate as the cheapest of the solvers ({cheapest.name}). Nearest is {nearest.name}: it would have to be "
        f"{_rounded(nearest.error(horizon) / cheapest.error(horizon))} times more accurate and {_rounded(nearest.cost / cheapest.cost)} times faster."
    )


def _rounded(factor: float) -> str:
    """Format with two digits; from a million on, with an exponent."""
    return f"{float(f'{factor:.2g}'):g}"


def _interval(values: list[float], scale: float) -> str:
    if not np.isfinite(values).all():
        return f"{int((~np.isfinite(values)).sum())} of {len(values)} failed"
    i = bootstrap_interval(np.array([values]) * scale, statistic=np.mean)
    return f"{i.estimate:.3g} [{i.low:.3g}, {i.high:.3g}]"
