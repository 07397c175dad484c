"""Which material parameters occur in training. Parameters of other splits are compared with them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gpe_pl.schema import ParameterGroup, node_code
from gpe_pl.trajectory.trajectory import Trajectory

MOST_VALUES = 1000
"""Number of different values of a parameter up to which they are kept. With more, only their range is known, and values inside it count as seen."""


def parameters_in(trajectory: Trajectory) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield the materials that occur in a trajectory, with the names of their stored parameters and the different values of these."""
    m = trajectory.metadata
    for material in m.materials:
        rows = trajectory.node_type == node_code(material)
        if rows.any():
            for parameter, column in zip(m.parameters_of(material), m.columns_of(material), strict=True):
                yield material, parameter.name, np.unique(trajectory.material_params[rows, column])


@dataclass
class TrainedParameters:
    """Values of material parameters in training.

    Attributes:
        values: different values by material and parameter, sorted.
    """

    values: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory of training."""
        for material, name, values in parameters_in(trajectory):
            together = np.union1d(self.values.get((material, name), values[:0]), values)
            self.values[material, name] = together if len(together) <= MOST_VALUES else np.r_[together[: MOST_VALUES - 1], together[-1:]]

    @property
    def materials(self) -> set[str]:
        """Materials that occur in training."""
        return {material for material, _ in self.values}

    def groups(self, trajectory: Trajectory) -> Iterator[tuple[str, str, ParameterGroup]]:
        """Yield the group of each parameter of a trajectory with its material and name. Materials that do not occur in training are left out."""
        for material, name, values in parameters_in(trajectory):
            known = self.values.get((material, name))
            if known is None:
                continue
            if values[0] < known[0] or values[-1] > known[-1]:
                yield material, name, "extrapolated"
            else:
                is_seen = len(known) == MOST_VALUES or bool(np.isin(values, known).all())
                yield material, name, "seen" if is_seen else "interpolated"
