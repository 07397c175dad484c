"""Command ``gpe design scene.yaml target=0.8,0.1``: move and turn an obstacle until it guides the bodies of a scene to a target."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gpe_pl.errors import GpeError
from gpe_pl.scenes.film import Film, check_file
from gpe_pl.scenes.rollouts import predicted, solved
from gpe_pl.scenes.scene import Point, Scene
from gpe_pl.system.command_line import ArgumentFault, command, integer, number, truth

if TYPE_CHECKING:
    from gpe_pl.geometry.shapes import Shape
    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.trajectory.trajectory import Trajectory

Method = Literal["auto", "gradient", "derivative_free"]
METHODS: tuple[Method, ...] = ("auto", "gradient", "derivative_free")
LEAST_GAIN = 1e-6
"""Relative gain in the mean squared distance below which a pose is not better than that of the start: the rounding of rollouts that nothing guides."""

ABOUT = """Move an obstacle until it guides the bodies of a scene to a target: gpe design SCENE.yaml target=X,Y [KEY=VALUE …]

  gpe design scene.yaml target=0.8,0.1                    the first obstacle, by a shipped model
  gpe design scene.yaml target=0.8,0.1 shift=0.05 angle=45 seconds=0.8

Settings (default)
  target       point [m] that the nodes should reach
  obstacle     number of the obstacle that is moved (1)
  shift        largest shift [m] along each axis, in both directions (0.05)
  angle        largest turn [deg], in both directions (30)
  seconds      time after which distances from the target count (0.6)
  checkpoint   shipped model, folder of a run, or path of a checkpoint (the shipped model of the material)
  method       auto: gradients if a check by finite differences trusts them; gradient, derivative_free (auto)
  evaluations  largest number of rollouts after the scan (30)
  solve        also run the solver at the start and at the optimum (true)
  file         viewer of the optimum; .png, .svg, .pdf, .gif, .mp4 and .npz (a file per rollout) also work (SCENE_design.html)"""


class DesignFault(GpeError, ValueError):
    """Raised for a design that cannot be sought; the message names the setting."""


@dataclass(frozen=True)
class Design:
    """The best pose of an obstacle, and how far nodes are from the target before and after.

    Attributes:
        scene: the scene with the obstacle at the best pose. A box has become the polygon with its outline, also at the start.
        pose: shift [m] and angle [rad]; zeros if no other pose that was tried is better.
        distances: root mean square distance of nodes from the target [m] by ``model`` and ``solver``, at the start and at the best pose. It is that of rollouts
            with limits and, for the model, containment, as in predictions; NaN if one stopped early. The search has neither.
        rollouts: rollouts at the best pose, by name.
        method: ``gradient`` or ``derivative_free``.
        check: what a check of the gradient by finite differences found; empty without gradients.
        num_rollouts, num_gradients: numbers of rollouts without and with a gradient.
        processor_seconds: processor time of the search [s].
    """

    scene: Scene
    pose: tuple[float, float, float]
    distances: dict[str, tuple[float, float]]
    rollouts: dict[str, Trajectory]
    method: str
    check: str
    num_rollouts: int
    num_gradients: int
    processor_seconds: float

    def summary(self) -> str:
        """Return the pose, the distances and the cost, one a line."""
        from gpe_pl.evaluation.design.pose import text

        none_is_better = (
            "that of the start, as no other that was tried is better; if the bodies do not reach the obstacle in time, raise seconds"
        )
        lines = [f"best pose: {text(self.pose) if any(self.pose) else none_is_better}"]
        lines += [
            f"{name}: distance from the target {_in_metres(after)}, {_in_metres(before)} at the start"
            for name, (before, after) in self.distances.items()
        ]
        lines += [
            f"{name} stopped at the best pose: {stop.reason}: {stop.message}"
            for name, own in self.rollouts.items()
            if (stop := own.termination)
        ]
        if len(self.distances) == 2:
            promised, kept = (before - after for before, after in self.distances.values())
            if promised > 0 and not math.isnan(kept):  # false for NaN
                lines.append(f"the solver keeps {100 * kept / promised:.0f} % of the improvement that the model promises")
        way = self.method.replace("_", "-")
        lines.append(
            f"search: {way}, {self.num_rollouts} rollouts and {self.num_gradients} gradients in {self.processor_seconds:.3g} s of processor time"
        )
        return "\n".join([*lines, *([self.check] if self.check else [])])

    def film(self) -> Film:
        """Return the rollouts at the best pose."""
        first, *_ = self.rollouts
        return Film(self.scene.title, self.rollouts[first], {key: value for key, value in self.rollouts.items() if key != first})


def _in_metres(distance: float) -> str:
    return "not known, as the rollout stopped early" if math.isnan(distance) else f"{distance:.3g} m"


def design(
    scene: Scene,
    target: Point,
    obstacle: int = 1,
    shift: float = 0.05,
    angle: float = 30.0,
    seconds: float = 0.6,
    model: str | None = None,
    method: Method = "auto",
    evaluations: int = 30,
    solve: bool = True,
) -> Design:
    """Find the pose of an obstacle with which the nodes of a scene come nearest to a target.

    Args:
        scene: the scene in 2D.
        target: point that the nodes should reach [2] in m.
        obstacle: number of the obstacle that is moved, from 1.
        shift: largest shift along each axis [m], in both directions; 0 keeps the place.
        angle: largest turn about the obstacle's centre [deg], in both directions; 0 keeps the angle. Discs do not turn.
        seconds: time after which distances from the target count [s].
        model: shipped model, folder of a run, or checkpoint; None takes the shipped model of the material.
        method: ``auto`` uses gradients if a check by finite differences trusts them.
        evaluations: largest number of rollouts after a scan of each unknown.
        solve: also run the solver at the start and at the best pose.

    Raises:
        SceneFault: the scene is impossible, or does not fit the model.
        DesignFault: a setting is impossible, or every rollout failed.
        PoseError: the obstacle cannot be moved, or touches other parts of the scene within the limits.
    """
    from gpe_pl.evaluation.design.guidance import Guidance
    from gpe_pl.evaluation.design.pose import TOUCHES, Obstacle, PoseError, movable
    from gpe_pl.evaluation.identification.search import SearchSettings, search
    from gpe_pl.geometry.shapes import Box, Polygon, Sphere

    _check(scene, target, obstacle, shift, angle, seconds, method, evaluations)
    name, given = scene.obstacles[obstacle - 1]
    if not isinstance(given, Sphere | Box | Polygon):
        raise DesignFault(f"obstacle={obstacle}: discs, boxes and polygons can be moved, not meshes and other shapes")
    shape = movable(given)
    scene = _with_obstacle(scene, name, shape)
    simulator = scene.model_for(model or scene.shipped())
    state, metadata = scene.state(simulator)
    number = next((k for k, own in enumerate(state.boundary.shapes) if own is shape), None)
    if number is None:  # one polygon with an obstacle that it touches
        raise PoseError(TOUCHES)
    moves = Obstacle.of(number, state.boundary)
    limits = (shift, shift, 0.0 if isinstance(shape, Sphere) else math.radians(angle))
    if not any(limits):
        raise DesignFault(f"shift=0: {name} is a disc, which does not turn; give a shift of more than 0")
    moves.check_limits(limits, state.boundary, state.pos, metadata.spacing, state.cells)
    num_frames, goal = max(1, round(seconds / metadata.frame_dt)), np.asarray(target, np.float64)
    solver = _solver(scene, simulator) if solve else None
    guidance = Guidance(simulator, state.to_torch(), metadata, moves, limits, goal, num_frames, failed=(4 * metadata.longest_side) ** 2)
    before, began = guidance.misfit(np.full(len(guidance.unknowns), 0.5)), time.process_time()
    found = search(guidance, SearchSettings(method=method, num_scanned=3, max_evaluations=evaluations, profile_evaluations=0))
    if not found.misfit < math.log(guidance.failed):
        raise DesignFault(
            f"every rollout failed, with all {len(found.tried)} poses that were tried; check the scene, and shorten seconds={seconds}"
        )
    spent, is_better = time.process_time() - began, found.misfit < before - LEAST_GAIN
    best = tuple(guidance.pose(found.z).tolist()) if is_better else (0.0, 0.0, 0.0)
    moved = _with_obstacle(scene, name, moves.moved_shape(best)) if is_better else scene
    starts = (state, moved.state(simulator)[0]) if is_better else (state,)
    made: dict[str, list[Trajectory]] = {}
    if solver is not None:
        made["solver"] = [solved(solver, s, metadata, num_frames, f"solver {solver.name}") for s in starts]
    made["model"] = [predicted(simulator, s, metadata, num_frames, "model") for s in starts]
    rollouts = {key: own[-1] for key, own in made.items()}
    distances = {key: (_distance(own[0], goal), _distance(own[-1], goal)) for key, own in reversed(made.items())}  # the model first
    check = "" if found.check is None or not is_better else str(found.check)
    return Design(moved, best, distances, rollouts, found.method, check, guidance.num_evaluations, guidance.num_gradients, spent)


def _with_obstacle(scene: Scene, name: str, shape: Shape) -> Scene:
    """Return a scene in which the obstacle of a name has another shape."""
    return replace(scene, obstacles=tuple((n, shape if n == name else own) for n, own in scene.obstacles))


def _solver(scene: Scene, simulator: LearnedSimulator) -> Any:
    """Return the solver of the model's training data. It is made before the search, so that no search is lost if it cannot compute the scene."""
    try:
        return scene.solver_of(simulator)
    except GpeError as error:
        raise DesignFault(f"solve=true: {error}; or give solve=false") from None


