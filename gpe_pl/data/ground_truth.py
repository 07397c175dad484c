"""Specification of generated data sets, and simulation of any of their trajectories.

Every trajectory depends only on ``(spec, split, index)``. The module ``generation`` stores trajectories.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, cast, runtime_checkable

import numpy as np
from pydantic import Field, InstanceOf
from pydantic.dataclasses import dataclass

from gpe_pl.errors import GpeError
from gpe_pl.files.names import DataName
from gpe_pl.geometry.shapes import ON_SURFACE
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Simulator, rollout
from gpe_pl.schema import MATERIALS, SPLITS, MaterialParameter, MaterialValues, ParameterGroup, param_names, parameters_by_name
from gpe_pl.solvers.finer_solver import TRACERS, FinerSolver, Refinable
from gpe_pl.solvers.materials import limits_fault
from gpe_pl.solvers.scenes import SceneDistribution, describe
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

MOST = 1_000_000
"""Maximum number of trajectories of a split, and of frames of a trajectory. Lists of this length still fit into memory."""

Count = Annotated[int, Field(ge=0, le=MOST)]


class GenerationError(GpeError):
    """Raised when data cannot be generated. If a trajectory failed, the error names its split, index and seed."""

    def __init__(self, message: str, split: str = "", index: int = -1, seed: int = -1) -> None:
        super().__init__(message)
        self.split, self.index, self.seed = split, index, seed


@runtime_checkable
class Solver(Simulator, Protocol):
    """A simulator whose results depend only on the state and on its own settings, name and version.

    Attributes:
        name, version: identify the solver. A version other than that of stored data has other results.
        stores_stress: whether its states have a stress.
        frame_dt: frame interval [s].
        solver_dt: largest substep [s].
        bounds: ``(low, high)`` of the domain per axis [m].
        materials: materials in its states.
    """

    name: ClassVar[str]
    version: ClassVar[str]

    @property
    def stores_stress(self) -> bool: ...

    @property
    def frame_dt(self) -> float: ...

    @property
    def solver_dt(self) -> float: ...

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]: ...

    @property
    def materials(self) -> tuple[str, ...]: ...

    def compile_kernels(self) -> None:
        """Compile everything that ``step`` needs, or load it from the cache on disk.

        Raises:
            SimulationError: the settings are impossible.
        """
        ...


@dataclass(frozen=True, config={"extra": "forbid"})
class ValueGroups:
    """Values of one parameter in a data set.

    Attributes:
        seen: values in ``train``, ``val`` and ``test``, used in turn.
        interpolated: values inside the range of ``seen``, in trajectories of ``test_unseen`` with even index.
        extrapolated: values outside the range of ``seen``, in trajectories of ``test_unseen`` with odd index.
    """

    seen: Annotated[tuple[float, ...], Field(min_length=1)]
    interpolated: tuple[float, ...] = ()
    extrapolated: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        unseen = {*self.interpolated, *self.extrapolated}
        if unseen & set(self.seen):
            raise ValueError(f"unseen values {sorted(unseen & set(self.seen))} are among the seen ones")
        low, high = min(self.seen), max(self.seen)
        if any(not low < v < high for v in self.interpolated) or any(low <= v <= high for v in self.extrapolated):
            raise ValueError(
                f"interpolated values must lie inside and extrapolated ones outside the range [{low}, {high}] of the seen ones"
            )

    def group(self, value: float) -> ParameterGroup:
        """Return the group of any value of the parameter. A value between seen ones is interpolated, also where ``interpolated`` does not list it."""
        if any(math.isclose(value, known, rel_tol=1e-6) for known in self.seen):  # to single precision, in which values are stored
            return "seen"
        return "interpolated" if min(self.seen) < value < max(self.seen) else "extrapolated"


@dataclass(frozen=True, config={"extra": "forbid"})
class ParameterValues(ValueGroups):
    """Values of the stored parameters of a material. ``seen``, ``interpolated`` and ``extrapolated`` are values of its first parameter.

    Attributes:
        further: values of further parameters by name. A parameter that is not named has the value of the solver's settings, and is not stored.
    """

    further: dict[str, ValueGroups] = field(default_factory=dict)

    def of(self, material: str) -> Iterator[tuple[MaterialParameter, str, ValueGroups]]:
        """Yield each stored parameter in schema order, with a key and its values.

        The key is what the parameter adds to the material's configuration key: nothing for the first parameter, ``.further.NAME`` for the others.

        Raises:
            ValueError: ``further`` names a parameter that the material does not have.
        """
        values = parameters_by_name(material, {MATERIALS[material][0].name: self, **self.further})
        for parameter in MATERIALS[material]:
            if parameter.name in values:
                yield parameter, f".further.{parameter.name}" if parameter.name in self.further else "", values[parameter.name]


@dataclass(frozen=True, config={"extra": "forbid", "arbitrary_types_allowed": True})
class DatasetSpec:
    """Specification of a data set. It determines all bytes of the data set.

    Attributes:
        name, size: names of its folders.
        parameters: values of each material's parameters.
        num_train, num_val, num_test, num_test_unseen: numbers of trajectories per split.
        num_frames: number of stored frames per trajectory, including the initial one.
        trajectories_per_shard: number of trajectories in a shard, the unit of work and of resuming.
        seed: seed of the data set.
        train_scenes: numbers of the scenes in ``train``; None takes 0 … num_train - 1. A number stands for a seed and parameter values, as an index does
            without it. Chosen scenes have such numbers (``chosen_scenes``).
        fine: factor by which the solver divides the spacing of the scene. Above 1, the nodes are tracers of the finer solution (``solvers.finer_solver``).
        scene: distribution of scenes.
        solver: solver that simulates them.
    """

    name: DataName
    size: DataName
    parameters: dict[str, ParameterValues]
    scene: InstanceOf[SceneDistribution]
    solver: InstanceOf[Solver]
    num_train: Annotated[int, Field(ge=1, le=MOST)]
    num_frames: Annotated[int, Field(ge=3, le=MOST)]
    num_val: Count = 0
    num_test: Count = 0
    num_test_unseen: Count = 0
    trajectories_per_shard: Annotated[int, Field(ge=1)] = 8
    seed: Annotated[int, Field(ge=0)] = 0
    fine: Literal[1, 2, 4] = 1
    train_scenes: tuple[Annotated[int, Field(ge=0, le=MOST)], ...] | None = None

    def __post_init__(self) -> None:
        if self.train_scenes is not None and not len({*self.train_scenes}) == len(self.train_scenes) == self.num_train:
            raise ValueError(f"train_scenes must be num_train = {self.num_train} different numbers, got {len(self.train_scenes)}")
        if self.fine > 1 and not isinstance(self.solver, Refinable):
            raise ValueError(f"fine = {self.fine}: the solver {self.solver.name} has no solution at a finer spacing; use fine = 1")
        scene, solver = asdict(cast(Any, self.scene)), asdict(cast(Any, self.solver))
        for key in sorted(scene.keys() & solver.keys()):
            if scene[key] != solver[key]:
                raise ValueError(f"scene.{key} = {scene[key]} and solver.{key} = {solver[key]} must be equal")
        for material, own in (scene["density"] if isinstance(scene.get("density"), dict) else {}).items():
            computed = (solver.get(material) or {}).get("density", own)
            if computed != own:
                raise ValueError(f"scene.density.{material} = {own} and solver.{material}.density = {computed} must be equal")
        if set(self.parameters) != set(self.scene.materials):
            raise ValueError(
                f"parameters are for {', '.join(self.parameters)}, the scene has {', '.join(self.scene.materials)}; "
                "leave out others with ~data.parameters.MATERIAL"
            )
        ordered = {material: self.parameters[material] for material in self.scene.materials}
        object.__setattr__(self, "parameters", ordered)  # the order decides what is drawn
        for material, design in self.parameters.items():
            self._check(material, design)
        for key, path in self.scene.input_files.items():
            try:
                Path(path).open("rb").close()
            except OSError as error:
                raise ValueError(f"scene.{key} = {path}: {error.strerror} (searched from {Path.cwd()})") from None

    def _check(self, material: str, design: ParameterValues) -> None:
        first = MATERIALS[material][0].name
        if first in design.further:
            raise ValueError(
                f"parameters.{material}.further.{first}: is the first parameter; give its values as parameters.{material}.seen"
            )
        try:
            own = list(design.of(material))
        except ValueError as error:
            raise ValueError(f"parameters.{material}.further: {error}") from None
        for parameter, key, values in own:
            for group in ("seen", "interpolated", "extrapolated"):
                for value in getattr(values, group):
                    if fault := limits_fault(parameter, value):
                        raise ValueError(f"parameters.{material}{key}.{group}: {fault}")
        unseen = [[bool(values.interpolated), bool(values.extrapolated)] for *_, values in own]
        if self.num_test_unseen and not np.any(unseen, axis=0).all():
            raise ValueError(f"num_test_unseen > 0 needs parameters.{material}.interpolated and .extrapolated")
        for other, further in ((m, d.further) for m, d in self.parameters.items()):
            lacking = [name for name in further if name in (p.name for p in MATERIALS[material]) and name not in design.further]
            if lacking:  # a name stands for one column
                raise ValueError(f"parameters.{material}.further: lacks {lacking[0]}, which {other} has; give it to both or to none")

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the stored parameters."""
        return param_names(tuple(self.parameters), (name for design in self.parameters.values() for name in design.further))

    @property
    def counts(self) -> dict[str, int]:
        """Number of trajectories per split."""
        return dict(zip(SPLITS, (self.num_train, self.num_val, self.num_test, self.num_test_unseen), strict=True))

    def refined(self, factor: int) -> Solver:
        """Return the solver for ``1 / factor`` of the spacing, which takes and returns states of the scene at its own spacing."""
        if factor == 1:
            return self.solver
        return cast(Solver, FinerSolver(cast(Refinable, self.solver).finer(factor), factor, self.scene.spacing))

    @property
    def label_solver(self) -> Solver:
        """The solver whose solution is stored: ``solver`` or, with ``fine`` above 1, that for the finer spacing."""
        return self.refined(self.fine)

    @property
    def provenance(self) -> dict[str, Any]:
        """Settings of scene and solver, with the solver's name, version and largest substep; for finer labels also those of the finer solver."""
        settings = {"scene": scene_settings(self.scene), "solver": solver_settings(self.solver)}
        if self.fine == 1:
            return settings
        finer = solver_settings(cast(FinerSolver, self.label_solver).solver)
        return {**settings, "fine": self.fine, "fine_solver": {**finer, "spacing": self.scene.spacing / self.fine, "tracers": TRACERS}}

    def as_dict(self) -> dict[str, Any]:
        """Convert to plain JSON values.

        The values include everything else that the bytes of the data depend on: the solver's name, version and largest substep, and checksums of the scene's
        files.
        """
        files = {path: hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in self.scene.input_files.values()}
        values = asdict(self)  # type: ignore[call-overload]
        for design in values["parameters"].values():
            if not design["further"]:  # as in the specification of a data set with one parameter per material
                del design["further"]
        if self.fine == 1:  # as in the specification of a data set that has no finer labels
            del values["fine"]
        if self.train_scenes is None:  # as in the specification of a data set whose scenes were not chosen
            del values["train_scenes"]
        return json.loads(json.dumps({**values, **self.provenance, "input_files": files}))

    def scene_number(self, split: str, index: int) -> int:
        """Return the number of a scene, from which its seed and its parameter values follow: its index, except in ``train`` with ``train_scenes``."""
        return index if self.train_scenes is None or split != "train" else self.train_scenes[index]


