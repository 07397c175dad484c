"""Several parameters of one material: names of columns, states, stored trajectories, standardisation, trained ranges and exported steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpe_pl.export.program import ExportedStep, describe, scene_of
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator, SceneError
from gpe_pl.models.gpe import GPE
from gpe_pl.schema import param_names, parameters_by_name
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.captions import describe as caption
from tests import scenes

RUBBER = ("youngs_modulus", "poisson_ratio")


def rubber_state(modulus: tuple[float, float] = (1e4, 1e6), ratio: tuple[float, float] = (0.1, 0.4), seed: int = 0) -> State:
    """Return a cloud of elastomer with random moduli and ratios."""
    state, rng = scenes.state(materials=("elastomer",), seed=seed), np.random.default_rng(seed)
    columns = [np.exp(rng.uniform(np.log(modulus[0]), np.log(modulus[1]), state.num_nodes)), rng.uniform(*ratio, state.num_nodes)]
    return replace(state, material_params=np.stack(columns, axis=1), param_names=RUBBER)


def simulator() -> LearnedSimulator:
    """Return a simulator with random weights, and statistics of ``rubber_state``."""
    metadata = replace(scenes.metadata(("elastomer",)), param_names=RUBBER)
    build = GraphBuilder(scenes.builder(("elastomer",)).config, metadata)
    torch.manual_seed(0)
    made = LearnedSimulator(GPE(build.spec, num_message_passing_steps=2, hidden_channels=8), build).eval()
    graph = build(rubber_state().to_torch())
    graph["elastomer"].target = torch.randn(graph["elastomer"].num_nodes, 2)
    made.fit_statistics([graph])
    return made


def test_columns_are_the_first_parameters_and_the_further_ones_that_are_stored() -> None:
    assert param_names(("snow", "sand")) == ("friction_angle", "hardening_coefficient")
    assert param_names(("sand", "elastomer", "solid"), ["poisson_ratio"]) == ("friction_angle", *RUBBER)
    assert parameters_by_name("sand", 30.0) == {"friction_angle": 30.0}
    assert parameters_by_name("sand", {"cohesion": 1.0, "friction_angle": 30.0}) == {"friction_angle": 30.0, "cohesion": 1.0}
    with pytest.raises(ValueError, match="sand has no parameter 'density'; it has friction_angle, cohesion"):
        parameters_by_name("sand", {"density": 1.0})
    with pytest.raises(ValueError, match="sand needs friction_angle"):
        parameters_by_name("sand", {"cohesion": 1.0})


@pytest.mark.parametrize(
    "names", [(), ("cohesion",), ("cohesion", "friction_angle"), ("friction_angle", "poisson_ratio"), ("friction_angle", "friction_angle")]
)
def test_other_columns_are_no_metadata(names: tuple[str, ...]) -> None:
    assert dict(replace(scenes.metadata(), param_names=("friction_angle", "cohesion")).violations()) == {}
    faults = dict(replace(scenes.metadata(), param_names=names).violations())
    assert "and possibly more, in the order ('friction_angle', 'cohesion')" in faults["param_names"]


def test_a_trajectory_with_several_parameters_is_stored(tmp_path: Path, new_trajectory: Callable[..., Trajectory]) -> None:
    metadata = {"materials": ("elastomer",), "param_names": RUBBER}
    columns = np.stack([np.full(12, 1e5, np.float32), np.linspace(0.1, 0.4, 12, dtype=np.float32)], axis=1)
    given = replace(new_trajectory(**metadata), node_type=np.full(12, 3, np.uint8), material_params=columns)
    write_shard(tmp_path / "shard-00000.h5", [given])
    stored = read_trajectory(tmp_path / "shard-00000.h5", "00000")
    np.testing.assert_array_equal(stored.material_params, columns)
    assert stored.metadata.param_names == stored.state(0).param_names == RUBBER
    assert caption(stored) == "elastomer, Young’s modulus 100 kPa, Poisson’s ratio 0.1 … 0.4"


def test_arrays_give_parameters_by_name() -> None:
    pos = np.random.default_rng(0).uniform(size=(3, 4, 2))
    made = Trajectory.from_numpy(pos, 0.1, "elastomer", {"elastomer": {"poisson_ratio": [0.1, 0.2, 0.3, 0.4], "youngs_modulus": 1e5}})
    assert made.metadata.param_names == RUBBER
    np.testing.assert_allclose(made.material_params, [[1e5, ratio] for ratio in (0.1, 0.2, 0.3, 0.4)], rtol=1e-6)
    for params, message in (
        ({"elastomer": {"poisson_ratio": 0.3}}, r"params\['elastomer'\]: elastomer needs youngs_modulus"),
        ({"elastomer": {"youngs_modulus": 1e5, "cohesion": 1.0}}, "elastomer has no parameter 'cohesion'"),
        ({"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": -0.1}}, "node 0 has poisson_ratio = -0.1, must be finite and not negative"),
    ):
        with pytest.raises(ArrayError, match=message):
            Trajectory.from_numpy(pos, 0.1, "elastomer", params)
    both = {"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": 0.3}, "solid": 1e6}
    with pytest.raises(ArrayError, match=r"params\['solid'\]: has no poisson_ratio, which another material has"):
        Trajectory.from_numpy(pos, 0.1, ["elastomer", "elastomer", "solid", "solid"], both)


def test_each_parameter_is_standardised_on_its_own_scale() -> None:
    made, state = simulator(), rubber_state()
    found = made.standardizer(made.builder(state.to_torch()))["elastomer"].material_params
    wanted = np.stack([np.log(state.material_params[:, 0].astype(np.float32)), state.material_params[:, 1].astype(np.float32)], axis=1)
    wanted = (wanted - wanted.mean(axis=0)) / wanted.std(axis=0)
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-4)


def test_a_constant_parameter_keeps_a_unit_scale() -> None:
    made = simulator()
    graph = made.builder(rubber_state(ratio=(0.3, 0.3)).to_torch())
    made.standardizer.fit([graph])
    found = made.standardizer(graph)["elastomer"].material_params
    assert torch.isfinite(found).all() and found[:, 0].std() == pytest.approx(1.0, rel=0.05)
    assert found[:, 1].abs().max() < 1e-6
    other = made.standardizer(made.builder(rubber_state(ratio=(0.4, 0.4)).to_torch()))["elastomer"].material_params
    assert other[:, 1].numpy() == pytest.approx(np.full(len(other), 0.1), abs=1e-5)


def test_every_parameter_reaches_the_prediction() -> None:
    made, state = simulator(), rubber_state().to_torch()
    first = made.step(state)
    for column in range(2):
        params = state.material_params.clone()
        params[:, column] = params[:, column].flip(0)
        assert not torch.allclose(made.step(replace(state, material_params=params)).vel, first.vel, rtol=0, atol=1e-6)


def test_values_outside_the_training_are_named_and_clamped() -> None:
    made, inside = simulator(), rubber_state()
    assert made.untrained_parameters(inside.to_torch()) == []
    (line,) = made.untrained_parameters(rubber_state(ratio=(0.45, 0.45)).to_torch())
    assert line.startswith("poisson_ratio of elastomer is 0.45, trained were 0.1")
    assert [name for name, _ in made.described_training()][:2] == ["youngs_modulus of elastomer", "poisson_ratio of elastomer"]
    far, end = (
        replace(inside, material_params=np.stack([inside.material_params[:, 0], np.full(inside.num_nodes, ratio)], axis=1)).to_torch()
        for ratio in (0.49, inside.material_params[:, 1].max())
    )
    torch.testing.assert_close(made.step(far).vel, made.step(end).vel, rtol=0, atol=1e-9)
    assert not torch.allclose(made.configured(clamps_parameters=False).step(far).vel, made.step(end).vel, rtol=0, atol=1e-6)


def test_scenes_without_a_trained_parameter_are_refused(new_trajectory: Callable[..., Trajectory]) -> None:
    made = simulator()
    scene = replace(made.builder.metadata, param_names=RUBBER[:1])
    with pytest.raises(SceneError, match=r"on elastomer with poisson_ratio; the scene has .* in 2D and elastomer; choose"):
        made.check_scene(scene)


def test_an_exported_step_takes_all_parameters() -> None:
    made, state = simulator(), rubber_state(seed=1).to_torch()
    about = describe(made)["material_params.elastomer"]
    assert (about.shape, about.unit, about.doc) == (("elastomer", 2), "Pa, 1", "youngs_modulus, poisson_ratio")
    with torch.inference_mode():
        moved, _ = ExportedStep(made)(scene_of(made, state))
    rows = made.builder(state)["elastomer"].node_id
    torch.testing.assert_close(moved["pos.elastomer"], made.step(state).pos[rows], rtol=0, atol=1e-9)