def _distance(trajectory: Trajectory, goal: np.ndarray) -> float:
    """Return the root mean square distance [m] of the nodes from a point [dim] in the last frame; NaN for a rollout that stopped early."""
    if trajectory.termination is not None:
        return math.nan
    return float(np.sqrt(np.mean(np.sum((trajectory.pos[-1].astype(np.float64) - goal) ** 2, axis=1))))


def _check(scene: Scene, target: Point, obstacle: int, shift: float, angle: float, seconds: float, method: str, evaluations: int) -> None:
    """Raise ``DesignFault`` for a setting that is impossible in a scene."""
    if scene.dim != 2:
        raise DesignFault(f"box: has {scene.dim} axes; designs are for 2D")
    if scene.zones:
        raise DesignFault("openings: designs are for scenes without inlets and outlets, in which nodes stay")
    goal = np.asarray(target, np.float64) if np.shape(target) == (2,) else np.full(2, np.nan)
    if not all(low <= x <= high for x, (low, high) in zip(goal, scene.box, strict=True)):
        raise DesignFault(f"target={target}: must be a point [x, y] in the box")
    if not 1 <= obstacle <= len(scene.obstacles):
        raise DesignFault(
            f"obstacle={obstacle}: the scene has {len(scene.obstacles) or 'no'} obstacles; add one, or name one of them by number"
        )
    if not (0 <= shift < math.inf and 0 <= angle <= 180 and shift + angle > 0):
        raise DesignFault(f"shift={shift} angle={angle}: must be at least 0, the angle at most 180, and not both 0")
    if not 0 < seconds <= 60:
        raise DesignFault(f"seconds={seconds}: must be more than 0 and at most 60")
    if method not in METHODS:
        raise DesignFault(f"method={method}: must be one of {', '.join(METHODS)}")
    if evaluations < 1:
        raise DesignFault(f"evaluations={evaluations}: must be at least 1")