def scene_settings(scene: Any) -> dict[str, Any]:
    """Return the settings of a distribution of scenes with its kind, as provenance stores them."""
    settings = asdict(scene)
    if settings.get("resting_probability") == 0:  # as in the specification of a data set without bodies at rest
        del settings["resting_probability"]
    return {"kind": type(scene).__name__, **settings}


def solver_settings(solver: Any) -> dict[str, Any]:
    """Return the settings of a solver with its name, version and largest substep [s], as provenance stores them."""
    settings = asdict(solver)
    if settings.get("stress") is False:  # as in the specification of a data set without the stress of particles
        del settings["stress"]
    return {**settings, "name": solver.name, "version": solver.version, "solver_dt": solver.solver_dt}


def scene_seed(spec: DatasetSpec, split: str, index: int) -> int:
    """Return the seed of one scene, which differs for every seed of the data set, split and index.

    Raises:
        GenerationError: there is no such split, or ``index`` is no number from 0 on.
    """
    if split not in SPLITS:
        raise GenerationError(f"split={split!r}: no such split; the splits are {', '.join(SPLITS)}")
    if index < 0:
        raise GenerationError(f"index={index}: must be a number of a trajectory, from 0 on")
    words = np.random.SeedSequence((spec.seed, SPLITS.index(split), spec.scene_number(split, index))).generate_state(2, np.uint32)
    return int(words[0]) << 32 | int(words[1])


