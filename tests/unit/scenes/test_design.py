"""``gpe design``: impossible designs are refused in one line, and a small one is found and verified with the solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpe_pl.errors import GpeError
from gpe_pl.geometry.shapes import Box, Polygon
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.scenes import design as verb
from gpe_pl.scenes.design import Design, design
from gpe_pl.scenes.obstacles import Circle, MeshObstacle
from gpe_pl.scenes.scene import Scene
from gpe_pl.trajectory.trajectory import Termination

RAMP = Polygon(((0.30, 0.35), (0.34, 0.35), (0.34, 0.55), (0.30, 0.55)), 0.3)
MESH = (("obstacle 1", MeshObstacle(Path("a.stl"), None, None, "z", 0.4)),)
FILE = """
box: [1.0, 1.0]
bodies:
  - {block: sand, at: [0.25, 0.62], size: [0.1, 0.1], velocity: [0, -2]}
obstacles:
  - {polygon: [[0.30, 0.35], [0.34, 0.35], [0.34, 0.55], [0.30, 0.55]], friction: 0.3}
"""


def scene(shape: Any = RAMP) -> Scene:
    return Scene(box=(1.0, 1.0)).block("sand", at=(0.25, 0.62), size=(0.1, 0.1), velocity=(0.0, -2.0)).obstacle(shape)


@pytest.mark.parametrize(
    ("seek", "message"),
    [
        (lambda: design(scene(), (0.8, 1.2)), "target=(0.8, 1.2): must be a point [x, y] in the box"),
        (lambda: design(scene(), (0.8, 0.1), obstacle=2), "obstacle=2: the scene has 1 obstacles; add one"),
        (lambda: design(scene(), (0.8, 0.1), shift=0.0, angle=0.0), "shift=0.0 angle=0.0: must be at least 0, the angle at most 180, and not both 0"),
        (lambda: design(scene(), (0.8, 0.1), shift=0.4), "the obstacle touches"),
        (lambda: design(scene(), (0.8, 0.1), seconds=0.0), "seconds=0.0: must be more than 0"),
        (lambda: design(scene().obstacle(RAMP), (0.8, 0.1)), "obstacle: it touches a wall or another obstacle"),
        (lambda: design(scene(Circle((0.6, 0.3), 0.1)).obstacle(Circle((0.6, 0.3), 0.1)), (0.8, 0.1)), "obstacle: it touches a wall or another obstacle"),
        (lambda: design(replace(scene(), obstacles=MESH), (0.8, 0.1)), "obstacle=1: discs, boxes and polygons can be moved"),
        (lambda: design(scene(Circle((0.5, 0.05), 0.1)), (0.8, 0.1)), "obstacle: it touches a wall or another obstacle"),
        (lambda: design(scene(Circle((0.6, 0.3), 0.1)), (0.8, 0.1), shift=0.0), "shift=0: obstacle 1 is a disc, which does not turn"),
        (lambda: verb.run("scene.yaml", {"target": (0.8, 0.1), "file": Path(__file__) / "a.html"}), "is a file and no folder; name another file"),
        (lambda: verb.run(None, {}), "gpe design: name a scene file"),
        (lambda: verb.run("scene.yaml", {}), "gpe design: name the point that the bodies should reach"),
    ],
)  # fmt: skip
def test_impossible_designs_are_refused_in_one_line(seek: Callable[[], Any], message: str) -> None:
    with pytest.raises(GpeError) as caught:
        seek()
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_scene_that_the_solver_refuses_is_told_before_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gpe_pl.evaluation.design.guidance.Guidance.misfit", lambda *_: pytest.fail("the search began"))
    heavy = Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.5), size=(0.1, 0.1), density=1500).obstacle(Circle((0.6, 0.3), 0.1))
    with pytest.raises(verb.DesignFault, match=r"solve=true: .*computes with 1600 kg/m³ only.*; or give solve=false"):
        design(heavy, (0.8, 0.1), shift=0.05, angle=0.0)


def test_a_design_has_the_scale_of_its_scene() -> None:
    """Models of one scale refuse another spacing, as in predictions."""
    other = scene()
    other = replace(other, spacing=2 * LearnedSimulator.from_checkpoint("sand").builder.metadata.spacing)
    with pytest.raises(GpeError) as predicted:
        other.predict()
    with pytest.raises(GpeError) as designed:
        design(other, (0.8, 0.1))
    assert str(designed.value) == str(predicted.value)


def test_a_rollout_that_stopped_has_no_distance() -> None:
    seen = scene().predict("sand", 0.02).first
    goal = np.array([0.5, 0.5])
    expected = np.sqrt(((seen.pos[-1].astype(np.float64) - goal) ** 2).sum(axis=1).mean())
    assert verb._distance(seen, goal) == pytest.approx(expected)
    stopped = replace(seen, termination=Termination("nan", 2, 0, "frame 2"))
    distances = {"model": (0.5, 0.3), "solver": (0.5, verb._distance(stopped, goal))}
    text = Design(scene(), (0.0, 0.0, 0.0), distances, {}, "gradient", "", 1, 1, 1.0).summary()
    assert "solver: distance from the target not known, as the rollout stopped early, 0.5 m at the start" in text
    assert "keeps" not in text


@pytest.mark.parametrize(("shift", "angle"), [(0.01, 0.0), (0.002, 0.0), (0.0, 20.0)])
def test_the_distance_of_a_box_is_that_of_the_scene_that_is_returned(shift: float, angle: float) -> None:
    """Nodes at corners of boxes have other normals than those of polygons, so both differ already at the start.

    A shift of 1 cm brings the box near the sand, which is then in free flight no more.
    """
    seconds, goal, plate = 0.02, np.array([0.8, 0.1]), Box((0.30, 0.45), (0.34, 0.55), 0.3)
    above = Scene(box=(1.0, 1.0)).block("sand", at=(0.28, 0.58), size=(0.06, 0.04), velocity=(0.0, -2.0)).obstacle(plate)
    found = design(above, (0.8, 0.1), shift=shift, angle=angle, seconds=seconds, method="derivative_free", evaluations=1, solve=False)

    def distance(scene: Scene) -> float:
        return verb._distance(scene.predict("sand", seconds).first, goal)

    assert any(found.pose)
    (moved,) = [shape for _, shape in found.scene.obstacles]
    start = Polygon(((0.30, 0.45), (0.34, 0.45), (0.34, 0.55), (0.30, 0.55)), 0.3)
    scenes = [replace(found.scene, obstacles=(("obstacle 1", shape),)) for shape in (start, moved)]
    assert found.distances["model"] == pytest.approx([*map(distance, scenes)], rel=1e-7)


@pytest.mark.slow
def test_the_distance_of_the_model_is_that_of_a_contained_rollout() -> None:
    """Fast sand passes a thin plate in the rollouts of the search. The model's own rollout at the best pose stops, so that it has no distance."""
    plate = Polygon(((0.28, 0.40), (0.48, 0.40), (0.48, 0.42), (0.28, 0.42)), 0.4)
    fast = Scene(box=(1.0, 1.0)).block("sand", at=(0.3, 0.5), size=(0.1, 0.1), friction_angle=30, velocity=(0.0, -8.0)).obstacle(plate)
    found = design(fast, (0.7, 0.05), shift=0.02, angle=5.0, seconds=0.1, method="derivative_free", evaluations=3, solve=False)
    stop = found.rollouts["model"].termination
    assert stop is not None and np.isnan(found.distances["model"][1])
    assert "model: distance from the target not known, as the rollout stopped early" in found.summary()
    assert f"model stopped at the best pose: {stop.reason}: {stop.message}" in found.summary()


