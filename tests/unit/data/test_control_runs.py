"""Solver runs with other material parameters: which values they have, from where they start, and when they are computed again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.data.control_runs import HIGHEST, LOWEST, NEAREST, ControlRuns, TrainedValues, Values, scene_values, with_values
from gpe_pl.data.ground_truth import DatasetSpec, ParameterValues, generate_trajectory
from gpe_pl.rollout.baselines import Ballistic
from gpe_pl.rollout.loop import steps
from tests.open_scenes import DT, open_state
from tests.runs import DATA, compose


def spec_of(*overrides: str) -> DatasetSpec:
    return dataset_spec(compose("simulate", *DATA, "data.num_train=20", *overrides))


@pytest.fixture(scope="module")
def sand() -> DatasetSpec:
    return spec_of("data=sand", "data.num_frames=40")


def value(values: Values) -> float:
    ((number,),) = (parameters.values() for parameters in values.values())
    return number


def test_values_are_chosen_among_the_trained_ones_on_the_scale_of_the_parameter() -> None:
    parameters = {"elastomer": ParameterValues((1e4, 3e4, 9e4, 8e5, 1e6), (1e5, 5.8e5), (1e3, 2e6))}
    trained = TrainedValues(replace(spec_of("data=elastomer"), parameters=parameters))

    def own(modulus: float) -> Values:
        return {"elastomer": {"youngs_modulus": modulus}}

    assert [value(trained.nearest(own(v))) for v in (1e5, 2.5e5, 5.8e5, 1e3, 2e6)] == [
        9e4,
        9e4,
        8e5,
        1e4,
        1e6,
    ]  # 2.5e5 is nearer to 9e4 as a logarithm
    assert [value(trained.farthest(own(v))) for v in (5e4, 5.8e5)] == [1e6, 1e4]
    assert value(trained.middle) == 9e4  # the middle of the logarithms is 1e5
    assert (value(trained.end(LOWEST)), value(trained.end(HIGHEST))) == (1e4, 1e6)


@dataclass(frozen=True)
class Unchanged(TrainedValues):
    """Trained values that are a scene's own."""

    def nearest(self, own: Values) -> Values:
        return own


def test_runs_branch_off_the_ground_truth(sand: DatasetSpec, tmp_path: Path) -> None:
    truth = generate_trajectory(sand, "test_unseen", 0).frames(4)
    runs = ControlRuns(tmp_path / "sand" / "tiny", sand, Unchanged(sand), "test_unseen", 4)
    runs.generate([0])
    run = runs.read(0)
    assert run[NEAREST].pos.tobytes() == truth.pos.astype(np.float32).tobytes()  # with its own values the scene goes on as it did
    assert run[NEAREST].start_time == pytest.approx(truth.start_time)
    for name, angle in ((LOWEST, 20.0), (HIGHEST, 42.5)):
        assert (run[name].material_params == angle).all()
        assert (run[name].pos[0] == run[NEAREST].pos[0]).all()
        assert np.abs(run[name].pos[-1] - run[NEAREST].pos[-1]).max() > 0


@pytest.mark.slow
def test_only_missing_and_outdated_runs_are_computed(sand: DatasetSpec, tmp_path: Path) -> None:
    runs = ControlRuns(tmp_path / "sand" / "tiny", sand, TrainedValues(sand), "test_unseen", 2)
    reported: list[tuple[int, int]] = []
    runs.generate([0, 1], 1, lambda done, total: reported.append((done, total)))
    assert reported == [(0, 2), (1, 2), (2, 2)]
    files = sorted(runs.folder.glob("*.h5"))
    assert [f.name for f in files] == ["00000.h5", "00001.h5"]
    before = [f.read_bytes() for f in files]
    files[1].unlink()
    files[0].touch()
    marks = files[0].stat().st_mtime_ns
    runs.generate([0, 1])
    assert files[0].stat().st_mtime_ns == marks and [f.read_bytes() for f in files] == before
    lower = {"sand": ParameterValues((10.0, 42.5), (21.0,), (5.0, 47.5))}
    replace(runs, trained=TrainedValues(replace(sand, parameters=lower))).generate([0])
    assert files[0].read_bytes() != before[0] and files[1].read_bytes() == before[1]
    assert (replace(runs).read(0)[LOWEST].material_params == 10.0).all()


def test_what_enters_has_the_new_values_too() -> None:
    before = open_state()
    state = with_values(before, ("friction_angle",), {"sand": {"friction_angle": 20.0}})
    assert [opening.params for opening in before.openings] == [(30.0,), (40.0,), ()]
    *_, after = steps(Ballistic(DT), state, 10)
    assert len(set(np.asarray(after.node_id).tolist()) - set(range(before.num_nodes)))
    assert (np.asarray(after.material_params) == 20.0).all()


@pytest.mark.slow
def test_runs_of_open_scenes_are_complete(tmp_path: Path) -> None:
    channel = spec_of("data=channel", "dimension=2", "data.num_frames=15")
    runs = ControlRuns(tmp_path / "channel" / "tiny", channel, TrainedValues(channel), "test_unseen", 4)
    runs.generate([0])
    reported: list[tuple[int, int]] = []
    runs.generate([0], 1, lambda done, total: reported.append((done, total)))
    assert reported == [(1, 1)]  # nothing is missing
    for name in (LOWEST, HIGHEST):
        (own,) = np.unique(runs.read(0)[name].material_params)
        assert own == pytest.approx(value(TrainedValues(channel).end(name)))


def test_values_of_a_scene_are_named(sand: DatasetSpec) -> None:
    assert scene_values(sand, "test_unseen", 0) == {"sand": {"friction_angle": 21.0}}
