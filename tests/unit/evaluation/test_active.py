"""Models choose the scenes in which they disagree, or say why they cannot."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data import chosen_scenes
from gpe_pl.data.chosen_scenes import SPEC_FILE
from gpe_pl.data.generation import GenerationError
from gpe_pl.data.ground_truth import DatasetSpec, trajectory_metadata
from gpe_pl.data.validate import validate
from gpe_pl.errors import GpeError
from gpe_pl.evaluation import active
from gpe_pl.evaluation.active import ActiveSettings, choose, disagreement, drawn
from gpe_pl.files import sealed
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.ensemble import LearnedEnsemble
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.simulate import simulate
from gpe_pl.trajectory.store import iter_trajectories
from tests.runs import DATA, compose

FRAMES = 3


def pool(*overrides: str) -> DatasetSpec:
    return dataset_spec(compose("simulate", *DATA, "data.num_train=6", "data.num_test_unseen=0", *overrides))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return checkpoints of two untrained models of tiny scenes of sand."""
    return untrained(pool(), tmp_path_factory.mktemp("models"))


def untrained(spec: DatasetSpec, folder: Path) -> list[str]:
    builder = GraphBuilder(GraphConfig(history=2), trajectory_metadata(spec, "train", 0))
    for seed in range(2):
        torch.manual_seed(seed)
        LearnedSimulator(GPE(builder.spec, num_message_passing_steps=1, hidden_channels=4), builder).save(folder / f"{seed}.ckpt")
    return [str(folder / f"{seed}.ckpt") for seed in range(2)]


@pytest.mark.slow
def test_disagreement_is_zero_only_for_equal_models(models: list[str]) -> None:
    apart = disagreement(LearnedEnsemble.from_checkpoints(models), pool(), [0, 4], FRAMES)
    assert apart.shape == (2,) and (apart > 0).all()
    same = disagreement(LearnedEnsemble.from_checkpoints(models[:1] * 2), pool(), [0, 4], FRAMES)
    np.testing.assert_array_equal(same, 0.0)


def test_disagreement_does_not_depend_on_other_scenes(models: list[str]) -> None:
    ensemble = LearnedEnsemble.from_checkpoints(models)
    both = disagreement(ensemble, pool(), [3, 1], FRAMES)
    alone = [disagreement(ensemble, pool(), [scene], FRAMES)[0] for scene in (3, 1)]
    np.testing.assert_allclose(both, alone, rtol=1e-4)


