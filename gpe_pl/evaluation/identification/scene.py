"""``identify_parameters``: the unknowns of one scene from its observed motion."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.identification.answer import MODEL, SOLVER, Answer, value_of
from gpe_pl.evaluation.identification.calibration import Calibration
from gpe_pl.evaluation.identification.observations import Observations
from gpe_pl.evaluation.identification.profile import Profile
from gpe_pl.evaluation.identification.search import Found, SearchSettings, search
from gpe_pl.evaluation.identification.shooting import FAILED, Shooting, ShootingError, ShootingSettings, shooting
from gpe_pl.evaluation.identification.unknowns import Bounds, UnknownError, check_bounds, unknowns_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.rollout.loop import Simulator
from gpe_pl.schema import MATERIALS
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.flip.solver import FLIP
from gpe_pl.solvers.mpm.solver import MPM
from gpe_pl.system.progress import Progress
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

SOLVERS: dict[str, Any] = {solver.name: solver for solver in (MPM, FLIP, FEM)}


class SolverError(GpeError, ValueError):
    """Raised when the bundled solver of a trajectory cannot be rebuilt."""


def identify_parameters(
    simulator: LearnedSimulator | Simulator,
    observed: Trajectory | Observations,
    unknowns: Sequence[str] | str | None = None,
    *,
    per_body: bool = False,
    bounds: Bounds | None = None,
    shooting_settings: ShootingSettings | None = None,
    search_settings: SearchSettings | None = None,
    calibration: Mapping[str, Calibration] | None = None,
    scene: str = "scene",
    on_progress: Progress | None = None,
) -> Answer:
    """Return the material parameters of a scene, or other unknowns, from its observed motion.

    Stored values of the unknowns are not used. Other parameters, the obstacles and the masses have to be right::

        simulator = LearnedSimulator.from_checkpoint("sand")
        print(identify_parameters(simulator, trajectory))  # friction angle of sand 31.2° (90 %: 30.1–32.4)

    Args:
        simulator: trained model, or a solver. Models of several scales take that of the scene.
        observed: a trajectory, or observations with missing parts or noise.
        unknowns: names ``MATERIAL``, ``MATERIAL.PARAMETER``, ``velocity`` or ``gravity``, or one such name; None takes all material parameters.
        per_body: give each body values of its own.
        bounds: lowest and highest value by ``MATERIAL.PARAMETER``; by default the model's range in training. Solvers need bounds.
        shooting_settings: windows of the rollouts.
        search_settings: how to search.
        calibration: corrections and intervals by name of the unknown (``calibration.calibrated``). Without it, intervals are rough.
        scene: name of the scene, for the answer.
        on_progress: called with numbers of done and planned evaluations.

    Raises:
        UnknownError, ObservationError, ShootingError, SceneError: the scene does not fit; the message says why.
    """
    seen = observed if isinstance(observed, Observations) else Observations.of(observed)
    began, processor = time.monotonic(), time.process_time()
    check_bounds(bounds or {}, seen.trajectory.metadata)
    if isinstance(simulator, LearnedSimulator):
        simulator = simulator.on(seen.trajectory.metadata)
    ranges = {**(trained_bounds(simulator) if isinstance(simulator, LearnedSimulator) else {}), **(bounds or {})}
    sought = unknowns_of(seen.completed, unknowns, ranges, per_body, seen.first_frame, seen.trajectory)
    rollouts = shooting(simulator, seen, sought, shooting_settings)
    found = search(rollouts, search_settings, on_progress)
    if not found.misfit < math.log(FAILED):
        raise ShootingError(
            f"{scene}: every rollout failed, with all {len(found.tried)} values that were tried; check units, bounds and the observed motion"
        )
    answer = _answer(scene, rollouts, found, calibration or {})
    return replace(answer, seconds=round(time.monotonic() - began, 2), processor_seconds=round(time.process_time() - processor, 2))


def _answer(scene: str, rollouts: Shooting, found: Found, calibration: Mapping[str, Calibration]) -> Answer:
    """Return the answer of a search, without its times."""
    sought = rollouts.unknowns.items
    names = [unknown.name.partition("#")[0] for unknown in sought]
    if calibration and (missing := [name for name in names if name not in calibration]):
        raise UnknownError(f"{missing[0]}: the calibration is for {', '.join(calibration)}; calibrate it, too, or leave it out")
    chosen = [calibration[name] if calibration else Calibration() for name in names]
    values = []
    for k, (unknown, own) in enumerate(zip(sought, chosen, strict=True)):
        tried = ((unknown.coordinate(float(unknown.at(float(z[k])))), misfit) for z, misfit in found.tried)
        profile = Profile.of(tried, (unknown.coordinate(unknown.low), unknown.coordinate(unknown.high)))
        values.append(value_of(unknown, float(found.z[k]), profile, own))
    return Answer(
        scene=scene,
        observed=rollouts.observations.digest,
        simulator=MODEL if isinstance(rollouts.simulator, LearnedSimulator) else SOLVER,
        values=tuple(values),
        level=chosen[0].level,
        num_calibration=min(own.num_scenes for own in chosen),
        method=found.method,
        gradients="" if found.check is None else str(found.check),
        misfit=found.misfit,
        is_unfinished=found.is_unfinished,
        num_windows=len(rollouts.starts),
        length=rollouts.length,
        num_evaluations=rollouts.num_evaluations,
        num_gradients=rollouts.num_gradients,
        seconds=0.0,
        processor_seconds=0.0,
        tried=tuple((*(float(u.at(float(v))) for u, v in zip(sought, z, strict=True)), misfit) for z, misfit in found.tried),
    )


def trained_bounds(simulator: LearnedSimulator) -> dict[str, tuple[float, float]]:
    """Return the range in training of each material parameter, by ``MATERIAL.PARAMETER``."""
    names = simulator.builder.spec.parameters
    return {
        f"{material}.{spec.name}": (float(low), float(high))
        for material, trained in simulator.trained_ranges()
        for spec, (low, high) in zip(names[material], trained.T.tolist(), strict=True)
    }


def solver_bounds(metadata: Metadata) -> dict[str, tuple[float, float]]:
    """Return the range that the solvers accept of each stored material parameter, by ``MATERIAL.PARAMETER``."""
    return {
        f"{m}.{p.name}": (p.limits.low, p.limits.high) for m in metadata.materials for p in MATERIALS[m] if p.name in metadata.param_names
    }


def solver_of(metadata: Metadata) -> Simulator:
    """Return the bundled solver with the settings that a generated trajectory stores.

    Raises:
        SolverError: the trajectory is not from a bundled solver, or has finer labels.
    """
    try:
        stored = json.loads(metadata.config)
        settings = {key: value for key, value in stored["solver"].items() if key not in ("name", "version", "solver_dt")}
        if "fine" in stored:
            raise SolverError("simulator=solver: the motion is that of a finer solver (data.fine); choose simulator=model")
        return cast(Simulator, SOLVERS[metadata.solver](**settings))
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, SolverError):
            raise
        raise SolverError(
            f"simulator=solver: the trajectory is from {metadata.solver or 'no solver'!r}, not from one that comes with the package"
        ) from None
