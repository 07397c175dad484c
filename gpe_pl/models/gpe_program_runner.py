"""Runs a GPE as a network program: one compiled call per forward pass, on a CPU without gradients.

``GPE.forward`` does so in evaluation mode without gradients. ``system.compiled.unfused`` switches it off. PyTorch's operations take over, with a notice in
the log, if a layer has hooks or another ``forward``, if a layer or the model is of another class than ``GPE`` makes, or if a graph has another precision,
device or shape than the weights.

The program has a copy of the weights. It is written again when a layer is replaced or a weight changes. Each call compares a checksum of all weights, because
PyTorch does not count changes through ``weight.data``, NumPy or another process.
"""

from __future__ import annotations

import logging
from functools import lru_cache
from operator import is_
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData
from torch_geometric.nn.aggr import SumAggregation

from gpe_pl.models.gpe_program import GPEProgram
from gpe_pl.nn.blocks import MLP
from gpe_pl.nn.encoders import MaterialEmbedding, OddEncoder
from gpe_pl.nn.momentum_conv import MomentumConv
from gpe_pl.nn.network_program import Executable, Tables
from gpe_pl.nn.pair_force import PairForce
from gpe_pl.nn.pointers import checksum, count_words
from gpe_pl.nn.stores import contents
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import is_symmetric

if TYPE_CHECKING:
    from gpe_pl.models.gpe import GPE

log = logging.getLogger(__name__)

COVERED = (
    *(nn.ModuleDict, nn.ModuleList, nn.Linear, nn.PReLU, nn.LayerNorm),
    *(MLP, MaterialEmbedding, OddEncoder, MomentumConv, PairForce, SumAggregation),
)
"""Classes of layers that a program covers. A program knows their equations, so subclasses are not covered."""


class Decoded(NamedTuple):
    """Output of the network, per material.

    Attributes:
        acceleration: acceleration without gravity [node, dim].
        stress: stress, if decoded [node, component].
        contact: acceleration of nodes of bodies by contacts alone [node, dim], with the ``contact`` decoder.
    """

    acceleration: dict[str, Tensor]
    stress: dict[str, Tensor]
    contact: dict[str, Tensor]


@lru_cache
def notice(reason: str) -> None:
    """Log why a forward pass does not use the program. Each reason is logged once per process."""
    log.info("the network runs by PyTorch's operations, which is slower: %s", reason)


