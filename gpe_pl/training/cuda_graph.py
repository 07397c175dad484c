"""Training steps of small batches on a GPU as CUDA graphs.

A network consists of thousands of operations. In small batches, the host takes longer to start an operation than the GPU takes to do it. A CUDA graph starts
all operations of a forward or backward pass with one call. It works on arrays of fixed sizes, so batches are filled up with further nodes, and with edges among
these nodes. Messages do not leave the further nodes, so results and gradients are those of the batch alone.

Sources: ``torch.cuda.make_graphed_callables``; Ng 2021, "Accelerating PyTorch with CUDA Graphs".
"""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils import _pytree as pytree

from gpe_pl.learned.checkpoint_file import reason
from gpe_pl.models.base import Model
from gpe_pl.schema import EdgeType

log = logging.getLogger(__name__)

Sizes = dict[str | EdgeType, int]
"""Number of rows of each node type and relation."""

MULTIPLE = 64
"""Sizes of arrays are multiples of this number."""

MOST_ROWS = 100_000
"""Number of nodes and edges of a batch beyond which there are no graphs. The GPU then computes longer than the host needs to start the operations (see
``docs/results/scaling_gpu``), and further rows would cost time."""

MOST_EDGES = 16
"""Largest number of further edges of a relation per further node. With many more edges than usual, states of models without normalisation could overflow."""

MARGIN = 1.125
"""Size of an array relative to the batch for which it was made. Later batches then fit more often."""


def sizes_of(arguments: tuple[dict[Any, Any], ...]) -> Sizes:
    """Return the number of nodes of each type and of edges of each relation, given arguments of ``Model.compute``."""
    found: Sizes = {}
    for values in arguments:
        for key, value in values.items():
            found[key] = value[0].shape[1] if isinstance(key, tuple) else value.shape[0]
    return found


def enlarged(needed: Sizes, before: Sizes) -> Sizes:
    """Return sizes of arrays in which a batch fits, with some margin where ``before`` does not suffice.

    Node types have enough further nodes for the further edges of each relation, and at least one.
    """

    def size(key: str | EdgeType, rows: int) -> int:
        return before[key] if before.get(key, 0) >= rows else MULTIPLE * math.ceil(MARGIN * rows / MULTIPLE)

    found: Sizes = {key: size(key, count) for key, count in needed.items() if isinstance(key, tuple)}
    further = {key: 1 for key in needed if isinstance(key, str)}
    for key, rows in found.items():
        ends = {key[0], key[2]} if isinstance(key, tuple) else set()
        for end in ends & further.keys():
            further[end] = max(further[end], math.ceil((rows - needed[key]) / MOST_EDGES))
    return found | {key: size(key, needed[key] + count) for key, count in further.items()}


class FilledArguments:
    """Arguments of ``Model.compute`` in arrays of fixed sizes.

    Args:
        arguments: arguments of some batch, which determine types, relations, channels and devices.
        sizes: rows of the arrays, as ``enlarged`` returns them.

    Attributes:
        arguments: the arrays, in dictionaries and tuples as in a call.
    """

    def __init__(self, arguments: tuple[dict[Any, Any], ...], sizes: Sizes) -> None:
        self.sizes = sizes
        self.arguments = tuple({key: self._array(key, value) for key, value in values.items()} for values in arguments)
        self._count = torch.arange(max(sizes.values()), device=pytree.tree_leaves(arguments)[0].device)

    def _array(self, key: str | EdgeType, value: Any) -> Any:
        size = self.sizes[key]
        if isinstance(value, tuple):
            index, *features = value
            return (index.new_zeros(2, size), *(f.new_zeros(size, *f.shape[1:]) for f in features))
        return value.new_zeros(size, *value.shape[1:])

    @torch.no_grad()
    def fill(self, arguments: tuple[dict[Any, Any], ...]) -> None:
        """Write the arguments of a batch to the arrays. Further nodes and edges have the features of the first one, so that no value is unusual."""
        nodes = sizes_of(arguments)
        for ours, theirs in zip(self.arguments, arguments, strict=True):
            for key, value in theirs.items():
                if isinstance(key, tuple):
                    (index, *features), (own_index, *own_features) = value, ours[key]
                    self._write_edges(own_index, index, nodes[key[0]], nodes[key[2]], key)
                    for own, feature in zip(own_features, features, strict=True):
                        _write(own, feature)
                else:
                    _write(ours[key], value)

    def _write_edges(self, own: Tensor, index: Tensor, num_sources: int, num_targets: int, relation: EdgeType) -> None:
        count = index.shape[1]
        own[:, :count] = index
        for row, first, node_type in ((0, num_sources, relation[0]), (1, num_targets, relation[2])):
            # further edges are spread over the further nodes, because sums at a single one would wait for each other
            own[row, count:] = first + self._count[: own.shape[1] - count] % (self.sizes[node_type] - first)


def _write(own: Tensor, value: Tensor) -> None:
    count = value.shape[0]
    own[:count] = value
    own[count:] = value[0]


