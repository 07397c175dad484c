"""Export of a network to ONNX, for runtimes without PyTorch.

Before the file is written, ONNX Runtime computes steps with it, which must equal those of the model. The network is ``GPE.compute``: it takes standardised
features and edges, and returns accelerations without gravity in units of the data set's acceleration scale. Search, features, conservation of momentum, the
elastic law and integration are not part of it. Its inputs are

- ``x.TYPE`` features of nodes [node, channel], ``params.MATERIAL`` [node, parameter], ``mass.MATERIAL`` [node]; with contact forces ``body.MATERIAL`` [node]
- ``edges.SOURCE.NAME.TARGET`` rows of source and target [2, edge], with ``odd.…`` and ``even.…`` features [edge, channel]

All levels of virtual nodes are one type ``grid`` if they share weights. Its outputs are ``acceleration.MATERIAL``, ``stress.MATERIAL`` and
``contact.MATERIAL``. With ``stress_unit="strain"`` the stress is that per strain.
"""

from __future__ import annotations

import copy
import logging
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.export import Dim

from gpe_pl.errors import GpeError
from gpe_pl.export.agreement import excess, largest_difference
from gpe_pl.export.program import EVERYTHING
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.models.gpe_program_runner import Decoded
from gpe_pl.trajectory.state import State

Arguments = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor], dict[str, Tensor], dict[Any, tuple[Tensor, Tensor, Tensor]]]
"""Arguments of ``GPE.compute``."""


class OnnxError(GpeError, ValueError):
    """Raised when a network cannot be exported, or when the exported network differs from the model."""


