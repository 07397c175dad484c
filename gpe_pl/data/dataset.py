"""Training samples: short windows of trajectories as graphs with a target acceleration.

A sample is a pure function of (split, seed, sample number): runs resume exactly, whatever the number of workers. Stored arrays are read-only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch.utils.data import Dataset, Sampler
from torch_geometric.data import HeteroData

from gpe_pl import integrators, ranks
from gpe_pl.data.noise import Noise
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.store import StoreError, open_group, open_shard, read_trajectory, shards
from gpe_pl.trajectory import State, Trajectory

CACHE_BYTES = 2 * 1024**3
"""Splits smaller than this are held in memory; larger ones are read from disk window by window."""


@dataclass(frozen=True)
class StoredTrajectory:
    """Where a trajectory lies, and the trajectory itself if the split is held in memory."""

    path: Path
    name: str
    num_frames: int
    num_nodes: int
    held: Trajectory | None

    def window(self, start: int, stop: int) -> Trajectory:
        """Frames ``start:stop``."""
        if self.held is not None:
            return self.held.frames(start, stop)
        return read_trajectory(self.path, self.name, frames=slice(start, stop))


def open_split(root: Path | str, split: str, cache_bytes: int = CACHE_BYTES) -> list[StoredTrajectory]:
    """Index all trajectories of a split, holding them in memory if they are small enough."""
    paths = shards(root, split)
    hold = 2 * sum(p.stat().st_size for p in paths) <= cache_bytes
    stored = []
    for path in paths:
        with open_shard(path) as file:
            shapes = {name: open_group(file, name)["pos"].shape[:2] for name in sorted(file)}
        for name, (num_frames, num_nodes) in shapes.items():
            held = _read_only(read_trajectory(path, name)) if hold else None
            stored.append(StoredTrajectory(path, name, num_frames, num_nodes, held))
    return stored


def _read_only(trajectory: Trajectory) -> Trajectory:
    """The same trajectory; writing to its arrays raises."""
    for array in (*vars(trajectory).values(), *vars(trajectory.boundary).values()):
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return trajectory


class WindowDataset(Dataset[HeteroData]):
    """Windows x[t−H … t+1] of a split as graphs at frame t.

    Every material's store has ``target`` [node, dim]: the acceleration from t to t+1 without gravity [m/s²], from float64 differences. The graph carries
    ``trajectory`` and ``frame`` numbers for error messages.

    Args:
        trajectories: of the split.
        builder: makes the graphs.
        noise: applied to inputs; None for evaluation.
        velocity_unit: acceleration std × frame interval [m/s], the unit of velocity noise.
        seed: of the noise.
        stress: also give the Cauchy stress at t+1, ``stress_target`` [node, component] in Pa, of materials that have one.

    Raises:
        StoreError: no trajectory is long enough, or a window holds a position that is not finite.
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
        history = builder.config.history
        counts = [max(0, t.num_frames - history - 1) for t in trajectories]
        self.ends = np.cumsum(counts)
        if not len(self.ends) or self.ends[-1] == 0:
            longest = max((t.num_frames for t in trajectories), default=0)
            raise StoreError(f"no trajectory has the {history + 2} frames that graph.history={history} needs; the longest has {longest}")

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

    def __getitem__(self, key: int | tuple[int, int]) -> HeteroData:
        """The graph of a window; ``key`` is its number, or (sample number, window number) where the sample number seeds the noise."""
        sample, window = key if isinstance(key, tuple) else (key, key)
        number, frame = self.locate(window)
        history = self.builder.config.history
        trajectory = self.trajectories[number].window(frame - history, frame + 2)
        dt = trajectory.metadata.frame_dt
        pos = trajectory.pos.astype(np.float64)
        if not np.isfinite(pos).all():
            bad, node = np.argwhere(~np.isfinite(pos))[0, :2]
            where = f"{self.trajectories[number].path}:{self.trajectories[number].name}: frame {frame - history + bad}, node {node}"
            raise StoreError(f"{where}: the position is not finite; see `python -m gpe_pl.data.validate`")
        if self.noise is not None:
            rng = np.random.default_rng((self.seed, sample))
            pos = self.noise.apply(pos, self.velocity_unit, dt, rng)
        velocities = integrators.velocities(pos, dt, trajectory.metadata.periodicity)
        gravity = np.asarray(trajectory.metadata.gravity)
        target = integrators.acceleration(velocities[-1], velocities[-2], dt) - gravity
        past = np.ascontiguousarray(velocities[:-1].swapaxes(0, 1))
        state = State(
            pos[-2],
            past[:, -1],
            trajectory.node_type,
            trajectory.mass,
            trajectory.material_params,
            trajectory.boundary,
            gravity,
            past,
            frame * dt,
            trajectory.rest_pos,
            trajectory.cells,
            periodicity=trajectory.metadata.periodicity,
        )
        data = self.builder(state.to_torch())
        target_tensor = torch.from_numpy(target).float()
        for material in self.builder.spec.materials:
            data[material].target = target_tensor[data[material].node_id]
        if self.stress and trajectory.stress is not None:
            stress = torch.from_numpy(np.array(trajectory.stress.node[-1], dtype=np.float32))
            for material in self.builder.spec.stress_channels:
                data[material].stress_target = stress[data[material].node_id]
        data.trajectory, data.frame = number, frame
        return data


