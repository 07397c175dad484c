"""Control runs: the solver simulates scenes of a data set with other material parameters. They show how much a parameter changes the motion.

The solver starts from the state in which a model's rollout starts, internal state included. The parameter therefore changes in solver and model from the same
frame on. Runs depend on the data and the solver only, and all models that are evaluated on the data share them. A killed command resumes. Layout::

    {root}/{name}/{size}-controls/{split}-from-{frame}/00000.h5    runs of one scene: nearest, lowest and highest trained values
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.ground_truth import DatasetSpec, GenerationError, initial_state, parameter_values, trajectory_metadata
from gpe_pl.geometry.shapes import ON_SURFACE
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import SimulationError, rollout, steps
from gpe_pl.schema import MATERIALS, node_code
from gpe_pl.system.locks import locked
from gpe_pl.system.progress import Progress
from gpe_pl.system.workers import pool, results
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import StoreError, read_trajectory, trajectory_names, write_shard
from gpe_pl.trajectory.trajectory import Trajectory

Values = Mapping[str, Mapping[str, float]]
"""Parameters of each material by name."""

NEAREST, LOWEST, HIGHEST = "nearest", "lowest", "highest"
RUNS = (NEAREST, LOWEST, HIGHEST)
"""Names of the solver runs of a scene: nearest trained values, all parameters at their lowest trained value, and at their highest."""


def scene_values(spec: DatasetSpec, split: str, index: int) -> dict[str, dict[str, float]]:
    """Return the parameters of each material in one scene by name."""
    return parameter_values(spec, split, index)[0]


def with_values(state: State, param_names: Sequence[str], values: Values) -> State:
    """Return a state with other material parameters, also of the nodes that will enter.

    Args:
        state: state of arrays or tensors.
        param_names: names of the columns of its material parameters.
        values: new values. Parameters that are not named keep theirs.
    """
    params, openings = 1 * state.material_params, list(state.openings)
    for material, parameters in values.items():
        rows = state.node_type == node_code(material)
        for name, value in parameters.items():
            column = param_names.index(name)
            params[rows, column] = value
            for k, opening in enumerate(openings):
                if opening.enters and opening.node_type == node_code(material):
                    entering = (*opening.params[:column], value, *opening.params[column + 1 :])
                    openings[k] = replace(opening, params=entering)
    return replace(state, material_params=params, openings=tuple(openings))


@dataclass(frozen=True)
class TrainedValues:
    """Values of material parameters in the training split of a data set, and functions that select some of them.

    The parameters of a material in one scene are a vector, and vectors are selected as a whole. Distances between vectors are Euclidean. Each parameter is
    taken on its scale in ``schema.MATERIALS`` (linear or logarithmic) and divided by its trained range.
    """

    spec: DatasetSpec

    @cached_property
    def _vectors(self) -> dict[str, np.ndarray]:
        """Trained vectors of each material [vector, param], in ascending order."""
        scenes = [scene_values(self.spec, "train", index) for index in range(self.spec.num_train)]
        return {m: np.unique([[*scene[m].values()] for scene in scenes], axis=0) for m in scenes[0]}

    @property
    def is_single(self) -> bool:
        """Whether every material has a single trained vector. All choices between trained vectors are equal then."""
        return all(len(vectors) == 1 for vectors in self._vectors.values())

    def nearest(self, own: Values) -> Values:
        """Return the trained vector of each material that is nearest to a scene's own."""
        return self._chosen({m: np.argmin(distance) for m, distance in self._distances(own).items()})

    def farthest(self, own: Values) -> Values:
        """Return the trained vector of each material that is farthest from a scene's own."""
        return self._chosen({m: np.argmax(distance) for m, distance in self._distances(own).items()})

    @property
    def middle(self) -> Values:
        """The trained vector of each material that is nearest to the middle of the trained ranges, by the largest difference of a parameter."""
        return self._chosen({m: np.argmin(np.abs(self._scaled(m, v) - 0.5).max(axis=1)) for m, v in self._vectors.items()})

    def end(self, name: str) -> Values:
        """Return every parameter at its ``lowest`` or ``highest`` trained value."""
        ends = {m: (v.min if name == LOWEST else v.max)(axis=0) for m, v in self._vectors.items()}
        return {m: dict(zip(self._names[m], map(float, end), strict=True)) for m, end in ends.items()}

    @cached_property
    def _names(self) -> dict[str, list[str]]:
        return {m: [*values] for m, values in scene_values(self.spec, "train", 0).items()}

    def _chosen(self, number: Mapping[str, Any]) -> Values:
        return {m: dict(zip(self._names[m], map(float, self._vectors[m][k]), strict=True)) for m, k in number.items()}

    def _distances(self, own: Values) -> dict[str, np.ndarray]:
        """Return the distances of each material's trained vectors from a scene's own [vector]."""
        return {
            m: np.linalg.norm(self._scaled(m, v) - self._scaled(m, np.array([[*own[m].values()]])), axis=1)
            for m, v in self._vectors.items()
        }

    def _scaled(self, material: str, vectors: np.ndarray) -> np.ndarray:
        """Return vectors [vector, param] with each parameter on its scale, normalised so that its trained values range from 0 to 1."""
        is_log = [p.scale == "log" for p in MATERIALS[material] if p.name in self._names[material]]
        trained, given = (np.log(v, out=np.array(v, np.float64), where=is_log) for v in (self._vectors[material], vectors))
        low, high = trained.min(axis=0), trained.max(axis=0)
        return (given - low) / np.where(high > low, high - low, 1.0)


