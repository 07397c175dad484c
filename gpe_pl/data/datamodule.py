"""``LightningDataModule`` over the HDF5 store."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader
from torch_geometric.data import HeteroData

from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.dataset import (
    CachedGraphs,
    Scale,
    StoredTrajectory,
    WindowDataset,
    collated,
    every,
    long_enough,
    open_split,
    usable,
    window_counts,
)
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import BatchSampler, BatchSize, PushForward, Sampling, probabilities
from gpe_pl.data.statistics import acceleration_std
from gpe_pl.data.strides import connectivity_radius, stride_statistics
from gpe_pl.files import sealed
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.standardizer import StatisticsSample
from gpe_pl.learned.training_ranges import scale_range
from gpe_pl.rollout.loop import Restartable
from gpe_pl.schema import BOUNDARY, NODE_TYPES, EdgeType, grid, node_code, role
from gpe_pl.system import ranks
from gpe_pl.trajectory.scene_ranges import scene_range, united
from gpe_pl.trajectory.store import StoreError
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

NUM_VAL_GRAPHS = 8
"""Number of graphs in a validation batch, unless ``BatchSize.max_nodes`` limits it. The validation error does not depend on it: the error is a quotient of sums
over all nodes."""


ENOUGH = 0.25
"""Fraction of the statistics windows. Node types that occur in fewer windows get this many additional windows."""
FEW_CONTACTS = 1 / 16
"""Fraction of the statistics windows. For a ``radius`` relation with edges in fewer windows, additional windows with such edges are searched."""
MOST_SEARCHED = 8
"""Maximum number of windows searched for a rare relation, as a multiple of the number of statistics windows."""


def data_statistics(root: Path | str) -> dict[str, float]:
    """Read ``acceleration_std``, the rms acceleration of the train split [m/s²], from the file that ``simulate`` or ``convert`` has written.

    Raises:
        StoreError: the statistics are missing or damaged, or belong to other data.
    """
    path = Path(root) / "statistics.json"
    try:
        statistics = sealed.read(path, "generate or import the data again")
        if statistics["data_sha256"] != split_checksum(root, "train"):
            raise StoreError(f"{path}: cannot be used (it belongs to other data than those in train); generate or import the data again")
        return {"acceleration_std": float(statistics["acceleration_std"])}
    except StoreError:
        raise
    except sealed.SealError as error:
        raise StoreError(str(error)) from None
    except OSError as error:
        raise StoreError(f"{path}: cannot be used ({error.strerror}); generate or import the data again") from None
    except (ValueError, KeyError, TypeError, OverflowError):
        raise StoreError(f"{path}: holds no statistics; generate or import the data again") from None


@dataclass(frozen=True)
class _Part:
    """A data set at one stride.

    Attributes:
        root: folder of the data set.
        stride: number of stored frames in a frame of the model.
        metadata: metadata of the longer frames, with the connectivity radius that they need.
        acceleration_std: rms acceleration of the train split [m/s²].
        train, val: views of the trajectories.
    """

    root: Path
    stride: int
    metadata: Metadata
    acceleration_std: float
    train: list[StoredTrajectory]
    val: list[StoredTrajectory]

    @classmethod
    def opened(cls, root: Path, stride: int, history: int) -> _Part:
        std = data_statistics(root)["acceleration_std"]
        stored = open_split(root, "train")
        train = usable(stored, stride)
        val = every(usable(open_split(root, "val"), stride), stride)
        metadata = train[0].window(0, 1).metadata
        if stride > 1:
            window_counts(every(train, stride), history)
            statistics = stride_statistics(root, stride, train)
            std, radius = statistics.acceleration_std, connectivity_radius(metadata, stride, statistics.max_speed)
            metadata = replace(metadata.every(stride), connectivity_radius=radius)
            train = every(train, stride, phases=stride)
        elif len(train) < len(stored):
            std = acceleration_std(t.window(0, t.num_frames) for t in train)
        return cls(root, stride, metadata, std, train, val)

    @property
    def scale(self) -> Scale:
        return self.metadata.spacing, self.metadata.frame_dt

    @property
    def velocity_unit(self) -> float:
        """Rms acceleration × frame interval [m/s]."""
        return self.acceleration_std * self.metadata.frame_dt


def _common(parts: Sequence[_Part]) -> Metadata:
    """Return the metadata of the first part with the largest connectivity radius in spacings of all.

    Raises:
        StoreError: a part has another dimension, other materials or parameters.
    """
    first = parts[0].metadata
    for part in parts[1:]:
        if (part.metadata.dim, part.metadata.materials, part.metadata.param_names) != (first.dim, first.materials, first.param_names):
            raise StoreError(
                f"{part.root}: has another dimension, other materials or parameters than {parts[0].root}; choose data of one kind"
            )
    spacings = max(part.metadata.connectivity_radius / part.metadata.spacing for part in parts)
    return first if len(parts) == 1 else replace(first, connectivity_radius=spacings * first.spacing)


class TrajectoryDataModule(L.LightningDataModule):
    """Training windows in an endless, seeded order that can be resumed, and a fixed sample of validation windows without noise.

    Args:
        root: folder of the data set.
        graph: settings of the graphs.
        noise: noise on training inputs.
        batch_size: samples per step over all ranks. Its ``max_nodes`` also limits batches of validation windows.
        seed: seed of order, noise and augmentation.
        num_workers: number of processes that build graphs; 0 builds them in the training process.
        num_val_windows: number of windows of the one-step validation loss, evenly spread over the ``val`` split.
        stress: add the stress to samples; see ``WindowDataset``.
        sampling: how often each training window is drawn.
        num_statistics_windows: number of windows from which features are standardised, evenly spread over the ``train`` split.
        solver: gives the targets of noisy and unrolled states; see ``WindowDataset``.
        augmentation: images of training windows.
        stride: number of stored frames in a frame of the model. Training windows begin at any stored frame, validation windows at every ``stride``-th.
        unroll_steps: number of steps of an unroll with gradients; see ``WindowDataset``.
        others: folders of further data sets, each with a stride. They may have another spacing and frame interval if ``graph.scales`` allows it. The metadata
            are those of the first, but the connectivity radius is the largest one in spacings.
        reads_relief: see ``GraphBuilder``.

    Attributes:
        push_forward: settings of the push-forward trick; None if it is not used. In steps with push-forward, batches contain starts of unrolls instead of
            graphs.

    Raises:
        AugmentationError: the scenes do not have a symmetry of ``augmentation``.
        OpenScenesError: the scenes are open, and a setting needs nodes that stay.
        StoreError: a split or its statistics are missing or damaged, too many of its trajectories cannot be used, none is long enough for a window, a node
            may move by half a period within a frame of this stride, or data sets differ in more than their scales.
        NoiseError: the noise is too large for the spacing of the data.
    """

    def __init__(
        self,
        root: Path | str,
        graph: GraphConfig,
        noise: Noise,
        batch_size: BatchSize,
        seed: int = 0,
        num_workers: int = 0,
        num_val_windows: int = 256,
        stress: bool = False,
        sampling: Sampling = "uniform",
        num_statistics_windows: int = 256,
        solver: Restartable | None = None,
        augmentation: Augmentation = Augmentation(),  # noqa: B008
        stride: int = 1,
        unroll_steps: int = 1,
        others: Sequence[tuple[Path, int]] = (),
        reads_relief: bool = True,
    ) -> None:
        super().__init__()
        self.root, self.noise, self.batch_size, self.seed = Path(root), noise, batch_size, seed
        self.num_workers, self.num_val_windows = num_workers, num_val_windows
        self.num_statistics_windows, self.stride = num_statistics_windows, stride
        self.push_forward: PushForward | None = None
        self.parts = [_Part.opened(Path(folder), own, graph.history) for folder, own in ((root, stride), *others)]
        self.metadata = _common(self.parts)
        self.builder = GraphBuilder(graph, self.metadata, reads_relief=reads_relief)
        for part in self.parts:
            noise.check(part.metadata, part.velocity_unit)
        unit = self.parts[0].velocity_unit
        train, val = ([stored for part in self.parts for stored in getattr(part, split)] for split in ("train", "val"))
        self.train_set = WindowDataset(train, self.builder, noise, unit, seed, stress, solver, augmentation, unroll_steps)
        self.train_set.velocity_units = {part.scale: part.velocity_unit for part in self.parts}
        self.val_set = WindowDataset(val, self.builder, stress=stress)
        if sampling == "activity":
            self.train_set.probability = probabilities(self.train_set.activity())

    def statistics_sample(self) -> StatisticsSample:
        """Sample training graphs with noise for the standardisation of features.

        They are evenly spread over the split. Rare node types and rare ``radius`` relations get additional graphs.
        """
        windows = _spread(len(self.train_set), self.num_statistics_windows)
        return StatisticsSample([self.train_set[int(window)] for window in windows], self._rare_graphs, self._touching_graphs)

    def _rare_graphs(self, roles: frozenset[str]) -> list[HeteroData]:
        """Sample graphs evenly from the trajectories that have nodes of all these roles.

        The list is empty in two cases: the sample of the whole split already has enough windows of such trajectories, or either all or none of the trajectories
        have these roles.
        """
        has = np.array([roles <= own for own in self._roles])
        if has.all() or not has.any():
            return []
        enough = max(1, round(ENOUGH * self.num_statistics_windows))
        sampled = [self.train_set.locate(int(window))[0] for window in _spread(len(self.train_set), self.num_statistics_windows)]
        if has[sampled].sum() >= enough:
            return []
        counts = np.diff(self.train_set.ends, prepend=0)
        windows = np.flatnonzero(np.repeat(has, counts))
        return [self.train_set[int(windows[k])] for k in _spread(len(windows), enough)]

    def _touching_graphs(self, relation: EdgeType, known: list[HeteroData]) -> list[HeteroData]:
        """Return the graphs for the statistics of a relation.

        These are the ``known`` graphs if enough of them have such edges. Otherwise random windows are searched for graphs with such edges. They replace the
        known graphs if they are more than the known graphs with such edges.
        """
        num_known = sum(graph[relation].edge_index.shape[1] > 0 for graph in known)
        if num_known >= max(1, round(FEW_CONTACTS * self.num_statistics_windows)):
            return known
        has = np.array([{role(relation[0]), role(relation[2])} <= own for own in self._roles])
        windows = np.flatnonzero(np.repeat(has, np.diff(self.train_set.ends, prepend=0)))
        if len(windows) <= len(known):  # all windows are known already
            return known
        order = np.random.default_rng(0).permutation(windows)[: MOST_SEARCHED * self.num_statistics_windows]
        graphs = (self.train_set[int(window)] for window in order)
        touching = (graph for graph in graphs if graph[relation].edge_index.shape[1])
        found = list(islice(touching, max(1, round(ENOUGH * self.num_statistics_windows))))
        return found if len(found) > num_known else known

    @cached_property
    def _roles(self) -> list[frozenset[str]]:
        """Roles of nodes (``schema.role``) that occur in each training trajectory."""
        found = []
        for stored in self.train_set.trajectories:
            first = stored.window(0, 1)
            roles = {NODE_TYPES[code] for code in np.unique(first.node_type)}
            if len(first.boundary.pos):
                roles.add(BOUNDARY)
            if first.cells is not None and len(first.cells):
                roles.add(role(grid(1)))
            found.append(frozenset(roles))
        return found

    def parameter_ranges(self) -> dict[str, torch.Tensor]:
        """Return the lowest and highest values [2, param] of the parameters of each material that occurs in the training trajectories."""
        found: dict[str, list[np.ndarray]] = {}
        for stored in self.train_set.trajectories:
            first = stored.window(0, 1)
            for material in self.builder.spec.param_channels:
                values = first.material_params[first.node_type == node_code(material)][:, self.metadata.columns_of(material)]
                if len(values):
                    found.setdefault(material, []).append(np.array([values.min(axis=0), values.max(axis=0)]))
        ranges = {m: np.stack([np.min(parts, axis=(0, 1)), np.max(parts, axis=(0, 1))]) for m, parts in found.items()}
        return {m: torch.tensor(values, dtype=torch.float32) for m, values in ranges.items()}

    def trained_scene(self) -> np.ndarray:
        """Return the range [2, channel] of gravity and boundary nodes over all training trajectories; see ``trajectory.scene_ranges``.

        It includes the speeds of walls and the directions of gravity in images of the trajectories.
        """
        augmentation = self.train_set.augmentation
        return united(_scene(image) for stored in self.train_set.trajectories for image in augmentation.extremes(_whole(stored)))

    def trained_scales(self) -> torch.Tensor:
        """Return the range of spacings and frame intervals; see ``training_ranges.scale_range``."""
        return scale_range([part.metadata for part in self.parts])

    def val_trajectories(self, count: int) -> list[Trajectory]:
        """Read the first ``count`` trajectories of the ``val`` split that are valid and long enough; see ``long_enough``.

        Of several data sets, each gives the same number, and at least one.
        """
        own = -(-count // len(self.parts))
        history = self.builder.config.history
        return [t for part in self.parts for _, t in islice(long_enough(part.root, "val", history, part.stride), own)]

    def train_dataloader(self) -> DataLoader:
        trainer = self.trainer
        assert trainer is not None
        return DataLoader(
            self.train_set,
            batch_sampler=BatchSampler(self.train_set, self.batch_size, self.seed, lambda: trainer.global_step, self.push_forward),
            collate_fn=collated,
            num_workers=self.num_workers,
            persistent_workers=self.num_workers > 0,
            prefetch_factor=4 if self.num_workers else None,
            worker_init_fn=_set_up_worker,
        )

    def val_dataloader(self) -> DataLoader:
        windows = [int(w) for w in _spread(len(self.val_set), self.num_val_windows)]
        if len(windows) < ranks.num_ranks():
            raise StoreError(
                f"{self.root}: split 'val' has {len(windows)} windows, too few for {ranks.num_ranks()} processes; lower trainer.devices"
            )
        max_nodes = self.batch_size.max_nodes
        size = BatchSize(NUM_VAL_GRAPHS, None if max_nodes is None else max(1, max_nodes // ranks.num_ranks()))
        batches = size.once(self.val_set, windows[ranks.rank() :: ranks.num_ranks()])
        return DataLoader(CachedGraphs(self.val_set), batch_sampler=batches, collate_fn=collated)


def _spread(length: int, count: int) -> np.ndarray:
    return np.unique(np.linspace(0, length - 1, min(length, count)).round().astype(int))


def _set_up_worker(_: int) -> None:
    """Keep signals to a group of processes away from a worker, such as those of Ctrl-C and of ``timeout``: training needs its workers until it has saved."""
    torch.set_num_threads(1)
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    for name in ("SIGINT", "SIGUSR1", "SIGUSR2"):  # by SIGTERM, PyTorch ends a worker that does not end by itself
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def _whole(stored: StoredTrajectory) -> Trajectory:
    """Return a trajectory with all of the boundary's motion; its first frame alone if the boundary does not move."""
    first = stored.window(0, 1)
    return first if first.boundary.motion is None else stored.window(0, stored.num_frames)


def _scene(trajectory: Trajectory) -> np.ndarray:
    return scene_range(np.asarray(trajectory.metadata.gravity), trajectory.boundary, trajectory.metadata.periodicity)
