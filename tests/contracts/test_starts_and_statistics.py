"""Statistics that a training lacks, and simulators that start from others."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl import Scene, roll_out
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.simulator import CheckpointError, LearnedSimulator
from gpe_pl.schema import param_names
from gpe_pl.trajectory.state import State
from tests import scenes
from tests.contracts.test_learned_simulator import learned


def alone(build: GraphBuilder, materials: tuple[str, ...], seed: int = 0) -> tuple[State, HeteroData]:
    """Return a state with some of the builder's materials, and its graph with targets."""
    state = scenes.state(40, materials, seed=seed).to_torch()
    columns = [param_names(build.metadata.materials).index(name) for name in param_names(materials)]
    params = state.material_params.new_full((state.num_nodes, len(param_names(build.metadata.materials))), torch.nan)
    params[:, columns] = state.material_params
    state = replace(state, material_params=params)
    graph = build(state)
    for material in build.spec.materials:
        graph[material].target = torch.ones(graph[material].num_nodes, 2)
    return state, graph


@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_targets_that_teach_nothing_are_refused(value: float) -> None:
    build = scenes.builder(history=1)
    graph = build(scenes.state().to_torch())
    graph["sand"].target = torch.full((40, 2), value)
    with pytest.raises(ValueError, match="nothing to learn from"):
        learned(build).fit_statistics([graph])


def test_what_the_statistics_lack_is_named_once_and_never_silently_unscaled(caplog: pytest.LogCaptureFixture) -> None:
    build = scenes.builder(("sand", "snow"), history=1)
    simulator = learned(build).eval()
    state, _ = alone(build, ("sand", "snow"))
    simulator.step(state)
    assert not caplog.records  # it has no statistics at all
    simulator.fit_statistics([alone(build, ("sand",))[1]])
    assert "that statistics are taken from: snow; its features are not standardised" in caplog.text
    caplog.clear()
    simulator.step(alone(build, ("sand",), seed=1)[0])
    assert not caplog.records
    for _ in range(2):
        simulator.step(state)
    expected = {f"outside the training data: {kind} has no statistics; its features are not standardised" for kind in (
        "snow", "snow–radius–snow", "sand–radius–snow", "boundary–radius–snow"
    )}  # fmt: skip
    assert sorted(r.getMessage() for r in caplog.records) == sorted(expected)


# --- training that begins with another simulator's weights --------------------------------------------------------------------------------


def fitted(seed: int, history: int = 2, **settings: Any) -> LearnedSimulator:
    """Return a simulator with fitted statistics and parameter ranges."""
    build = scenes.builder(("sand", "snow"), history=history)
    simulator = learned(build, seed, **settings)
    graph = build(scenes.state(40, ("sand", "snow"), history=history, seed=seed).to_torch())
    for material in ("sand", "snow"):
        graph[material].target = torch.full((graph[material].num_nodes, 2), 1.0 + seed)
    simulator.fit_statistics([graph])
    return simulator


def test_a_start_keeps_its_own_statistics_of_what_the_other_training_lacked() -> None:
    build = scenes.builder(("sand", "snow"), history=1)
    trained, new = learned(build), learned(build, 1)
    trained.fit_statistics([alone(build, ("sand",))[1]])
    new.fit_statistics([alone(build, ("sand", "snow"), seed=1)[1]])
    sand, snow = (copy.deepcopy(s.standardizer.node[m].state_dict()) for s, m in ((trained, "sand"), (new, "snow")))
    low, high = (r.clone() for r in dict(new.trained_ranges())["snow"])
    new.start_from(trained)
    torch.testing.assert_close(new.standardizer.node["sand"].state_dict(), sand, rtol=0, atol=0)
    torch.testing.assert_close(new.standardizer.node["snow"].state_dict(), snow, rtol=0, atol=0)
    assert torch.equal(dict(new.trained_ranges())["snow"], torch.stack([low, high]))


