"""Training samples: short windows of trajectories as graphs with a target acceleration.

A sample is a pure function of (split, seed, sample number): runs resume exactly, whatever the number of workers. Stored arrays are read-only.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset
from torch_geometric.data import HeteroData

from gpe_pl.data.noise import Noise
from gpe_pl.data.statistics import FRAMES_AT_ONCE
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import StoreError, UnsoundError, open_field, open_group, open_shard, read_trajectory, shards, trajectory_names
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)


class StartKey(NamedTuple):
    """A window to start from for steps of the model's own; batches of the same ``lane`` go on where the last one has come to.

    ``correction`` is the share of what the velocity has gone astray by in these steps that the target takes back within one.
    """

    sample: int
    window: int
    own_steps: int
    lane: int = 0
    correction: float = 1.0


Key = int | tuple[int, int] | StartKey
"""A window's number; or sample number and window; or a start."""

CACHE_BYTES = 2 * 1024**3
"""Splits smaller than this are held in memory; larger ones are read from disk window by window. Graphs that are needed again are held up to as much."""


MAX_DAMAGED = 0.2
"""Share of a split's trajectories that may be left out; one may always."""
MAX_JUMP, MIN_RATIO = 2.0, 10.0
"""A way within a frame longer than so many neighbour radii, and so many times that within the frame before or after it, is a fault of the data."""


@dataclass(frozen=True)
class StoredTrajectory:
    """Where a trajectory lies, and the trajectory itself if the split is held in memory and nothing is wrong with it."""

    path: Path
    name: str
    num_frames: int
    num_nodes: int
    held: Trajectory | None

    def window(self, start: int, stop: int) -> Trajectory:
        """Frames ``start:stop``; raises ``StoreError``, also for values that nothing can be learned from."""
        if self.held is not None:
            return self.held.frames(start, stop)
        return read_trajectory(self.path, self.name, frames=slice(start, stop))

    def whole(self) -> Trajectory:
        """All frames, compared with the digest that they were stored with; raises ``StoreError`` as ``window`` does."""
        return read_trajectory(self.path, self.name, verify=True) if self.held is None else self.held


def open_split(root: Path | str, split: str, cache_bytes: int = CACHE_BYTES) -> list[StoredTrajectory]:
    """Index all trajectories of a split, holding them in memory if they are small enough."""
    paths = shards(root, split)
    hold = 2 * sum(p.stat().st_size for p in paths) <= cache_bytes
    stored = []
    for path in paths:
        with open_shard(path) as file:
            shapes = {name: open_field(open_group(file, name), "pos").shape[:2] for name in sorted(file)}
        for name, (num_frames, num_nodes) in shapes.items():
            held = None
            if hold:
                with suppress(UnsoundError):  # which ``usable`` will meet again
                    held = _read_only(read_trajectory(path, name, verify=True))
            stored.append(StoredTrajectory(path, name, num_frames, num_nodes, held))
    return stored


def long_enough(root: Path | str, split: str, history: int) -> Iterator[Trajectory]:
    """The undamaged trajectories of a split that have a frame with so many velocities and one to predict; warns of the others."""
    for path in shards(root, split):
        for name in trajectory_names(path):
            try:
                trajectory = read_trajectory(path, name, verify=True)
            except UnsoundError as error:
                _warn(path, name, error.fault)
                continue
            fault = damage(trajectory)
            if fault is None and trajectory.num_frames < history + 2:
                fault = f"its {trajectory.num_frames} frames are fewer than the {history + 2} that a start at frame {history} needs"
            if fault is None:
                yield trajectory
            else:
                _warn(path, name, fault)


def _warn(path: Path, name: str, fault: str) -> None:
    log.warning("%s:%s: left out, %s; see `python -m gpe_pl.data.validate`", path, name, fault)