def parameter_values(spec: DatasetSpec, split: str, index: int) -> tuple[dict[str, dict[str, float]], ParameterGroup]:
    """Return the parameters of each material by name in one trajectory, and the group that these values belong to.

    Trajectories take the values of a parameter in turn. For the first parameter of the first material, every round through the values has the given order. For
    other parameters, each round has a random order that follows from the seed, so that parameters are independent. If all have equally many values, a round is
    a Latin hypercube.

    In the group ``interpolated``, a parameter has interpolated values if there are any, else seen ones. The group ``extrapolated`` is alike. A scene is
    therefore unseen if any parameter is, and extrapolated if any parameter is outside the range of its seen values.
    """
    group: ParameterGroup = "seen"
    index = spec.scene_number(split, index)
    if split == "test_unseen":
        group, index = ("interpolated", "extrapolated")[index % 2], index // 2  # type: ignore[assignment]
    values: dict[str, dict[str, float]] = {}
    for k, (material, design) in enumerate(spec.parameters.items()):
        values[material] = {}
        for j, (parameter, _, choices) in enumerate(design.of(material)):
            dealt = getattr(choices, group) or choices.seen
            number, place = divmod(index, len(dealt))
            key = (spec.seed, SPLITS.index(split), k, number, *([MATERIALS[material].index(parameter)] if j else []))
            shuffled = np.random.default_rng(key).permutation(len(dealt))
            values[material][parameter.name] = dealt[place if k == j == 0 else int(shuffled[place])]
    return values, group


