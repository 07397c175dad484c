"""A learned model as a ``Simulator``: builder ∘ standardisation ∘ model ∘ integrator.

Everything that a rollout needs travels in one checkpoint: the model's settings and weights, the statistics of the training data, the graph's settings and
the data set's metadata.
"""

from __future__ import annotations

import copy
import importlib
import inspect
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch_geometric.data import Batch, HeteroData

from gpe_pl import integrators
from gpe_pl.errors import GpeError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig, history_of
from gpe_pl.models.base import Prediction
from gpe_pl.nn.blocks import Standardize
from gpe_pl.rollout import SimulationError
from gpe_pl.schema import MATERIALS, FeatureSpec, node_code
from gpe_pl.trajectory import Metadata, State, Trajectory

CHECKPOINT_FORMAT = 1


class CheckpointError(GpeError, ValueError):
    """A checkpoint is missing, damaged, or not one of gpe_pl; the message names the file and what to do."""


class SceneError(GpeError, ValueError):
    """A scene does not fit a trained simulator, or holds values that are not finite."""


class GraphStandardizer(nn.Module):
    """Standardises every feature of a graph with training statistics; odd edge channels are only scaled, so they stay odd."""

    mass: Tensor

    def __init__(self, spec: FeatureSpec) -> None:
        super().__init__()
        self.spec = spec
        self.node = nn.ModuleDict({t: Standardize(c) for t, c in spec.node_channels.items()})
        self.params = nn.ModuleDict({m: Standardize(c) for m, c in spec.param_channels.items()})
        self.odd = nn.ModuleDict({"__".join(r): Standardize(spec.odd_channels[r], centered=False) for r in spec.relations})
        self.even = nn.ModuleDict({"__".join(r): Standardize(spec.even_channels[r]) for r in spec.relations})
        self.register_buffer("mass", torch.ones(()))

    @staticmethod
    def _material_scale(material: str, params: Tensor) -> Tensor:
        return params.log() if MATERIALS[material].scale == "log" else params

    def fit(self, graphs: list[HeteroData]) -> None:
        """Set all statistics from graphs of the training split."""

        def fit(module: nn.Module, values: Iterable[Tensor]) -> None:
            cast(Standardize, module).fit(values)

        for t, module in self.node.items():
            fit(module, (g[t].x for g in graphs))
        for m, module in self.params.items():
            fit(module, (self._material_scale(m, g[m].material_params) for g in graphs))
        for relation in self.spec.relations:
            fit(self.odd["__".join(relation)], (g[relation].odd for g in graphs))
            fit(self.even["__".join(relation)], (g[relation].even for g in graphs))
        mass = [g[m].mass for g in graphs for m in self.spec.materials]
        if sum(len(x) for x in mass):
            self.mass.copy_(torch.cat(mass).double().mean())

    def forward(self, data: HeteroData) -> HeteroData:
        """A graph with standardised features; the input is left as it is."""
        out = copy.copy(data)
        for t in self.spec.node_types:
            out[t].x = self.node[t](data[t].x)
        for m in self.spec.materials:
            out[m].material_params = self.params[m](self._material_scale(m, data[m].material_params))
            out[m].mass = data[m].mass / self.mass
        for relation in self.spec.relations:
            out[relation].odd = self.odd["__".join(relation)](data[relation].odd)
            out[relation].even = self.even["__".join(relation)](data[relation].even)
        return out