def usable(trajectories: list[StoredTrajectory]) -> list[StoredTrajectory]:
    """Those that can be learned from; warns of the others.

    Raises:
        StoreError: more than one, and more than ``MAX_DAMAGED`` of them, cannot be.
    """
    found = []
    for stored in trajectories:
        try:
            fault = damage(stored.whole())
        except UnsoundError as error:
            fault = error.fault
        if fault is None:
            found.append(stored)
        else:
            _warn(stored.path, stored.name, fault)
    num_damaged = len(trajectories) - len(found)
    if not found or num_damaged > max(1, MAX_DAMAGED * len(trajectories)):
        where = trajectories[0].path.parent
        raise StoreError(f"{where}: {num_damaged} of {len(trajectories)} trajectories cannot be used; see the warnings above")
    return found


def damage(trajectory: Trajectory) -> str | None:
    """Why a trajectory whose values are sound cannot be learned from, with the frame and node, or None."""
    pos, metadata = trajectory.pos, trajectory.metadata
    if trajectory.num_nodes == 0:
        return "it has no nodes"
    bounds = np.array(metadata.bounds)
    width = np.ptp(bounds, axis=1)
    low, high = (
        limits.astype(pos.dtype) for limits in (bounds[:, 0] - width, bounds[:, 1] + width)
    )  # long trajectories would not fit twice
    near = (pos >= low) & (pos <= high)
    if not near.all():
        frame, node = np.argwhere(~near)[0, :2]
        return f"the position of node {node} in frame {frame} is farther outside the domain than this is wide"
    return _jump(trajectory)


def _jump(trajectory: Trajectory) -> str | None:
    """A node that goes farther than neighbours see between two frames, but hardly moves before or after them.

    What is fast is so for more than a frame; a frame that went wrong is the largest of all accelerations, and the scale to which all others are related.
    """
    limit = MAX_JUMP * trajectory.metadata.connectivity_radius
    for start in range(0, trajectory.num_frames - 1, FRAMES_AT_ONCE):
        first = max(0, start - 1)
        pos = trajectory.pos[first : start + FRAMES_AT_ONCE + 2].astype(np.float64)
        way = np.linalg.norm(integrators.velocities(pos, 1.0, trajectory.metadata.periodicity), axis=-1)
        before, after = np.full_like(way, np.inf), np.full_like(way, np.inf)
        before[1:], after[:-1] = way[:-1], way[1:]
        jumps = np.argwhere((way > limit) & (np.minimum(before, after) < way / MIN_RATIO))
        if len(jumps):
            frame, node = jumps[0]
            where = f"between frames {first + frame} and {first + frame + 1}"
            return f"node {node} jumps by {way[frame, node]:.3g} m {where}"
    return None


def _read_only(trajectory: Trajectory) -> Trajectory:
    """The same trajectory; writing to its arrays raises."""
    parts = (trajectory, trajectory.boundary, *([motion] if (motion := trajectory.boundary.motion) else []))
    for array in (value for part in parts for value in vars(part).values()):
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return trajectory


@dataclass(frozen=True)
class Start:
    """A state for a model to start from, and what truly follows.

    Attributes:
        state: with noise, as float64 tensors.
        truth: positions [own_steps + 2, node, dim] of the frames from the state's on [m].
        stress: true Cauchy stress [own_steps + 1, node, component] of the frames after the state's [Pa], where it is asked for.
        position_correction: share of the distance from the true position that the target takes back within a step; see ``Noise``.
        velocity_correction: the same of the velocity, after own steps; as in the key.
        about: trajectory and frame, and the weight in the loss if there is one.
        sample, lane: as in the key.
    """

    state: State
    truth: Tensor
    stress: Tensor | None
    position_correction: float
    velocity_correction: float
    about: dict[str, Any]
    sample: int
    lane: int

    @property
    def own_steps(self) -> int:
        """How many steps a model is to make by itself."""
        return self.truth.shape[0] - 2

    def to(self, device: Any) -> Start:
        """The same on a device."""
        stress = None if self.stress is None else self.stress.to(device)
        return replace(self, state=self.state.to_torch(device), truth=self.truth.to(device), stress=stress)

    def graph(self, builder: GraphBuilder, state: State, step: int) -> HeteroData:
        """The training graph of the state that a model has come to in so many steps.

        Its target is the true velocity that follows, plus what is to remain of the distance from the true velocity, minus what is to be taken back of that
        from the true position.
        """
        dt, where = builder.metadata.frame_dt, state.periodicity
        vel = integrators.velocities(self.truth[step : step + 2], dt, where)[0]
        if step:  # the noise of the start is taken back as a whole
            before = integrators.velocities(self.truth[step - 1 : step + 1], dt, where)[0]
            vel = vel + (1 - self.velocity_correction) * (state.vel - before)
        astray = integrators.velocities(torch.stack([self.truth[step], state.pos]), dt, where)[0]
        target = integrators.acceleration(vel - self.position_correction * astray, state.vel, dt) - state.gravity
        return training_graph(builder, state, target, None if self.stress is None else self.stress[step], self.about)


