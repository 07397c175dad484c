"""The effect of material parameters on the truth: runs that are compared, storage of finished scenes, the verdict, and the paper's split."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from gpe_pl.benchmarks import parameter_effect as module
from gpe_pl.benchmarks.finished_parts import FinishedParts
from gpe_pl.benchmarks.parameter_effect import (
    CHANGES,
    EffectError,
    Settings,
    figures,
    group_of,
    positions,
    report,
    run,
    scene_changes,
    stored_changes,
    trained_values,
)
from gpe_pl.benchmarks.trained import Case
from gpe_pl.config.datasets import dataset
from gpe_pl.config.folder import CONF
from gpe_pl.data.ground_truth import DatasetSpec, initial_state, parameter_values
from gpe_pl.files import sealed

TINY = ("data=sand", "size=tiny", "data.sizes.tiny.num_frames=5", "data.sizes.tiny.d2.num_particles=30", "data.scene.max_speed=4")
DOMAINS = ("sand", "snow", "elastomer", "fem", "fluid")


def tiny(*overrides: str) -> DatasetSpec:
    return dataset(*TINY, *overrides)


def test_the_other_values_are_trained_ones() -> None:
    """Scene 0 has a friction angle of 21°."""
    found = trained_values(tiny(), 0)
    assert {name: values["sand"]["friction_angle"] for name, values in found.items()} == {"lowest": 20.0, "highest": 42.5, "nearest": 20.0}
    assert [group_of(value, (20.0, 42.5)) for value in (15.0, 31.0, 47.5)] == ["below", "between", "above"]


def test_changes_are_against_the_own_value() -> None:
    spec = tiny()
    values, _ = parameter_values(spec, "test_unseen", 1)
    own, other = (positions(spec.solver, initial_state(spec, "test_unseen", 1, v), 4) for v in (values, {"sand": 42.5}))
    changes = scene_changes(spec, 1)
    assert list(changes) == list(CHANGES) and all(len(curve) == 4 for curve in changes.values())
    np.testing.assert_allclose(changes["highest"], ((own - other) ** 2).mean(axis=(1, 2)))
    assert 0 < changes["rounded"][-1] < changes["half_step"][-1] < 1e-6
    assert 0 < changes["nearest"][-1] < changes["highest"][-1] != changes["range"][-1]


def test_finished_scenes_are_not_simulated_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, calls = tiny(), []

    def counted(spec: DatasetSpec, index: int) -> dict[str, list[float]]:
        calls.append(index)
        return {name: [1.0] * 4 for name in CHANGES}

    monkeypatch.setattr(module, "scene_changes", counted)
    parts = FinishedParts(tmp_path)
    first = stored_changes(spec, 0, parts)
    assert stored_changes(spec, 0, parts) == first and calls == [0]
    stored_changes(tiny("data.solver.cfl=0.4"), 0, parts)
    stored_changes(tiny("data.parameters.sand.seen=[20,42.5]"), 0, parts)
    assert calls == [0, 0, 0], "other settings are other scenes"
    for path in tmp_path.iterdir():
        path.write_text(path.read_text().replace("1.0", "2.0", 1))
    with pytest.raises(sealed.SealError, match="delete it"):
        stored_changes(spec, 0, parts)


def test_a_scene_that_cannot_be_simulated_is_named() -> None:
    with pytest.raises(EffectError, match="sand tiny, scene 1 of test_unseen: frame 1: .*substeps"):
        scene_changes(tiny("data.solver.max_substeps=1"), 1)


def test_data_without_unseen_values_are_refused(tmp_path: Path) -> None:
    settings = Settings({"sand": Case([])})
    with pytest.raises(EffectError, match=r"suite\.cases\.sand: .*num_test_unseen"):
        run(settings, {"sand": tiny("data.num_test_unseen=0")}, tmp_path)


def test_results_have_every_scene_horizon_and_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    curves = {name: [0.1 * k, 0.2 * k, 0.3 * k, 0.4 * k] for k, name in enumerate(CHANGES, start=1)}
    monkeypatch.setattr(module, "scene_changes", lambda spec, index: curves)
    settings = Settings({"sand": Case([])}, num_scenes=3, horizons=[2, 100, "full"])
    records, table = run(settings, {"sand": tiny()}, tmp_path)
    scenes = [record for record in records if "scene" in record]
    assert [(r["scene"], r["horizon"]) for r in scenes] == [(k, h) for k in range(3) for h in (2, "full")], "no scene has 100 frames"
    assert scenes[0]["range"] == pytest.approx(0.15) and scenes[1]["range"] == pytest.approx(0.25)
    (curve,) = (r for r in records if r.get("curve") == "nearest")
    assert curve["time"] == pytest.approx([0.005, 0.01, 0.015, 0.02]) and curve["change"] == pytest.approx([0.4, 0.8, 1.2, 1.6])
    assert "| sand | 3 | 0.02 |" in table
    (figure,) = figures(records).values()
    assert len(figure.axes[0].lines) == 4


def test_ratios_below_ten_are_bold() -> None:
    def record(scene: int, value: float, change: float) -> dict[str, Any]:
        about = {"case": "sand", "scene": scene, "values": {"sand": value}, "horizon": "full", "seconds": 1.0}
        return {**about, "group": "below" if value < 20 else "between", **dict.fromkeys(CHANGES, 1.0), "nearest": change}

    rows = report([record(0, 15.0, 8.0), record(1, 30.0, 30.0)]).splitlines()
    assert "| sand | below: 15 | 1 | **8 [8, 8]** |" in rows
    assert "| sand | between: 30 | 1 | 30 [30, 30] |" in rows
    assert "| sand | all | 2 | 19 [8, 30] |" in rows, "the ratio of means"


# --- the paper's split ----------------------------------------------------------------------------------------------------------------------


def test_every_domain_has_a_case_for_both_splits() -> None:
    suite: Any = OmegaConf.to_container(OmegaConf.load(CONF / "suite" / "parameter_effect.yaml"), resolve=False)
    given = {label: case["overrides"][:-1] for label, case in suite["cases"].items()}
    today = {name: [f"data={name}"] for name in DOMAINS}
    assert given == today | {f"{name}_paper": [f"data={name}", "parameters=paper"] for name in DOMAINS}


@pytest.mark.slow
@pytest.mark.parametrize("data", DOMAINS)
def test_the_papers_split_trains_the_ends(data: str) -> None:
    today, paper = (dataset(f"data={data}", "size=small", *more) for more in ([], ["parameters=paper"]))
    assert paper.name == f"{data}_paper" != today.name
    ((_, values),) = paper.parameters.items()
    low, lower, upper, high = values.seen
    assert low < lower < min(values.interpolated) and max(values.interpolated) < upper < high and len(values.interpolated) == 2
    assert min(values.extrapolated) < low and high < max(values.extrapolated)
    assert paper.solver == today.solver and paper.counts == today.counts


def test_solids_have_the_papers_range() -> None:
    values = dataset("data=fem", "parameters=paper").parameters["solid"]
    assert (min(values.seen), max(values.seen), values.extrapolated) == (1e6, 4e6, (5e5, 1e7))


@pytest.mark.parametrize("size", ["small", "paper"])
def test_faster_solids_do_not_outrun_the_graph(size: str) -> None:
    spec = dataset("data=fem", "parameters=paper", f"size={size}")
    (low, high), fall = spec.scene.bounds[-1], 2 * 9.81
    speed = np.sqrt(spec.scene.max_speed**2 + fall * (high - low))  # type: ignore[attr-defined]
    assert speed * spec.solver.frame_dt < spec.scene.connectivity_radius


def test_other_data_have_no_such_split() -> None:
    with pytest.raises(Exception, match="split_name"):
        dataset("data=mixed", "parameters=paper")
