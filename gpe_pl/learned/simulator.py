"""A learned model as a ``Simulator``. A step builds the graph, standardises it, calls the model, and integrates its accelerations.

A checkpoint contains everything that a rollout needs: settings and weights of the model, statistics of the training data, settings of the graphs, and metadata
of the data set.
"""

from __future__ import annotations

import copy
import io
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.compiled_graph import works_on
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.standardizer import GraphStandardizer, StatisticsSample, named
from gpe_pl.graphs.standards import Standards
from gpe_pl.graphs.topology import GraphError, Topology
from gpe_pl.learned import next_states, rollout_settings, training_ranges, transfer
from gpe_pl.learned.checkpoint_file import CheckpointError as CheckpointError
from gpe_pl.learned.checkpoint_file import load_checkpoint, reason
from gpe_pl.learned.checkpoint_weights import check_sizes, check_statistics
from gpe_pl.learned.least_distance import kept_apart
from gpe_pl.learned.mean_velocities import history_at_start
from gpe_pl.learned.mirror_average import MirrorAverage
from gpe_pl.learned.next_states import Rows
from gpe_pl.learned.pretrained import checkpoint_path
from gpe_pl.learned.rollout_settings import RolloutSettings
from gpe_pl.learned.start_checks import SceneError as SceneError
from gpe_pl.learned.start_checks import check_derivatives, check_start, inside_obstacles
from gpe_pl.learned.transfer import Transfer
from gpe_pl.learned.wall_contacts import of_graph, of_topology
from gpe_pl.models.base import Model, Prediction
from gpe_pl.models.lookup import model_class
from gpe_pl.nn.friction_cone import limited
from gpe_pl.nn.node_loads import scaled
from gpe_pl.nn.stores import predicted_rows
from gpe_pl.nn.wall_contacts import WallContacts
from gpe_pl.rollout.loop import SimulationError, sound
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import EdgeType
from gpe_pl.system.signatures import check_plain, checked
from gpe_pl.trajectory.scene_ranges import described, outside, scene_range, unlimited
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

log = logging.getLogger(__name__)

CHECKPOINT_FORMAT = 3


class PrecisionError(GpeError, ValueError):
    """Raised when a simulator should compute in a precision other than float32 and float64."""