def training_graph(builder: GraphBuilder, state: State, target: Tensor, stress: Tensor | None, about: dict[str, Any]) -> HeteroData:
    """The graph of a state with what is to be predicted for each node: ``target`` [m/s²], and ``stress_target`` [Pa] where it is known."""
    data = builder(state)
    for material in builder.spec.materials:
        data[material].target = target.float()[data[material].node_id]
    if stress is not None:
        for material in builder.spec.stress_channels:
            data[material].stress_target = stress.float()[data[material].node_id]
    for name, value in about.items():
        data[name] = value
    return data


Samples: TypeAlias = HeteroData | list[Start]
"""What an optimiser step takes: graphs as one, or starts for own steps of the model."""


def collated(samples: list[HeteroData | Start]) -> Samples:
    """Samples of one kind together."""
    starts = [sample for sample in samples if isinstance(sample, Start)]
    return starts or batched(samples)


def window_counts(trajectories: Sequence[StoredTrajectory], history: int) -> list[int]:
    """How many windows of frames t − H … t + 1 each trajectory of a split has; raises ``StoreError`` where none has any."""
    counts = [max(0, t.num_frames - history - 1) for t in trajectories]
    if not any(counts):
        longest = max((t.num_frames for t in trajectories), default=0)
        where = f"{trajectories[0].path.parent}: " if trajectories else ""
        needed = f"{history + 2} frames that a start at frame {history} needs (graph.history, evaluation.start_frame)"
        raise StoreError(f"{where}no trajectory has the {needed}; the longest has {longest}")
    return counts


