"""Materials of the solvers: checks of their parameters, and constants of the material point method.

Every law is isotropic hyperelasticity, some with a return mapping. The laws themselves are in ``mpm.laws_2d`` and ``mpm.laws_3d``. A law reads one row of
constants per particle; ``LAMBDA`` … ``MEMORY`` name the columns. Parameters that a data set does not store have the values of the settings. Viscous stress is
added to the stress of every law.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.rollout.loop import SimulationError
from gpe_pl.schema import MATERIALS, MaterialParameter, param_names, stored_parameters
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.strain import FloatOrArray
from gpe_pl.trajectory.strain import lame_parameters as lame_parameters

SAND, SNOW, ELASTOMER = 0, 1, 2
"""Codes by which ``respond`` selects a law."""

LAMBDA, MU, COEFFICIENT, SMALLEST, LARGEST, MAX_HARDENING, VISCOSITY, MEMORY = range(8)
"""Columns of a particle's constants: Lamé parameters at rest [Pa]; slope of the cone in strains (sand) or ξ (snow); three constants of snow; kinematic
viscosity [m²/s]; and the time for which a particle keeps a velocity that the grid does not represent, per grid spacing [s/m]."""
INTERCEPT, TIP = SMALLEST, LARGEST
"""Columns of sand, which has none of snow's constants: ``|dev ε|`` of the cone at ``tr ε = 0``, and ``tr ε`` at its tip."""
NUM_CONSTANTS = 8


Parameters = Mapping[str, np.ndarray]
"""Values of the stored parameters of one material by name, each [node]."""


def limits_fault(parameter: MaterialParameter, value: float) -> str:
    """Return a message for a parameter outside the solvers' limits, or an empty string."""
    limits = parameter.limits
    if limits.low <= value <= limits.high:
        return ""
    return f"{parameter.name} = {parameter.quantity(str(value))} is outside {limits}, the solvers' limits"


def parameters_of(state: State, material: str, nodes: np.ndarray, materials: tuple[str, ...]) -> Parameters:
    """Return the stored parameters of the nodes of one material in float64.

    Args:
        state: state of a solver.
        material: name of the material.
        nodes: numbers of its nodes [chosen].
        materials: every material of the data set; they determine the columns of a state without ``param_names``.

    Raises:
        SimulationError: with reason ``input``; the first parameter has no column, or a value is outside the limits of the solvers or not a number.
    """
    names = state.param_names or param_names(materials)
    columns = np.asarray(state.material_params)
    if columns.shape != (state.num_nodes, len(names)):
        raise SimulationError(f"material_params has shape {columns.shape}, expected {(state.num_nodes, len(names))}", reason="input")
    if MATERIALS[material][0].name not in names:
        raise SimulationError(f"material_params has no column {MATERIALS[material][0].name}, which {material} needs", reason="input")
    values = {}
    for parameter in stored_parameters(material, names):
        own = columns[nodes, names.index(parameter.name)].astype(np.float64)
        check_limits(material, parameter, own, nodes)
        values[parameter.name] = own
    return values


def check_limits(material: str, parameter: MaterialParameter, values: np.ndarray, nodes: np.ndarray) -> None:
    """Refuse parameters outside the solvers' limits.

    Args:
        material: material of all nodes.
        parameter: one of its parameters.
        values: values of the parameter [node].
        nodes: numbers of the nodes [node], for the message.

    Raises:
        SimulationError: with reason ``input``; a value is outside the limits, or not a number.
    """
    limits = parameter.limits
    slack = 1 + np.finfo(np.float32).eps  # values at a limit may have been rounded in storage
    wrong = ~((values >= limits.low / slack) & (values <= limits.high * slack))
    if wrong.any():
        node, value = int(nodes[wrong][0]), values[wrong][0]
        message = f"node {node}: {parameter.name} of {material} is {parameter.quantity(value)}, outside {limits}, the limits of the solvers"
        raise SimulationError(message, reason="input", node=node)


Positive = Annotated[float, Field(gt=0)]
PoissonRatio = Annotated[float, Field(ge=0, lt=0.5)]


def drucker_prager_coefficient(friction_angle: np.ndarray, dim: int) -> np.ndarray:
    """Return the slope α of the Drucker-Prager cone in ``|dev ε| = -α (dλ + 2μ)/(2μ) tr ε``.

    In plane strain α = sin φ / √2 makes the law Mohr-Coulomb, ``|τ₁ - τ₂| = -sin φ (τ₁ + τ₂)``; in 3D the cone passes through the triaxial
    compression corners, α = √(2/3) 2 sin φ / (3 - sin φ) (Klar et al. 2016, section 5).

    Args:
        friction_angle: φ [node] in degrees.
        dim: 2 or 3.
    """
    sine = np.sin(np.deg2rad(friction_angle))
    return sine / math.sqrt(2.0) if dim == 2 else math.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine)