def test_a_frame_that_a_model_cannot_predict_counts_as_the_domain(models: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(active, "MAX_SPEED_FACTOR", 1e-9)  # every rollout stops at its first frame
    spec = pool()
    apart = disagreement(LearnedEnsemble.from_checkpoints(models), spec, [0], FRAMES)
    np.testing.assert_allclose(apart, 1.0 / spec.scene.spacing)


def test_probabilities_of_a_draw() -> None:
    """The first of two has the probability 2⁴ / (1 + 2⁴)."""
    first = [drawn(np.array([1.0, 2.0]), 1, (seed,))[0] for seed in range(4000)]
    assert np.mean(first) == pytest.approx(16 / 17, abs=4 * (16 / 17 / 17 / 4000) ** 0.5)


def test_a_draw_has_no_scene_twice_and_takes_zeros_last() -> None:
    values = np.array([0.0, 1.0, 0.0, 3.0, 2.0])
    picks = drawn(values, 5, (0, 1))
    assert sorted(picks) == [0, 1, 2, 3, 4] and {*picks[:3]} == {1, 3, 4}
    np.testing.assert_array_equal(drawn(values, 3, (0, 1)), picks[:3])


@pytest.mark.slow
def test_a_choice_is_noted_and_made_once(tmp_path: Path, models: list[str]) -> None:
    folder, settings = tmp_path / "sand" / "tiny", ActiveSettings(models, horizon=0.015)
    chosen_scenes.write(folder, [chosen_scenes.Choice([0, 1], [], 0, 0, [], 0.0)])
    spec = pool().as_dict()
    (folder / SPEC_FILE).write_text(json.dumps({"spec": spec, "sha256": sealed.checksum(spec)}))
    choice = choose(tmp_path, pool(), 4, settings)
    assert choice is not None and chosen_scenes.read(folder)[1] == choice
    assert len({*choice.scenes}) == 2 and {*choice.scenes} <= {2, 3, 4, 5}
    assert (choice.num_candidates, choice.num_frames, len(choice.models)) == (6, 3, 2)
    assert choose(tmp_path, pool(), 4, settings) is None
    with pytest.raises(GenerationError, match="holds a data set with other settings: seed is 0, now 7"):
        choose(tmp_path, pool("data.seed=7"), 5, settings)
    assert len(chosen_scenes.read(folder)) == 2
    more = choose(tmp_path, pool(), 5, settings)
    assert more is not None and not {*more.scenes} & {0, 1, *choice.scenes}


def test_without_a_data_set_all_scenes_are_chosen(tmp_path: Path, models: list[str]) -> None:
    choice = choose(tmp_path, pool(), 3, ActiveSettings(models, horizon=0.015))
    assert choice is not None and len(choice.scenes) == 3 and chosen_scenes.read(tmp_path / "sand" / "tiny") == [choice]


@pytest.mark.slow
def test_what_cannot_choose(tmp_path: Path, models: list[str]) -> None:
    def refused(match: str, settings: ActiveSettings, spec: DatasetSpec, number: int = 3) -> None:
        with pytest.raises(GpeError, match=match):
            choose(tmp_path, spec, number, settings)
        assert not any(tmp_path.rglob("*.json"))

    refused("1 given; models can disagree", ActiveSettings(models[:1]), pool())
    refused("the same checkpoint", ActiveSettings(models[:1] * 2), pool())
    refused("leaves 6 candidates, to choose 7", ActiveSettings(models), pool(), 7)
    refused("trained with .* on sand", ActiveSettings(models), pool("data=snow"))
    refused("shorter than a frame", ActiveSettings(models, horizon=1e-3), pool())
    refused("no such checkpoint", ActiveSettings([models[0], "absent.ckpt"]), pool())


def test_scenes_with_openings_are_refused(models: list[str], tmp_path: Path) -> None:
    spec = dataset_spec(compose("simulate", "data=channel", "size=tiny"))
    with pytest.raises(GpeError, match="trained with .* on sand"):
        disagreement(LearnedEnsemble.from_checkpoints(models), spec, [0], FRAMES)
    with pytest.raises(SimulationError, match="cannot predict open scenes"):
        disagreement(LearnedEnsemble.from_checkpoints(untrained(spec, tmp_path)), spec, [0], FRAMES)


@pytest.mark.slow
def test_the_command_chooses_and_simulates(tmp_path: Path, models: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    def run(*overrides: str) -> str:
        simulate(compose("simulate", *DATA, "data.num_test_unseen=0", "num_workers=1", f"paths.data={tmp_path}", *overrides))
        return capsys.readouterr().out

    run()
    growing = ("data.num_train=4", f"active.models=[{','.join(models)}]", "active.num_candidates=6", "active.horizon=0.015")
    assert "chose scenes" in run(*growing)
    folder = tmp_path / "sand" / "tiny"
    assert not validate([folder]).violations and len([*iter_trajectories(folder, "train")]) == 4
    assert "nothing to choose" in run(*growing) and len(chosen_scenes.read(folder)) == 2
    run("data.num_train=4")  # as `fit` does
    with pytest.raises(ConfigError, match="data.num_train='abc'|data.num_train=abc"):
        run(*growing, "data.num_train=abc")
    with pytest.raises(ConfigError, match="choose scenes with num_parts=1"):
        run(*growing, "num_parts=2")