class LearnedSimulator(nn.Module):
    """Advances a state by one frame with a learned acceleration.

    Args:
        model: any ``models.base.Model``; its ``settings`` rebuild it from a checkpoint.
        builder: makes the graphs.
    """

    acceleration_std: Tensor

    def __init__(self, model: nn.Module, builder: GraphBuilder) -> None:
        super().__init__()
        self.model, self.builder = model, builder
        self.standardizer = GraphStandardizer(builder.spec)
        self.register_buffer("acceleration_std", torch.ones((), dtype=torch.float64))

    @torch.no_grad()
    def fit_statistics(self, graphs: Iterable[HeteroData]) -> None:
        """Set feature statistics and the acceleration scale (one scalar for all axes and materials, mean zero) from training graphs with ``target``."""
        graphs = list(graphs)
        self.standardizer.fit(graphs)
        target = torch.cat([g[m].target for g in graphs for m in self.builder.spec.materials]).double()
        rms = target.square().mean().sqrt()
        if not torch.isfinite(rms) or rms == 0:
            raise ValueError(f"the training data's accelerations without gravity have rms {float(rms)}; nothing to learn from")
        self.acceleration_std.copy_(rms)

    def forward(self, data: HeteroData) -> Prediction:
        """Accelerations without gravity per material, in units of ``acceleration_std``."""
        return self.model(self.standardizer(data))

    def initial_state(self, trajectory: Trajectory, frame: int) -> State:
        """The state at a frame with the velocity history that the graph needs, on this model's device.

        Raises:
            IndexError: too few frames before ``frame``.
            SceneError: another frame interval, dimension or material than in training, or a value that is not finite; names the node.
        """
        own, scene = self.builder.metadata, trajectory.metadata
        same_scales = abs(scene.frame_dt / own.frame_dt - 1) < 1e-6 and abs(scene.spacing / own.spacing - 1) < 0.01
        if not same_scales or scene.dim != own.dim or scene.param_names != own.param_names:
            raise SceneError(
                f"the model was trained with frame_dt={own.frame_dt:g} s and spacing={own.spacing:g} m in {own.dim}D on {', '.join(own.materials)}; "
                f"the scene has frame_dt={scene.frame_dt:g} s and spacing={scene.spacing:g} m in {scene.dim}D and "
                f"{', '.join(scene.materials)}; choose the data set with data=… size=…"
            )
        state = trajectory.state(frame, history=self.builder.config.history).to_torch(self.acceleration_std.device)
        for name, values in (("pos", state.pos), ("velocity", history_of(state))):
            bad = ~torch.isfinite(values).flatten(1).all(dim=1)
            if bad.any():
                raise SceneError(f"frame {frame}: node {int(bad.nonzero()[0])} has a {name} that is not finite")
        for material, spec in MATERIALS.items():
            if material in self.builder.metadata.materials:
                rows = torch.nonzero(state.node_type == node_code(material)).flatten()
                column = state.material_params[rows, self.builder.metadata.param_names.index(spec.name)]
                if not torch.isfinite(column).all():
                    node = int(rows[torch.nonzero(~torch.isfinite(column))[0]])
                    raise SceneError(f"node {node} ({material}): {spec.name} [{spec.unit}] is not finite")
        return state

    @torch.inference_mode()
    def step(self, state: State) -> State:
        return self._advance_all([state])[0]

    @torch.inference_mode()
    def step_all(self, states: list[State]) -> list[State | SimulationError]:
        """``step`` of several scenes in one pass of the model."""
        return [*self._advance_all(states)]

    def _advance_all(self, states: list[State]) -> list[State]:
        graphs = [self.builder(state) for state in states]
        data = graphs[0] if len(graphs) == 1 else Batch.from_data_list(graphs)
        predicted = self(data).acceleration
        acc = [state.gravity.expand_as(state.pos).clone() for state in states]
        for material, normalized in predicted.items():
            rows = [graph[material].node_id for graph in graphs]
            for scene, part in enumerate(normalized.split([len(r) for r in rows])):
                acc[scene][rows[scene]] += part.double() * self.acceleration_std
        return [self.advance(state, a) for state, a in zip(states, acc, strict=True)]

    def advance(self, state: State, acc: Tensor) -> State:
        """The next state under a given acceleration [m/s²], gravity included."""
        dt = self.builder.metadata.frame_dt
        pos, vel = integrators.advance(state.pos, state.vel, acc, dt)
        history = torch.cat([history_of(state)[:, 1:], vel[:, None]], dim=1)
        return replace(state, pos=pos, vel=vel, velocity_history=history, time=state.time + dt)

    # --- checkpoints ----------------------------------------------------------------------------------------------------------------------

    def description(self) -> dict[str, Any]:
        """Plain values from which ``from_description`` rebuilds this simulator, weights excluded."""
        cls = type(self.model)
        return {
            "format": CHECKPOINT_FORMAT,
            "model": f"{cls.__module__}.{cls.__qualname__}",
            "settings": dict(cast(Any, self.model).settings),
            "graph": asdict(self.builder.config),
            "metadata": asdict(self.builder.metadata),
        }

    @classmethod
    def from_description(cls, values: dict[str, Any]) -> LearnedSimulator:
        """Rebuild from ``description``; raises ``ValueError`` for anything else."""
        if values.get("format") != CHECKPOINT_FORMAT:
            raise ValueError(f"checkpoint format {values.get('format')!r}, this version reads {CHECKPOINT_FORMAT}")
        builder = GraphBuilder(GraphConfig(**values["graph"]), Metadata(**values["metadata"]))
        return cls(model_class(values["model"])(builder.spec, **values["settings"]), builder)

    @classmethod
    def from_checkpoint(cls, path: Path | str, device: Any = "cpu") -> LearnedSimulator:
        """Load a training checkpoint (averaged weights if the run averaged them), in evaluation mode. Only tensors and plain values are unpickled.

        Raises:
            CheckpointError: not a readable checkpoint of gpe_pl, or one of another model.
        """
        if not Path(path).is_file():
            raise CheckpointError(f"{path}: no such checkpoint")
        try:
            checkpoint = torch.load(path, map_location=device, weights_only=True)
        except Exception as error:  # torch raises many types for damaged or unsafe files
            raise CheckpointError(f"{path}: not a safe, complete checkpoint ({_reason(error)})") from None
        try:
            simulator = cls.from_description(checkpoint["simulator"])
            weights = {k.removeprefix("simulator."): v for k, v in checkpoint["state_dict"].items() if k.startswith("simulator.")}
            simulator.load_state_dict(weights)
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise CheckpointError(f"{path}: not a checkpoint of gpe_pl or one of another model ({_reason(error)})") from None
        return simulator.to(device).eval()


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"


class UnknownModelError(GpeError, ValueError):
    """A dotted name that is not a model of this package."""


def model_class(target: str) -> type[nn.Module]:
    """The model class of a dotted name; only classes under ``gpe_pl.models`` are accepted, because names come from files.

    Raises:
        UnknownModelError: any other name.
    """
    module, _, name = target.rpartition(".")
    if not module.startswith("gpe_pl.models."):
        raise UnknownModelError(f"model {target!r} is not one of gpe_pl.models")
    try:
        cls = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        raise UnknownModelError(f"model {target!r} does not exist in this version of gpe_pl") from None
    if not (inspect.isclass(cls) and issubclass(cls, nn.Module)):
        raise UnknownModelError(f"{target!r} is not a model")
    return cls