def drucker_prager_intercept(friction_angle: np.ndarray, cohesion: np.ndarray, dim: int) -> np.ndarray:
    """Return k [Pa] of the Drucker-Prager cone ``|dev τ| = k - α tr τ``, with α as in ``drucker_prager_coefficient``.

    The Mohr-Coulomb law with cohesion is ``τ₁ - τ₂ = 2 c cos φ - sin φ (τ₁ + τ₂)`` for the largest and the smallest principal stress. In plane strain
    ``|dev τ| = |τ₁ - τ₂| / √2`` gives k = √2 c cos φ. In 3D the triaxial compression corners give k = √(2/3) 6 c cos φ / (3 - sin φ). In both, the tip is at
    the isotropic tension c cot φ.

    Args:
        friction_angle: φ [node] in degrees.
        cohesion: c [node] in Pa.
        dim: 2 or 3.
    """
    angle = np.deg2rad(friction_angle)
    factor = math.sqrt(2.0) if dim == 2 else math.sqrt(2.0 / 3.0) * 6.0 / (3.0 - np.sin(angle))
    return factor * cohesion * np.cos(angle)


def _memory(cells: float, lam: FloatOrArray, mu: FloatOrArray, density: float) -> FloatOrArray:
    """Return the time [s] per grid spacing [m] in which a pressure wave crosses ``cells`` cells."""
    return cells * np.sqrt(density / (lam + 2.0 * mu))  # type: ignore[return-value]


def _constants(count: int, **columns: float | np.ndarray) -> np.ndarray:
    """Return rows [node, constant] filled with the named columns."""
    rows = np.zeros((count, NUM_CONSTANTS))
    for name, value in columns.items():
        rows[:, globals()[name]] = value
    return rows


@dataclass(frozen=True, config={"extra": "forbid"})
class Sand:
    """Sand: Hencky elasticity with Drucker-Prager plasticity (Klar et al. 2016). Material parameters: friction angle [°] and cohesion [Pa].

    Sand without stored cohesion is dry, with cohesion 0. Cohesion moves the tip of the cone into tension, as in wet sand (Tampubolon et al. 2017). It does not
    decrease in fracture: grains that come into contact again stick together as before.

    Attributes:
        youngs_modulus: Young's modulus [Pa]. It is a numerical choice, stiff enough to keep the wave speed well above the speeds of the flow.
        poisson_ratio: Poisson's ratio, below 0.5.
        density: mass per volume at rest [kg/m³].
        memory_cells: as in ``Elastomer``. Columns collapse as far as in experiments only with a short memory, because grains bounce little.
    """

    youngs_modulus: Positive = 3e5
    poisson_ratio: PoissonRatio = 0.2
    density: Positive = 1600.0
    memory_cells: Annotated[float, Field(ge=0)] = 0.5
    law: ClassVar[int] = SAND

    def constants(self, values: Parameters, dim: int) -> np.ndarray:
        """Return the constants that the law reads [node, constant]."""
        friction_angle = values["friction_angle"]
        cohesion = values.get("cohesion", np.zeros(len(friction_angle)))
        lam, mu = lame_parameters(self.youngs_modulus, self.poisson_ratio)
        slope = drucker_prager_coefficient(friction_angle, dim) * (dim * lam + 2.0 * mu) / (2.0 * mu)
        intercept = drucker_prager_intercept(friction_angle, cohesion, dim) / (2.0 * mu)
        without_tip = np.where(intercept > 0.0, math.inf, 0.0)  # the cone is a cylinder
        tip = np.divide(intercept, slope, out=without_tip, where=(slope > 0.0) & (intercept > 0.0))
        memory = _memory(self.memory_cells, lam, mu, self.density)
        return _constants(len(slope), LAMBDA=lam, MU=mu, COEFFICIENT=slope, INTERCEPT=intercept, TIP=tip, MEMORY=memory)

    @property
    def smallest_stiffness(self) -> float:
        """λ + 2μ at rest [Pa] of the softest sand."""
        return _pressure_wave_modulus(self.youngs_modulus, self.poisson_ratio)


