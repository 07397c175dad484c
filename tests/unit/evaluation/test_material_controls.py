"""Rollouts with other material parameters: a model that ignores the parameter has equal errors, one that reads it has not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.control_runs import HIGHEST, LOWEST, ControlRuns, TrainedValues, scene_values
from gpe_pl.data.ground_truth import trajectory_metadata
from gpe_pl.evaluation import split_files
from gpe_pl.evaluation.material_controls import CONTROLS, SOLVER_ENDS, SOLVER_NEAREST, UNSEEN, ControlError, MaterialControls, label_of
from gpe_pl.evaluation.metric_rows import Row
from gpe_pl.evaluation.predictions import start_of
from gpe_pl.evaluation.rollouts import evaluate
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout import loop as rollout_loop
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.loop import Start
from gpe_pl.schema import node_code
from gpe_pl.trajectory.store import iter_trajectories
from tests.runs import DATA, compose

SETTINGS = EvaluationSettings(splits=["test", "test_unseen"], horizons=[0.025], num_pictures=0, num_uncontained=0, material_controls=True)


@pytest.fixture(scope="module")
def controls(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> MaterialControls:
    spec = dataset_spec(compose("simulate", *DATA))
    root = tmp_path_factory.mktemp("controls") / "sand" / "tiny"
    root.parent.mkdir()
    root.symlink_to(tiny_data / "sand" / "tiny")
    made = MaterialControls(root, spec, replace(spec, num_train=10), 2)
    made.prepare()
    return made


def simulator(root: Path, embedding: str) -> LearnedSimulator:
    builder = GraphBuilder(GraphConfig(history=2), next(iter_trajectories(root, "test")).metadata)
    torch.manual_seed(0)
    model = GPE(builder.spec, material_embedding=embedding, num_message_passing_steps=1, hidden_channels=8)  # type: ignore[arg-type]
    made = LearnedSimulator(model, builder).eval()
    made.get_buffer("trained_sand")[:, 0] = torch.tensor([20.0, 42.5])
    return made


def errors(rows: list[Row], model: str, split: str = UNSEEN) -> list[float]:
    return [r.value for r in rows if (r.model, r.split, r.metric, r.horizon) == (model, split, "rollout_mse", "full")]


@pytest.mark.slow
@pytest.mark.parametrize("embedding", ["affine", "none"])
def test_controls_change_what_reads_the_parameter(embedding: str, controls: MaterialControls, tmp_path: Path) -> None:
    learned = simulator(controls.root, embedding)
    rows = evaluate(learned, controls.root, SETTINGS, tmp_path, controls=controls)
    own = errors(rows, "learned")
    if embedding == "none":
        assert own == errors(evaluate(learned, controls.root, replace(SETTINGS, material_controls=False), tmp_path / "plain"), "learned")
    for control in CONTROLS:
        other = errors(rows, label_of("learned", control))
        assert len(own) == 2 and len(other) == (0 if control == "shuffled" else 2)  # each group has one scene, so none has another's values
        assert not errors(rows, label_of("learned", control), "test")
        if embedding == "none" and other:
            assert other == own
    if embedding == "affine":
        nearest, far = (errors(rows, label_of("learned", control)) for control in ("nearest", "far"))
        assert nearest[0] != own[0] and far[0] not in (nearest[0], own[0])
        assert nearest[1] == own[1]  # extrapolated, so clamped to the nearest trained value
    for solver in (SOLVER_NEAREST, SOLVER_ENDS):
        assert len(errors(rows, solver)) == 2 and np.isfinite(errors(rows, solver)).all()


def test_pictured_scenes_are_at_three_values_in_ascending_order(controls: MaterialControls) -> None:
    learned = simulator(controls.root, "affine")
    trajectory = next(iter_trajectories(controls.root, UNSEEN))
    start = start_of(learned, 2, trajectory, truth := trajectory.frames(2))
    (prediction,) = rollout_loop.rollouts(learned, [start])
    scenes = controls.at_three_values(learned, start, 0, truth, prediction)
    assert [caption.split("\n")[-1] for caption, *_ in scenes] == ["20°", "21° (unseen)", "42.5°"]
    assert scenes[1][1:] == (truth, prediction)
    angles = [[t.material_params[t.node_type == node_code("sand")][:, 0].tolist() for t in pair] for _, *pair in scenes]
    assert [{*solved, *predicted} for solved, predicted in angles] == [{20.0}, {21.0}, {42.5}]
    assert not np.array_equal(scenes[0][2].pos[-1], prediction.pos[-1]) and not np.array_equal(scenes[2][2].pos[-1], prediction.pos[-1])


@pytest.mark.slow
def test_controls_give_a_picture_of_three_values(controls: MaterialControls, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for other in ("write_pictures", "write_error_curve"):
        monkeypatch.setattr(split_files, other, lambda *_: None)
    evaluate(simulator(controls.root, "affine"), controls.root, replace(SETTINGS, num_pictures=1), tmp_path, controls=controls)
    assert [path.name for path in tmp_path.glob("*.png")] == ["parameters_test_unseen_00.png"]


def test_shuffled_values_are_those_of_another_scene_of_the_group(controls: MaterialControls) -> None:
    many = replace(controls, spec=replace(controls.spec, num_test_unseen=20))
    values = [scene["shuffled"]["sand"]["friction_angle"] for scene in many.values]
    own = [21.0, 26.0, 31.0, 36.0, 41.0] * 2, [15.0, 17.5, 45.0, 47.5] * 3
    for shuffled, group in ((values[::2], own[0]), (values[1::2], own[1][:10])):
        assert sorted(shuffled) == sorted(group)
        assert sum(a == b for a, b in zip(shuffled, group, strict=True)) <= 1


def unseen(controls: MaterialControls, angles: list[float], count: int) -> MaterialControls:
    """Return controls of scenes that have these interpolated friction angles in turn."""
    cfg = compose("simulate", *DATA, f"data.parameters.sand.interpolated={angles}")
    return replace(controls, spec=replace(dataset_spec(cfg), num_test_unseen=count))


def test_scenes_without_another_value_have_no_shuffled_one(
    controls: MaterialControls, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ControlRuns, "generate", lambda *_: None)
    single = unseen(controls, [31.0], 8)
    assert [[*scene] == [*CONTROLS] for scene in single.values] == [False, True] * 4
    single.prepare()
    assert "4 of 8 scenes in test_unseen of sand are not rolled out at shuffled values" in caplog.text
    starts = [Start(next(iter_trajectories(controls.root, UNSEEN)).state(0), 1, trajectory_metadata(controls.spec, UNSEEN, 0))] * 2
    found = single.predictions(ConstantVelocity(0.005), starts, [0, 1])
    assert [[*scene] for scene in found] == [[*CONTROLS[:-1]], [*CONTROLS]]
    assert "shuffled" not in single.predictions(ConstantVelocity(0.005), starts[:1], [0])[0]


def test_shuffled_values_are_never_a_scenes_own(controls: MaterialControls) -> None:
    few = unseen(controls, [26.0, 31.0], 6)  # two of three interpolated scenes have the same value
    own = [scene_values(few.spec, UNSEEN, k) for k in range(6)]
    assert all(scene["shuffled"] != value for scene, value in zip(few.values, own, strict=True))


def test_data_that_the_solver_does_not_reproduce_are_refused(controls: MaterialControls) -> None:
    truth = next(iter_trajectories(controls.root, UNSEEN)).frames(2)
    assert controls.solver_runs(0, truth)[SOLVER_NEAREST][1] is truth
    moved = replace(truth, pos=truth.pos + np.float32(0.01 * truth.metadata.spacing))
    other = replace(truth, metadata=replace(truth.metadata, seed=1))
    for wrong in (moved, other):
        with pytest.raises(ControlError, match="the solver does not reproduce trajectory 0 of test_unseen; generate the data again, or"):
            controls.solver_runs(0, wrong)


def test_data_without_unseen_scenes_are_refused(controls: MaterialControls) -> None:
    for spec in (replace(controls.spec, num_test_unseen=0), replace(controls.spec, num_frames=3)):
        with pytest.raises(ControlError, match="evaluation.material_controls=true: sand has . trajectories of .* frames in test_unseen"):
            replace(controls, spec=spec).prepare()


def test_a_single_trained_value_is_refused(controls: MaterialControls) -> None:
    with pytest.raises(ControlError, match=r"all trajectories \(1\) in the train split of sand have the same material parameters"):
        replace(controls, trained=replace(controls.trained, num_train=1)).prepare()


def test_values_that_the_model_was_not_trained_with_are_no_trained_values(controls: MaterialControls) -> None:
    builder = GraphBuilder(GraphConfig(history=1), trajectory_metadata(controls.trained, "train", 0))
    simulator = LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder)
    (trained,) = (values for _, values in simulator.trained_ranges())
    ends = [TrainedValues(controls.trained).end(name)["sand"]["friction_angle"] for name in (LOWEST, HIGHEST)]
    trained.copy_(torch.tensor(ends)[:, None])
    controls.check_trained(simulator)
    trained[1] += 1.0
    with pytest.raises(
        ControlError, match="the model was trained with friction_angle of sand from .* and the train split of these data has"
    ):
        controls.check_trained(simulator)
