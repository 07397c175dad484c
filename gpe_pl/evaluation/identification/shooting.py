"""Multiple shooting: rollouts from several observed states over short horizons, and their misfit to the observed motion.

With the mean squared displacement ``e(w)`` of window w, in units of the spacing, the misfit is the mean of ``log(e(w) + FLOOR)`` over all windows. Up to a
factor it is the negative log-likelihood of normal errors with an unknown variance in each window, so a few windows in which a simulator fails do not decide.
Windows start from observed states, so errors do not grow over the whole motion. A single long rollout is cut into blocks of frames, which count as windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field
from pydantic.dataclasses import dataclass as validated_dataclass

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.observations import Observations
from gpe_pl.evaluation.identification.unknowns import Unknowns
from gpe_pl.evaluation.rollout_scores import rollout_scores
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import Restartable, Simulator, unfit
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata

FLOOR = 1e-6
"""Squared displacement below which motions count as equal [spacings²]."""
FAILED = 1e6
"""Squared displacement of frames that a rollout does not reach [spacings²]."""


class ShootingError(GpeError, ValueError):
    """Raised when no rollout can start, because the motion is too short or the start is not known."""


@validated_dataclass(frozen=True, config={"extra": "forbid"})
class ShootingSettings:
    """Windows of rollouts.

    Attributes:
        horizon: number of frames of a window.
        num_windows: largest number of windows, spread evenly over the motion.
        single_frames: largest number of frames of the only rollout, if rollouts can start at the beginning only: some nodes are hidden, an initial velocity is
            sought, or a solver cannot be restarted.
    """

    horizon: Annotated[int, Field(ge=1)] = 20
    num_windows: Annotated[int, Field(ge=1)] = 6
    single_frames: Annotated[int, Field(ge=1)] = 100


@dataclass
class Shooting:
    """Rollouts of one scene as a function of its unknowns.

    Attributes:
        simulator: a learned simulator or a solver.
        observations: observed motion.
        unknowns: what is sought.
        starts: starting state of each window by its frame. If an initial velocity is sought by a model, it has no history yet.
        length: number of frames of each window.
        block: number of frames whose misfits count as one sample of the uncertainty.
        num_evaluations, num_gradients: numbers of calls so far.
    """

    simulator: Simulator
    observations: Observations
    unknowns: Unknowns
    starts: dict[int, State]
    length: int
    block: int
    num_evaluations: int = 0
    num_gradients: int = 0

    def misfit(self, z: Sequence[float] | np.ndarray) -> float:
        """Return the misfit at numbers from 0 to 1 [unknown]."""
        return float(self.block_misfits(z).mean())

    def block_misfits(self, z: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "block"]:
        """Return the misfit of each block of frames."""
        return np.log(_block_means(self.errors(z), self.block) + FLOOR)

    def errors(self, z: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "window frame"]:
        """Return the mean squared displacement of observed nodes [spacings²]. It is ``FAILED`` after a rollout failed, and NaN where nothing is observed."""
        self.num_evaluations += 1
        with torch.no_grad():
            z = np.asarray(z, dtype=np.float64)
            errors = self._errors(torch.from_numpy(z) if isinstance(self.simulator, LearnedSimulator) else z)
        return np.array([[float(e) for e in window] for window in errors])

    def misfit_and_gradient(self, z: Sequence[float] | np.ndarray) -> tuple[float, Float64[np.ndarray, "unknown"]]:
        """Return the misfit and its gradient, which passes backwards through all rollouts.

        Raises:
            ShootingError: the simulator is a solver, which has no gradients.
        """
        if not isinstance(self.simulator, LearnedSimulator):
            raise ShootingError("solvers have no gradients; choose method=derivative_free")
        self.num_gradients += 1
        at = torch.tensor(np.asarray(z, dtype=np.float64), requires_grad=True)
        with torch.enable_grad():
            errors = self._errors(at)
            rows = [torch.stack([torch.as_tensor(e, dtype=torch.float64) for e in window]) for window in errors]
            terms = torch.stack(rows)
            is_known = ~terms.isnan()
            blocks = _block_numbers(terms.shape[0], terms.shape[1], self.block)
            means = [terms[is_known & torch.from_numpy(blocks == k)].mean() for k in np.unique(blocks[is_known.numpy()])]
            misfit = torch.log(torch.stack(means) + FLOOR).mean()
            (gradient,) = torch.autograd.grad(misfit, at)
        return misfit.item(), gradient.numpy()

    def _errors(self, z: Any) -> list[list[Any]]:
        metadata = self.observations.trajectory.metadata
        states = {frame: started(self.simulator, self.unknowns, state, z, metadata) for frame, state in self.starts.items()}
        errors: dict[int, list[Any]] = {frame: [FAILED] * self.length for frame in states}
        for frame in states:
            for k in range(1, self.length + 1):
                if not self.observations.seen[frame + k].any():
                    errors[frame][k - 1] = np.nan
        for (start, k), error in rollout_scores(self.simulator, states, self.length, self._error).items():
            errors[start][k - 1] = error if bool(error < FAILED) else FAILED  # also if it is NaN
        return list(errors.values())

    def _error(self, start: int, k: int, state: State) -> Any:
        """Return the mean squared displacement in frame ``k`` after a start [spacings²], or None if nothing is observed."""
        if not self.observations.seen[start + k].any():
            return None
        rows, target = self._target(start, k, state.pos)
        difference = state.periodicity.shortest(state.pos[rows] - target) / self.observations.trajectory.metadata.spacing
        return (difference**2).sum() / len(target)

    def _target(self, start: int, k: int, like: Any) -> tuple[Any, Any]:
        """Return rows and positions of the nodes observed in frame ``k`` after a start, as arrays or tensors like ``like``."""
        seen = self.observations.seen[start + k]
        rows: Any = slice(None) if seen.all() else np.flatnonzero(seen)
        target: Any = self.observations.trajectory.pos[start + k, rows].astype(np.float64)
        if isinstance(like, torch.Tensor):
            rows, target = rows if isinstance(rows, slice) else torch.from_numpy(rows), torch.from_numpy(target)
        return rows, target


def shooting(simulator: Simulator, observations: Observations, unknowns: Unknowns, settings: ShootingSettings | None = None) -> Shooting:
    """Return the rollouts of a scene. A learned simulator does not clamp parameters: optimisers keep bounds, and gradients would vanish beyond them.

    Raises:
        ShootingError: the solver has other frames or materials than the motion, the motion is too short, or it begins after the start of the scene and the
            solver cannot be restarted.
        SceneError: the scene does not fit the model.
    """
    if (stop := unfit(simulator, observations.trajectory.metadata)) is not None:
        raise ShootingError(stop.message)
    s = settings or ShootingSettings()
    is_learned, completed = isinstance(simulator, LearnedSimulator), observations.completed
    first = observations.first_frame
    if first and unknowns.needs_start:
        raise ShootingError(
            f"an initial velocity is sought, but the first observed frame is {first}; begin the trajectory with an observed frame"
        )
    first += simulator.builder.config.history if isinstance(simulator, LearnedSimulator) and not unknowns.needs_start else 0
    can_restart = is_learned or (isinstance(simulator, Restartable) and simulator.can_restart)
    is_single = observations.has_hidden_nodes or unknowns.needs_start or not can_restart
    length = min(s.single_frames if is_single else s.horizon, observations.last_frame - first)
    if length < 1:
        raise ShootingError(
            f"the motion has {observations.last_frame + 1} observed frames; rollouts start at frame {first}, so it needs more"
        )
    if not can_restart and (observations.trajectory.start_time > 0 or observations.first_frame > 0):
        raise ShootingError("the motion begins after the start of the scene, and this solver needs the start; choose simulator=model")
    last = observations.last_frame - length
    number = 1 if is_single else min(s.num_windows, 1 + (last - first) // max(1, length // 2))
    frames = sorted({int(f) for f in np.linspace(first, last if number > 1 else first, number).round()})
    observed = observations.frames[(observations.frames >= first) & (observations.frames <= last)]
    if not is_single and len(observed):  # interpolated states in long gaps can be far from the truth
        frames = sorted({int(observed[np.abs(observed - f).argmin()]) for f in frames})
    if not any(observations.seen[f + 1 : f + length + 1].any() for f in frames):
        raise ShootingError(f"no frame within shooting.horizon={s.horizon} of the starts {frames} is observed; choose a longer horizon")
    if isinstance(simulator, LearnedSimulator):
        simulator = simulator.configured(clamps_parameters=False)
        device = simulator.acceleration_std.device
        starts = {f: completed.state(f).to_torch(device) if unknowns.needs_start else simulator.initial_state(completed, f) for f in frames}
    else:
        starts = {f: completed.state(f) for f in frames}
        if can_restart:
            starts = {f: simulator.restarted(state) if f > 0 else state for f, state in starts.items()}  # type: ignore[attr-defined]
    return Shooting(simulator, observations, unknowns, starts, length, min(s.horizon, length))


def started(simulator: Simulator, unknowns: Unknowns, state: State, z: Any, metadata: Metadata) -> State:
    """Return the start of a rollout with the values at ``z`` [unknown]. If a model's initial velocity is sought, its history follows from that velocity."""
    new = unknowns.applied(state, z)
    return simulator.standing(new, metadata) if isinstance(simulator, LearnedSimulator) and unknowns.needs_start else new


def _block_numbers(num_windows: int, num_frames: int, block: int) -> np.ndarray:
    """Return the number of the block of each window and frame [window, frame]. A short rest belongs to the block before it."""
    per_window = max(1, num_frames // block)
    within = np.minimum(np.arange(num_frames) // block, per_window - 1)
    return np.arange(num_windows)[:, None] * per_window + within


def _block_means(terms: np.ndarray, block: int) -> np.ndarray:
    """Return the mean of known terms [window, frame] in each block that has any."""
    number, is_known = _block_numbers(terms.shape[0], terms.shape[1], block).ravel(), ~np.isnan(terms).ravel()
    total = np.bincount(number[is_known], terms.ravel()[is_known])
    count = np.bincount(number[is_known])
    return total[count > 0] / count[count > 0]