@pytest.mark.slow
def test_an_obstacle_without_effect_stays_where_it_is() -> None:
    far = Scene(box=(1.0, 1.0)).block("sand", at=(0.1, 0.0), size=(0.08, 0.08))
    far = far.obstacle(Polygon(((0.60, 0.5), (0.64, 0.5), (0.64, 0.7), (0.60, 0.7)), 0.3))
    found = design(far, (0.3, 0.05), seconds=0.02, evaluations=1, solve=False)
    assert found.pose == (0.0, 0.0, 0.0) and found.scene == far
    before, after = found.distances["model"]
    assert before == after
    assert "best pose: that of the start, as no other that was tried is better" in found.summary() and "gradients" in found.summary()
    assert "cannot be trusted" not in found.summary()


@pytest.mark.slow
def test_a_design_is_found_and_verified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(FILE)
    made: list[Design] = []

    def kept(*args: Any, **values: Any) -> Design:
        made.append(design(*args, **values))
        return made[-1]

    monkeypatch.setattr(verb, "design", kept)
    verb.run("scene.yaml", {"target": (0.6, 0.3), "shift": 0.03, "angle": 0.0, "seconds": 0.05, "evaluations": 3, "file": Path("film.svg")})
    printed = capsys.readouterr().out
    assert "best pose: a shift of" in printed and "solver: distance from the target" in printed and Path("film.svg").exists()
    before, after = made[0].distances["model"]
    assert after <= before
    assert (np.abs(made[0].pose) <= np.array([0.03, 0.03, 0.0]) + 1e-12).all()
    ((_, moved),) = made[0].scene.obstacles
    assert moved != RAMP or not any(made[0].pose)