def named_values(spec: DatasetSpec, values: Mapping[str, MaterialValues]) -> dict[str, dict[str, float]]:
    """Return the given values of all stored parameters by material and name. A number is the value of a material's first parameter.

    Raises:
        ValueError: a stored parameter is missing, or another one is named.
    """
    named = {}
    for material, design in spec.parameters.items():
        if material not in values:
            raise ValueError(f"values: {material} is missing")
        named[material] = parameters_by_name(material, values[material])
        stored = [parameter.name for parameter, *_ in design.of(material)]
        if [*named[material]] != stored:
            raise ValueError(f"values of {material} are {', '.join(named[material])}; the data set stores {', '.join(stored)}")
    return named


def group_of(spec: DatasetSpec, values: Mapping[str, MaterialValues]) -> ParameterGroup:
    """Return the parameter group of a scene with these values: that of the value farthest from training.

    Raises:
        ValueError: a stored parameter is missing, or another one is named.
    """
    named = named_values(spec, values)
    found = {known.group(named[m][parameter.name]) for m, design in spec.parameters.items() for parameter, _, known in design.of(m)}
    return next(group for group in ("extrapolated", "interpolated", "seen") if group in found)  # type: ignore[return-value]


def trajectory_metadata(spec: DatasetSpec, split: str, index: int) -> Metadata:
    """Return the metadata of one trajectory."""
    return describe(
        spec.scene,
        spec.solver.frame_dt,
        dataset=spec.name,
        solver_dt=spec.label_solver.solver_dt,
        seed=scene_seed(spec, split, index),
        split=split,
        parameter_group=parameter_values(spec, split, index)[1],
        param_names=spec.param_names,
        solver=spec.solver.name,
        solver_version=spec.solver.version,
        config=json.dumps(spec.provenance, sort_keys=True),
        stress_materials=tuple(spec.scene.materials) if spec.solver.stores_stress and "solid" not in spec.scene.materials else None,
    )


def initial_state(spec: DatasetSpec, split: str, index: int, values: Mapping[str, MaterialValues] | None = None) -> State:
    """Return the initial state of one trajectory.

    Args:
        spec: the data set.
        split, index: split and number of the trajectory.
        values: other parameters of each material: a number for a material with one stored parameter, otherwise parameters by name. None takes the values of
            the data set.

    Raises:
        GenerationError: the scene is impossible, or ``values`` are not those of all stored parameters.
    """
    seed = scene_seed(spec, split, index)
    try:
        state = spec.scene.sample(named_values(spec, values) if values else parameter_values(spec, split, index)[0], seed)
        if spec.solver.stores_stress and state.stress is None:
            state = replace(state, stress=Stress.of_nodes(np.zeros((state.num_nodes, 4 if state.dim == 2 else 6)), state.cells))
        return state
    except ValueError as error:
        raise GenerationError(f"split {split}, index {index}, seed {seed}: {error}", split, index, seed) from None


def generate_trajectory(
    spec: DatasetSpec, split: str, index: int, values: Mapping[str, MaterialValues] | None = None, num_frames: int | None = None
) -> Trajectory:
    """Simulate one trajectory.

    Args:
        spec: the data set.
        split, index: split and number of the trajectory.
        values: other parameters of each material, as in ``initial_state``. The parameter group of the metadata is that of these values; the split stays that
            of the scene.
        num_frames: number of frames, the initial one included; None takes that of the data set.

    Raises:
        GenerationError: the scene is impossible, ``values`` are not those of all stored parameters, or the simulation stopped early.
    """
    metadata = trajectory_metadata(spec, split, index)
    label = f"split {split}, index {index}, seed {metadata.seed}"
    state = initial_state(spec, split, index, values)
    if values:
        metadata = replace(metadata, parameter_group=group_of(spec, values))
    guard = Guard(bounds=spec.scene.bounds, margin=ON_SURFACE * max(high - low for low, high in spec.scene.bounds))
    trajectory = rollout(spec.label_solver, state, (num_frames or spec.num_frames) - 1, metadata, guard)
    if trajectory.termination is not None:
        stop = trajectory.termination
        raise GenerationError(f"{label}: {stop.reason}: {stop.message}{_advice(stop.reason)}", split, index, metadata.seed)
    return trajectory


def _advice(reason: str) -> str:
    """Return what may help against a failure of the solver. Nothing of it helps against a start or a parameter that the solver refuses."""
    if reason in ("input", "material"):
        return ""
    first = "raise the solver's max_substeps or lower" if reason == "explosion" else "lower the solver's cfl or"
    return f"; {first} the scene's max_speed"
