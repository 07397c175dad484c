"""Training samples: short windows of trajectories as graphs with a target acceleration.

A sample depends only on split, seed and sample number. Runs therefore resume exactly, with any number of workers. Cached arrays are read-only.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, overload

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset
from torch_geometric.data import HeteroData

from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.damage import damage
from gpe_pl.data.noise import Noise
from gpe_pl.data.open_windows import check_settings, continued
from gpe_pl.data.solver_targets import SolverTargets
from gpe_pl.data.training_samples import Unroll, UnrollStart, training_graph
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.rollout.loop import Restartable
from gpe_pl.trajectory import integrators
from gpe_pl.trajectory.openings import carried
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.store import StoreError, UnsoundError, open_field, open_group, open_shard, read_trajectory, shards, trajectory_names
from gpe_pl.trajectory.trajectory import Trajectory

log = logging.getLogger(__name__)

LOOKED_AT = 20
"""Number of trajectories, and of their first frames, in which a pull is looked for that data do not store as gravity."""


class StartKey(NamedTuple):
    """Key of a push-forward sample. Successive batches of a lane continue the same unrolls, until the lane takes other windows.

    Attributes:
        sample: sample number.
        window: number of the window at which the unroll starts.
        num_steps: number of steps of the unroll.
        lane: number of the lane.
        correction: fraction of the velocity's deviation after the unroll that the target removes within one step.
    """

    sample: int
    window: int
    num_steps: int
    lane: int = 0
    correction: float = 1.0


@dataclass(frozen=True)
class UnrollKey:
    """Key of a sample that is unrolled with gradients, for ``WindowDataset.unroll_steps`` steps.

    Attributes:
        sample: sample number.
        window: number of the window at which the unroll starts.
    """

    sample: int
    window: int


Key = int | tuple[int, int] | StartKey | UnrollKey
"""Key of a sample: the number of a window; sample number and window; or the key of a push-forward sample or of an unroll with gradients."""

Scale = tuple[float, float]
"""Rest spacing [m] and frame interval [s] of a scene."""

CACHE_BYTES = 2 * 1024**3
"""A split is cached in memory if its compressed files have at most half this size [bytes]. Larger splits are read from disk window by window. Cached graphs may
take this much memory, too."""

MAX_DAMAGED = 0.2
"""Maximum fraction of a split's trajectories that may be left out. One trajectory may always be left out."""


