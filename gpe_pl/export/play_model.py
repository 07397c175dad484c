"""A model for the page: its settings as plain values, and its weights as one array of 32-bit numbers.

Two pairs of linear maps are multiplied here, in double precision, as ``models.gpe_program`` does: the last map of the messages with the first map of the
update, and the material embedding with the first map of the encoder. An array of weights is named by its place ``[first number, rows, columns]``; a matrix
multiplies rows from the right.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from gpe_pl.errors import GpeError
from gpe_pl.graphs.features import GAP_LIMIT, GAP_SCALE, TINY
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.blocks import NORM_EPS
from gpe_pl.nn.edge_strength import FULL
from gpe_pl.nn.friction_cone import ALIKE, NO_SLIP
from gpe_pl.nn.static_friction import LEVEL
from gpe_pl.schema import BOUNDARY, EdgeType

Place = list[int]
"""Place of a matrix in the array of weights: first number, rows and columns."""


class PageError(GpeError, ValueError):
    """Raised when a page cannot compute a model."""


@dataclass
class Numbers:
    """Weights, one after the other in the order in which they are asked for."""

    parts: list[np.ndarray] = field(default_factory=list)
    count: int = 0

    def place(self, values: Tensor) -> Place:
        """Append a matrix [row, column], or a vector as one row, and return its place."""
        matrix = np.atleast_2d(values.detach().double().cpu().numpy()).astype("<f4")
        first, self.count = self.count, self.count + matrix.size
        self.parts.append(matrix.ravel())
        return [first, *matrix.shape]

    @property
    def array(self) -> np.ndarray:
        return np.concatenate(self.parts)


def check(simulator: LearnedSimulator) -> None:
    """Raise ``PageError`` unless a page can compute this simulator."""
    model, builder = simulator.model, simulator.builder
    wanted = {"interaction": "negated", "decoder": "node", "edge_state": "geometry", "implementation": "factored", "stress": False}
    wrong = ""
    if type(model) is not GPE:
        wrong = f"a {type(model).__name__}"
    elif builder.spec.meshes:
        wrong = f"a model of meshes ({', '.join(builder.spec.meshes)})"
    elif builder.metadata.dim != 2:
        wrong = f"a model in {builder.metadata.dim}D"
    elif builder.metadata.periodicity:
        wrong = "a model of a periodic domain"
    elif builder.config.scales != "one":
        wrong = "a model of several spacings and frame intervals"
    elif builder.spec.loads:
        wrong = "a model of scenes with prescribed nodes or forces"
    elif builder.spec.reads_stress:
        wrong = "a model that reads the stress"
    elif len(builder.spec.materials) > 1:
        wrong = f"a model of several materials ({', '.join(builder.spec.materials)})"
    elif different := [f"model.{key}={model.settings[key]}" for key, value in wanted.items() if model.settings[key] != value]:
        wrong = f"a model with {' '.join(different)}"
    elif model.settings["material_embedding"] == "mlp":
        wrong = "a model with model.material_embedding=mlp"
    elif simulator.mirror_average:
        wrong = "a model that averages over mirror images (mirror_average)"
    elif not simulator.clamps_parameters:
        wrong = "a model that does not clamp material parameters to the trained range"
    elif simulator.least_distance:
        wrong = "a model with a least distance of liquid nodes"
    elif builder.config.features != "contact" or not builder.config.boundary_condition:
        wrong = "a model without contact features"
    elif not all(trained.isfinite().all() for _, trained in simulator.trained_ranges()):
        wrong = "a model that was not trained"
    if wrong:
        raise PageError(
            f"the page computes GPE models of particles in 2D, and not {wrong}; choose sand or snow, or look at a rollout with the viewer"
        )


def model_for_page(simulator: LearnedSimulator) -> tuple[dict[str, Any], np.ndarray]:
    """Return what the page needs of a simulator: plain values, and weights as 32-bit numbers.

    Raises:
        PageError: the page cannot compute the model.
    """
    check(simulator)
    builder, numbers = simulator.builder, Numbers()
    spec, metadata, scales = builder.spec, builder.metadata, builder.scales
    (material,) = spec.materials
    trained = dict(simulator.trained_ranges())[material].tolist()
    about = {
        "dataset": metadata.dataset,
        "material": material,
        "frameDt": metadata.frame_dt,
        "spacing": metadata.spacing,
        "radius": scales.radius,
        "bounds": [list(b) for b in metadata.bounds],
        "gravity": list(metadata.gravity),
        "history": builder.config.history,
        "gapScale": GAP_SCALE,
        "gapLimit": GAP_LIMIT,
        "tiny": TINY,
        "accelerationStd": float(simulator.acceleration_std),
        "nodeMass": float(simulator.standardizer.mass),
        "staticFriction": simulator.static_friction,
        "level": LEVEL,
        "alike": ALIKE,
        "noSlip": NO_SLIP,
        "fullStrength": FULL,
        "islandMomentum": simulator.model.settings["island_momentum"],
        "trained": dict(simulator.described_training()),
        "parameters": [
            {"name": p.name, "unit": p.unit, "isLog": p.scale == "log" and builder.config.parameter_scale is None, "low": low, "high": high}
            for p, low, high in zip(spec.parameters[material], *trained, strict=True)
        ],
        "standards": _standards(simulator, material),
        "network": _network(cast(GPE, simulator.model), material, numbers),
    }
    return about, numbers.array


def _standards(simulator: LearnedSimulator, material: str) -> dict[str, Any]:
    """Return mean and 1 / std of the features of nodes, parameters and edges."""
    own = simulator.standardizer.standards()

    def listed(statistics: Any) -> dict[str, list[float]]:
        mean, inverse = statistics
        return {"mean": mean.astype(float).tolist(), "inverse": inverse.astype(float).tolist()}

    edges = []
    for relation in simulator.builder.spec.relations:
        (mean, inverse), odd = own.even[relation], own.odd[relation]
        edges.append(listed((np.concatenate([np.zeros_like(odd), mean]), np.concatenate([odd, inverse]))))
    return {
        "nodes": listed(own.node[material]),
        "boundary": listed(own.node[BOUNDARY]),
        "params": listed(own.params[material].statistics),
        "edges": edges,
    }


def _network(model: GPE, material: str, numbers: Numbers) -> dict[str, Any]:
    spec = model.spec
    types, relations = [material, BOUNDARY], [*spec.relations]
    inputs = {t: spec.node_channels[t] for t in types}
    if material in model.material_embedding:
        inputs[material] += spec.param_channels[material]
    steps = []
    for convs, updates in zip(model.convs, model.updates, strict=True):
        conv_of, update_of = cast(nn.ModuleDict, convs), cast(nn.ModuleDict, updates)
        present = [r for r in relations if model.key(r) in conv_of]
        steps.append(
            {
                "messages": [_messages(conv_of[model.key(r)], numbers) for r in present],
                "updates": [_update(t, update_of, conv_of, present, model, numbers) if t in update_of else None for t in types],
            }
        )
    return {
        "hidden": model.settings["hidden_channels"],
        "epsilon": NORM_EPS,
        "none": numbers.place(torch.zeros(model.settings["hidden_channels"])),
        "types": [{"name": t, "channels": inputs[t]} for t in types],
        "relations": [
            {"source": types.index(r[0]), "target": types.index(r[2]), "channels": spec.odd_channels[r] + spec.even_channels[r]}
            for r in relations
        ],
        "encoders": [_encoder(model, t, numbers) for t in types],
        "steps": steps,
        "decoders": [_layers(model.node_decoder[t], numbers) if t == material else None for t in types],
    }


def _layers(layers: Any, numbers: Numbers) -> dict[str, Any]:
    """Return two linear layers with the activation between them, and a LayerNorm if there is one."""
    return {"first": numbers.place(layers[0].weight.T), "bias": numbers.place(layers[0].bias)} | _after_first(layers, numbers)


def _after_first(layers: Any, numbers: Numbers) -> dict[str, Any]:
    _, act, last, *norm = layers
    return {
        "slope": float(act.weight.detach()),
        "last": numbers.place(last.weight.T),
        "lastBias": numbers.place(last.bias),
        "gain": numbers.place(norm[0].weight) if norm else None,
        "shift": numbers.place(norm[0].bias) if norm else None,
    }


def _encoder(model: GPE, t: str, numbers: Numbers) -> dict[str, Any]:
    encoder: Any = model.node_encoder[t]
    if t not in model.material_embedding:
        return _layers(encoder, numbers)
    theta: Any = cast(Any, model.material_embedding[t]).theta
    channels = model.spec.node_channels[t]
    weight, own = encoder[0].weight.double(), encoder[0].weight[:, channels:].double()
    joined = torch.cat([weight[:, :channels], own @ theta.weight.double()], dim=1)
    bias = encoder[0].bias.double() + own @ theta.bias.double()
    return {"first": numbers.place(joined.T), "bias": numbers.place(bias)} | _after_first(encoder, numbers)


def _messages(conv: Any, numbers: Numbers) -> dict[str, Any]:
    of_target, of_source, of_edge, _ = conv.lin_in.weight.split(conv.widths, dim=1)
    return {
        "ofTarget": numbers.place(of_target.T),
        "ofSource": numbers.place(of_source.T),
        "ofEdge": numbers.place(of_edge.T),
        "bias": numbers.place(conv.lin_in.bias),
        "slope": float(conv.act.weight.detach()),
    }


def _update(
    t: str, updates: nn.ModuleDict, convs: nn.ModuleDict, relations: list[EdgeType], model: GPE, numbers: Numbers
) -> dict[str, Any]:
    """Return the update of a node type. Its first map is multiplied with the last map of the messages; the last row takes the number of edges."""
    layers: Any = updates[t]
    sums = []
    for k, relation in enumerate(relations):
        conv: Any = convs[model.key(relation)]
        first, last = layers[0].weight.double(), conv.lin_out
        weight = torch.cat([(first @ last.weight.double()).T, (first @ last.bias.double())[None]])
        ends = [end for end, name in (("target", relation[2]), ("source", relation[0])) if name == t]
        sums += [{"relation": k, "end": end, "weight": numbers.place(weight)} for end in ends[:1]]
    return {"sums": sums, "bias": numbers.place(layers[0].bias)} | _after_first(layers, numbers)
