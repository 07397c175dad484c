"""Error bands beside a checkpoint: what they promise, and what they refuse."""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from gpe_pl.evaluation.calibration import Calibration, CalibrationError
from gpe_pl.evaluation.coverage import Coverage
from gpe_pl.evaluation.metric_rows import LEARNED, Row
from gpe_pl.evaluation.predictions import PredictedScene
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.evaluation.uncertainty import Uncertainty, _other_settings
from gpe_pl.files.sealed import SealError
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned import bands
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.banded import roll_out_with_bands
from gpe_pl.learned.bands import Bands
from gpe_pl.learned.ensemble import LearnedEnsemble
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.trajectory.trajectory import Termination, Trajectory
from tests.conftest import make_trajectory
from tests.scenes import metadata, state

FRAMES, NODES = 5, 8
Found = dict[str, dict[str, tuple[float, float]]]


def scene(seed: int, num_frames: int = FRAMES, **about: Any) -> PredictedScene:
    """Return a scene whose prediction is wrong by an amount that all its nodes share, and that grows with their motion."""
    rng = np.random.default_rng(seed)
    truth = make_trajectory(seed, num_frames, NODES, **about)
    steps = np.abs(rng.normal(size=(num_frames, NODES, 2))) * 0.01
    pos = 0.3 + np.cumsum(steps, axis=0)
    prediction = replace(truth, pos=pos)
    scale = bands.scale_of(prediction, None)
    wrong = scale * np.abs(rng.standard_t(3)) * rng.random((num_frames, NODES))
    truth = replace(truth, pos=pos + np.stack([wrong, 0 * wrong], axis=-1))
    return PredictedScene(0, truth, truth, {LEARNED: prediction}, {}, {}, [], None, {"speed": (0.0, float(seed))})


def calibrated(num_scenes: int, checkpoint: Path, first: int = 0) -> Bands:
    calibration = Calibration("abc", True, 2)
    for seed in range(first, first + num_scenes):
        calibration.add(scene(seed))
    return calibration.bands([checkpoint])


def test_a_rollout_that_stops_early_keeps_the_limits_of_the_spread_from_others(checkpoint: Path) -> None:
    calibration = Calibration("abc", True, 2)
    for seed in range(19):
        own = scene(seed)
        spread = np.full((FRAMES, NODES), 0.001 * (1 + seed))
        if seed == 18:  # the widest
            own.predictions[LEARNED] = replace(own.predictions[LEARNED].frames(0, 2), termination=Termination("explosion", 2, 0, "x"))
            spread = spread[:2]
        calibration.add(replace(own, spread=spread))
    assert calibration.bands([checkpoint, checkpoint]).spread == pytest.approx([0.019, 0.018, 0.018, 0.018])


def of_frames(own: Bands) -> Bands:
    """Return bands for the frames and the spacing of ``tests.scenes``."""
    return replace(own, frame_dt=metadata().frame_dt, spacing=metadata().spacing)


def covered(own: Bands, scenes: list[PredictedScene]) -> list[Row]:
    coverage = Coverage(own)
    return [row for number, each in enumerate(scenes) for row in coverage.add(each, {2: "0.02s"}, ("test", number, "seen", 0.0))]


@pytest.mark.slow
def test_new_scenes_are_covered_as_promised(checkpoint: Path) -> None:
    """Over many calibrations, so that chance does not decide."""
    values: dict[str, list[float]] = {}
    for k in range(12):
        own = calibrated(19, checkpoint, 1000 * k)
        for row in covered(own, [scene(seed) for seed in range(1000 * k + 100, 1000 * k + 110)]):
            values.setdefault(row.metric, []).append(row.value)
    assert 0.87 < np.mean(values["fraction_in_bands"]) < 0.97
    assert 0.84 < np.mean(values["enough_in_bands"]) < 0.98
    assert set(values["enough_in_bands"]) == {0.0, 1.0}