@dataclass(frozen=True)
class StoredTrajectory:
    """A trajectory in a shard: where it is stored, and its arrays if they are cached. With a stride, its frames are every ``stride``-th stored frame.

    Attributes:
        path: shard.
        name: name of the trajectory in the shard.
        num_stored: number of stored frames.
        num_nodes: number of dynamic nodes.
        cached: the trajectory with all stored frames if the split is cached in memory and its values are valid, else None.
        stride: number of stored frames in a frame.
        phase: stored frame that is frame 0 of this view.
        is_open: whether its nodes enter and leave.
    """

    path: Path
    name: str
    num_stored: int
    num_nodes: int
    cached: Trajectory | None
    stride: int = 1
    phase: int = 0
    is_open: bool = False

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return max(0, -(-(self.num_stored - self.phase) // self.stride))

    def window(self, start: int, stop: int) -> Trajectory:
        """Return the frames ``start:stop``.

        Raises:
            StoreError: the trajectory cannot be read, or has invalid values.
        """
        first, last = self.phase + start * self.stride, min(self.phase + stop * self.stride, self.num_stored)
        if self.cached is not None:
            return self.cached.frames(first, last).every(self.stride)
        return read_trajectory(self.path, self.name, frames=slice(first, last)).every(self.stride)

    def whole(self) -> Trajectory:
        """Return all stored frames. Their digest is verified, either now or when they were cached. Errors are those of ``window``."""
        return read_trajectory(self.path, self.name, verify=True) if self.cached is None else self.cached


def scale_of(stored: StoredTrajectory) -> Scale:
    """Return the rest spacing and frame interval of a trajectory."""
    metadata = stored.window(0, 1).metadata
    return metadata.spacing, metadata.frame_dt


def every(trajectories: Sequence[StoredTrajectory], stride: int, phases: int = 1) -> list[StoredTrajectory]:
    """Return views of every ``stride``-th stored frame.

    Args:
        trajectories: trajectories with all stored frames.
        stride: number of stored frames in a frame.
        phases: number of views of each trajectory. They begin at its stored frames 0 to ``phases - 1``.
    """
    return [replace(stored, stride=stride, phase=phase) for stored in trajectories for phase in range(phases)]


def open_split(root: Path | str, split: str, cache_bytes: int = CACHE_BYTES) -> list[StoredTrajectory]:
    """Index all trajectories of a split with all stored frames, and cache them in memory if the split is small enough.

    Raises:
        StoreError: the split has no trajectories, or a shard is damaged. Invalid values are not an error here; ``usable`` reports them.
    """
    paths = shards(root, split)
    fits = 2 * sum(p.stat().st_size for p in paths) <= cache_bytes
    stored = []
    for path in paths:
        with open_shard(path) as file:
            groups = {name: open_group(file, name) for name in sorted(file)}
            shapes = {name: (*open_field(group, "pos").shape[:2], "alive" in group) for name, group in groups.items()}
        for name, (num_frames, num_nodes, is_open) in shapes.items():
            cached = None
            if fits:
                with suppress(UnsoundError):  # ``usable`` reports it
                    cached = _read_only(read_trajectory(path, name, verify=True))
            stored.append(StoredTrajectory(path, name, num_frames, num_nodes, cached, is_open=is_open))
    if not stored:
        raise StoreError(f"{paths[0].parent}: its shards hold no trajectories; generate or import the data again")
    return stored


def long_enough(root: Path | str, split: str, history: int, stride: int = 1) -> Iterator[tuple[int, Trajectory]]:
    """Yield every ``stride``-th frame of the valid trajectories of a split that have at least ``history + 2`` such frames, and warn of the others.

    A model needs ``history`` velocities before a frame and one frame to predict.

    Yields:
        Number of the trajectory among all of the split, so that it does not depend on ``history`` and ``stride``; and the trajectory.
    """
    places = ((path, name) for path in shards(root, split) for name in trajectory_names(path))
    for number, (path, name) in enumerate(places):
        try:
            trajectory = read_trajectory(path, name, verify=True)
        except UnsoundError as error:
            _warn(path, name, error.fault)
            continue
        fault = damage(trajectory, stride)
        trajectory = trajectory.every(stride)
        if fault is None and trajectory.num_frames < history + 2:
            fault = f"its {trajectory.num_frames} frames are fewer than the {history + 2} that a start at frame {history} needs"
        if fault is None:
            yield number, trajectory
        else:
            _warn(path, name, fault)


def _warn(path: Path, name: str, fault: str) -> None:
    log.warning("%s:%s: left out, %s; see `python -m gpe_pl.data.validate`", path, name, fault)


def usable(trajectories: list[StoredTrajectory], stride: int = 1) -> list[StoredTrajectory]:
    """Return the trajectories that can be learned from, and warn of the others.

    Args:
        trajectories: trajectories with all stored frames.
        stride: number of stored frames in a frame of the model.

    Raises:
        StoreError: no trajectory can be used, or too many cannot: more than one, and more than the fraction ``MAX_DAMAGED``.
    """
    found = []
    for stored in trajectories:
        try:
            fault = damage(stored.whole(), stride)
        except UnsoundError as error:
            fault = error.fault
        if fault is None:
            found.append(stored)
        else:
            _warn(stored.path, stored.name, fault)
    num_damaged = len(trajectories) - len(found)
    if not found or num_damaged > max(1, MAX_DAMAGED * len(trajectories)):
        where = trajectories[0].path.parent
        raise StoreError(
            f"{where}: {num_damaged} of {len(trajectories)} trajectories cannot be used; see the warnings above, then generate or import the data again"
        )
    return found


def _read_only(trajectory: Trajectory) -> Trajectory:
    """Make the arrays of a trajectory read-only, and return it."""
    parts = (trajectory, trajectory.boundary, *([motion] if (motion := trajectory.boundary.motion) else []))
    for array in (value for part in parts for value in vars(part).values()):
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return trajectory


Samples: TypeAlias = HeteroData | list[UnrollStart] | list[Unroll]
"""Samples of an optimiser step: one batch of graphs, the starts of unrolls of push-forward, or unrolls with gradients."""


def collated(samples: list[HeteroData | UnrollStart | Unroll]) -> Samples:
    """Join samples of one kind: graphs become one batch, starts and unrolls a list."""
    starts = [sample for sample in samples if isinstance(sample, UnrollStart)]
    unrolls = [sample for sample in samples if isinstance(sample, Unroll)]
    return starts or unrolls or batched(samples)


def window_counts(trajectories: Sequence[StoredTrajectory], history: int, steps: int = 1) -> list[int]:
    """Count the windows of frames t − H … t + ``steps`` in each trajectory of a split.

    Raises:
        StoreError: no trajectory is long enough for a window.
    """
    counts = [max(0, t.num_frames - history - steps) for t in trajectories]
    if not any(counts):
        longest = max((t.num_frames for t in trajectories), default=0)
        where = f"{trajectories[0].path.parent}: " if trajectories else ""
        keys = "graph.history, evaluation.start_time" if steps == 1 else "graph.history, training.unroll_steps"
        needed = f"{history + steps + 1} frames that a start at frame {history} needs ({keys})"
        strided = f" with data.stride={trajectories[0].stride}" if trajectories and trajectories[0].stride > 1 else ""
        smaller = "stride, an earlier start" if strided else "history, an earlier start"
        raise StoreError(
            f"{where}no trajectory has the {needed}; the longest has {longest}{strided}; choose a smaller {smaller} or longer trajectories"
        )
    return counts


class WindowDataset(Dataset[HeteroData | UnrollStart | Unroll]):
    """Windows x[t−H … t+1] of a split as graphs at frame t.

    Every material's store has ``target`` [node, dim] in m/s²: the acceleration from t to t+1 without gravity, from float64 differences. For error
    messages, the graph has the numbers ``trajectory``, among the usable ones of the split, and ``frame``, among the stored ones.

    Args:
        trajectories: trajectories of the split, or views of them as ``every`` returns them.
        builder: builder of the graphs.
        noise: noise on inputs; None for evaluation.
        velocity_unit: root mean square acceleration × frame interval [m/s], the unit of velocity noise.
        seed: seed of noise and augmentation.
        solver: gives the targets of noisy and unrolled states; None takes those that lead back to the trajectory.
        augmentation: images of windows; those beyond mirror images do not go together with ``solver``.
        stress: also give the Cauchy stress at t+1 of materials that have one, as ``stress_target`` [node, component] in Pa.
        unroll_steps: number of steps of an unroll with gradients. Each window then has at least that many true frames after t.

    Attributes:
        probability: probability of drawing each window [window], or None if all are equal. With it, graphs have a ``weight``: the uniform probability
            divided by this one.
        is_open: whether nodes enter and leave in any trajectory. Graphs then have a mask ``without_target`` [node] of nodes from which nothing is learned.
        scales: scale of each trajectory; empty unless ``builder.config.scales`` allows several.
        velocity_units: ``velocity_unit`` of scales that have their own.

    Raises:
        AugmentationError: the scenes do not have a symmetry of ``augmentation``.
        OpenScenesError: the scenes are open, and a setting needs nodes that stay.
        StoreError: no trajectory is long enough. Reading a window raises it if the trajectory cannot be read, or has invalid values.
    """

    def __init__(
        self,
        trajectories: list[StoredTrajectory],
        builder: GraphBuilder,
        noise: Noise | None = None,
        velocity_unit: float = 0.0,
        seed: int = 0,
        stress: bool = False,
        solver: Restartable | None = None,
        augmentation: Augmentation = Augmentation(),  # noqa: B008
        unroll_steps: int = 1,
    ) -> None:
        self.trajectories, self.builder, self.noise, self.stress, self.solver = trajectories, builder, noise, stress, solver
        self.augmentation, self.unroll_steps = augmentation, unroll_steps
        if augmentation.is_beyond_mirror:
            for stored in trajectories:
                augmentation.check(stored.window(0, 1))
        if augmentation.is_idle(stored.window(0, 1) for stored in trajectories[:LOOKED_AT]):
            log.warning(
                "training.mirror, training.boost_speed: they change no window, as no axis is level: gravity is not along an axis, or walls face one way "
                "along every axis; leave these settings off"
            )
        if pulled := augmentation.hidden_pull(stored.window(0, LOOKED_AT) for stored in trajectories[:LOOKED_AT]):
            axes = " and ".join("xyz"[axis] for axis in pulled)
            log.warning(
                "training.mirror, training.rotate: no gravity is stored, but nodes accelerate along %s, which images turn over; store gravity "
                "(gravity=[…] of convert), or leave these settings off",
                axes,
            )
        self.is_open = any(trajectory.is_open for trajectory in trajectories)
        if self.is_open:
            check_settings(unroll_steps, solver is not None, augmentation != Augmentation())
        self.velocity_unit, self.seed = velocity_unit, seed
        self.probability: np.ndarray | None = None
        counts = window_counts(trajectories, builder.config.history, unroll_steps)
        self.ends = np.cumsum(counts)
        if short := counts.count(0):
            frames = builder.config.history + unroll_steps + 1
            log.warning(
                "%s: %d of %d trajectories have fewer than %d frames and give no window",
                trajectories[0].path.parent,
                short,
                len(counts),
                frames,
            )
        self._num_phases = 1 + max(t.phase for t in trajectories)
        self.scales = [] if builder.config.scales == "one" else [scale_of(stored) for stored in trajectories]
        self.velocity_units: Mapping[Scale, float] = {}
        self._builders = {scale: builder.at(*scale) for scale in self.scales}

    def __len__(self) -> int:
        return int(self.ends[-1])

    def locate(self, window: int) -> tuple[int, int]:
        """Return trajectory number and frame t of a window."""
        trajectory = int(np.searchsorted(self.ends, window, side="right"))
        start = 0 if trajectory == 0 else int(self.ends[trajectory - 1])
        return trajectory, window - start + self.builder.config.history

    def num_nodes(self, window: int) -> int:
        """Number of dynamic nodes in a window, without boundary nodes and virtual nodes."""
        return self.trajectories[self.locate(window)[0]].num_nodes

    def scale(self, window: int) -> Scale | None:
        """Scale of a window; None if the data have only one."""
        return self.scales[self.locate(window)[0]] if self.scales else None

    def activity(self) -> np.ndarray:
        """Return the root mean square acceleration without gravity of each window [window] in m/s². This reads the whole split."""
        values = []
        for stored in self.trajectories:
            trajectory = stored.window(0, max(0, stored.num_frames - self.unroll_steps + 1))
            metadata = trajectory.metadata
            velocities = integrators.velocities(trajectory.pos.astype(np.float64), metadata.frame_dt, metadata.periodicity)
            acc = integrators.acceleration(velocities[1:], velocities[:-1], metadata.frame_dt) - np.asarray(metadata.gravity)
            stays = (
                np.ones(acc.shape[:2], bool)
                if trajectory.alive is None
                else np.all([trajectory.alive[k:][: len(acc)] for k in range(3)], axis=0)
            )
            counted = np.repeat(stays[..., None], metadata.dim, axis=2)
            if trajectory.prescribed is not None:
                counted &= ~trajectory.prescribed
            square = np.where(counted, acc**2, 0.0).sum(axis=(1, 2)) / np.maximum(1, counted.sum(axis=(1, 2)))
            values.append(np.sqrt(square)[self.builder.config.history - 1 :])
        return np.concatenate(values)

    @overload
    def __getitem__(self, key: int | tuple[int, int]) -> HeteroData: ...

    @overload
    def __getitem__(self, key: StartKey) -> UnrollStart: ...

    @overload
    def __getitem__(self, key: UnrollKey) -> Unroll: ...

    def __getitem__(self, key: Key) -> HeteroData | UnrollStart | Unroll:
        """Return the graph of a window, the start of an unroll for a ``StartKey``, or an unroll for an ``UnrollKey``.

        The trajectory's length limits the unroll of a ``StartKey``.
        """
        start = key if isinstance(key, StartKey) else None
        is_unroll = isinstance(key, UnrollKey)
        sample, window = (key.sample, key.window) if isinstance(key, UnrollKey) else (key, key) if isinstance(key, int) else key[:2]
        number, frame = self.locate(window)
        scale = self.scales[number] if self.scales else None
        builder = self.builder if scale is None else self._builders[scale]
        history = builder.config.history
        stored = self.trajectories[number]
        ahead = self.unroll_steps - 1 if is_unroll else 0 if start is None else min(start.num_steps, stored.num_frames - 2 - frame)
        original = stored.window(frame - history, frame + 2 + ahead)
        reflection = self.augmentation.reflection(original, self.seed, sample)
        trajectory = self.augmentation.moved(reflection.trajectory(original), history, self.seed, sample)
        dt = trajectory.metadata.frame_dt
        truth = continued(trajectory)
        pos, is_given = truth[: history + 2], carried(trajectory.openings, truth[history])[:, None]
        if trajectory.prescribed is not None:
            is_given = is_given | trajectory.prescribed
        if self.noise is not None:
            rng = np.random.default_rng((self.seed, sample))
            unit = self.velocity_unit if scale is None else self.velocity_units.get(scale, self.velocity_unit)
            pos = self.noise.apply(pos, original.metadata.longest_side, unit, dt, rng)
            if is_given.any():  # their motion is given exactly
                pos = np.where(is_given, truth[: history + 2], pos)
        velocities = integrators.velocities(pos, dt, trajectory.metadata.periodicity)
        gravity = np.asarray(trajectory.metadata.gravity)
        past = np.ascontiguousarray(velocities[:-1].swapaxes(0, 1))
        true = integrators.velocities(truth[history - 1 : history + 1], dt, trajectory.metadata.periodicity)[0]
        at_frame = trajectory.vel[history].astype(np.float64) + (past[:, -1] - true)  # noise on the mean velocity is on this one, too
        state = State(
            pos[-2],
            past[:, -1],
            trajectory.node_type,
            trajectory.mass,
            trajectory.material_params,
            trajectory.boundary.at(history),
            gravity,
            past,
            trajectory.start_time + history * dt,
            trajectory.rest_pos,
            trajectory.cells,
            cell_dim=trajectory.cell_dim,
            periodicity=trajectory.metadata.periodicity,
            param_names=trajectory.metadata.param_names,
            frame_velocity=at_frame,
            rigid_body=trajectory.rigid_body,
            loads=trajectory.loads_at(history),
            stress=_stress_at(trajectory, history) if self.builder.spec.reads_stress else None,
        )
        rows, alive = np.arange(state.num_nodes), None
        if self.is_open:
            alive = np.ones(truth.shape[:2], bool) if trajectory.alive is None else trajectory.alive
            state, rows = _living(state, trajectory, history)
        state = state.to_torch()
        stress = None
        if self.stress and trajectory.stress is not None:
            stress = torch.from_numpy(np.array(trajectory.stress.node[history + 1 :], dtype=np.float32))
        about: dict[str, Any] = {"trajectory": number // self._num_phases, "frame": stored.phase + frame * stored.stride}
        if self.probability is not None:
            about["weight"] = 1 / (len(self) * float(self.probability[window]))
        deviates = start is not None or (self.noise is not None and self.noise.is_any)
        targets = None if self.solver is None or not deviates else SolverTargets.of(self.solver, original, history, reflection)
        if start is not None or targets is not None:
            correction = 0.0 if self.noise is None else self.noise.correction
            key = start or StartKey(sample, window, 0)
            unroll = UnrollStart(
                state,
                torch.from_numpy(truth[history:]),
                stress,
                correction,
                key.correction,
                about,
                sample,
                key.lane,
                targets,
                None if alive is None else torch.from_numpy(alive[history:].copy()),
                scale,
            )
            return unroll if start else unroll.graph(builder, state, 0)
        target = (integrators.acceleration(velocities[-1], velocities[-2], dt) - gravity)[rows]
        unknown = (
            None if alive is None else torch.from_numpy(~alive[history + 1][rows] | carried(trajectory.openings, truth[history][rows]))
        )
        graph = training_graph(builder, state, torch.from_numpy(target), None if stress is None else stress[0], about, unknown)
        if not is_unroll:
            return graph
        kept = 0.0 if self.noise is None else 1 - self.noise.correction  # fraction of the noise on the position that a step keeps
        left = kept ** np.arange(1, self.unroll_steps + 1)[:, None, None]
        reference = truth[history + 1 :] + left * (pos[history] - truth[history])
        return Unroll(graph, state, torch.from_numpy(reference), stress, about)


def _stress_at(trajectory: Trajectory, frame: int) -> Stress | None:
    """Return the true stress at a frame of a window; None if the trajectory has none."""
    return None if trajectory.stress is None else Stress(np.array(trajectory.stress.node[frame]), np.array(trajectory.stress.cell[frame]))


def _living(state: State, window: Trajectory, frame: int) -> tuple[State, np.ndarray]:
    """Return the nodes of a state that are in the scene at a frame of a window, with their columns as identities, and these columns [node]."""
    if window.alive is None:
        return state, np.arange(state.num_nodes)
    nodes, known = np.flatnonzero(window.alive[frame]), np.flatnonzero(window.alive[: frame + 1].any(axis=0))
    return replace(state.take(nodes), openings=window.openings, node_id=nodes, next_id=int(known[-1]) + 1), nodes


class CachedGraphs(Dataset[HeteroData]):
    """Windows as graphs that are built at first use and then cached.

    Args:
        windows: data set of the windows.
        cache_bytes: maximum memory of cached graphs [bytes]. Further graphs are built at every use.
    """

    def __init__(self, windows: WindowDataset, cache_bytes: int = CACHE_BYTES) -> None:
        self.windows, self.free_bytes = windows, cache_bytes
        self.graphs: dict[int, HeteroData] = {}

    def __getitem__(self, window: int) -> HeteroData:
        if window in self.graphs:
            return self.graphs[window]
        graph = self.windows[window]
        size = sum(value.nbytes for store in graph.stores for value in store.values() if isinstance(value, Tensor))
        if size <= self.free_bytes:
            self.free_bytes -= size
            self.graphs[window] = graph
        return graph
