"""The contract of every model: a graph in, one prediction per dynamic node type out."""

from dataclasses import dataclass, field
from typing import Any, Protocol

from torch import Tensor
from torch_geometric.data import HeteroData

from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import FeatureSpec


@dataclass(frozen=True)
class Prediction:
    """What a model says about a graph; materials without nodes are absent.

    Attributes:
        acceleration: without gravity, per material [node, dim], in units of the data set's acceleration scale.
        stress: Cauchy stress after the step, per material with a stress decoder [node, component], in units of the data set's stress scale.
    """

    acceleration: dict[str, Tensor]
    stress: dict[str, Tensor] = field(default_factory=dict)


class Model(Protocol):
    """A network whose constructor takes a ``FeatureSpec`` first and keyword settings after it.

    ``forward`` gets a graph with standardised features. ``settings`` holds the constructor's keyword arguments as plain values, so a checkpoint can rebuild
    the model. ``compute`` does the work of ``forward`` on tensors, in dictionaries and tuples: the part that ``torch.compile`` sees. ``skips`` says what
    ``forward`` may leave out in evaluation mode; a model need not know any of it. ``num_hops`` is how many ``radius`` edges lead to the farthest node that
    an answer can depend on, apart from paths inside of meshes.
    """

    spec: FeatureSpec
    settings: dict[str, Any]
    skips: Skips

    @property
    def num_hops(self) -> int: ...

    def forward(self, data: HeteroData) -> Prediction: ...

    def compute(self, *args: Any) -> Any: ...
