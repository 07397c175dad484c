"""The contract of every model: a graph in, one prediction per dynamic node type out."""

from typing import Any, Protocol

from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.schema import FeatureSpec


class Model(Protocol):
    """A network whose constructor takes a ``FeatureSpec`` first and keyword settings after it.

    ``forward`` gets a graph with standardised features and returns, per material with nodes in it, the acceleration without gravity [node, dim] in units
    of the data set's acceleration scale. ``settings`` holds the constructor's keyword arguments as plain values, so a checkpoint can rebuild the model.
    """

    spec: FeatureSpec
    settings: dict[str, Any]

    def forward(self, data: HeteroData) -> dict[str, Tensor]: ...
