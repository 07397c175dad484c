"""Data sets grow by scenes that were chosen, and keep those that they had."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.config.datasets import candidate_spec, dataset_spec
from gpe_pl.config.entry_point import ConfigError
from gpe_pl.data import chosen_scenes
from gpe_pl.data.chosen_scenes import CHOICES_FILE, SPEC_FILE, Choice
from gpe_pl.data.generation import discard_damaged, generate, is_complete, stored_scenes
from gpe_pl.data.ground_truth import DatasetSpec, GenerationError, generate_trajectory, initial_state, parameter_values, scene_seed
from gpe_pl.data.validate import validate
from gpe_pl.files.sealed import SealError
from gpe_pl.trajectory.store import iter_trajectories
from tests.runs import DATA, compose

CHOICE = Choice([7, 5], ["a.ckpt", "b.ckpt"], 10, 11, [2.0, 1.5], 0.5)


def spec(*overrides: str, **changes: object) -> DatasetSpec:
    return replace(dataset_spec(compose("simulate", *DATA, "data.num_test_unseen=0", *overrides)), **changes)  # type: ignore[arg-type]


def test_a_chosen_scene_is_that_of_the_pool() -> None:
    pool, own = spec("data.num_train=10"), spec(num_train=2, train_scenes=(7, 5))
    for index, number in enumerate((7, 5)):
        assert scene_seed(own, "train", index) == scene_seed(pool, "train", number)
        assert parameter_values(own, "train", index) == parameter_values(pool, "train", number)
        np.testing.assert_array_equal(initial_state(own, "train", index).pos, initial_state(pool, "train", number).pos)
    assert scene_seed(own, "val", 0) == scene_seed(pool, "val", 0)


@pytest.mark.slow
def test_a_data_set_grows_and_keeps_its_scenes(tmp_path: Path) -> None:
    folder = generate(tmp_path, spec())
    first = (folder / "train" / "shard-00000.h5").read_bytes()
    statistics = (folder / "statistics.json").read_bytes()
    grown = spec(num_train=4, train_scenes=(0, 1, 7, 5))
    assert not is_complete(tmp_path, grown)
    discard_damaged(tmp_path, grown)  # as the command does first
    generate(tmp_path, grown)
    assert is_complete(tmp_path, grown) and not validate([folder]).violations
    assert (folder / "train" / "shard-00000.h5").read_bytes() == first
    assert (folder / "statistics.json").read_bytes() != statistics
    *_, last = iter_trajectories(folder, "train")
    np.testing.assert_array_equal(last.pos, generate_trajectory(spec("data.num_train=10"), "train", 5).pos.astype(last.pos.dtype))
    assert stored_scenes(tmp_path, spec("data.num_train=10")) == [0, 1, 7, 5]


@pytest.mark.slow
@pytest.mark.parametrize(
    "other", [{"num_train": 4, "train_scenes": (0, 2, 7, 5)}, {"num_train": 4}, {"num_train": 1, "train_scenes": (0,)}]
)
def test_other_scenes_are_refused(tmp_path: Path, other: dict[str, object]) -> None:
    generate(tmp_path, spec())
    with pytest.raises(GenerationError, match="other settings: num_train is 2"):
        generate(tmp_path, spec(**other))


@pytest.mark.slow
def test_a_data_set_with_other_settings_does_not_grow(tmp_path: Path) -> None:
    generate(tmp_path, spec())
    with pytest.raises(GenerationError, match="seed is 0, now 1"):
        stored_scenes(tmp_path, spec("data.seed=1", "data.num_train=10"))
    path = tmp_path / "sand" / "tiny" / SPEC_FILE
    values = json.loads(path.read_text())
    values["sha256"] = "0" * 64
    path.write_text(json.dumps(values))
    with pytest.raises(GenerationError, match="checksum mismatch"):
        generate(tmp_path, spec(num_train=4, train_scenes=(0, 1, 7, 5)))


@pytest.mark.parametrize("scenes", [(7,), (7, 7), (7, 5, 3)])
def test_as_many_different_scenes_as_trajectories(scenes: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="num_train = 2 different numbers"):
        spec(train_scenes=scenes)


@pytest.mark.slow
def test_commands_take_the_chosen_scenes(tmp_path: Path) -> None:
    chosen_scenes.write(tmp_path / "sand" / "tiny", [Choice([0, 1], [], 0, 0, [], 0.0), CHOICE])
    folders = f"paths.data={tmp_path}"
    cfg = compose("simulate", *DATA, "data.num_train=4", folders)
    assert dataset_spec(cfg).train_scenes == (0, 1, 7, 5)
    assert (candidate_spec(cfg, 10).num_train, candidate_spec(cfg, 10).train_scenes) == (10, None)
    with pytest.raises(ConfigError, match=r"data\.num_train=2: models chose 4 training scenes .* set data\.num_train=4"):
        dataset_spec(compose("fit", *DATA, folders))


def test_a_changed_list_is_refused(tmp_path: Path) -> None:
    chosen_scenes.write(tmp_path, [CHOICE])
    assert chosen_scenes.read(tmp_path) == [CHOICE]
    path = tmp_path / CHOICES_FILE
    path.write_text(path.read_text().replace("7", "8"))
    with pytest.raises(SealError, match="checksum mismatch"):
        chosen_scenes.read(tmp_path)
