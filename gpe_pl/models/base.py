"""Base class of all models. A model maps a graph to a prediction for each dynamic node type."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn
from torch_geometric.data import HeteroData

from gpe_pl.errors import GpeError
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import FeatureSpec


class LayersError(GpeError, ValueError):
    """Raised when the early layers of a model should be trained alone, and it has none."""


@dataclass(frozen=True)
class Prediction:
    """Predictions of a model for a graph; materials without nodes are absent.

    Attributes:
        acceleration: acceleration without gravity, per material [node, dim], in units of the data set's acceleration scale.
        stress: Cauchy stress after the step, per material with a stress decoder [node, component], in units of the data set's stress scale.
        frame_velocity: velocities at the end of the step [node, dim] in m/frame, per material for which the model integrates within the frame.
    """

    acceleration: dict[str, Tensor]
    stress: dict[str, Tensor] = field(default_factory=dict)
    frame_velocity: dict[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device) -> "Prediction":
        """Return the same prediction on a device."""
        if all(values.device == device for values in self.acceleration.values()):
            return self
        parts = (self.acceleration, self.stress, self.frame_velocity)
        return Prediction(*({m: values.to(device) for m, values in part.items()} for part in parts))


class Model(nn.Module, ABC):
    """Base class of networks.

    The constructor of a subclass takes a ``FeatureSpec`` first and annotated keyword settings after it, and passes all of them to the constructor of ``Model``.

    A subclass calls ``super().__init__(spec, width=width, …)`` before it makes its layers, so that ``type(model)(spec, **model.settings)`` rebuilds it.

    Args:
        spec: channels of the graphs.
        settings: the keyword arguments of the subclass, as plain values.

    Attributes:
        spec: channels of the graphs.
        settings: keyword arguments that rebuild the model; a checkpoint stores them.
        skips: computations that ``forward`` may leave out in evaluation mode; a model may ignore them.
    """

    spec: FeatureSpec
    settings: dict[str, Any]
    skips: Skips = Skips()
    has_named_weights: ClassVar[bool] = False
    """Whether the names of weights tell their materials and relations. Otherwise the order of the ``FeatureSpec`` gives weights their places."""
    compute: Callable[..., Any]
    """Does the work of ``forward`` on tensors in dictionaries and tuples. Training may replace it on a model by its ``torch.compile`` version."""

    def __init__(self, spec: FeatureSpec, **settings: Any) -> None:
        super().__init__()
        self.spec, self.settings = spec, settings

    if TYPE_CHECKING:  # nn.Module says that any call returns anything

        def __call__(self, data: HeteroData) -> Prediction: ...

    @property
    @abstractmethod
    def num_hops(self) -> int:
        """Number of ``radius`` edges to the farthest node that can influence a prediction, apart from paths inside meshes."""

    @property
    def is_fused(self) -> bool:
        """Whether the model has fused passes for CPUs. If so, ``torch.compile`` makes it no faster on a CPU."""
        return False

    def early_layers(self, num_steps: int) -> list[nn.Module]:
        """Return the encoders, the embeddings of materials and the layers of the first message-passing steps, for fine-tuning of these alone.

        Raises:
            LayersError: the model has no layers of single steps.
        """
        raise LayersError(f"{type(self).__name__} has no layers of single message-passing steps; choose training.early_layers=null")

    def parameter_weights(self) -> dict[str, str]:
        """Return the material whose parameters each tensor of weights [..., param] reads, by name of the tensor.

        Weights that also read other features are absent.
        """
        return {}

    def convert_units(self, material: str, stress: float, time: float, shift: Tensor, scale: Tensor) -> None:
        """Rewrite weights that stand for stresses or viscosities as functions of material parameters, so that they mean the same in other units.

        Args:
            material: name of the material.
            stress: previous unit of stresses (see ``set_units``) over the new one.
            time: previous frame interval over the new one.
            shift, scale: the parameters as they were standardised before [param] are ``shift`` + ``scale`` × those as they are standardised now.
        """

    def set_units(self, acceleration: float, spacing: float, stress: float) -> None:
        """Tell the model the units of a data set, before training.

        Args:
            acceleration: unit of predicted accelerations [m/frame²].
            spacing: rest spacing of nodes [m].
            stress: unit of predicted stresses, in mean masses per m^(dim − 2) and frame².
        """

    @abstractmethod
    def forward(self, data: HeteroData) -> Prediction:
        """Return the prediction for a graph, or a batch of graphs, with standardised features. The graph is not changed."""