def test_a_simulator_starts_from_another_ones_weights_and_statistics() -> None:
    trained, new = fitted(0), fitted(1)
    low, high = ({m: r[k].clone() for m, r in s.trained_ranges()} for s, k in ((new, 0), (new, 1)))
    state = scenes.state(40, ("sand", "snow"), history=2, seed=2).to_torch()
    graph = trained.builder(state)
    trained.clamps_parameters = new.clamps_parameters = False
    new.start_from(trained)
    for name, value in trained(graph).acceleration.items():
        assert torch.equal(new(graph).acceleration[name], value)
    assert torch.equal(new.acceleration_std, trained.acceleration_std)
    for (material, both), (_, before) in zip(new.trained_ranges(), trained.trained_ranges(), strict=True):
        assert torch.equal(both, torch.stack([torch.minimum(before[0], low[material]), torch.maximum(before[1], high[material])]))
    assert not all(torch.equal(a, b) for (_, a), (_, b) in zip(new.trained_ranges(), trained.trained_ranges(), strict=True))
    next(new.model.parameters()).data.zero_()
    assert torch.any(next(trained.model.parameters()) != 0)  # nothing is shared


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"hidden_channels": 4}, "choose model.hidden_channels=4$"),
        ({"interaction": "directed"}, "choose model.interaction=directed$"),
    ],
)
def test_another_model_is_no_start(other: dict[str, Any], message: str) -> None:
    new = fitted(1, interaction="odd")
    before = {k: v.clone() for k, v in new.state_dict().items()}
    with pytest.raises(CheckpointError, match=message):
        new.start_from(fitted(0, **{"interaction": "odd", **other}))
    assert all(torch.equal(v, before[k]) for k, v in new.state_dict().items())


def test_levels_that_share_weights_start_on_meshes_of_any_size() -> None:
    def of_domain(size: float, level_weights: str) -> LearnedSimulator:
        metadata = replace(scenes.metadata(("elastomer",)), bounds=((0.0, size), (0.0, size)))
        return learned(GraphBuilder(GraphConfig(history=1, mesh=True), metadata), level_weights=level_weights, num_message_passing_steps=6)

    small, large = of_domain(0.4, "shared"), of_domain(3.0, "shared")
    assert small.builder.spec.num_levels < large.builder.spec.num_levels
    assert not large.start_from(small).new
    small, large = of_domain(0.4, "separate"), of_domain(3.0, "separate")
    new = large.start_from(small).new
    assert f"node_encoder.grid_{small.builder.spec.num_levels + 1}.0.weight" in new and "node_encoder.grid_1.0.weight" not in new


def _nested(levels: int, width: int = 1) -> Any:
    """Return nested lists; with ``width`` 2 each list is referred to twice, which is small in a file but has 2^levels values when traversed."""
    value: Any = "x"
    for _ in range(levels):
        value = [value] * width
    return value


UNBOUNDED = {
    "shared": (_nested(60, 2), r"values nested more than \d+ levels deep|more than \d+ values"),
    "shared, flat": (_nested(15, 4), r"more than \d+ values"),
    "deep": (_nested(200), r"values nested more than \d+ levels deep"),
    "wide": (list(range(10**5)), "more than 20000 values"),
    "long": ("x" * 10**7, "a text of 10000000 characters"),
    "large": (2**1000, "an integer beyond 64 bits"),
    "tensor": (torch.zeros(10), "a Tensor, only text"),
}


PLACES = ("graph", "metadata", "format", "model", "static_friction")


@pytest.mark.slow
@pytest.mark.parametrize(("place", "kind"), [*(("settings", kind) for kind in UNBOUNDED), *((place, "tensor") for place in PLACES)])
def test_what_a_checkpoint_says_is_bounded_before_it_is_looked_at(checkpoint: Path, tmp_path: Path, place: str, kind: str) -> None:
    value, message = UNBOUNDED[kind]
    content = torch.load(checkpoint, weights_only=True)
    known = content["simulator"][place]
    if isinstance(known, dict):
        known[min(known)] = value
    else:
        content["simulator"][place] = value
    torch.save(content, tmp_path / "hostile.ckpt")
    with pytest.raises(CheckpointError, match=message) as caught:
        LearnedSimulator.from_checkpoint(tmp_path / "hostile.ckpt")
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("name", ["sand", "snow", "elastomer"])
def test_a_start_without_history_flies_as_far_as_free_fall(name: str) -> None:
    """Mean velocities of the frames before the start lag behind the velocity at its instant, and at rest they do not."""
    simulator = LearnedSimulator.from_checkpoint(name)
    scene = Scene(box=(1.0, 1.0)).block(name, at=(0.4, 0.6), size=(0.1, 0.1), velocity=(0.3, 0.5))
    state, metadata = scene.block(name, at=(0.1, 0.0), size=(0.1, 0.1)).state(simulator)
    start = simulator.standing(state, metadata)
    flies = state.pos[:, 1] > 0.5
    rollout = roll_out(simulator, start, 10, metadata)
    time = metadata.frame_dt * np.arange(11)[:, None]
    way = rollout.pos[:, flies].mean(axis=1) - rollout.pos[0, flies].mean(axis=0)
    np.testing.assert_allclose(way, time * [0.3, 0.5] - 0.5 * time**2 * [0.0, 9.81], atol=1e-6)
    assert start.velocity_history is not None and (start.velocity_history[~torch.from_numpy(flies)] == 0).all()
