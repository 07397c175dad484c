"""Errors of predicted trajectories against the ground truth, and their confidence intervals.

Four rules apply to every metric of a rollout:

- Frame 0 is the shared initial state and does not count. A horizon ``h`` means frames 1 to ``h``; ``"full"`` means all frames of the ground truth.
- A horizon that the ground truth does not reach is left out, never shortened.
- Nodes whose motion is given do not count in errors of positions and velocities.
- The error of a rollout is infinite from the frame where it stopped early or has a value that is not finite, so that no failure improves a score.

Velocities of both trajectories are computed from positions (``integrators``). The velocities that a solver stores are instantaneous, while those of a learned
simulator are averages over a frame. In free fall they would differ by ``g dt / 2``.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics import Metric

from gpe_pl.metrics import bodies, liquids, open_scenes
from gpe_pl.metrics.bodies import Bodies, body_metrics
from gpe_pl.metrics.energy_distance import distance_of_materials
from gpe_pl.metrics.liquids import liquid_metrics, liquid_nodes
from gpe_pl.metrics.mirror import mirror_error, mirrors
from gpe_pl.rollout.loop import fraction_outside
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.rigid_deformation import rigid_deformation
from gpe_pl.trajectory.state import von_mises
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

Horizon = int | Literal["full"]

HORIZONS: tuple[Horizon, ...] = (5, 20, 50, 100, "full")

UNITS: dict[str, str] = {
    "rollout_mse": "m^2",
    "final_mse": "m^2",
    "displacement_error": "1",
    "velocity_error": "1",
    "von_mises_error": "1",
    "stress_error": "1",
    "energy_distance": "m",
    "momentum_error": "m/s",
    "angular_momentum_error": "m^2/s",
    "kinetic_energy_bias": "1",
    "kinetic_energy_error": "1",
    "fraction_outside": "1",
    "mirror_error": "1",
    **bodies.UNITS,
    "rigid_deformation": "1",
    **liquids.UNITS,
    **open_scenes.UNITS,
}
"""Metrics of ``rollout_metrics`` and their units."""


@dataclass(frozen=True)
class Record:
    """The value of a metric at a horizon, in the unit given by ``UNITS``."""

    metric: str
    horizon: Horizon
    value: float


@dataclass(frozen=True)
class Interval:
    """A statistic (``estimate``) with the ends of its confidence interval (``low`` and ``high``)."""

    estimate: float
    low: float
    high: float


# --- positions ----------------------------------------------------------------------------------------------------------------------------


def displacement(
    pos: Float[np.ndarray, "*axes dim"], reference: Float[np.ndarray, "*axes dim"], metadata: Metadata
) -> Float[np.ndarray, "*axes dim"]:
    """Return the displacement ``pos - reference`` [m] in float64; the minimum image along periodic axes."""
    return metadata.periodicity.shortest(pos.astype(np.float64) - reference.astype(np.float64))


def per_frame_mse(prediction: Trajectory, ground_truth: Trajectory) -> Float[np.ndarray, "frame"]:
    """Return the mean squared position error of every frame [m²], over dimensions and over the nodes that ``compared`` returns.

    In open scenes, the place of a node that has not yet entered or has left is that of its entry or exit.

    Returns:
        One value per frame, including frame 0 (zero up to rounding). If the rollout stopped early, the array has the length of the ground truth, with ``inf``
        from the first missing frame on. If the rollout was meant to be shorter, the array has the length of the prediction.

    Raises:
        ValueError: the trajectories differ in nodes, start or frame interval, or the prediction has more frames.
    """
    _check_comparable(prediction, ground_truth)
    frames = prediction.num_frames
    with np.errstate(invalid="ignore", over="ignore"):  # broken frames are handled below
        square = displacement(open_scenes.places(prediction), open_scenes.places(ground_truth)[:frames], ground_truth.metadata) ** 2
        counted = compared(prediction, ground_truth)[:frames]
        error = np.where(counted, square.mean(axis=2), 0.0).sum(axis=1) / np.maximum(1, counted.sum(axis=1))
    missing = ground_truth.num_frames - frames if prediction.termination is not None else 0
    # Frames after a broken one are meaningless, even if their numbers are finite.
    broken = np.logical_or.accumulate(~np.isfinite(error))
    return np.concatenate([np.where(broken, math.inf, error), np.full(missing, math.inf)])


def compared(prediction: Trajectory, ground_truth: Trajectory) -> Bool[np.ndarray, "frame node"]:
    """Return which nodes count in the errors of each frame of the ground truth: those whose motion is not given along all axes.

    In open scenes, these are the nodes that are in either rollout at the frame, without those that never enter one of the two.
    """
    if prediction.alive is None or ground_truth.alive is None:
        return np.broadcast_to(ground_truth.is_predicted, ground_truth.pos.shape[:2])
    here = np.pad(prediction.alive, ((0, ground_truth.num_frames - prediction.num_frames), (0, 0)))
    enters = prediction.alive.any(axis=0) & ground_truth.alive.any(axis=0)
    return (here | ground_truth.alive) & enters & ground_truth.is_predicted


def _check_comparable(prediction: Trajectory, ground_truth: Trajectory) -> None:
    if prediction.pos.shape[1:] != ground_truth.pos.shape[1:] or not np.array_equal(prediction.node_type, ground_truth.node_type):
        raise ValueError(
            f"prediction and ground truth have different nodes: [frame, node, dim] {prediction.pos.shape} and {ground_truth.pos.shape}"
        )
    if ground_truth.num_nodes == 0:
        raise ValueError("a trajectory without nodes has no error")
    if not math.isclose(prediction.metadata.frame_dt, ground_truth.metadata.frame_dt, rel_tol=1e-6):
        raise ValueError(f"frame_dt differs: {prediction.metadata.frame_dt:g} s and {ground_truth.metadata.frame_dt:g} s")
    if prediction.num_frames > ground_truth.num_frames:
        raise ValueError(
            f"{prediction.num_frames} predicted frames but only {ground_truth.num_frames} of ground truth; cut with Trajectory.frames"
        )
    there = slice(None) if ground_truth.alive is None else ground_truth.alive[0]
    start = np.abs(displacement(prediction.pos[0], ground_truth.pos[0], ground_truth.metadata)[there]).max(initial=0.0)
    if not start <= 0.01 * ground_truth.metadata.spacing:
        raise ValueError(
            f"frame 0 differs by {start:.3g} m: the prediction must start at frame 0 of the ground truth (see Trajectory.frames)"
        )


def _num_steps(horizon: Horizon, ground_truth: Trajectory) -> int:
    if horizon == "full":
        return ground_truth.num_frames - 1
    if isinstance(horizon, str) or horizon < 1:
        raise ValueError(f"a horizon is a positive number of frames or 'full', got {horizon!r}")
    return horizon


def _reached(horizons: Sequence[Horizon], error: Float[np.ndarray, "frame"], ground_truth: Trajectory) -> Iterator[tuple[Horizon, int]]:
    """Yield the horizons that a per-frame error covers, each with its number of steps."""
    for horizon in horizons:
        steps = _num_steps(horizon, ground_truth)
        if 1 <= steps < len(error):
            yield horizon, steps


def _relative_errors(prediction: Trajectory, ground_truth: Trajectory, num_steps: int) -> dict[str, float]:
    """Return L2 errors over frames 1 to ``num_steps`` and all nodes, relative to the norm of the ground truth.

    An error is infinite if that norm is zero and the error is not.
    """
    own, true = (t.pos[: num_steps + 1, ground_truth.is_predicted] for t in (prediction, ground_truth))
    metadata = ground_truth.metadata
    steps, true_steps = displacement(own[1:], own[:-1], metadata), displacement(true[1:], true[:-1], metadata)
    errors = {
        "displacement_error": _relative(displacement(own[1:], true[1:], metadata), np.cumsum(true_steps, axis=0)),
        "velocity_error": _relative(steps - true_steps, true_steps),
    }
    if prediction.stress is not None and ground_truth.stress is not None:
        own_stress, true_stress = (np.asarray(t.stress.node, dtype=np.float64)[1:] for t in (prediction, ground_truth))  # type: ignore[union-attr]
        errors["von_mises_error"] = _stress_error(von_mises(own_stress), von_mises(true_stress), num_steps)
        errors["stress_error"] = _stress_error(_whole(own_stress), _whole(true_stress), num_steps)
    return errors


def _stress_error(stress: np.ndarray, reference: np.ndarray, num_steps: int) -> float:
    """Return the root mean squared error over the first frames, relative to the root mean square of the reference over all frames.

    All frames are used for the reference, because there is no stress before an impact.
    """
    wrong = stress[:num_steps] - reference[:num_steps]
    return _relative(wrong / np.sqrt(wrong.size), reference / np.sqrt(reference.size))


def _whole(stress: np.ndarray) -> np.ndarray:
    """Return stresses [..., component] with shear components multiplied by √2.

    The sum of squares then equals that of the whole tensor, which contains each shear twice.
    """
    shears = (1,) if stress.shape[-1] == 4 else (1, 2, 4)
    weight = np.ones(stress.shape[-1])
    weight[[*shears]] = np.sqrt(2)
    return stress * weight


def _relative(error: np.ndarray, reference: np.ndarray) -> float:
    size, scale = float(np.linalg.norm(error)), float(np.linalg.norm(reference))
    if not math.isfinite(size):  # a stress that is no number
        return math.inf
    return size / scale if scale > 0 else (0.0 if size == 0 else math.inf)


# --- conservation -------------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MassMotion:
    """Quantities per mass of frames 1, 2, …

    Attributes:
        momentum: momentum [m/s].
        angular_momentum: angular momentum about the centre of mass [m²/s].
        kinetic_energy: kinetic energy [J/kg].
        pos: positions [m], undivided by the seams of a periodic domain.
        centre: centre of mass [m].
    """

    momentum: Float[np.ndarray, "frame dim"]
    angular_momentum: Float[np.ndarray, "frame dim dim"]
    kinetic_energy: Float[np.ndarray, "frame"]
    pos: Float[np.ndarray, "frame node dim"]
    centre: Float[np.ndarray, "frame dim"]


def mass_motion(trajectory: Trajectory, num_steps: int) -> MassMotion:
    """Return the motion of all nodes of a trajectory in frames 1 to ``num_steps``, with velocities (x[t] − x[t−1]) / Δt."""
    pos, dt = trajectory.pos[: num_steps + 1].astype(np.float64), trajectory.metadata.frame_dt
    if any(trajectory.metadata.periodic):  # unwrap, so that crossing the seam is not a jump
        steps = displacement(pos[1:], pos[:-1], trajectory.metadata)
        pos = np.concatenate([pos[:1], pos[:1] + np.cumsum(steps, axis=0)])
    vel, pos = integrators.velocities(pos, dt), pos[1:]
    fraction = trajectory.mass.astype(np.float64) / trajectory.mass.sum(dtype=np.float64)
    momentum = np.einsum("n,fnd->fd", fraction, vel)
    centre = np.einsum("n,fnd->fd", fraction, pos)
    arm = pos - centre[:, None]
    moment = np.einsum("n,fni,fnj->fij", fraction, arm, vel)
    return MassMotion(momentum, moment - moment.swapaxes(1, 2), 0.5 * np.einsum("n,fnd,fnd->f", fraction, vel, vel), pos, centre)


def _motion_errors(prediction: Trajectory, ground_truth: Trajectory, num_steps: int) -> dict[str, float]:
    p, g = mass_motion(prediction, num_steps), mass_motion(ground_truth, num_steps)
    energy = p.kinetic_energy - g.kinetic_energy
    # Relative to the largest ground-truth energy up to the horizon, because material at rest has none.
    scale = g.kinetic_energy.max()
    relative = np.divide(energy, scale, out=np.where(energy == 0, 0.0, math.inf), where=scale > 0)
    # An antisymmetric matrix has every component of the angular momentum twice.
    spin = np.sqrt(0.5 * ((p.angular_momentum - g.angular_momentum) ** 2).sum(axis=(1, 2)))
    return {
        "momentum_error": float(np.linalg.norm(p.momentum - g.momentum, axis=-1).mean()),
        "angular_momentum_error": float(spin.mean()),
        "kinetic_energy_bias": float(relative.mean()),
        "kinetic_energy_error": float(np.abs(relative).mean()),
    }


# --- one trajectory -----------------------------------------------------------------------------------------------------------------------


def rollout_metrics(prediction: Trajectory, ground_truth: Trajectory, horizons: Sequence[Horizon] = HORIZONS) -> list[Record]:
    """Compute all metrics of one rollout at all horizons that the ground truth reaches.

    ====================== ====== ====================================================================================================
    rollout_mse            m²     squared position error, mean over frames 1 … h, nodes and dimensions (the paper's average MSE)
    final_mse              m²     squared position error in frame h, mean over nodes and dimensions
    displacement_error     1      ‖x − x̂‖ / ‖x̂ − x̂(0)‖ with x̂ the ground truth, norms over frames, nodes and dimensions
    velocity_error         1      ‖v − v̂‖ / ‖v̂‖, norms as above
    von_mises_error        1      root mean square error of the von Mises stress at nodes over frames 1 … h, over the root mean square in all
                                  frames of the ground truth; only if both trajectories have a stress
    stress_error           1      the same for the Cauchy stress tensor
    energy_distance        m      between the clouds of frame h, per material, averaged by mass
    momentum_error         m/s    length of the difference in momentum per mass, mean over frames. Gravity and walls also act on the
                                  ground truth, so the difference is what the prediction adds or loses
    angular_momentum_error m²/s   the same for angular momentum about the cloud's own centre of mass
    kinetic_energy_bias    1      difference in kinetic energy, mean over frames, over the largest kinetic energy of the ground truth up to h
    kinetic_energy_error   1      the same for absolute differences
    mirror_error           1      ‖x − Mx‖ / ‖x̂ − x̂(0)‖ with Mx the mirror image of the prediction; only if the scene is symmetric about a vertical plane
                                  (``mirror.mirrors``); the largest, if it is about several
    rigid_deformation      1      largest change of a distance inside a rigid body, relative to the size of the body; only if the scene has rigid bodies
    fraction_outside       1      fraction of predicted particle positions deeper than a thousandth of the spacing in a wall or obstacle
    ====================== ====== ====================================================================================================

    Open scenes have ``rollout_mse`` and ``final_mse`` over the nodes in either rollout (``per_frame_mse``), ``energy_distance`` and ``fraction_outside`` over
    those that are there, and the metrics of ``open_scenes.open_metrics``.

    Energy distance and angular momentum are undefined in periodic domains and left out. ``fraction_outside`` is left out if the boundary has no shapes. Meshes
    also have the metrics of ``bodies.body_metrics``, and liquids those of ``liquids.liquid_metrics`` in frame h.

    Args:
        prediction: rollout from frame 0 of the ground truth.
        ground_truth: the same scene from a solver.
        horizons: numbers of frames, or ``"full"``.

    Raises:
        ValueError: a horizon is not positive, or as in ``per_frame_mse``.
    """
    if ground_truth.alive is not None:
        return _open_records(prediction.with_nodes_of(ground_truth), ground_truth, horizons)
    error = per_frame_mse(prediction, ground_truth)
    periodic = any(ground_truth.metadata.periodic)
    undefined = {*bodies.UNITS, *open_scenes.UNITS, *(("energy_distance", "angular_momentum_error") if periodic else ())}
    if prediction.stress is None or ground_truth.stress is None:
        undefined |= {"von_mises_error", "stress_error"}
    if not ground_truth.boundary.shapes:
        undefined.add("fraction_outside")
    liquid = liquid_nodes(ground_truth)
    undefined |= {*(liquids.WHOLE if periodic else ())} if liquid.any() else {*liquids.UNITS}
    if prediction.rigid_body is None:
        undefined.add("rigid_deformation")
    names = [name for name in UNITS if name not in undefined]
    planes = mirrors(ground_truth)
    if not planes:
        names.remove("mirror_error")
    true_bodies = Bodies.of(ground_truth)
    finite = int(np.isfinite(error).sum())  # frames, from the start
    own_bodies = None if true_bodies is None else true_bodies.predicted(prediction.frames(0, finite))
    records = []
    for horizon, steps in _reached(horizons, error, ground_truth):
        values = dict.fromkeys(names, math.inf)
        if true_bodies is not None:  # the ground truth decides which metrics there are
            measured = body_metrics(true_bodies, true_bodies, steps)
            values |= {name: math.inf for name in measured if prediction.stress is not None or name not in bodies.STRESS}
        if np.isfinite(error[: steps + 1]).all():
            motion = _motion_errors(prediction, ground_truth, steps)
            values |= {name: motion[name] for name in motion.keys() & values.keys()}
            if planes:
                values["mirror_error"] = max(mirror_error(prediction, ground_truth, plane, steps) for plane in planes)
            values["rollout_mse"], values["final_mse"] = float(error[1 : steps + 1].mean()), float(error[steps])
            values |= _relative_errors(prediction, ground_truth, steps)
            if "fraction_outside" in values:
                values["fraction_outside"] = fraction_outside(
                    prediction.frames(1, steps + 1), tolerance=1e-3 * ground_truth.metadata.spacing
                )
            if liquid.any():
                own, true = (t.pos[steps, liquid] for t in (prediction, ground_truth))
                values |= liquid_metrics(own, true, ground_truth.mass[liquid], ground_truth.metadata)
            if "rigid_deformation" in values:
                values["rigid_deformation"] = rigid_deformation(prediction, steps)
            if not periodic:
                values["energy_distance"] = distance_of_materials(
                    prediction, ground_truth, steps, ground_truth.is_predicted, ground_truth.is_predicted
                )
            if own_bodies is not None and true_bodies is not None:
                values |= body_metrics(own_bodies, true_bodies, steps)
        records += [Record(name, horizon, value) for name, value in values.items()]
    return records


def _open_records(prediction: Trajectory, ground_truth: Trajectory, horizons: Sequence[Horizon]) -> list[Record]:
    """Return the records of ``rollout_metrics`` for an open scene."""
    error, records = per_frame_mse(prediction, ground_truth), []
    names = ["rollout_mse", "final_mse", *open_scenes.UNITS]
    names += ["fraction_outside"] if ground_truth.boundary.shapes else []
    names += [] if any(ground_truth.metadata.periodic) else ["energy_distance"]
    for horizon, steps in _reached(horizons, error, ground_truth):
        values = dict.fromkeys(names, math.inf)
        if np.isfinite(error[: steps + 1]).all():
            values["rollout_mse"], values["final_mse"] = float(error[1 : steps + 1].mean()), float(error[steps])
            values |= open_scenes.open_metrics(prediction, ground_truth, steps)
            if "energy_distance" in values:
                there = [open_scenes.present(t)[steps] for t in (prediction, ground_truth)]
                values["energy_distance"] = distance_of_materials(prediction, ground_truth, steps, *there)
            if "fraction_outside" in values:
                values["fraction_outside"] = fraction_outside(
                    prediction.frames(1, steps + 1), tolerance=1e-3 * ground_truth.metadata.spacing
                )
        records += [Record(name, horizon, value) for name, value in values.items()]
    return records


# --- over many trajectories ---------------------------------------------------------------------------------------------------------------


class OneStepNMSE(Metric):
    """Normalised mean squared one-step error, ``sum |prediction - target|² / sum |target|²`` over all nodes and axes. It is 0 for a perfect model and 1 if
    zero is predicted.

    Unlike a training loss it does not depend on the training noise, so models trained with different noise can be compared.
    """

    higher_is_better = False
    is_differentiable = False
    full_state_update = False

    squared_error: Tensor
    squared_target: Tensor

    def __init__(self, **metric_options: Any) -> None:
        super().__init__(**metric_options)
        for name in ("squared_error", "squared_target"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, prediction: Float[Tensor, "*values"], target: Float[Tensor, "*values"]) -> None:
        """Add the values of a batch, such as those that ``predicted_rows`` returns. Prediction and target have the same unit."""
        if prediction.shape != target.shape:  # broadcasting would give a wrong number without an error
            raise ValueError(f"prediction {list(prediction.shape)} and target {list(target.shape)} differ in shape")
        prediction, target = prediction.detach().double(), target.detach().double()
        self.squared_error += ((prediction - target) ** 2).sum()
        self.squared_target += (target**2).sum()

    def compute(self) -> Float[Tensor, ""]:
        return self.squared_error / self.squared_target


class RolloutMSE(Metric):
    """Mean over trajectories of ``rollout_mse`` [m²] at several horizons (see ``rollout_metrics``).

    The mean is infinite if one rollout fails. ``bootstrap_interval`` of the records gives medians, which do not depend on a single failure.

    Args:
        horizons: numbers of frames, or ``"full"``.
    """

    higher_is_better = False
    is_differentiable = False
    full_state_update = False

    total: Tensor
    count: Tensor

    def __init__(self, horizons: Sequence[Horizon] = HORIZONS, **metric_options: Any) -> None:
        super().__init__(**metric_options)
        self.horizons = tuple(horizons)
        self.add_state("total", torch.zeros(len(self.horizons), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(len(self.horizons), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, prediction: Trajectory, ground_truth: Trajectory) -> None:
        """Add the errors of one rollout."""
        error = per_frame_mse(prediction, ground_truth)
        for horizon, steps in _reached(self.horizons, error, ground_truth):
            k = self.horizons.index(horizon)
            self.total[k] += float(error[1 : steps + 1].mean())
            self.count[k] += 1

    def compute(self) -> dict[str, Tensor]:
        """Return ``{"rollout_mse@5": …}`` for the horizons that at least one trajectory reached."""
        mean = self.total / self.count
        return {f"rollout_mse@{h}": mean[k] for k, h in enumerate(self.horizons) if self.count[k] > 0}


BOTH = (-2, -1)
"""The last two axes of a table [..., seed, trajectory], over which statistics are taken."""


def median_of_means(table: np.ndarray, axis: tuple[int, int]) -> Any:
    """Return the median over seeds of means over trajectories; a ``statistic`` for ``bootstrap_interval``."""
    return np.median(table.mean(axis=axis[1], keepdims=True), axis=axis)


def bootstrap_interval(
    values: Sequence[Sequence[int | float] | np.ndarray] | np.ndarray,
    statistic: Callable[..., Any] = np.median,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Return a percentile interval of a statistic that varies with training seed and test trajectory.

    Seeds and trajectories are resampled independently. All seeds are tested on the same trajectories, and a hard trajectory is hard for all of them, so
    resampling trajectories within each seed would make the interval too narrow. With fewer than about five seeds, any bootstrap underestimates the spread
    between seeds.

    Args:
        values: one row per training seed, one column per test trajectory; ``inf`` marks a failure.
        statistic: function of tables [..., seed, trajectory] that takes the last two axes as ``axis``, like ``np.median`` and ``np.mean``.
        confidence: coverage probability of the interval.
        num_resamples: number of bootstrap resamples.
        seed: seed of the resampling.

    Raises:
        ValueError: ``values`` is not a table of numbers or has NaN, or ``confidence`` is not between 0 and 1.

    Source: Owen, The pigeonhole bootstrap, Ann. Appl. Stat. 1 (2007).
    """
    if not isinstance(values, np.ndarray) and len({len(row) for row in values}) > 1:
        raise ValueError("every seed needs the same test trajectories, in the same order")
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != 2 or table.size == 0 or np.isnan(table).any():
        raise ValueError(f"values must be numbers [seed, trajectory] without NaN, got shape {list(table.shape)}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence lies between 0 and 1, got {confidence}")
    rng = np.random.default_rng(seed)
    num_seeds, num_trajectories = table.shape
    rows, columns = _drawn(num_resamples, rng, num_seeds, num_trajectories)
    return _interval(float(statistic(table, axis=BOTH)), statistic(_resampled(table, rows, columns), axis=BOTH), confidence)


def bootstrap_ratio(
    values: np.ndarray,
    reference: np.ndarray,
    statistic: Callable[..., Any] = np.median,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
    is_paired: bool = False,
) -> Interval:
    """Return a percentile interval of the ratio of a statistic between two models on the same trajectories.

    Trajectories are resampled together for both models. The other arguments are those of ``bootstrap_interval``.

    Args:
        values, reference: values of the two models, one row per training seed, one column per test trajectory. Trajectories are the same for both. The ratio
            is 1 where both statistics are equal, also if both are infinite or zero. It is infinite where only that of the reference is zero.
        is_paired: rows of both tables belong to the same trained networks, so they are resampled together, too.

    Raises:
        ValueError: the tables have different numbers of trajectories, or with ``is_paired`` different numbers of rows.
    """
    if values.shape[1] != reference.shape[1]:
        raise ValueError(f"both models need the same test trajectories, got {values.shape[1]} and {reference.shape[1]}")
    if is_paired and len(values) != len(reference):
        raise ValueError(f"paired tables need the same seeds, got {len(values)} and {len(reference)}")
    rows, others, columns = _drawn(num_resamples, np.random.default_rng(seed), len(values), len(reference), values.shape[1])
    if is_paired:
        others = rows

    def ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        own, other = (np.asarray(statistic(table, axis=BOTH)) for table in (a, b))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(own == other, 1.0, np.where(other == 0, np.inf, own / other))

    resampled = ratio(_resampled(values, rows, columns), _resampled(reference, others, columns))
    return _interval(float(ratio(values, reference)), resampled, confidence)


def _drawn(num_resamples: int, rng: np.random.Generator, *counts: int) -> list[np.ndarray]:
    """Return one array [resample, index] for each count. Each row has ``count`` indices below it, drawn with replacement."""
    return [rng.integers(count, size=(num_resamples, count)) for count in counts]


def _resampled(table: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return resampled tables [resample, seed, trajectory]."""
    return table[rows[:, :, None], columns[:, None, :]]


def _interval(estimate: float, resampled: np.ndarray, confidence: float) -> Interval:
    # Order statistics, because interpolation between infinities gives NaN.
    tail = (1 - confidence) / 2
    low, high = np.quantile(resampled, [tail, 1 - tail], method="inverted_cdf")
    return Interval(estimate, float(low), float(high))
