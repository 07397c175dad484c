"""Statistics of features as arrays, with which ``compiled_features`` standardises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gpe_pl.schema import EdgeType, FeatureSpec

Statistics = tuple[np.ndarray, np.ndarray]
"""Mean and 1 / std of each channel."""


@dataclass(frozen=True)
class ParameterStandards:
    """Statistics of a material's parameters.

    Attributes:
        statistics: mean and 1 / std of each parameter, or of its logarithm.
        is_log: whether each parameter enters as its logarithm.
        limits: lowest and highest value [2, param] to which values are clamped; None does not clamp.
    """

    statistics: Statistics
    is_log: list[bool]
    limits: np.ndarray | None

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return standardised parameters [node, param]."""
        if self.limits is not None:
            values = np.minimum(np.maximum(values, self.limits[0]), self.limits[1])
        if any(self.is_log):  # in another unit, logarithms are shifted, and single precision would round them differently
            values = values.astype(np.float64)
            values[:, self.is_log] = np.log(values[:, self.is_log])
        mean, inverse = self.statistics
        return (values - mean) * inverse


@dataclass(frozen=True)
class Standards:
    """Statistics of the features of graphs, in the precision of the features.

    Attributes:
        node: statistics of each node type.
        odd: 1 / std of each relation's odd channels.
        even: statistics of each relation's even channels.
        params: statistics of each material's parameters. Parameters of other materials are not standardised.
        mass: mass by which masses are divided [kg].
        precision: type of the features.
    """

    node: Mapping[str, Statistics]
    odd: Mapping[EdgeType, np.ndarray]
    even: Mapping[EdgeType, Statistics]
    params: Mapping[str, ParameterStandards]
    mass: float
    precision: np.dtype
    _of_mesh: dict[tuple[EdgeType, ...], tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)

    def of_params(self, material: str, values: np.ndarray) -> np.ndarray:
        """Return standardised parameters of nodes of a material [node, param], given those in the units of ``schema.MATERIALS`` [node, param]."""
        values = values.astype(np.float32)
        return self.params[material](values).astype(self.precision) if material in self.params else values

    def of_mesh(self, relations: tuple[EdgeType, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return 1 / std of odd channels, and mean and 1 / std of even channels, by relation of meshes [relation, channel]."""
        if relations not in self._of_mesh:
            widest = max(len(self.even[r][0]) for r in relations)
            mean, inverse = (
                np.stack([np.pad(self.even[r][k], (0, widest - len(self.even[r][k])), constant_values=k) for r in relations])
                for k in range(2)
            )
            self._of_mesh[relations] = np.stack([self.odd[r] for r in relations]), mean, inverse
        return self._of_mesh[relations]


def raw(spec: FeatureSpec, precision: np.dtype) -> Standards:
    """Return statistics that leave features as they are."""

    def identity(channels: int) -> Statistics:
        return np.zeros(channels, precision), np.ones(channels, precision)

    return Standards(
        node={t: identity(c) for t, c in spec.node_channels.items()},
        odd={r: identity(c)[1] for r, c in spec.odd_channels.items()},
        even={r: identity(c) for r, c in spec.even_channels.items()},
        params={},
        mass=1.0,
        precision=precision,
    )