def without_further_nodes(results: Any, nodes: Sizes) -> Any:
    """Return results of ``Model.compute``, dictionaries by node type, without the rows of further nodes."""

    def cut(path: pytree.KeyPath, value: Tensor) -> Tensor:
        return value[: nodes[path[-1].key]].clone()  # type: ignore[attr-defined]

    return pytree.tree_map_with_path(cut, results)


class _Compute(nn.Module):
    """``compute`` of a model as a module, whose weights can be replaced for a call."""

    def __init__(self, model: Model, compute: Callable[..., Any]) -> None:
        super().__init__()
        self.model, self.compute = model, compute

    def forward(self, *arguments: Any) -> Any:
        return self.compute(*arguments)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Collect garbage now, and not inside this context. Freeing an old CUDA graph while another is made would spoil that one."""
    gc.collect()
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class CudaGraphs:
    """Replaces ``compute`` of a model in training on a GPU by CUDA graphs.

    There is one graph for each combination of node types and relations and for each class of sizes. The number of rows grows by a factor of √2 from class to
    class. A graph is made when it is first needed, and again for a batch that does not fit.

    The first call after ``begin_step`` uses a graph. Further ones do not, since they would overwrite what the gradient of the first needs. Gradients of weights
    may be arrays of the graph, so they have to be cleared before each backward pass, as Lightning does.

    Args:
        model: model whose weights are trained.
        compute: its ``compute``, or a compiled version of that.
    """

    def __init__(self, model: Model, compute: Callable[..., Any]) -> None:
        self.model, self.compute = model, compute
        self.works = True
        self.num_made = 0
        self._is_free = True
        self._graphs: dict[Any, tuple[FilledArguments, Callable[..., Any], list[int]]] = {}
        self._memory: Any = None

    def begin_step(self) -> None:
        """Tell that the gradients of all earlier calls have been computed or are not needed."""
        self._is_free = True

    def clear(self) -> None:
        """Free the memory of all graphs."""
        self._graphs.clear()
        self._memory = None
        gc.collect()
        torch.cuda.empty_cache()

    def __call__(self, *arguments: Any) -> Any:
        usable = self.works and self._is_free and self.model.training and torch.is_grad_enabled()
        leaves = pytree.tree_leaves(arguments) if usable else []
        sizes = sizes_of(arguments) if leaves else {}
        if not all(sizes.values()) or not 0 < sum(sizes.values()) <= MOST_ROWS or any(leaf.requires_grad for leaf in leaves):
            return self.compute(*arguments)
        try:
            filled, graph = self._graph(arguments, sizes)
        except Exception as error:  # depends on the operations of the model
            log.warning("training.cuda_graph: auto continues without CUDA graphs, which fail here (%s)", reason(error))
            self.works = False
            self.clear()
            return self.compute(*arguments)
        self._is_free = False
        filled.fill(arguments)
        results = graph(*self.model.parameters(), *pytree.tree_leaves(filled.arguments))
        return without_further_nodes(results, sizes)

    def _graph(self, arguments: tuple[dict[Any, Any], ...], sizes: Sizes) -> tuple[FilledArguments, Callable[..., Any]]:
        """Return arrays in which arguments of the given sizes fit, and the graph that works on them."""
        key = tuple(map(tuple, arguments)), round(2 * math.log2(sum(sizes.values())))
        weights = [p.data_ptr() for p in self.model.parameters()]
        before, graph, of_weights = self._graphs.get(key, (None, None, []))
        needed = enlarged(sizes, before.sizes if before else {})
        if before and graph and before.sizes == needed and weights == of_weights:
            return before, graph
        self._graphs.pop(key, None)
        before = graph = None  # so that its memory is free before a larger graph is made
        filled = FilledArguments(arguments, needed)
        filled.fill(arguments)
        graph = self._made(filled)
        self._graphs[key] = filled, graph, weights
        self.num_made += 1
        return filled, graph

    def _made(self, filled: FilledArguments) -> Callable[..., Any]:
        """Return a graph, a function of all weights and of the arrays.

        It is made with aliases of the weights. As long as an earlier loss exists, PyTorch remembers the stream on which the gradient of a weight was computed,
        and would wait for that stream inside the graph.
        """
        weights = {f"model.{name}": p.detach().requires_grad_(p.requires_grad) for name, p in self.model.named_parameters()}
        leaves, structure = pytree.tree_flatten(filled.arguments)
        module = _Compute(self.model, self.compute)

        def network(*tensors: Tensor) -> Any:
            arguments = pytree.tree_unflatten(tensors[len(weights) :], structure)
            return functional_call(module, dict(zip(weights, tensors, strict=False)), arguments)

        if self._memory is None:
            self._memory = torch.cuda.graph_pool_handle()
        with _no_garbage_collection():
            return torch.cuda.make_graphed_callables(network, (*weights.values(), *leaves), allow_unused_input=True, pool=self._memory)