class WindowDataset(Dataset[HeteroData | Start]):
    """Windows x[t−H … t+1] of a split as graphs at frame t.

    Every material's store has ``target`` [node, dim]: the acceleration from t to t+1 without gravity [m/s²], from float64 differences. The graph carries
    ``trajectory`` and ``frame`` numbers for error messages.

    Args:
        trajectories: of the split.
        builder: makes the graphs.
        noise: applied to inputs; None for evaluation.
        velocity_unit: root mean square acceleration × frame interval [m/s], the unit of velocity noise.
        seed: of the noise.
        stress: also give the Cauchy stress at t+1, ``stress_target`` [node, component] in Pa, of materials that have one.

    Attributes:
        probability: of each window to be drawn, where they are not drawn alike; graphs then carry ``weight``, its inverse over that of equal chances.

    Raises:
        StoreError: no trajectory is long enough, or a window holds values that nothing can be learned from.
    """

    def __init__(
        self,
        trajectories: list[StoredTrajectory],
        builder: GraphBuilder,
        noise: Noise | None = None,
        velocity_unit: float = 0.0,
        seed: int = 0,
        stress: bool = False,
    ) -> None:
        self.trajectories, self.builder, self.noise, self.stress = trajectories, builder, noise, stress
        self.velocity_unit, self.seed = velocity_unit, seed
        self.probability: np.ndarray | None = None
        self.ends = np.cumsum(window_counts(trajectories, builder.config.history))

    def __len__(self) -> int:
        return int(self.ends[-1])

    def locate(self, window: int) -> tuple[int, int]:
        """Trajectory number and frame t of a window."""
        trajectory = int(np.searchsorted(self.ends, window, side="right"))
        start = 0 if trajectory == 0 else int(self.ends[trajectory - 1])
        return trajectory, window - start + self.builder.config.history

    def num_nodes(self, window: int) -> int:
        """Nodes of a window, without those of the boundary and of coarser levels."""
        return self.trajectories[self.locate(window)[0]].num_nodes

    def activity(self) -> np.ndarray:
        """Root mean square of the acceleration without gravity [m/s²] in each window; reads the whole split."""
        values = []
        for stored in self.trajectories:
            trajectory = stored.window(0, stored.num_frames)
            metadata = trajectory.metadata
            velocities = integrators.velocities(trajectory.pos.astype(np.float64), metadata.frame_dt, metadata.periodicity)
            acc = integrators.acceleration(velocities[1:], velocities[:-1], metadata.frame_dt) - np.asarray(metadata.gravity)
            values.append(np.sqrt(np.mean(acc**2, axis=(1, 2)))[self.builder.config.history - 1 :])
        return np.concatenate(values)

    @overload
    def __getitem__(self, key: int | tuple[int, int]) -> HeteroData: ...

    @overload
    def __getitem__(self, key: StartKey) -> Start: ...

    def __getitem__(self, key: Key) -> HeteroData | Start:
        """The graph of a window, or where own steps are asked for, a start for them: as many as the trajectory is long enough for."""
        start = key if isinstance(key, StartKey) else None
        sample, window = (key, key) if isinstance(key, int) else key[:2]
        number, frame = self.locate(window)
        history = self.builder.config.history
        stored = self.trajectories[number]
        ahead = 0 if start is None else min(start.own_steps, stored.num_frames - 2 - frame)
        trajectory = stored.window(frame - history, frame + 2 + ahead)
        dt = trajectory.metadata.frame_dt
        truth = trajectory.pos.astype(np.float64)
        pos = truth[: history + 2]
        if self.noise is not None:
            rng = np.random.default_rng((self.seed, sample))
            pos = self.noise.apply(pos, self.builder.metadata.longest_side, self.velocity_unit, dt, rng)
        velocities = integrators.velocities(pos, dt, trajectory.metadata.periodicity)
        gravity = np.asarray(trajectory.metadata.gravity)
        past = np.ascontiguousarray(velocities[:-1].swapaxes(0, 1))
        state = State(
            pos[-2],
            past[:, -1],
            trajectory.node_type,
            trajectory.mass,
            trajectory.material_params,
            trajectory.boundary.at(history),
            gravity,
            past,
            frame * dt,
            trajectory.rest_pos,
            trajectory.cells,
            cell_dim=trajectory.cell_dim,
            periodicity=trajectory.metadata.periodicity,
        ).to_torch()
        stress = None
        if self.stress and trajectory.stress is not None:
            stress = torch.from_numpy(np.array(trajectory.stress.node[history + 1 :], dtype=np.float32))
        about: dict[str, Any] = {"trajectory": number, "frame": frame}
        if self.probability is not None:
            about["weight"] = 1 / (len(self) * float(self.probability[window]))
        if start is not None:
            correction = 0.0 if self.noise is None else self.noise.correction
            return Start(state, torch.from_numpy(truth[history:]), stress, correction, start.correction, about, sample, start.lane)
        target = integrators.acceleration(velocities[-1], velocities[-2], dt) - gravity
        return training_graph(self.builder, state, torch.from_numpy(target), None if stress is None else stress[-1], about)


class HeldGraphs(Dataset[HeteroData]):
    """Windows of a data set as graphs that are built when they are first asked for.

    Args:
        windows: their data set.
        cache_bytes: of the graphs that are held in memory; those that come when it is used up are built every time.
    """

    def __init__(self, windows: WindowDataset, cache_bytes: int = CACHE_BYTES) -> None:
        self.windows, self.free_bytes = windows, cache_bytes
        self.held: dict[int, HeteroData] = {}

    def __getitem__(self, window: int) -> HeteroData:
        if window in self.held:
            return self.held[window]
        graph = self.windows[window]
        size = sum(value.nbytes for store in graph.stores for value in store.values() if isinstance(value, Tensor))
        if size <= self.free_bytes:
            self.free_bytes -= size
            self.held[window] = graph
        return graph