class _Network(nn.Module):
    """``GPE.compute`` from named tensors to tensors with the names of ``decoded``."""

    def __init__(self, model: GPE, names: list[str], relations: list[Any]) -> None:
        super().__init__()
        self.model, self.names, self.relations = model, names, relations

    def forward(self, tensors: dict[str, Tensor]) -> tuple[Tensor, ...]:
        return tuple(self.decoded(tensors).values())

    def decoded(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        groups: dict[str, dict[str, Tensor]] = {group: {} for group in ("x", "params", "mass", "body")}
        for name in self.names:
            group, _, key = name.partition(".")
            if group in groups:
                groups[group][key] = tensors[name]
        edges = {r: tuple(tensors[f"{group}.{'.'.join(r)}"] for group in ("edges", "odd", "even")) for r in self.relations}
        decoded = GPE.compute(self.model, *groups.values(), edges)  # type: ignore[call-arg, arg-type]
        kinds = zip(("acceleration", "stress", "contact"), decoded, strict=True)
        return {f"{kind}.{m}": values for kind, by_material in kinds for m, values in by_material.items()}


def named(arguments: Arguments) -> dict[str, Tensor]:
    """Return the arguments of ``GPE.compute`` by the names of the inputs."""
    x, params, mass, body, edges = arguments
    groups = {"x": x, "params": params, "mass": mass, "body": body}
    found = {f"{group}.{key}": values for group, by_key in groups.items() for key, values in by_key.items()}
    for relation, parts in edges.items():
        found |= {f"{group}.{'.'.join(relation)}": values for group, values in zip(("edges", "odd", "even"), parts, strict=True)}
    return found


def _with_compute(simulator: LearnedSimulator, compute: Any) -> LearnedSimulator:
    """Return a copy of a simulator whose network is this function."""
    other = simulator.configured(skips=EVERYTHING)
    other.model.compute = compute
    return other


def _arguments(simulator: LearnedSimulator, state: State) -> Arguments:
    """Return what ``GPE.compute`` gets in a step from a state."""
    seen: list[Arguments] = []

    def compute(*arguments: Any) -> Decoded:
        seen.append(arguments)  # type: ignore[arg-type]
        return GPE.compute(simulator.model, *arguments)  # type: ignore[arg-type]

    _with_compute(simulator, compute).step(state)
    return seen[0]


def _example(arguments: Arguments) -> tuple[dict[str, Tensor], dict[str, dict[int, Any]]]:
    """Return example inputs with different sizes, and the axes whose length may change."""
    x, _, _, _, edges = arguments
    sizes = {t: 5 + 2 * k for k, t in enumerate([*x, *(".".join(r) for r in edges)])}
    dims = {name: Dim(re.sub(r"\W", "_", name)) for name in sizes}
    random, inputs, shapes = torch.Generator().manual_seed(0), dict[str, Tensor](), dict[str, dict[int, Any]]()
    for name, values in named(arguments).items():
        group, _, key = name.partition(".")
        if group == "edges":
            source, _, target = key.split(".")
            ends = [torch.randint(sizes[end], (1, sizes[key]), generator=random) for end in (source, target)]
            inputs[name], shapes[name] = torch.cat(ends), {1: dims[key]}
            continue
        shape = (sizes[key], *values.shape[1:])
        is_integer = not values.is_floating_point()
        inputs[name] = torch.randint(3, shape, generator=random) if is_integer else 1 + torch.rand(shape, generator=random)
        shapes[name] = {0: dims[key]}
    return inputs, shapes


def _program(simulator: LearnedSimulator, arguments: Arguments) -> bytes:
    """Return the network as the bytes of an ONNX file."""
    inputs, shapes = _example(arguments)
    model: Any = copy.deepcopy(simulator.model).cpu().eval()
    model.skips = EVERYTHING
    network = _Network(model, [*inputs], [*arguments[4]])
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        outputs = [*network.decoded(inputs)]
        exported = torch.export.export(network, (inputs,), dynamic_shapes=(shapes,))
        program = torch.onnx.export(exported, dynamo=True, input_names=[*inputs], output_names=outputs, optimize=False, verbose=False)
    return program.model_proto.SerializeToString()  # type: ignore[union-attr]


def simulator_of(simulator: LearnedSimulator, content: bytes) -> LearnedSimulator:
    """Return a copy of a simulator whose network ONNX Runtime computes."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    taken, outputs = {i.name for i in session.get_inputs()}, [o.name for o in session.get_outputs()]

    def compute(*arguments: Any) -> Decoded:
        feed = {name: np.ascontiguousarray(values.numpy()) for name, values in named(arguments).items() if name in taken}  # type: ignore[arg-type]
        decoded = Decoded({}, {}, {})
        for name, values in zip(outputs, session.run(outputs, feed), strict=True):
            kind, _, material = name.partition(".")
            getattr(decoded, kind)[material] = torch.from_numpy(values)
        return decoded

    return _with_compute(simulator, compute)


def differences(simulator: LearnedSimulator, other: LearnedSimulator, states: Sequence[State]) -> tuple[float, float]:
    """Return the largest differences of a position [m] and of a stress [Pa] between one step of two simulators from each of some states."""
    complete = simulator.configured(skips=EVERYTHING)
    pairs = [(complete.step(state), other.step(state)) for state in states]
    stresses = [(a.stress.node, b.stress.node) for a, b in pairs if a.stress is not None and b.stress is not None]
    return largest_difference((a.pos, b.pos) for a, b in pairs), largest_difference(stresses)


def check_network(simulator: LearnedSimulator) -> None:
    """Raise ``OnnxError`` for a simulator whose model is no GPE."""
    if type(simulator.model) is not GPE:
        raise OnnxError(f"ONNX export knows GPE models, and no {type(simulator.model).__name__}; choose evaluation.export=[model]")


def export_network(simulator: LearnedSimulator, path: Path | str, states: Sequence[State]) -> float:
    """Write the network of a simulator as an ONNX file, which appears complete or not at all.

    Args:
        simulator: simulator whose model is a GPE.
        path: file that ends in ``.onnx``.
        states: states with velocity history from which the exported network and the model make a step, at least one.

    Returns:
        The largest difference of a position after these steps [m].

    Raises:
        OnnxError: the model is no GPE, or the exported network moves a node elsewhere or stresses it otherwise, by more than ``agreement.excess`` allows;
            nothing is written.
        ValueError: ``path`` has another file type, or there are no states.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"{path}: an ONNX file ends in .onnx")
    if not states:
        raise ValueError("states: give at least one, in which the exported network is compared with the model")
    check_network(simulator)
    content = _program(simulator, _arguments(simulator, states[0]))
    position, stress = differences(simulator, simulator_of(simulator, content), states)
    if wrong := excess(position, stress, states, simulator.stress_std):
        raise OnnxError(f"one step of the exported network differs from that of the model {wrong}; leave onnx out of evaluation.export")
    replace_bytes(path, content)
    return position
