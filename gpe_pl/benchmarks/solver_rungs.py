"""Cheaper variants of a solver: coarser grids, longer steps, softer materials and their combinations.

A learned model is compared with the best of them at its cost. Leaving one of them out can make a model seem to win.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gpe_pl.data.ground_truth import DatasetSpec
from gpe_pl.solvers.finer_solver import FinerSolver
from gpe_pl.solvers.resolution import Resolved, coarser
from gpe_pl.trajectory.state import State

log = logging.getLogger(__name__)

DATA = "solver, as for the data"
NODES = "solver, spacing of the nodes"
SPACING, STEPS, MODULI = "spacing × ", "steps × ", "moduli ÷ "

CONSTANT_MODULI = ("youngs_modulus", "bulk_modulus")
"""Settings of a solver's materials that are elastic moduli. A material whose modulus is a parameter of the data has none of them."""


@dataclass(frozen=True)
class Rung:
    """One variant of the solver.

    Attributes:
        name: its name, which says what is cheaper.
        solver: the solver.
        start: its initial state, and the map from its positions to those of the scene's nodes.
        frames_per_step: number of frames of the data that one step advances.
    """

    name: str
    solver: Any
    start: Resolved
    frames_per_step: int = 1


def rungs(
    spec: DatasetSpec, start: State, factors: Sequence[float], step_factors: Sequence[int], soft_factors: Sequence[float]
) -> Iterator[Rung]:
    """Yield the solver of the data (``DATA``) and all its variants for one scene.

    With labels of a finer solver, also yield the solver at the spacing of the nodes (``NODES``). Spacings that do not fit the scene are left out.

    Args:
        spec: the data set.
        start: initial state of the scene.
        factors: factors on the spacing of the nodes.
        step_factors: factors on frames and substeps (``with_longer_steps``).
        soft_factors: factors by which moduli are divided (``softer``).
    """
    for base, solver, resolved in _spacings(spec, start, factors):
        for softness, longer in itertools.product((1.0, *soft_factors), (1, *step_factors)):
            variant = solver if softness == 1 else _within(solver, lambda s, by=softness: softer(s, by))  # type: ignore[misc]
            if longer > 1 and variant is not None:
                variant = _within(variant, lambda s, by=longer: with_longer_steps(s, by))  # type: ignore[misc]
            if variant is not None:
                changes = ([f"{MODULI}{softness:g}"] if softness > 1 else []) + ([f"{STEPS}{longer}"] if longer > 1 else [])
                name = ", ".join([base, *changes])
                yield Rung(DATA if name == "solver" else name, variant, resolved, longer)


def _spacings(spec: DatasetSpec, start: State, factors: Sequence[float]) -> Iterator[tuple[str, Any, Resolved]]:
    """Yield name, solver and initial state of each spacing."""
    same = Resolved(start, lambda pos: pos)
    if spec.fine > 1:
        yield DATA, spec.label_solver, same
        yield NODES, spec.solver, same
    else:
        yield "solver", spec.solver, same
    for factor in factors:
        solver = coarser_solver(spec, factor)
        try:
            resolved = coarser(start, spec.scene.spacing, factor)
        except ValueError as error:
            log.info("%s: no scene %g times coarser (%s)", spec.name, factor, error)
            continue
        if solver is not None:
            yield f"solver, {SPACING}{factor:g}", solver, resolved


def _within(solver: Any, change: Callable[[Any], Any | None]) -> Any | None:
    """Change a solver. Of one for a finer spacing, change the solver that it calls."""
    if not isinstance(solver, FinerSolver):
        return change(solver)
    inner = change(solver.solver)
    return None if inner is None else replace(solver, solver=inner)


def coarser_solver(spec: DatasetSpec, factor: float) -> Any | None:
    """Return the solver with about ``factor`` times the grid spacing, for nodes with ``factor`` times the spacing.

    A solver without a grid is returned unchanged. Return None if such a grid does not fit the domain.
    """
    solver: Any = spec.solver
    spacing = getattr(solver, "grid_spacing", None)
    if spacing is None:
        return solver
    cells = [max(1, round((high - low) / (factor * spacing))) for low, high in solver.bounds]
    wanted = (solver.bounds[0][1] - solver.bounds[0][0]) / cells[0]
    try:
        return replace(solver, grid_spacing=wanted)
    except ValueError as error:
        log.info("%s: no grid %g times coarser (%s)", spec.name, factor, error)
        return None


def with_longer_steps(solver: Any, factor: int) -> Any | None:
    """Return a solver with frames ``factor`` times as long. Its substeps may grow as much, up to a distance of one cell per substep.

    Return None for a solver without a grid, whose substeps are already as long as is stable.
    """
    if getattr(solver, "grid_spacing", None) is None:
        return None
    return replace(solver, frame_dt=factor * solver.frame_dt, cfl=min(1.0, factor * solver.cfl))


def softer(solver: Any, factor: float) -> Any | None:
    """Return a solver whose constant elastic moduli are divided by ``factor``. Waves are slower then, and substeps longer.

    Moduli that are parameters of the data stay. Return None if the solver has no constant ones.
    """
    changed = {}
    for material in solver.materials if hasattr(solver, "constants_of") else ():
        constants = solver.constants_of(material)
        moduli = {name: getattr(constants, name) / factor for name in CONSTANT_MODULI if hasattr(constants, name)}
        if moduli:
            changed[material] = replace(constants, **moduli)
    return replace(solver, **changed) if changed else None