class GPEProgramRunner:
    """The program of a GPE with the present weights of the model, ready to run.

    Args:
        model: the model.
    """

    def __init__(self, model: GPE) -> None:
        modules = [*model.modules()]
        layers = [
            m for name, m in model.named_modules() if name.partition(".")[0] not in ("", "elastic_bodies", "strain_scale")
        ]  # the law and the strain are no parts of the program
        self._hooks = [hooks for m in modules[1:] for hooks in (m._forward_hooks, m._forward_pre_hooks)]
        self._attributes = [vars(m) for m in layers]
        self._unknown = next((type(m).__name__ for m in layers if type(m) not in COVERED), None)
        parts = [
            (own, name, part) for m in modules for own in (m._modules, m._parameters) for name, part in own.items() if part is not None
        ]
        self._owners, self._names, self._parts = ([*column] for column in zip(*parts, strict=True))
        self._weights = [part for part in self._parts if isinstance(part, Tensor)]
        self._addresses = [*map(Tensor.data_ptr, self._weights)]
        self._places, self._words = np.array(self._addresses, np.int64), np.array([*map(count_words, self._weights)], np.int64)
        self._checksum = checksum(self._places, self._words)
        if self._unknown is not None:
            return
        with torch.no_grad():
            written = GPEProgram(model)
        self.written, self.spec, self.dtype = written, model.spec, written.program.dtype
        types = {name: kind.number for name, kind in written.program.node_types.items()}
        self.type_of = {t: types[key] for t, key in written.types.items()}
        self.every = np.array([kind.every for kind in written.program.node_types.values()], np.int64)
        self.set_of = {r: written.program.relations[joined] for r, joined in written.relations.items()}
        self.materials = [m for m in model.spec.materials if m in written.types]
        self.bodies = [m for m in model.bodies if m in written.types]
        self.outputs = [(m, name, matrix) for name in Decoded._fields for m, matrix in getattr(written, name).items()]
        self.executable = Executable(written.program, self._kinds(model))

    def __deepcopy__(self, memo: Any) -> None:
        """Copies of a model write their own program."""

    def __reduce__(self) -> Any:
        """Models are pickled without their program."""
        return type(None), ()

    def _kinds(self, model: GPE) -> Tables:
        written, spec, types = self.written, self.spec, self.type_of
        nodes = [[types[t], written.features[key], spec.node_channels[t]] for t, key in written.types.items()]
        nodes += [[types[m], matrix, spec.param_channels[m]] for m, matrix in written.params.items()]
        nodes += [[types[m], matrix, 1] for m, matrix in written.mass.items()]
        edges = []
        for r, joined in written.relations.items():
            features, opposite = written.edges[joined]
            turns = model.interaction == "negated" and is_symmetric(r)
            edges.append([types[r[0]], types[r[2]], self.set_of[r], features, spec.odd_channels[r], spec.even_channels[r], turns, opposite])
        results = [[types[m], matrix, self._num_channels(m, name)] for m, name, matrix in self.outputs]
        return Tables(_table(nodes, 3), _table(edges, 8), np.array([types[m] for m in self.bodies], np.int64), _table(results, 3))

    def _num_channels(self, material: str, name: str) -> int:
        return self.spec.stress_channels[material] if name == "stress" else self.spec.dim

    def is_current(self) -> bool:
        """Tell whether the model still has the layers and weights with which the program was written."""
        return (
            all(map(is_, map(dict.get, self._owners, self._names), self._parts))
            and [*map(Tensor.data_ptr, self._weights)] == self._addresses
            and checksum(self._places, self._words) == self._checksum
        )

    def __call__(self, data: HeteroData, skips: Skips, keep_absent: bool) -> Decoded | None:
        """Return what the network decodes from a graph with standardised features; None if the program cannot be used.

        Args:
            data: the graph.
            skips: levels of skipping.
            keep_absent: whether materials without nodes have empty results.

        Raises:
            IndexError: an edge names a node that does not exist.
        """
        if self._unknown is not None:
            return notice(f"a layer is a {self._unknown}, which GPE does not make")
        if any(self._hooks):
            return notice("a layer has hooks")
        if any("forward" in own for own in self._attributes):
            return notice("a layer has another forward")
        try:
            found = self._run(data, skips)
        except _UnexpectedError:
            return notice("the graph has another precision, device or shape than the weights")
        if not keep_absent:
            found = Decoded(*({m: v for m, v in values.items() if v.shape[0]} for values in found))
        return found

    def _run(self, data: HeteroData, skips: Skips) -> Decoded:
        kept: list[Tensor] = []  # copies stay alive while their addresses are in use

        def address(tensor: Tensor, dtype: torch.dtype, *shape: int) -> int:
            if tensor.dtype is not dtype or not tensor.is_cpu or tensor.shape != shape:
                raise _UnexpectedError
            if not tensor.is_contiguous():
                tensor = tensor.contiguous()
                kept.append(tensor)
            return tensor.data_ptr()

        written, spec, dtype = self.written, self.spec, self.dtype
        at_nodes, at_edges = contents(data)
        num_nodes, size = [0] * len(self.every), np.zeros(written.program.num_sets, np.int64)
        nodes, edges, results = [], [], []
        count, first = dict[str, int](), dict[str, int]()
        for t, number in self.type_of.items():
            x = at_nodes[t]["x"]
            count[t], first[t] = len(x), num_nodes[number]
            num_nodes[number] += count[t]
            nodes.append((address(x, dtype, count[t], spec.node_channels[t]), count[t], first[t]))
        nodes += [(address(at_nodes[m]["material_params"], dtype, count[m], spec.param_channels[m]), count[m], 0) for m in written.params]
        nodes += [(address(at_nodes[m]["mass"], dtype, count[m]), count[m], 0) for m in written.mass]
        for r, rows in self.set_of.items():
            index, odd, even = map(at_edges[r].__getitem__, ("edge_index", "odd", "even"))
            n = index.shape[-1]
            size[rows] += n
            features = address(odd, dtype, n, spec.odd_channels[r]), address(even, dtype, n, spec.even_channels[r])
            edges.append((address(index, torch.int64, 2, n), *features, n, first[r[0]], first[r[2]]))
        size[self.every] = num_nodes
        size[written.stress_rows] = not skips.stress
        bodies = [(address(at_nodes[m]["body"], torch.int64, count[m]), count[m], 0) for m in self.bodies]
        found = Decoded({}, {}, {})
        for m, name, _ in self.outputs:
            if name == "stress" and skips.stress:
                results.append((0, 0, 0))
                continue
            out = getattr(found, name)[m] = torch.empty(count[m], self._num_channels(m, name), dtype=dtype)
            results.append((out.data_ptr(), count[m], 0))
        tensors = Tables(_table(nodes, 3), _table(edges, 6), _table(bodies, 3), _table(results, 3))
        sorts = skips.sorted_from is not None and sum(num_nodes) >= skips.sorted_from
        wrong = self.executable(tensors, np.array(num_nodes, np.int64), size, skips.isolated_nodes, sorts)
        if wrong is not None:
            source, name, target = [*self.set_of][wrong]
            raise IndexError(f"edges {name} from {source} to {target} name a node that does not exist")
        return found


class _UnexpectedError(Exception):
    """A tensor of another precision, device or shape than the weights."""


def _table(rows: list[Any], columns: int) -> np.ndarray:
    return np.array(rows, np.int64).reshape(-1, columns)