def test_rows_of_the_table_have_the_scenes_that_reach_them(checkpoint: Path, tmp_path: Path) -> None:
    coverage = Coverage(of_frames(calibrated(19, checkpoint)))
    rows: list[Row] = []
    for number, frames in enumerate((FRAMES, FRAMES, FRAMES - 2)):
        rows += coverage.add(scene(number, frames), {2: "0.02s", FRAMES - 2: "later"}, ("test", number, "seen", 0.0))
    coverage.write(tmp_path, {2: "0.02s", FRAMES - 2: "later"})
    table = [
        [cell.strip() for cell in line.split("|")]
        for line in (tmp_path / "coverage.md").read_text().splitlines()
        if "0.02s" in line or "| later" in line or "| full" in line
    ]
    assert [(row[2], row[3]) for row in table] == [("3", "0.02s"), ("2", "later"), ("3", "full")]
    ends = [row.value for row in rows if (row.metric, row.horizon) == ("fraction_in_bands", "full")]
    assert table[-1][4].startswith(f"{100 * np.mean(ends):.1f} %")


def test_bands_for_scenes_are_wider(checkpoint: Path) -> None:
    own = calibrated(30, checkpoint)
    prediction = scene(99).predictions[LEARNED]
    nodes, whole = own.radius(prediction), own.radius(prediction, guarantee="scene")
    assert (nodes[0] == 0).all() and (whole[1:].mean() > nodes[1:].mean())
    assert (own.radius(prediction, level=0.95)[1:] >= nodes[1:]).all()
    longer = scene(98, FRAMES + 2).predictions[LEARNED]
    assert np.isinf(own.radius(longer)[FRAMES:]).all() and np.isfinite(own.radius(longer)[:FRAMES]).all()
    with pytest.raises(ValueError, match=r"level=0.99: bands are stored for 0.5, 0.6"):
        own.radius(prediction, level=0.99)
    with pytest.raises(ValueError, match="go without"):
        own.radius(prediction, np.zeros((FRAMES, NODES)))


def test_a_stopped_rollout_makes_bands_infinite(checkpoint: Path) -> None:
    calibration = Calibration("abc", True, 2)
    for seed in range(9):
        each = scene(seed)
        if seed == 4:
            cut = replace(each.predictions[LEARNED].frames(0, 3), termination=Termination("nan", 3, 0, "frame 3"))
            each = replace(each, predictions={LEARNED: cut})
        calibration.add(each)
    own = calibration.bands([checkpoint])
    factors = own.factors(0.9)
    assert np.isfinite(factors[:3]).all() and np.isinf(factors[3:]).all()
    assert np.isfinite(own.factors(0.5)).all()
    assert covered(own, [scene(50)])


def test_too_few_scenes_are_refused(checkpoint: Path) -> None:
    with pytest.raises(CalibrationError, match=r"8 calibration scenes: bands with a level of 0.9 need at least 9"):
        calibrated(8, checkpoint)


def test_bands_survive_the_file(checkpoint: Path, tmp_path: Path) -> None:
    own = tmp_path / "best.ckpt"
    own.write_bytes(checkpoint.read_bytes())
    assert bands.read(own) is None
    stored = calibrated(19, own)
    path = bands.path_beside([own])
    bands.write(path, stored)
    assert path.name == "best.bands.json" and bands.read(own) == stored
    assert stored.features == {"speed": (0.0, 18.0)}
    other = tmp_path / "other.ckpt"
    other.write_bytes(b"x")
    ensembles = {bands.path_beside(members).name for members in ([own, own], [own, other], [other, own], [own, own, other])}
    assert len(ensembles) == 4 and all(re.fullmatch(r"(best|other)\.ensemble_[0-9a-f]{8}\.bands\.json", name) for name in ensembles)
    values = json.loads(path.read_text())
    values["nodes"]["0.9"][0] = 0.0
    path.write_text(json.dumps(values))
    with pytest.raises(SealError, match="calibrate again"):
        bands.read(own)
    bands.write(path, stored)
    LearnedSimulator.from_checkpoint(checkpoint).save(own)
    with open(own, "ab") as file:
        file.write(b" ")
    assert bands.read(own) is None, "bands of another checkpoint"