class StepSampler(Sampler[tuple[int, int]]):
    """Endless shuffled passes over a data set as (sample number, window), starting at any sample number.

    Args:
        num_windows: size of the data set.
        seed: of the order; every pass has its own.
        start: called when iteration begins; the number of samples already consumed.
    """

    def __init__(self, num_windows: int, seed: int, start: Callable[[], int] = lambda: 0) -> None:
        self.num_windows, self.seed, self.start = num_windows, seed, start

    def __iter__(self) -> Iterator[tuple[int, int]]:
        sample = self.start()
        while True:
            epoch, offset = divmod(sample, self.num_windows)
            order = np.random.default_rng((self.seed, epoch)).permutation(self.num_windows)
            for window in order[offset:]:
                yield sample, int(window)
                sample += 1


@dataclass(frozen=True)
class BatchSize:
    """How many samples an optimiser step takes, all ranks together.

    Attributes:
        num_graphs: so many.
        max_nodes: if given, instead: the next ones in the order whose nodes (see ``WindowDataset.num_nodes``) are at most so many together, at least one.
    """

    num_graphs: Annotated[int, Field(ge=1)]
    max_nodes: Annotated[int, Field(ge=1)] | None = None

    def batches(self, data: WindowDataset, seed: int, step: int) -> Iterator[list[tuple[int, int]]]:
        """The samples of each optimiser step, from a step on, without end."""
        if self.max_nodes is None:
            samples = iter(StepSampler(len(data), seed, start=lambda: step * self.num_graphs))
            while True:
                yield list(islice(samples, self.num_graphs))
        else:
            yield from islice(self._packed(data, iter(StepSampler(len(data), seed)), self.max_nodes), step, None)

    @staticmethod
    def _packed(data: WindowDataset, samples: Iterator[tuple[int, int]], max_nodes: int) -> Iterator[list[tuple[int, int]]]:
        batch, total = [next(samples)], 0
        for sample in samples:
            total += data.num_nodes(batch[-1][1])
            if total + data.num_nodes(sample[1]) > max_nodes:
                yield batch
                batch, total = [], 0
            batch.append(sample)


class BatchSampler(Sampler[list[tuple[int, int]]]):
    """What this rank takes of the samples of each optimiser step. The order is one for all ranks, and the same as that of a single process.

    Args:
        data: training windows.
        size: of the batches.
        seed: of the order.
        step: called when iteration begins; the number of optimiser steps already taken.

    Raises:
        StoreError: batches may have fewer samples than there are ranks.
    """

    def __init__(self, data: WindowDataset, size: BatchSize, seed: int, step: Callable[[], int]) -> None:
        self.data, self.size, self.seed, self.step = data, size, seed, step
        largest = max(t.num_nodes for t in data.trajectories)
        fewest = size.num_graphs if size.max_nodes is None else size.max_nodes // largest
        if fewest < ranks.num_ranks() > 1:
            what = f"training.batch_size={size.num_graphs}" if size.max_nodes is None else f"batching.max_nodes={size.max_nodes}"
            nodes = "" if size.max_nodes is None else f" of up to {largest} nodes"
            raise StoreError(f"{what}: too small for {ranks.num_ranks()} processes, each of which takes at least one graph{nodes}")

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for batch in self.size.batches(self.data, self.seed, self.step()):
            yield batch if ranks.num_ranks() == 1 else self._part(batch)

    def _part(self, batch: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Samples dealt by their nodes, the largest first, each to the rank that has the fewest so far."""
        nodes = {sample: self.data.num_nodes(window) for sample, window in batch}
        load = [0] * ranks.num_ranks()
        own = set()
        for sample in sorted(nodes, key=lambda sample: -nodes[sample]):
            fewest = load.index(min(load))
            load[fewest] += nodes[sample]
            if fewest == ranks.rank():
                own.add(sample)
        return [(sample, window) for sample, window in batch if sample in own]