@dataclass(frozen=True, config={"extra": "forbid"})
class Snow:
    """Snow: fixed-corotated elasticity that hardens under compaction (Stomakhin et al. 2013). Material parameters: hardening coefficient ξ, θ_c and θ_s.

    Attributes:
        youngs_modulus: E₀ [Pa] before any compaction.
        poisson_ratio: Poisson's ratio, below 0.5.
        density: mass per volume at rest [kg/m³].
        critical_compression: θ_c; principal stretches below 1 - θ_c become plastic. A stored value has precedence.
        critical_stretch: θ_s; principal stretches above 1 + θ_s become plastic. A stored value has precedence.
        max_hardening: largest factor on the elastic moduli. It bounds the wave speed, hence the number of substeps.
        memory_cells: as in ``Elastomer``. Without memory, snow settles at a greater height with shorter substeps.
    """

    youngs_modulus: Positive = 1.4e5
    poisson_ratio: PoissonRatio = 0.2
    density: Positive = 400.0
    critical_compression: Annotated[float, Field(gt=0, lt=1)] = 2.5e-2
    critical_stretch: Positive = 7.5e-3
    max_hardening: Annotated[float, Field(ge=1)] = 20.0
    memory_cells: Annotated[float, Field(ge=0)] = 2.0
    law: ClassVar[int] = SNOW

    def constants(self, values: Parameters, dim: int) -> np.ndarray:
        """Return the constants that the law reads [node, constant]."""
        lam, mu = lame_parameters(self.youngs_modulus, self.poisson_ratio)
        return _constants(
            len(values["hardening_coefficient"]),
            LAMBDA=lam,
            MU=mu,
            COEFFICIENT=values["hardening_coefficient"],
            SMALLEST=1.0 - values.get("critical_compression", self.critical_compression),
            LARGEST=1.0 + values.get("critical_stretch", self.critical_stretch),
            MAX_HARDENING=self.max_hardening,
            MEMORY=_memory(self.memory_cells, lam, mu, self.density),
        )

    @property
    def smallest_stiffness(self) -> float:
        """λ + 2μ at rest [Pa] of snow that has not hardened."""
        return _pressure_wave_modulus(self.youngs_modulus, self.poisson_ratio)


@dataclass(frozen=True, config={"extra": "forbid"})
class Elastomer:
    """Rubber: compressible neo-Hookean elasticity. Material parameters: Young's modulus [Pa] and Poisson's ratio.

    Attributes:
        poisson_ratio: Poisson's ratio, below 0.5, unless the data set stores it.
        density: mass per volume at rest [kg/m³].
        memory_cells: memory of the velocity that the grid does not represent. It decays to 1/e while a pressure wave crosses this many grid cells, for any
            length of substeps. 0 drops it in every substep (APIC), and then shorter substeps lose more energy.
    """

    poisson_ratio: PoissonRatio = 0.3
    density: Positive = 1000.0
    memory_cells: Annotated[float, Field(ge=0)] = 10.0
    law: ClassVar[int] = ELASTOMER

    def constants(self, values: Parameters, dim: int) -> np.ndarray:
        """Return the constants that the law reads [node, constant]."""
        lam, mu = lame_parameters(values["youngs_modulus"], values.get("poisson_ratio", self.poisson_ratio))
        return _constants(len(lam), LAMBDA=lam, MU=mu, MEMORY=_memory(self.memory_cells, lam, mu, self.density))

    @property
    def smallest_stiffness(self) -> float:
        """λ + 2μ at rest [Pa] of the softest elastomer within the limits."""
        youngs_modulus, poisson_ratio = (p.limits.low for p in MATERIALS["elastomer"])
        return _pressure_wave_modulus(youngs_modulus, poisson_ratio)


@dataclass(frozen=True, config={"extra": "forbid"})
class Fluid:
    """Liquid in scenes with other materials. It is weakly compressible, viscous and cannot bear tension, like sand without friction.

    The material parameter is the kinematic viscosity [m²/s]. For scenes of liquid alone, use the solver ``flip``, which is incompressible.

    Attributes:
        bulk_modulus: bulk modulus [Pa]. It is a numerical choice: a column of height H is compressed by the fraction ρ g H / bulk_modulus at its foot.
        density: mass per volume at rest [kg/m³].
        memory_cells: as in ``Elastomer``. A longer memory reduces the viscosity that the grid adds.
    """

    bulk_modulus: Positive = 5e5
    density: Positive = 1000.0
    memory_cells: Annotated[float, Field(ge=0)] = 2.0
    law: ClassVar[int] = SAND

    def constants(self, values: Parameters, dim: int) -> np.ndarray:
        """Return the constants that the law reads [node, constant]."""
        viscosity = values["kinematic_viscosity"]
        return _constants(len(viscosity), LAMBDA=self.bulk_modulus, VISCOSITY=viscosity, MEMORY=self.memory)

    @property
    def memory(self) -> float:
        """Time [s] per grid spacing [m] for which a particle keeps a velocity that the grid does not represent."""
        return _memory(self.memory_cells, self.bulk_modulus, 0.0, self.density)

    @property
    def smallest_stiffness(self) -> float:
        """Bulk modulus at rest [Pa]."""
        return self.bulk_modulus


def _pressure_wave_modulus(youngs_modulus: float, poisson_ratio: float) -> float:
    lam, mu = lame_parameters(youngs_modulus, poisson_ratio)
    return lam + 2.0 * mu