def test_bands_name_what_they_do_not_hold_for(checkpoint: Path) -> None:
    own = calibrated(19, checkpoint)
    dt = own.frame_dt
    h = own.spacing
    assert h is not None and own.unfit(2, dt, h, True, {}, "other") == ""
    assert "calibration scenes" in own.unfit(2, dt, h, True, {}, "abc")
    assert "frame 3" in own.unfit(3, dt, h, True, {}, "other") and "containment=false" in own.unfit(2, dt, h, False, {}, "other")
    assert f"frames are {2 * dt:g} s long" in own.unfit(2, 2 * dt, h, True, {}, "other")
    assert own.unfit(2, dt, h / 2, True, {}, "other") == f"nodes are {h / 2:g} m apart, in calibration {h:g} m"
    key = "rollout.repeat_frames"
    assert own.unfit(2, dt, h, True, {key: 4}, "other") == f"{key} is 4, in calibration the default"
    skipped = replace(own, settings={key: 4})
    assert skipped.unfit(2, dt, h, True, {}, "other") == f"{key} is the default, in calibration 4"
    assert skipped.unfit(2, dt, h, True, {key: 4}, "other") == ""


def test_older_bands_are_of_rollouts_with_the_settings_of_the_model(checkpoint: Path) -> None:
    values = asdict(calibrated(19, checkpoint))
    del values["settings"]
    assert TypeAdapter(Bands).validate_json(json.dumps(values)).settings == {}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["absent", "held"])
def test_only_nodes_that_errors_are_about_are_covered(checkpoint: Path, kind: str) -> None:
    """Three quarters of the nodes have no error: they are not in the scene, or their motion is given. The others are covered as promised."""
    idle = np.arange(NODES) < 6

    def thinned(seed: int) -> PredictedScene:
        own = scene(seed)
        truth, prediction = own.truth, own.predictions[LEARNED]
        truth = replace(truth, pos=np.where(idle[:, None], prediction.pos, truth.pos))
        if kind == "held":
            about: dict[str, Any] = {"prescribed": np.repeat(idle[:, None], 2, axis=1)}
        else:
            about = {"alive": np.tile(~idle, (FRAMES, 1))}
        return replace(own, truth=replace(truth, **about), predictions={LEARNED: replace(prediction, **about)})

    fractions = []
    for k in range(6):
        calibration = Calibration("abc", True, 2)
        for seed in range(1000 * k, 1000 * k + 19):
            calibration.add(thinned(seed))
        own = calibration.bands([checkpoint])
        for seed in range(1000 * k + 100, 1000 * k + 110):
            each = thinned(seed)
            error = bands.errors_of(each.predictions[LEARNED], each.truth)
            assert (np.isnan(error) == idle).all()
            radius = own.radius(each.predictions[LEARNED])
            fractions.append((error[2, 6:] <= radius[2, 6:]).mean())
            rows = {r.metric: r.value for r in covered(own, [each]) if r.horizon == "0.02s"}
            assert rows["fraction_in_bands"] == fractions[-1] and rows["band_radius"] == pytest.approx(radius[2, 6:].mean())
            assert kind == "absent" or not radius[:, :6].any()
    assert 0.85 < np.mean(fractions) < 0.97


def test_a_scene_without_nodes_is_covered(checkpoint: Path) -> None:
    own, each = calibrated(19, checkpoint), scene(50)
    nobody: dict[str, Any] = {"alive": np.zeros((FRAMES, NODES), bool)}
    each = replace(each, truth=replace(each.truth, **nobody), predictions={LEARNED: replace(each.predictions[LEARNED], **nobody)})
    rows = {r.metric: r.value for r in covered(own, [each]) if r.horizon == "0.02s"}
    assert rows == {"fraction_in_bands": 1.0, "enough_in_bands": 1.0, "band_radius": 0.0}