class LearnedSimulator(nn.Module):
    """A simulator that advances a state by one frame with the acceleration that a model predicts.

    Args:
        model: the network; its ``settings`` rebuild it from a checkpoint.
        builder: makes the graphs.
        stride: number of stored frames of the training data in a frame of the model. Messages name it.

    Attributes:
        skips: levels of skipping. Approximate levels act in ``learned.approximate.approximate(simulator)``, which the commands and ``roll_out_with_bands`` use;
            a rollout of the simulator itself is exact.
        clamps_parameters: clamp material parameters outside the range of training to the nearest trained value. A network is less reliable outside this range.
        static_friction: fraction of the speed that gravity gives in one frame. Nodes on a wall that are slower keep their positions (see
            ``nn.static_friction``), and planes act by Coulomb's law, whatever the fraction (see ``nn.friction_cone``). 0 switches both off.
        mirror_average: average each step of a rollout over the scene and its mirror images (see ``mirror_average``).
        least_distance: liquid nodes that come nearer in a rollout are pushed apart [m] (see ``least_distance``). 0 switches this off.
        acceleration_std, stress_std: units of the model's accelerations [m/s²] and stresses [Pa].
        trained_scene, trained_mass: ranges in training, as in ``scene_ranges`` and ``training_ranges.outside_masses``.
        trained_scales: range in training, as in ``training_ranges.scale_range``. Only models with ``graph.scales`` other than ``one`` have it.

    You may change the first five attributes at any time. ``save`` stores the last three of them.
    """

    model: Model
    acceleration_std: Tensor
    stress_std: Tensor
    trained_scene: Tensor
    trained_mass: Tensor
    trained_scales: Tensor
    clamps_parameters: bool = True
    mirror_average: bool = False
    least_distance: float = 0.0

    def __init__(self, model: Model, builder: GraphBuilder, stride: int = 1) -> None:
        super().__init__()
        if builder.spec.reads_stress and not model.settings.get("stress", False):
            raise GraphError("graph.stress=true: the model predicts no stress, which its next step reads; set model.stress=true")
        self.model, self.stride = model, stride
        self.builder = replace(builder, reads_relief=bool(model.settings.get("wall_layer")))
        self._static_friction, self._averaged = 0.0, MirrorAverage.of(builder, model)
        self._warned: set[str] = set()
        self._unknown: list[str | EdgeType] | None = None  # None: not determined yet
        self.standardizer = GraphStandardizer(builder.spec, builder.config.parameter_scale)
        self.register_buffer("acceleration_std", torch.ones((), dtype=torch.float64))
        self.register_buffer("stress_std", torch.ones((), dtype=torch.float64))
        self.register_buffer("trained_scene", torch.from_numpy(unlimited(builder.spec.dim)))
        self.register_buffer("trained_mass", training_ranges.any_mass(self.builder.spec.materials))
        if builder.config.scales != "one":
            self.register_buffer("trained_scales", training_ranges.scale_range([builder.metadata]))
        for material, count in builder.spec.param_channels.items():
            self.register_buffer(
                f"trained_{material}", torch.tensor([[-torch.inf], [torch.inf]], dtype=torch.float64).expand(2, count).clone()
            )

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        state_dict.setdefault(f"{prefix}trained_mass", training_ranges.any_mass(self.builder.spec.materials))  # shipped models lack it
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> LearnedSimulator:
        wanted = fn(torch.zeros(0)).dtype
        if wanted not in (torch.float32, torch.float64):
            raise PrecisionError(
                f"{wanted}: a simulator computes in float32 or float64; positions of half precision lose the motion of a frame"
            )
        return super()._apply(fn, recurse)  # type: ignore[return-value]

    @property
    def skips(self) -> Skips:
        return self.builder.skips

    @skips.setter
    def skips(self, skips: Skips) -> None:
        if self.builder.spec.reads_stress:  # the next step needs it
            skips = replace(skips, stress=False)
        self.builder = replace(self.builder, skips=skips)
        self.model.skips = skips

    @property
    def frame_dt(self) -> float:
        """Frame interval [s]."""
        return self.builder.metadata.frame_dt

    @property
    def spacing(self) -> float:
        """Rest spacing of nodes [m]."""
        return self.builder.metadata.spacing

    def configured(self, **settings: Unpack[RolloutSettings]) -> LearnedSimulator:
        """Return a copy with other settings; None keeps a setting. The copy shares the weights and leaves this simulator unchanged."""
        other = copy.copy(self)
        other._modules = {**self._modules, "model": copy.copy(self.model)}
        for name, value in settings.items():
            if value is not None:
                setattr(other, name, value)
        return other

    def at(self, spacing: float | None = None, frame_dt: float | None = None) -> LearnedSimulator:
        """Return a copy for another rest spacing [m] or frame interval [s]; None keeps it. The copy shares the weights. Errors are those of ``on``."""
        own = self.builder.metadata
        return self.on(replace(own, spacing=spacing or own.spacing, frame_dt=frame_dt or own.frame_dt))

    def on(self, scene: Metadata) -> LearnedSimulator:
        """Return this model for the rest spacing and frame interval of a scene (see ``at``). Models of one scale return themselves.

        Raises:
            SceneError: the scene does not fit (``fits``).
        """
        self.check_scene(scene)
        if self.builder.config.scales == "one":
            return self
        other = self.configured()
        other.builder = self.builder.at(scene.spacing, scene.frame_dt)
        other._averaged = MirrorAverage.of(other.builder, self.model)
        other.least_distance = self.least_distance * scene.spacing / self.builder.metadata.spacing
        return other

    @property
    def static_friction(self) -> float:
        return self._static_friction

    @static_friction.setter
    def static_friction(self, fraction: Any) -> None:
        if isinstance(fraction, bool) or not isinstance(fraction, int | float) or not 0 <= fraction < 1:
            raise ValueError(f"static_friction={fraction!r}: must be a number from 0 to less than 1, a fraction of gravity")
        if fraction and not self.builder.spec.islands:
            raise SceneError(f"static_friction={fraction:g}: needs a model that was trained with graph.islands=true; 0 turns it off")
        if fraction and not self.builder.config.boundary_condition:  # graphs do not say which walls are below
            raise SceneError(
                f"static_friction={fraction:g}: needs a model that was trained with graph.boundary_condition=true; 0 turns it off"
            )
        self._static_friction = float(fraction)

    @property
    def num_hops(self) -> int:
        """Number of ``radius`` edges to the farthest node that can influence a prediction, apart from paths inside meshes."""
        return self.model.num_hops

    @torch.no_grad()
    def fit_statistics(
        self,
        graphs: Iterable[HeteroData],
        parameter_ranges: Mapping[str, Tensor] | None = None,
        trained_scene: np.ndarray | None = None,
        trained_scales: Tensor | None = None,
    ) -> None:
        """Set the statistics of features, the trained ranges, and the scales of acceleration and stress from training graphs with ``target``.

        Each scale is one scalar for all axes or components and all materials; no mean is subtracted. A warning names materials and relations without
        statistics.

        Args:
            graphs: sample of the training data, which also gives the trained range of masses. A ``StatisticsSample`` can provide more graphs of rare materials
                and relations.
            parameter_ranges: lowest and highest value [2, param] of each material's parameters in all training data; None takes those of the sample.
            trained_scene: range of gravity and boundary nodes in all training scenes, as in ``scene_ranges``; None leaves it unlimited.
            trained_scales: range of spacings and frame intervals, as in ``training_ranges.scale_range``; None takes those of the builder.

        Raises:
            ValueError: all accelerations are zero, or some are not finite.
        """
        sample = graphs if isinstance(graphs, StatisticsSample) else StatisticsSample(list(graphs))
        self._unknown = None
        if missing := self.standardizer.fit(sample):
            log.warning(
                "not in the training windows that statistics are taken from: %s; its features are not standardised", ", ".join(missing)
            )
        target = torch.cat([predicted_rows(g[m], g[m].target) for g in sample for m in self.builder.spec.materials]).double()
        rms = target.square().mean().sqrt()
        if not torch.isfinite(rms) or rms == 0:
            raise ValueError(
                f"the training data's accelerations without gravity have rms {float(rms)}; nothing to learn from: check positions, gravity and frame_dt"
            )
        self.acceleration_std.copy_(rms)
        stress = [g[m].stress_target for m in self.builder.spec.stress_channels for g in sample.of(m) if "stress_target" in g[m]]
        if stress:
            rms = torch.cat(stress).double().square().mean().sqrt()
            self.stress_std.copy_(torch.where(rms > 0, rms, 1.0))
        self.set_units_of(self.model)
        for k, material in enumerate(self.builder.spec.materials):
            mass = torch.cat([g[material].mass for g in sample.of(material)])
            if len(mass):
                self.trained_mass[:, k] = torch.stack([mass.min(), mass.max()])
        if trained_scene is not None:
            self.trained_scene.copy_(torch.from_numpy(trained_scene))
        if trained_scales is not None and self.builder.config.scales != "one":
            self.trained_scales.copy_(trained_scales)
        if parameter_ranges is None:
            params = {m: torch.cat([g[m].material_params for g in sample.of(m)]) for m, _ in self.trained_ranges()}
            parameter_ranges = {m: torch.stack([p.amin(dim=0), p.amax(dim=0)]) for m, p in params.items() if len(p)}
        for material, trained in self.trained_ranges():
            if material in parameter_ranges:
                trained.copy_(parameter_ranges[material])

    def set_units_of(self, model: Model) -> None:
        """Tell a model the units of the data set (``Model.set_units``). The statistics must be set."""
        scales, square = self.builder.scales, self.builder.scales.frame_dt**2
        stress_unit = float(self.stress_std / self.standardizer.mass) * square
        model.set_units(float(self.acceleration_std) * square, scales.spacing, stress_unit)

    def start_from(self, trained: LearnedSimulator) -> Transfer:
        """Copy what fits of the weights and statistics of another simulator (see ``transfer.start_from``). Return what was copied and what is new."""
        return transfer.start_from(self, trained)

    def forget_known_statistics(self) -> None:
        """Determine again which node types and relations have no statistics, when a scene contains them."""
        self._unknown = None

    def trained_ranges(self) -> Iterator[tuple[str, Tensor]]:
        """Yield each material with the lowest and highest value [2, param] of its parameters in training."""
        for material in self.builder.spec.param_channels:
            yield material, self.get_buffer(f"trained_{material}")

    def described_training(self) -> Iterator[tuple[str, str]]:
        """Yield name, and range in training with unit, of each material parameter, of masses, of gravity and of each property of boundary nodes."""
        for material, trained in self.trained_ranges():
            for spec, (low, high) in zip(self.builder.spec.parameters[material], trained.T.tolist(), strict=True):
                yield f"{spec.name} of {material}", spec.quantity(f"{low:g} to {high:g}")
        for material, (low, high) in zip(self.builder.spec.materials, self.trained_mass.T.tolist(), strict=True):
            if math.isfinite(high):
                yield f"mass of nodes of {material}", f"{low:g} to {high:g} kg"
        yield from described(self.trained_scene.cpu().numpy())
        if self.builder.config.scales != "one":
            yield from training_ranges.described_scales(self.trained_scales)

    def untrained_parameters(self, state: State) -> list[str]:
        """Return one line for each material parameter of a scene that is outside the range of training."""
        return [line for _, line in self._outside_parameters(state)]

    def _outside_parameters(self, state: State) -> Iterator[tuple[str, str]]:
        return training_ranges.outside_parameters(state, self.builder.metadata, self.trained_ranges())

    def untrained_scene(self, state: State) -> list[str]:
        """Return one line for each material's mass, for gravity, and for each property of boundary nodes, if a scene leaves the range of training there."""
        return [line for _, line in self._outside_scene(state)]

    def _outside_scene(self, state: State) -> Iterator[tuple[str, str]]:
        own = self.builder.metadata
        here = scene_range(state.gravity.cpu().numpy(), state.boundary.to_numpy(), state.periodicity)
        yield from outside(self.trained_scene.cpu().numpy(), here, own.spacing / own.frame_dt)
        cell = self.builder.scales.length_ratio**self.builder.spec.dim  # trained masses are those at the spacing of the reference
        yield from training_ranges.outside_masses(state, self.builder.spec.materials, self.trained_mass * cell)
        if self.builder.config.scales != "one":
            yield from training_ranges.outside_scales(own, self.trained_scales)

    def forward(self, data: HeteroData) -> Prediction:
        """Return the model's prediction for a graph whose features are not standardised."""
        limits = dict(self.trained_ranges()) if self.clamps_parameters else None
        return self.model(
            scaled(self.standardizer(data, self.skips.absent_types, limits), self.builder.spec.materials, self.acceleration_std)
        )

    def initial_state(self, trajectory: Trajectory, frame: int) -> State:
        """Return the state at a frame with the velocity history that the graph needs, on this model's device.

        Warnings name material parameters, masses, gravity and boundary nodes outside the range of training, and a version of the solver that differs from that
        of the training data. Each kind of warning appears once.

        Raises:
            FrameError: there are too few frames before ``frame`` (start at one with ``standing``), or no such frame.
            SceneError: the frame interval, spacing, dimension or materials differ from training, or a value is not finite or breaks its rule; the message names
            the node.
        """
        self._check_own(trajectory.metadata)
        own, scene = self.builder.metadata, trajectory.metadata
        if scene.solver == own.solver and scene.solver_version != own.solver_version:
            version = f"version {scene.solver_version} of the solver {scene.solver}, in training version {own.solver_version}"
            self._warn_once("solver", f"the ground truth is from {version}, whose trajectories differ")
        state = trajectory.state(frame, history=self.builder.config.history).to_torch(self.acceleration_std.device)
        return self._checked(state, scene, f"frame {frame}")

    def standing(self, state: State, scene: Metadata) -> State:
        """Return an initial state for a scene without earlier frames, on this model's device (``mean_velocities``). Errors: those of ``initial_state``."""
        self._check_own(scene)
        state = replace(state.to_torch(self.acceleration_std.device), velocity_history=None, frame_velocity=None)
        history = history_at_start(self._checked(state, scene, "start"), self.builder)
        return replace(state, vel=history[:, -1], velocity_history=history)

    def fits(self, scene: Metadata) -> bool:
        """Return whether a scene has the frame interval, spacing (to 1 %), dimension and material parameters of training, and only its materials and loads.

        A model of several scales fits if spacing and frame interval are at most ``training_ranges.FARTHEST`` times outside their ranges in training.
        """
        own, has_one = self.builder.metadata, self.builder.config.scales == "one"
        same_scales = training_ranges.have_same_scales(own, scene) if has_one else training_ranges.are_near(scene, self.trained_scales)
        same_channels = scene.dim == own.dim and scene.param_names == own.param_names
        known_loads = {*(scene.loads or ())} <= {*(own.loads or ())}
        return same_scales and same_channels and known_loads and {*scene.materials} <= {*own.materials}  # materials can share parameters

    def check_scene(self, scene: Metadata, choice: str = "") -> None:
        """Raise an error for a scene that does not fit. The message recommends ``choice``; by default a stride if one makes the scene fit.

        Raises:
            SceneError: the scene does not fit (``fits``).
        """
        if self.fits(scene):
            return
        own, choice = self.builder.metadata, choice or training_ranges.CHOICE
        if (stride := self.stride_on(scene)) > 1 and choice == training_ranges.CHOICE:
            choice = f"every frame number {stride}: Trajectory.every({stride}), or data.stride={stride}"
        strided = f" (data.stride={self.stride})" if self.stride > 1 else ""
        scales = f"frame_dt={own.frame_dt:g} s{strided} and spacing={own.spacing:g} m"
        if self.builder.config.scales != "one":
            scales = " and ".join(f"{name} {values}" for name, values in training_ranges.described_scales(self.trained_scales))
            choice = f"scales at most {training_ranges.FARTHEST:g} times outside these"
        raise SceneError(
            f"the model was trained with {scales} in {own.dim}D on {training_ranges.named_materials(own)}; "
            f"the scene has frame_dt={scene.frame_dt:g} s and spacing={scene.spacing:g} m in {scene.dim}D and "
            f"{training_ranges.named_materials(scene)}; choose the data set with {choice}"
        )

    def _check_own(self, scene: Metadata) -> None:
        """Raise ``SceneError`` for a scene that does not fit, or, with several scales, for one of another scale than this copy's."""
        self.check_scene(scene)
        own = self.builder.metadata
        if not training_ranges.have_same_scales(own, scene):
            raise SceneError(
                f"this copy of the model is for frame_dt={own.frame_dt:g} s and spacing={own.spacing:g} m, the scene has {scene.frame_dt:g} s and "
                f"{scene.spacing:g} m; take simulator.on(trajectory.metadata)"
            )

    def stride_on(self, stored: Metadata) -> int:
        """Return the ``data.stride`` with which stored data have the frame interval of the model; 0 if there is none."""
        stride = round(self.builder.metadata.frame_dt / stored.frame_dt)
        return stride if stride >= 1 and self.fits(stored.every(stride)) else 0

    def _checked(self, state: State, scene: Metadata, where: str) -> State:
        check_start(state, scene, where)
        clamped = "; clamped to the nearest trained value" if self.clamps_parameters else ""
        found = [(kind, line + clamped) for kind, line in self._outside_parameters(state)]
        for kind, line in (*found, *self._outside_scene(state), *inside_obstacles(state, self.builder.metadata.spacing)):
            self._warn_once(kind, line)
        return state

    def _warn_once(self, kind: str, line: str) -> None:
        if kind not in self._warned:
            log.warning("outside the training data: %s", line)
            self._warned.add(kind)

    @torch.inference_mode()
    def step(self, state: State) -> State:
        if self.mirror_average:
            return sound(*self.step_all([state]))
        standards = self._standards([state])
        return self._advance_all([state], [self.builder.topology(state)], standards)[0]

    @torch.inference_mode()
    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        """Advance several scenes by one pass of the model. A scene whose graph cannot be built has its error instead of a state."""
        return self._averaged.next_states(self.next_states, states) if self.mirror_average else self.next_states(states)

    def next_states(self, states: list[State]) -> list[State | SimulationError]:
        """Do the same as ``step_all`` outside inference mode, so that autograd can use the results in training, and without ``mirror_average``.

        States may be on the host while the model is on another device.
        """
        check_derivatives(self.model, states, self.spacing)
        new: list[Any] = [self.builder.topology_or_error(state) for state in states]
        kept = [k for k, topology in enumerate(new) if not isinstance(topology, SimulationError)]
        if kept:
            chosen = [states[k] for k in kept]
            for k, state in zip(kept, self._advance_all(chosen, [new[k] for k in kept], self._standards(chosen)), strict=True):
                new[k] = state
        return new

    def _standards(self, states: list[State]) -> Standards | None:
        """Return the statistics with which compiled features of these states are standardised; None if features have to be standardised afterwards."""
        mass = self.standardizer.mass
        if mass.is_cuda or mass.dtype != self.builder.precision or not all(map(works_on, states)):
            return None
        if self.static_friction and torch.is_grad_enabled():
            return None  # predictions can need gradients, which compiled static friction does not have
        if self.static_friction and any(bool(state.boundary.vel.any()) or state.rigid_body is not None for state in states):
            return None  # static friction reads from the graph which walls move, and keeps rigid bodies as a whole
        return self.standardizer.standards(dict(self.trained_ranges()) if self.clamps_parameters else None)

    def _warn_of_unknown(self, graph: HeteroData) -> None:
        """Warn, once each, of node types and relations of scenes that have no statistics from training."""
        if self._unknown is None:
            self._unknown = self.standardizer.unknown()
        for kind in [*self._unknown]:
            if len(graph[kind].x if isinstance(kind, str) else graph[kind].odd):
                log.warning("outside the training data: %s has no statistics; its features are not standardised", named(kind))
                self._unknown.remove(kind)

    def _advance_all(self, states: list[State], topologies: list[Topology], standards: Standards | None) -> list[State]:
        builder, rows, graphs = self.builder, [t.rows for t in topologies], list[HeteroData]()
        if len(states) == 1 or (self.static_friction and standards is None):
            graphs = [builder.graph(topology, state, standards) for topology, state in zip(topologies, states, strict=True)]
            data = graphs[0] if len(graphs) == 1 else batched(graphs)
        else:
            data = builder.batch(topologies, states, standards)
        self._warn_of_unknown(data)
        data = data.to(self.acceleration_std.device) if self.acceleration_std.device != states[0].pos.device else data
        units = builder.spec.materials, self.acceleration_std
        predicted = (self.model(scaled(data, *units)) if standards is not None else self(data)).to(states[0].pos.device)
        contacts = self._contacts(states, graphs if standards is None else topologies)
        new = self.later(states, rows, predicted, contacts)
        if standards is None:
            return self._with_static_friction(states, new, contacts)
        for state, after, touching in zip(states, new, contacts, strict=False):
            next_states.keep_slow(state, after, touching, self.static_friction, builder.metadata.frame_dt)
        return new

    def moved(self, states: list[State], graphs: list[HeteroData], predicted: Prediction) -> list[State]:
        """Return the states one frame later, given the states, their graphs, and the model's prediction for their batch."""
        contacts = self._contacts(states, graphs)
        return self._with_static_friction(states, self.later(states, [*map(next_states.rows_of, graphs)], predicted, contacts), contacts)

    def _contacts(self, states: list[State], found: Sequence[Topology] | Sequence[HeteroData]) -> list[WallContacts]:
        """Return the contacts with walls of scenes whose graphs or topologies are given; none without static friction."""
        spec, dt, known = self.builder.spec, self.builder.metadata.frame_dt, zip(states, found, strict=False)
        return [of_topology(s, f, dt) if isinstance(f, Topology) else of_graph(s, f, spec, dt) for s, f in known if self.static_friction]

    def later(self, states: list[State], rows: Sequence[Rows], predicted: Prediction, contacts: Sequence[WallContacts] = ()) -> list[State]:
        """Do the same as ``moved`` without keeping slow nodes in place, given the rows of each material's nodes, and contacts that obey Coulomb's law.

        Training states get a stress only if graphs read it.
        """
        acceleration, dt = predicted.acceleration, self.builder.metadata.frame_dt
        contacts = () if predicted.frame_velocity else contacts  # walls of the elastic law obey Coulomb's law within the frame
        if next_states.works_on_all(states, acceleration):
            new = next_states.moved(states, rows, acceleration, float(self.acceleration_std), dt, contacts)
        else:
            all_acc = next_states.accelerations(states, rows, acceleration, self.acceleration_std)
            for k, (state, touching) in enumerate(zip(states, contacts, strict=False)):
                all_acc[k] = limited(all_acc[k], state.mass, state.gravity, touching)
            new = [self.advance(state, acc) for state, acc in zip(states, all_acc, strict=True)]
        new = next_states.with_frame_velocity(new, rows, predicted.frame_velocity, dt)
        if self.least_distance and not self.training:
            new = [kept_apart(state, self.least_distance, dt) for state in new]
        if not predicted.stress or (self.training and not self.builder.spec.reads_stress):
            return new
        components = next(iter(self.builder.spec.stress_channels.values()))
        return next_states.with_stress(new, rows, predicted.stress, self.stress_std, components)

    def integrated(self, state: State, graph: HeteroData, acc: Tensor) -> State:
        """Return the next state under an acceleration [node, dim] in m/s² that includes gravity, with static friction."""
        contacts = self._contacts([state], [graph])
        for touching in contacts:
            acc = limited(acc, state.mass, state.gravity, touching)
        return self._with_static_friction([state], [self.advance(state, acc)], contacts)[0]

    def _with_static_friction(self, states: list[State], new: list[State], contacts: list[WallContacts]) -> list[State]:
        settings = self.static_friction, self.builder.metadata.frame_dt
        return [next_states.slow_kept(*parts, *settings) for parts in zip(states, new, contacts, strict=True)] if contacts else new

    def advance(self, state: State, acc: Tensor) -> State:
        """Return the next state under an acceleration [node, dim] in m/s² that includes gravity, without static friction. Rigid bodies keep their shape."""
        return next_states.advanced(state, acc, self.builder.metadata.frame_dt)

    # --- checkpoints ----------------------------------------------------------------------------------------------------------------------

    def description(self) -> dict[str, Any]:
        """Return plain values from which ``from_description`` rebuilds this simulator, weights excluded."""
        cls = type(self.model)
        return {
            "format": CHECKPOINT_FORMAT,
            "model": f"{cls.__module__}.{cls.__qualname__}",
            "settings": dict(self.model.settings),
            "graph": asdict(self.builder.config),
            "metadata": asdict(self.builder.reference or self.builder.metadata),
            **rollout_settings.to_store(self.static_friction, self.mirror_average, self.least_distance / self.builder.scales.length_ratio),
            "stride": self.stride,
        }

    @classmethod
    def from_description(cls, values: dict[str, Any]) -> LearnedSimulator:
        """Return a simulator rebuilt from ``description``.

        Raises:
            ValueError, KeyError: ``values`` are not such a description.
        """
        check_plain(values)
        if values.get("format") != CHECKPOINT_FORMAT:
            raise ValueError(f"checkpoint format {values.get('format')!r}, this version reads {CHECKPOINT_FORMAT}")
        graph, metadata = GraphConfig(**checked(GraphConfig, values["graph"])), Metadata(**checked(Metadata, values["metadata"]))
        for key, fault in metadata.violations():
            raise ValueError(f"{key} {fault}")
        builder, model, stride = GraphBuilder(graph, metadata), model_class(values["model"]), values.get("stride", 1)
        if type(stride) is not int or stride < 1:
            raise ValueError(f"stride {stride!r} is no integer of at least 1")
        simulator = cls(model(builder.spec, **checked(model, values["settings"], "spec")), builder, stride)
        return simulator.configured(**rollout_settings.stored(values))

    @classmethod
    def _check_sizes(cls, weights: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Check that weights fit a description, before memory is allocated for the model."""
        try:
            with torch.device("meta"):
                expected = cls.from_description(description).state_dict()
        except RuntimeError:  # the constructor of a model reads its values; other errors will be raised again
            return
        check_sizes(weights, expected, optional="trained_mass")

    def save(self, path: Path | str) -> None:
        """Write weights and description, atomically, for ``from_checkpoint``. A training checkpoint also has the optimiser's state."""
        weights = {f"simulator.{name}": value.detach().cpu().clone() for name, value in self.state_dict().items()}
        content = io.BytesIO()  # PyTorch's own writer aborts the process on a full disk
        torch.save({"simulator": self.description(), "state_dict": weights}, content)
        replace_bytes(Path(path), content.getbuffer())

    @classmethod
    def from_checkpoint(cls, path: Path | str, device: Any = "cpu") -> LearnedSimulator:
        """Return the simulator of a checkpoint, in evaluation mode. If the run averaged its weights, the simulator has the averages.

        Only tensors and plain values are unpickled.

        Args:
            path: path of the file, folder of a run, whose best checkpoint is loaded, or name of a shipped model.
            device: device of the simulator.

        Raises:
            CheckpointError: the file is missing, damaged, not a checkpoint of gpe_pl, or one of another model.
        """
        path = checkpoint_path(path)
        checkpoint = load_checkpoint(path, device)
        try:
            if not isinstance(checkpoint, dict):
                raise TypeError(f"holds a {type(checkpoint).__name__}")
            weights = {k.removeprefix("simulator."): v for k, v in checkpoint["state_dict"].items() if k.startswith("simulator.")}
            cls._check_sizes(weights, checkpoint["simulator"])
            simulator = cls.from_description(checkpoint["simulator"])
            simulator.load_state_dict(weights)
            check_statistics(simulator.state_dict())
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise CheckpointError(
                f"{path}: not a checkpoint of gpe_pl or one of another model ({reason(error)}); take last.ckpt, or train again with this version"
            ) from None
        return simulator.to(device).eval()
