"""A showcase counts events, keeps few frames, and says why it stopped."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from gpe_pl.evaluation import showcase
from gpe_pl.evaluation.showcase import Measurement, ShowcaseSettings, start
from gpe_pl.learned.simulator import LearnedSimulator, SceneError
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.skips import Skips
from gpe_pl.solvers.fluid_scenes import FluidScene
from gpe_pl.solvers.scenes import SceneDistribution
from tests import scenes

CANYON = FluidScene("canyon", ((0.0, 3.0), (0.0, 1.5), (0.0, 1.5)), 2 * scenes.SPACING, 60)
SETTINGS = ShowcaseSettings(num_steps=3, num_uncontained_steps=2, values={"fluid": 10.0})


def simulator(accelerations: float = 1.0) -> LearnedSimulator:
    torch.manual_seed(0)
    build = scenes.builder(("fluid",), 3, history=2)
    simulated = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    simulated.acceleration_std.fill_(accelerations)
    return simulated


def run(
    simulated: LearnedSimulator,
    scene: SceneDistribution,
    settings: ShowcaseSettings,
    folder: Path,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Measurement]:
    return showcase.run(simulated, *start(simulated, scene, settings), settings, folder, on_progress)


def values(records: list[Measurement]) -> dict[str, float]:
    return {r.metric: r.value for r in records}


@pytest.mark.slow
def test_a_rollout_from_rest_is_counted_and_drawn(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    records = run(simulator(), CANYON, SETTINGS, tmp_path, lambda done, total: seen.append((done, total)))
    found = values(records)
    assert found["num_nodes"] == 60 and found["num_steps"] == 3 and found["num_boundary_nodes"] > 1000
    assert found["fraction_outside_at_end"] == 0 and 0 <= found["fraction_corrected"] < 1
    assert found["num_uncontained_steps"] == 2 and "fraction_asleep" not in found
    assert found["max_speed"] > 0 and found["peak_memory"] > 1e6 and found["seconds_per_step"] > 0
    assert seen == [(k, 5) for k in range(1, 6)]
    written = json.loads((tmp_path / "showcase.json").read_text())
    assert f"| num steps | {written['records'][2]['value']:g} |  |" in (tmp_path / "showcase.md").read_text()
    assert {r["metric"]: r["value"] for r in written["records"]} == found and written["stopped"] is None
    assert written["environment"]["commit"]
    assert (tmp_path / "showcase.png").stat().st_size > 1000
    assert [*tmp_path.glob("showcase.gif"), *tmp_path.glob("showcase.mp4")]


@pytest.mark.slow
def test_without_containment_what_enters_a_wall_is_counted(tmp_path: Path) -> None:
    heavy = simulator(2000.0)  # some fly into the ground at once
    found = values(run(heavy, CANYON, SETTINGS, tmp_path))
    assert found["fraction_outside_uncontained"] > 0 and found["fraction_corrected"] > 0
    assert found["fraction_outside_at_end"] == 0


@pytest.mark.slow
def test_a_rollout_that_explodes_says_so(tmp_path: Path) -> None:
    records = run(simulator(float("inf")), CANYON, SETTINGS, tmp_path)
    assert values(records)["num_steps"] == 0
    written = json.loads((tmp_path / "showcase.json").read_text(), parse_constant=pytest.fail)  # no NaN, which JSON does not know
    assert {r["metric"]: r["value"] for r in written["records"]}["seconds_per_step"] is None
    stopped = json.loads((tmp_path / "showcase.json").read_text())["stopped"]
    assert "not finite" in stopped and f"Stopped: {stopped}" in (tmp_path / "showcase.md").read_text()


@pytest.mark.slow
def test_nodes_faster_than_gravity_explains_are_counted(tmp_path: Path) -> None:
    fast, slow = (values(run(simulator(a), CANYON, SETTINGS, tmp_path)) for a in (1e5, 1.0))
    assert slow["fraction_too_fast"] == 0 and slow["max_speed"] < 1
    assert fast["fraction_too_fast"] > 0.1 and fast["max_speed"] > 20


def test_a_long_rollout_keeps_few_frames() -> None:
    state = scenes.state(5, ("fluid",), dim=3).to_torch()
    film = showcase._Film(state, scenes.metadata(("fluid",), 3), 1000)
    for frame in range(1, 1001):
        film.add(frame, state)
    assert 40 <= len(film.pos) <= showcase.MAX_PICTURES + 1
    assert film.metadata.frame_dt == pytest.approx(film.stride * 0.005)


def test_a_scene_of_another_spacing_is_refused(tmp_path: Path) -> None:
    coarse = FluidScene("canyon", CANYON.bounds, 3 * scenes.SPACING, 20)
    with pytest.raises(SceneError, match=r"the scene has .* spacing=0\.075 m"):
        run(simulator(), coarse, SETTINGS, tmp_path)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fluid": -1.0}, "values.fluid: kinematic_viscosity = -1.0 m\\^2/s is outside 1e-06 … 10"),
        ({"fluid": 1e9}, r"values.fluid: kinematic_viscosity = 1000000000.0 m\^2/s is outside 1e-06 … 10"),
        ({"fluid": 10.0, "snow": 3.0}, "values.snow: no material of this scene, which has fluid"),
    ],
)
def test_a_material_that_cannot_be_is_refused_before_anything_runs(values: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        start(simulator(), CANYON, ShowcaseSettings(values=values))


@pytest.mark.slow
def test_what_approximate_levels_leave_out_is_counted(tmp_path: Path) -> None:
    simulated = simulator()
    simulated.skips = Skips(sleep_after=1, rest_step_spacings=1e3, rest_step_change_spacings=1e3)
    found = values(run(simulated, CANYON, SETTINGS, tmp_path))
    assert found["fraction_asleep"] > 0 and found["lost_impulse"] > 0