@pytest.mark.parametrize("value", [0.0, 1e-9, 1.0, 3.14159, 99995.0, 123456.0])
def test_stored_factors_are_not_smaller(value: float) -> None:
    assert value <= bands.rounded_up(value) <= value * 1.0011


def test_an_ensemble_of_equal_members_is_its_member(checkpoint: Path) -> None:
    single = LearnedSimulator.from_checkpoint(checkpoint)
    ensemble = LearnedEnsemble.from_checkpoints([checkpoint, checkpoint])
    start = single.standing(state().to_torch(), metadata())
    alone = roll_out_with_bands(single, start, 3, metadata(), None)
    both = roll_out_with_bands(ensemble, start, 3, metadata(), None)
    np.testing.assert_allclose(both.trajectory.pos, alone.trajectory.pos, atol=1e-9)
    assert alone.spread is None and both.spread is not None and both.spread.shape == both.trajectory.pos.shape[:2]
    assert float(both.spread.max()) < 1e-9
    own = of_frames(calibrated(19, checkpoint))
    banded = roll_out_with_bands(single, start, 3, metadata(), own)
    assert banded.radius is not None and banded.radius.shape == alone.trajectory.pos.shape[:2] and (banded.radius[1:] > 0).all()
    assert math.isfinite(float(banded.radius.max()))
    with pytest.raises(ValueError, match="bands are of 1 checkpoints, the simulator has 2"):
        roll_out_with_bands(ensemble, start, 3, metadata(), own)
    assert isinstance(rollout(ensemble, start, 2, metadata()), Trajectory)


def test_bands_of_other_frames_are_refused_and_of_other_levels_marked(checkpoint: Path, caplog: pytest.LogCaptureFixture) -> None:
    single, own = LearnedSimulator.from_checkpoint(checkpoint), of_frames(calibrated(19, checkpoint))
    start = replace(single.standing(state().to_torch(), metadata()), time=own.start_frame * metadata().frame_dt)
    with pytest.raises(ValueError, match=r"the bands are of frames of 0.02 s, those of the scene have 0.005 s"):
        roll_out_with_bands(single, start, 3, metadata(), replace(own, frame_dt=0.02))
    with pytest.raises(ValueError, match=r"the bands are of nodes 0.1 m apart, those of the scene are 0.05 m apart"):
        roll_out_with_bands(single, start, 3, metadata(), replace(own, spacing=0.1))
    exact = roll_out_with_bands(single, start, 4, metadata(), own)
    assert "promise nothing" not in caplog.text
    roll_out_with_bands(single, replace(start, time=start.time + 25 * metadata().frame_dt), 3, metadata(), own)
    assert f"the calibration began at frame {own.start_frame} of each scene, this rollout at frame {own.start_frame + 25}" in caplog.text
    single.skips = Skips(repeat_frames=4)
    repeated = roll_out_with_bands(single, start, 4, metadata(), own)
    assert "the calibration skipped nothing, this rollout {'repeat_frames': 4}" in caplog.text
    expected = rollout(Contained(approximate(single), metadata().frame_dt), start, 4, metadata())
    np.testing.assert_array_equal(repeated.trajectory.pos, expected.pos)
    assert np.abs(repeated.trajectory.pos - exact.trajectory.pos).max() > 0


