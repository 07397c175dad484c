"""Models that decode the stress per strain: it scales with the strain after the step, whatever the orientation, and scenes do not mix."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.topology import GraphError
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.testing import scenes
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.elastic_bodies import CellError, cells_at_rest
from gpe_pl.nn.strain_scale import FIRST_GUESS, StrainScale, rms_strain
from gpe_pl.rollout.loop import SimulationError
from gpe_pl.rollout.skips import Skips
from gpe_pl.trajectory.loads import Loads
from gpe_pl.trajectory.state import State

SOLID = "solid"


def strained(kind: str, strain: float) -> State:
    """A free body that is stretched along the first axis by ``strain`` and then turned."""
    state = scenes.mesh_state(kind, (SOLID,), num_bodies=1, walls=False).to_torch()
    rest, dim = state.rest_pos, state.dim
    assert rest is not None
    stretch = torch.eye(dim, dtype=torch.float64)
    stretch[0, 0] += strain
    turn = torch.eye(dim, dtype=torch.float64)
    turn[:2, :2] = torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=torch.float64)
    return replace(state, pos=(rest - rest.mean(dim=0)) @ stretch @ turn.T + state.pos.mean(dim=0), vel=torch.zeros_like(state.vel))


def simulator(dim: int, unit: str = "strain", **settings: Any) -> LearnedSimulator:
    """A simulator with random weights that leaves velocities as they are."""
    build = scenes.builder((SOLID,), dim, mesh=True, cells=True)
    torch.manual_seed(0)
    model = GPE(build.spec, hidden_channels=8, num_message_passing_steps=1, stress=True, stress_unit=unit, **settings)  # type: ignore[arg-type]
    with torch.no_grad():
        for p in model.node_decoder.parameters():
            p.zero_()
    made = LearnedSimulator(model, build).eval()
    made.stress_std.fill_(2e4)
    made.set_units_of(model)
    return made


@pytest.mark.parametrize("kind", ["triangles", "lattice", "tetrahedra"])
@pytest.mark.parametrize("strain", [0.0, 1e-3, -0.1])
def test_the_strain_of_a_uniform_stretch_is_found_in_any_orientation(kind: str, strain: float) -> None:
    state, build = strained(kind, strain), scenes.builder((SOLID,), 3 if kind == "tetrahedra" else 2, mesh=True, cells=True)
    store = build(state)[SOLID]
    cells = cells_at_rest(SOLID, store.cell_index, store.rest_pos, store.mass, None)
    assert len(cells.nodes) > 3
    np.testing.assert_allclose(rms_strain(store.body_pos.double(), cells).numpy(), [abs(strain + strain**2 / 2)], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
@pytest.mark.parametrize("decoder", ["node", "contact"])
def test_the_stress_is_what_the_network_decodes_times_the_strain_after_the_step(kind: str, decoder: str) -> None:
    dim, state = 3 if kind == "tetrahedra" else 2, strained(kind, 0.01)
    grows = replace(state, vel=(state.pos - state.pos.mean(dim=0)) * 2.0)  # the strain changes in the step
    gpe, plain = simulator(dim, decoder=decoder), simulator(dim, "data", decoder=decoder)
    plain.load_state_dict({k: v for k, v in gpe.state_dict().items() if ".strain_scale." not in k})
    after, without = gpe.step(grows), plain.step(grows)
    torch.testing.assert_close(after.pos, without.pos)
    store = gpe.builder(replace(grows, pos=after.pos))[SOLID]
    factor = rms_strain(store.body_pos.double(), cells_at_rest(SOLID, store.cell_index, store.rest_pos, store.mass, None)) / FIRST_GUESS
    assert after.stress is not None and without.stress is not None
    assert 0.3 < float(factor) < 30 and abs(float(factor) - 1) > 0.05
    torch.testing.assert_close(
        after.stress.node, without.stress.node * factor.float(), rtol=1e-3, atol=1e-3 * float(without.stress.node.abs().max())
    )


def test_a_body_at_rest_has_no_stress() -> None:
    after = simulator(2).step(replace(strained("triangles", 0.0), gravity=torch.zeros(2, dtype=torch.float64)))
    assert after.stress is not None and float(after.stress.node.abs().max()) < 1.0


def test_scenes_together_have_the_stress_of_scenes_alone() -> None:
    gpe, states = simulator(2), [strained("triangles", 0.01), strained("triangles", 0.05)]
    for state, together in zip(states, gpe.step_all(states), strict=True):
        alone = gpe.step(state)
        assert not isinstance(together, SimulationError) and together.stress is not None and alone.stress is not None
        torch.testing.assert_close(together.stress.node, alone.stress.node, rtol=1e-4, atol=1.0)


def test_the_compiled_network_has_the_same_stress() -> None:
    gpe, state = simulator(2), strained("triangles", 0.02)
    with torch.inference_mode():
        assert gpe.model._compiled(gpe.standardizer(gpe.builder(state)), True) is not None  # type: ignore[operator]
        fast = gpe.step(state).stress
    with torch.enable_grad():
        plain = gpe.model(gpe.standardizer(gpe.builder(state))).stress[SOLID]
    assert fast is not None
    torch.testing.assert_close(fast.node, (plain * gpe.stress_std).to(fast.node.dtype), rtol=1e-4, atol=1.0)


def test_nodes_whose_motion_is_given_count_where_this_frame_takes_them() -> None:
    build = scenes.builder((SOLID,), mesh=True, cells=True)
    build = GraphBuilder(build.config, replace(build.metadata, loads=("motion", "sliding")))
    state = replace(strained("triangles", 0.0), gravity=torch.zeros(2, dtype=torch.float64))
    after = state.pos.numpy().copy()
    after[:, 0] = after[:, 0].mean() + 1.05 * (after[:, 0] - after[:, 0].mean())
    held = np.zeros(after.shape, bool)
    held[:, 0] = True  # the other axis stays free, where nothing moves the nodes
    path = np.stack([state.pos.numpy(), after, after])
    first = replace(state, velocity_history=None, loads=Loads(held, path))
    torch.manual_seed(0)
    model = GPE(build.spec, hidden_channels=8, num_message_passing_steps=1, stress=True, stress_unit="strain")
    scale = model.strain_scale
    assert isinstance(scale, StrainScale)
    second = first.later(build.metadata.frame_dt, torch.from_numpy(after), torch.from_numpy((after - path[0]) / build.metadata.frame_dt))
    for now in (first, second):  # in the second frame, the nodes stay where they are
        graph = build(now)
        store = graph[SOLID]
        still = {SOLID: torch.zeros(len(after), 2)}
        cells = cells_at_rest(SOLID, store.cell_index, store.rest_pos, store.mass, None)
        factor = scale(graph, still, {SOLID: torch.ones(len(after), 4)})[SOLID]
        way = torch.from_numpy(after) - now.pos
        expected = rms_strain(store.body_pos.double() + way, cells) / FIRST_GUESS
        assert float(expected) > 0.5
        torch.testing.assert_close(factor, expected.float().expand(factor.shape), rtol=1e-4, atol=1e-5)


def test_what_it_learns_is_the_stress_per_strain_and_no_positions() -> None:
    gpe = simulator(2).train()
    gpe(gpe.builder(strained("triangles", 0.01))).stress[SOLID].square().mean().backward()
    slope = gpe.model.strain_scale.typical[SOLID].grad  # type: ignore[union-attr, index]
    assert slope is not None and slope < 0  # a larger typical strain means a smaller stress
    assert not any(p.grad is not None and p.grad.any() for p in gpe.model.node_decoder.parameters())  # type: ignore[union-attr]


def test_a_checkpoint_keeps_its_unit(tmp_path: Any) -> None:
    gpe, state = simulator(2), strained("triangles", 0.02)
    gpe.save(tmp_path / "gpe.ckpt")
    stress, again = gpe.step(state).stress, LearnedSimulator.from_checkpoint(tmp_path / "gpe.ckpt").step(state).stress
    assert stress is not None and again is not None
    torch.testing.assert_close(again.node, stress.node)


def test_sleeping_is_refused_unless_the_stress_is_left_out() -> None:
    """The strain of the awake bodies is another one than that of the whole scene."""
    made = simulator(2)
    with pytest.raises(GraphError, match="sleep_after: models with model.stress_unit=strain"):
        approximate(made.configured(skips=Skips(sleep_after=3)))
    runner = approximate(made.configured(skips=Skips(sleep_after=3, stress=True)))
    assert runner.step(strained("triangles", 0.02)).stress is None


def test_what_it_needs_is_named() -> None:
    with_cells, without = (scenes.builder((SOLID,), mesh=True, cells=cells).spec for cells in (True, False))
    for spec, wrong in ((with_cells, {"stress": False}), (with_cells, {"stress": True, "elastic": True}), (without, {"stress": True})):
        with pytest.raises(CellError, match=r"model.stress_unit=strain needs model.stress=true model.elastic=false graph.cells=true"):
            GPE(spec, stress_unit="strain", hidden_channels=8, num_message_passing_steps=1, **wrong)  # type: ignore[arg-type]
