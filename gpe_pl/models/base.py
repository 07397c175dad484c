"""The contract of all models: they map a graph to one prediction per dynamic node type."""

from dataclasses import dataclass, field
from typing import Any, Protocol

from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import FeatureSpec


@dataclass(frozen=True)
class Prediction:
    """Predictions of a model for a graph; materials without nodes are absent.

    Attributes:
        acceleration: acceleration without gravity, per material [node, dim], in units of the data set's acceleration scale.
        stress: Cauchy stress after the step, per material with a stress decoder [node, component], in units of the data set's stress scale.
    """

    acceleration: dict[str, Tensor]
    stress: dict[str, Tensor] = field(default_factory=dict)


class Model(Protocol):
    """Network whose constructor takes a ``FeatureSpec`` first and keyword settings after it.

    ``forward`` takes a graph with standardised features. ``settings`` holds the keyword arguments as plain values, so that a checkpoint can rebuild
    the model. ``compute`` does the work of ``forward`` on tensors in dictionaries and tuples; ``torch.compile`` compiles this part. ``skips`` lists what
    ``forward`` may leave out in evaluation mode; a model may ignore it. ``num_hops`` is the number of ``radius`` edges to the farthest node that can influence
    a prediction, apart from paths inside meshes.
    """

    spec: FeatureSpec
    settings: dict[str, Any]
    skips: Skips

    @property
    def num_hops(self) -> int: ...

    def forward(self, data: HeteroData) -> Prediction: ...

    def compute(self, *args: Any) -> Any: ...