@dataclass(frozen=True)
class ControlRuns:
    """Solver runs of the scenes of a split with other parameters.

    Attributes:
        root: folder of the data set.
        spec: the data set.
        trained: trained values of the data set.
        split: split whose scenes are computed.
        start_frame: frame at which the parameters change.
    """

    root: Path
    spec: DatasetSpec
    trained: TrainedValues
    split: str
    start_frame: int

    @property
    def folder(self) -> Path:
        return self.root.with_name(f"{self.root.name}-controls") / f"{self.split}-from-{self.start_frame}"

    def values(self, index: int) -> dict[str, Values]:
        """Return the parameters of each run of a scene, by the run's name."""
        own = scene_values(self.spec, self.split, index)
        return {NEAREST: self.trained.nearest(own), **{name: self.trained.end(name) for name in (LOWEST, HIGHEST)}}

    def generate(self, indices: Sequence[int], num_workers: int = 1, on_progress: Progress | None = None) -> None:
        """Compute the missing runs of some scenes. Wait first if another process is computing them.

        Args:
            indices: numbers of the scenes in the split.
            num_workers: number of processes; 1 computes in this process.
            on_progress: called with the number of finished scenes and their total, at the start and after each scene.

        Raises:
            GenerationError: a scene is impossible, or the solver stopped.
            WorkerError: a process died.
            FolderError: the folder cannot be created or written.
        """
        if not self._missing(indices):
            if on_progress is not None:
                on_progress(len(indices), len(indices))
            return
        with locked(self.folder, "paths.data", waits=True):
            missing = self._missing(indices)
            done, total = len(indices) - len(missing), len(indices)
            if on_progress is not None:
                on_progress(done, total)
            with contextlib.suppress(SimulationError):  # the first scene reports impossible settings with its seed
                self.spec.label_solver.compile_kernels()
            with pool(min(num_workers, max(1, len(missing)))) as workers:
                for _ in results(workers, self._write, [(index,) for index in missing]):
                    done += 1
                    if on_progress is not None:
                        on_progress(done, total)

    def read(self, index: int) -> dict[str, Trajectory]:
        """Return the runs of a scene by name. Frame 0 is ``start_frame`` of the scene.

        Raises:
            StoreError: the runs were not computed, or are damaged.
        """
        return {name: read_trajectory(self._path(index), name) for name in RUNS}

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:05d}.h5"

    def _missing(self, indices: Sequence[int]) -> list[int]:
        return [index for index in indices if not self._is_complete(index)]

    def _is_complete(self, index: int) -> bool:
        """Whether the runs of a scene exist, and are those of this data set, solver and parameters."""
        metadata = trajectory_metadata(self.spec, self.split, index)
        try:
            if trajectory_names(self._path(index)) != sorted(RUNS):
                return False
            runs = self.read(index)
        except StoreError:
            return False
        for name, values in self.values(index).items():
            run = runs[name]
            if run.metadata != metadata or run.num_frames != self.spec.num_frames - self.start_frame:
                return False
            for material, parameters in values.items():
                own = run.material_params[run.node_type == node_code(material)]
                if any((own[:, metadata.param_names.index(key)] != own.dtype.type(value)).any() for key, value in parameters.items()):
                    return False
        return True

    def _write(self, index: int) -> None:
        runs = self._computed(index)
        write_shard(self._path(index), (runs[name] for name in sorted(RUNS)), sorted(RUNS))

    def _computed(self, index: int) -> dict[str, Trajectory]:
        spec, metadata = self.spec, trajectory_metadata(self.spec, self.split, index)
        where = f"split {self.split}, index {index}, seed {metadata.seed}"
        state = initial_state(spec, self.split, index)
        guard = Guard(bounds=spec.scene.bounds, margin=ON_SURFACE * max(high - low for low, high in spec.scene.bounds))
        try:
            *_, state = (state, *steps(spec.label_solver, state, self.start_frame))
        except SimulationError as error:
            raise GenerationError(f"{where}: {error}", self.split, index, metadata.seed) from None
        runs = {}
        for name, values in self.values(index).items():
            num_steps = spec.num_frames - 1 - self.start_frame
            runs[name] = rollout(spec.label_solver, with_values(state, metadata.param_names, values), num_steps, metadata, guard)
            if (stop := runs[name].termination) is not None:
                raise GenerationError(
                    f"{where}, {name} trained values: {stop.reason}: {stop.message}; evaluate without evaluation.material_controls",
                    self.split, index, metadata.seed,
                )  # fmt: skip
        return runs
