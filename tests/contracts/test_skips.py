"""Exact levels of skipping, on and off: the same graph bit for bit, the same motion up to rounding, and less work."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.momentum_conv import MomentumConv
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import node_code
from gpe_pl.trajectory.boundary import search_tree
from gpe_pl.trajectory.state import State
from tests import scenes

NOTHING = Skips(absent_types=False, static_boundary=False, isolated_nodes=False, edges_at_once=None, sorted_from=None)
LEVELS: dict[str, Any] = {"absent_types": True, "static_boundary": True, "isolated_nodes": True, "edges_at_once": 7, "sorted_from": 50}
THREE = ("sand", "snow", "fluid")


def one_level(level: str) -> Skips:
    return replace(NOTHING, **{level: LEVELS[level]})


def scattered(materials: tuple[str, ...], present: tuple[str, ...], history: int = 2, seed: int = 0) -> State:
    """Return nodes of some of the data set's materials in a box; a quarter of them is far from everything."""
    s = scenes.state(90, materials, history=history, seed=seed)
    s = scenes.permuted(s, np.flatnonzero(np.isin(s.node_type, [node_code(m) for m in present])))
    pos = s.pos.copy()
    alone = np.arange(0, len(pos), 4)  # not a multiple of the number of materials
    pos[alone] = 10.0 + 3.0 * np.stack(np.unravel_index(np.arange(len(alone)), (10, 10)), axis=-1)
    return replace(s, pos=pos)


def simulator(build: GraphBuilder, **settings: Any) -> LearnedSimulator:
    torch.manual_seed(0)
    return LearnedSimulator(GPE(build.spec, **{"num_message_passing_steps": 3, "hidden_channels": 8, **settings}), build).eval()


def roll(simulated: LearnedSimulator, state: State, skips: Skips, steps: int = 3) -> State:
    simulated.skips = skips
    for _ in range(steps):
        state = simulated.step(state)
    return state


@contextmanager
def calls(module: nn.Module) -> Iterator[dict[str, list[int]]]:
    """Count the rows of the first argument of every call of every submodule, by name."""
    seen: dict[str, list[int]] = {}
    hooks = [
        m.register_forward_pre_hook(lambda _, inputs, name=name: seen.setdefault(name, []).append(len(inputs[0])))
        for name, m in module.named_modules()
        if not isinstance(m, (nn.ModuleDict, nn.ModuleList, LearnedSimulator, GPE))
    ]
    yield seen
    for hook in hooks:
        hook.remove()


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("present", [("sand",), ("snow", "fluid"), THREE])
@pytest.mark.parametrize("islands", [True, False])
def test_no_level_changes_a_graph(level: str, present: tuple[str, ...], islands: bool) -> None:
    build = scenes.builder(THREE, history=2, islands=islands)
    s = scattered(THREE, present).to_torch()
    off, on = (replace(build, skips=skips)(s) for skips in (NOTHING, one_level(level)))
    assert off["sand", "radius", "sand"].edge_index.shape[1] > 20 or "sand" not in present
    scenes.assert_equal_graphs(on, off)


@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
@pytest.mark.parametrize("level", LEVELS)
def test_no_level_changes_a_mesh(level: str, kind: str) -> None:
    build = scenes.builder(("sand", "elastomer"), 3 if kind == "tetrahedra" else 2, mesh=True)
    s = scenes.mesh_state(kind, ("sand", "elastomer")).to_torch()
    scenes.assert_equal_graphs(*(replace(build, skips=skips)(s) for skips in (one_level(level), NOTHING)))


@pytest.mark.slow
@pytest.mark.parametrize("decoder", ["node", "pair"])
@pytest.mark.parametrize("edge_state", ["latent", "geometry"])
@pytest.mark.parametrize("interaction", ["directed", "negated", "odd", "odd_even"])
def test_no_level_changes_what_a_model_says(interaction: Any, edge_state: Any, decoder: Any) -> None:
    build = scenes.builder(THREE, history=2)
    data = scenes.to_dtype(build(scattered(THREE, ("sand", "fluid")).to_torch()), torch.float64)
    model: Any = simulator(
        build, interaction=interaction, decoder=decoder, edge_state=edge_state, node_norm="layer", island_momentum="linear"
    ).model.double()
    predicted = []
    for skips in (NOTHING, *map(one_level, LEVELS), Skips(edges_at_once=7, sorted_from=1)):
        model.skips = skips
        with torch.inference_mode():
            predicted.append(model(data).acceleration)
    for other, material in itertools.product(predicted[1:], ("sand", "fluid")):
        torch.testing.assert_close(other[material], predicted[0][material], rtol=1e-11, atol=1e-13)
    assert predicted[0]["sand"].abs().max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("implementation", ["factored", "plain"])