def _point(text: str) -> tuple[float, ...]:
    try:
        x, y = (float(part) for part in text.strip("[]()").split(","))
    except ValueError:
        raise ValueError("must be two numbers, such as 0.8,0.1") from None
    return x, y


def _method(text: str) -> str:
    if text not in METHODS:
        raise ValueError(f"must be one of {', '.join(METHODS)}")
    return text


KEYS: dict[str, Callable[[str], Any]] = {
    "target": _point,
    "obstacle": integer(1, 1000),
    "shift": number(0.0, 1e3),
    "angle": number(0.0, 180.0),
    "seconds": number(1e-3, 60.0),
    "checkpoint": str,
    "method": _method,
    "evaluations": integer(1, 10_000),
    "solve": truth,
    "file": Path,
}


def run(word: str | None, values: dict[str, Any]) -> None:
    """Search, print the design, and write its film."""
    from gpe_pl.scenes.scene_file import read_scene

    if word is None:
        raise ArgumentFault("gpe design: name a scene file, such as scene.yaml; `gpe predict --help` shows one")
    given = dict(values)
    file = given.pop("file", Path(f"{Path(word).stem}_design.html"))
    check_file(file)
    if "target" not in given:
        raise ArgumentFault("gpe design: name the point that the bodies should reach, such as target=0.8,0.1")
    model = given.pop("checkpoint", None)
    found = design(read_scene(word), given.pop("target"), model=model, **given)
    print(found.summary())
    film = found.film()
    film.write(file)
    print(*film.files(file), sep="\n")


main = command(run, ABOUT, "scene file", KEYS)

if __name__ == "__main__":
    main()
