"""Terms of the loss: penalties of an error, weights that depend on a node's number of neighbours, and errors of stresses.

Source of ``root`` and of the weights: Ummenhofer et al. 2020, "Lagrangian Fluid Simulation with Continuous Convolutions", ICLR, section 4. Their loss is the
mean of exp(−n/40) |error|^0.5, where n is the number of neighbours, and 40 is about its mean.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch_geometric.data import HeteroData

Loss = Literal["square", "log", "root"]
StressLoss = Literal["square", "relative"]

SMALL_ERROR = 0.1
"""Scale s of the penalty ``log``, in units of normalised accelerations. For smaller errors, ``log`` is nearly the square."""
LEAST_ERROR = 6.3e-4
"""Error of a position [rest spacings] below which the penalty ``root`` is smooth. The code of Ummenhofer et al. adds 1e-9 m² to the square, with a spacing of
0.05 m."""

LEAST_STRESS = 0.01
"""Root mean square of the stress in a graph, in the unit of the data set, below which relative errors no longer grow."""


def penalty(error: Float[Tensor, "node dim"], loss: Loss, least: Float[Tensor, ""]) -> Float[Tensor, "node _"]:
    """Return the penalty of errors e, whose mean is the loss.

    ``square`` is e² of each component, ``log`` is s² log(1 + e²/s²) of each with s = ``SMALL_ERROR``, and ``root`` is (|e|² + least²)^(1/4) of each node.

    Args:
        error: errors of normalised accelerations.
        loss: kind of the penalty.
        least: error in the same unit below which ``root`` is smooth; used for ``root`` only.
    """
    if loss == "root":
        return (error.square().sum(dim=1, keepdim=True) + least.square()) ** 0.25
    return SMALL_ERROR**2 * (error / SMALL_ERROR).square().log1p() if loss == "log" else error.square()


def without_held(store: Mapping[str, Any], error: Float[Tensor, "node dim"]) -> Float[Tensor, "node dim"]:
    """Return errors with zeros along the axes along which the motion of a node is given, so that no penalty of a whole vector counts them."""
    held = store.get("prescribed")
    return error if held is None else error.masked_fill(held, 0.0)


def stress_error(
    predicted: Float[Tensor, "node component"],
    target: Float[Tensor, "node component"],
    loss: StressLoss,
    graph: Int64[Tensor, " node"],
) -> Float[Tensor, "node component"]:
    """Return squared errors of normalised stresses.

    With ``relative``, they are divided by the mean square of the target in the node's graph plus the square of ``LEAST_STRESS``. Their mean is then that of the
    squared relative L2 norms of the graphs, so that small stresses count as much as large ones.

    Args:
        predicted, target: stresses in the unit of the data set.
        loss: kind of the error.
        graph: number of the graph of each node.
    """
    error = (predicted - target).square()
    if loss == "square":
        return error
    square, num_graphs = target.square().mean(dim=1), int(graph.max()) + 1 if len(graph) else 0
    count = square.new_zeros(num_graphs).index_add_(0, graph, torch.ones_like(square))
    mean = square.new_zeros(num_graphs).index_add_(0, graph, square) / count.clamp(min=1)
    return error / (mean[graph] + LEAST_STRESS**2)[:, None]


def num_neighbors(data: HeteroData, materials: Sequence[str]) -> dict[str, Float[Tensor, " node"]]:
    """Return the number of edges that connect each node of these materials with other nodes of these materials, within the radius and along cells."""
    count = {m: torch.zeros(data[m].x.shape[0], device=data[m].x.device) for m in materials}
    for relation in data.edge_types:
        source, _, target = relation
        if source in count and target in count:
            for end, row in ((source, 0), (target, 1)):
                rows = data[relation].edge_index[row]
                count[end].index_add_(0, rows, torch.ones_like(rows, dtype=count[end].dtype))
    return count


def mean_num_neighbors(graphs: Iterable[HeteroData], materials: Sequence[str]) -> float:
    """Return the mean of ``num_neighbors`` over all nodes of some graphs; 1 if no node has any."""
    counts = torch.cat([count for graph in graphs for count in num_neighbors(graph, materials).values()])
    return float(counts.double().mean()) if bool((counts > 0).any()) else 1.0