def test_no_level_changes_a_rollout(level: str, implementation: Any) -> None:
    build = scenes.builder(THREE, history=2)
    simulated, start = (
        simulator(build, implementation=implementation, island_momentum="angular"),
        scattered(THREE, ("sand", "snow")).to_torch(),
    )
    off, on = (roll(simulated, start, skips) for skips in (NOTHING, one_level(level)))
    torch.testing.assert_close(on.pos, off.pos, rtol=0, atol=1e-6 * scenes.SPACING)
    assert (off.pos - start.pos).abs().max() > 1e-3 * scenes.SPACING


@pytest.mark.slow
@pytest.mark.parametrize("level_weights", ["shared", "separate"])
def test_no_level_changes_the_motion_of_meshes_and_loose_nodes(level_weights: Any) -> None:
    build = scenes.builder(("sand", "elastomer"), mesh=True, islands=True)
    s = scenes.mesh_state("triangles", ("sand", "elastomer"))
    pos = s.pos.copy()
    pos[np.flatnonzero(s.node_type == node_code("sand"))[:5]] += [[20.0 + k, 0.0] for k in range(5)]
    simulated = simulator(build, level_weights=level_weights, decoder="contact", island_momentum="linear")
    off, on = (roll(simulated, replace(s, pos=pos).to_torch(), skips) for skips in (NOTHING, Skips(edges_at_once=7, sorted_from=1)))
    torch.testing.assert_close(on.pos, off.pos, rtol=0, atol=1e-6 * scenes.SPACING)


def test_a_scene_without_a_material_runs_no_code_of_it() -> None:
    build = scenes.builder(THREE, history=2)
    simulated, start = simulator(build), scattered(THREE, ("snow",)).to_torch()
    for skips, expected in ((Skips(), set()), (NOTHING, {"sand", "fluid"})):
        with calls(simulated) as seen:
            roll(simulated, start, skips, 1)
        assert {m for m in THREE if any(m in name for name in seen)} == expected | {"snow"}


def test_nodes_in_free_fall_cost_no_message_passing() -> None:
    build = scenes.builder(("sand",), history=2)
    s = scattered(("sand",), ("sand",))
    pos = np.stack(np.unravel_index(np.arange(s.num_nodes), (10, 10)), axis=-1) + 10.0
    start = replace(s, pos=pos).to_torch()
    for decoder, num_decoded in (("node", s.num_nodes), ("pair", 0)):
        simulated = simulator(build, decoder=decoder)
        with calls(simulated.model) as seen:
            after = roll(simulated, start, Skips(), 1)
        kinds = {name: type(m) for name, m in simulated.model.named_modules()}
        assert not [name for name in seen if issubclass(kinds[name], MomentumConv)]
        assert all(rows == [1] for name, rows in seen.items() if name.startswith("updates"))
        assert sum(seen.get("node_encoder.sand", [])) == num_decoded
        with calls(simulated.model) as seen:
            expected = roll(simulated, start, NOTHING, 1)
        assert [seen[f"updates.{step}.sand"] for step in range(3)] == [[s.num_nodes]] * 3
        torch.testing.assert_close(after.pos, expected.pos, rtol=0, atol=1e-7 * scenes.SPACING)


@pytest.mark.parametrize("static", [True, False])
def test_the_boundary_is_sorted_once(static: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    build = scenes.builder(("sand",), history=2)
    simulated, start = simulator(build), scattered(("sand",), ("sand",)).to_torch()
    sizes: list[int] = []

    def counted(pos: Any, *others: Any) -> Any:
        sizes.append(len(pos))
        return search_tree(pos, *others)

    for module in ("trajectory.boundary", "graphs.neighbors"):
        monkeypatch.setattr(f"gpe_pl.{module}.search_tree", counted)
    roll(simulated, start, replace(NOTHING, static_boundary=static), 4)
    assert sizes.count(len(start.boundary.pos)) == (1 if static else 4)


def test_stress_that_nobody_reads_is_not_computed_and_the_motion_stays() -> None:
    build = scenes.builder(("solid",), mesh=True)
    simulated, start = simulator(build, stress=True), scenes.mesh_state("triangles", ("solid",)).to_torch()
    with_stress, without = (roll(simulated, start, Skips(stress=stress)) for stress in (False, True))
    assert with_stress.stress is not None and without.stress is None
    assert torch.equal(with_stress.pos, without.pos)


def test_skips_are_no_part_of_training_or_of_a_checkpoint() -> None:
    build = scenes.builder(THREE, history=2)
    simulated = simulator(build)
    before = simulated.description()
    simulated.skips = NOTHING
    assert simulated.description() == before
    model: Any = simulated.model.train()
    data = scenes.to_dtype(build(scattered(THREE, ("sand",)).to_torch()), torch.float32)
    with calls(model) as seen:
        model.skips = Skips()
        model(data)
    assert seen["updates.0.sand"] == [data["sand"].num_nodes]