@pytest.mark.parametrize(
    ("setting", "changed", "text"),
    [
        ({"evaluation.mirror_average": True}, {"mirror_average": True}, "evaluation.mirror_average=true, this rollout false"),
        ({"evaluation.clamp_parameters": False}, {"clamps_parameters": False}, "evaluation.clamp_parameters=false, this rollout true"),
        ({"evaluation.static_friction": 0.9}, {}, "evaluation.static_friction=0.9, this rollout 0.0"),
    ],
)
def test_bands_of_other_settings_are_warned_of(
    setting: dict[str, Any], changed: dict[str, Any], text: str, checkpoint: Path, caplog: pytest.LogCaptureFixture
) -> None:
    single, own = LearnedSimulator.from_checkpoint(checkpoint), replace(of_frames(calibrated(19, checkpoint)), settings=setting)
    start = replace(single.standing(state().to_torch(), metadata()), time=own.start_frame * metadata().frame_dt)
    if changed:
        roll_out_with_bands(single.configured(**changed), start, 1, metadata(), own)
        assert "promise nothing" not in caplog.text
    roll_out_with_bands(single, start, 1, metadata(), own)
    assert f"error bands promise nothing: the calibration had {text}" in caplog.text


def test_the_settings_of_a_rollout_are_those_that_differ_from_the_model(checkpoint: Path) -> None:
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    assert _other_settings(EvaluationSettings(), [simulator]) == {}
    assert _other_settings(EvaluationSettings(mirror_average=False, static_friction=simulator.static_friction), [simulator]) == {}
    simulator.skips = Skips(repeat_frames=3)
    given = EvaluationSettings(mirror_average=True, clamp_parameters=False)
    assert _other_settings(given, [simulator]) == {
        "evaluation.mirror_average": True, "evaluation.clamp_parameters": False, "rollout.repeat_frames": 3,
    }  # fmt: skip


def test_a_setting_that_one_member_has_of_its_own_is_one_that_differs(checkpoint: Path) -> None:
    first = LearnedSimulator.from_checkpoint(checkpoint)
    second = first.configured(mirror_average=True)
    assert _other_settings(EvaluationSettings(mirror_average=False), [first, second]) == {"evaluation.mirror_average": False}


def test_scenes_that_calibrated_bands_do_not_count_as_new(checkpoint: Path, caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    simulator = LearnedSimulator.from_checkpoint(checkpoint)
    own = of_frames(calibrated(19, checkpoint))
    assert len({*own.scenes}) == 19
    bands.write(
        bands.path_beside([checkpoint]),
        replace(
            own,
            start_frame=EvaluationSettings().first_frame(simulator.builder.config.history, own.frame_dt),
            spacing=simulator.builder.metadata.spacing,
        ),
    )
    seen = Uncertainty([str(checkpoint)], [simulator], EvaluationSettings(horizons=[0.02]), "test", "other")
    rows = [row for seed in (3, 400, 4, 401) for row in seen.see(scene(seed), ("test", seed, "seen", 0.0))]
    assert {row.trajectory for row in rows if row.metric == "fraction_in_bands"} == {400, 401}
    seen.finish(tmp_path)
    assert "leaves out 2 scenes of test that calibrated them" in caplog.text
    bands.path_beside([checkpoint]).unlink()


def test_a_model_at_another_scale_has_the_horizons_of_its_scene(tmp_path: Path) -> None:
    builder = GraphBuilder(GraphConfig(history=1, scales="dimensionless"), metadata())
    simulator = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=8), builder)
    simulator.save(tmp_path / "own.ckpt")
    for factor, frame in ((1.0, 20), (2.0, 10)):
        here = simulator.at(frame_dt=factor * metadata().frame_dt)
        seen = Uncertainty([str(tmp_path / "own.ckpt")], [here], EvaluationSettings(horizons=[0.1]), "test", "abc")
        assert [*seen.horizons] == [frame]


def test_bands_of_a_shipped_model_are_not_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shipped = bands.path_beside(["sand"])
    before, sand = shipped.read_bytes(), LearnedSimulator.from_checkpoint("sand")
    found = Uncertainty(["sand"], [sand], EvaluationSettings(horizons=[0.1]), "test", "abc", calibrate=True)
    assert found.calibration is not None
    for k in range(9):
        found.calibration.add(scene(k))
    found.finish(tmp_path)
    assert shipped.read_bytes() == before and (tmp_path / "sand.bands.json").is_file()
    assert "the bands that come with the shipped model stay in use" in caplog.text
