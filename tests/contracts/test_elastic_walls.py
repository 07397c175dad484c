"""Walls of elastic bodies: where they stop nodes, their elastic layer, sharp obstacles, and derivatives."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import cast

import numpy as np
import pytest
import torch
from torch import Tensor

from gpe_pl.export.program import EVERYTHING
from gpe_pl.geometry.relief import reliefs
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.graphs.contacts import corners_near_edges, oriented_edges
from gpe_pl.learned.differentiable import Differentiable
from gpe_pl.learned.start_checks import DerivativeError
from gpe_pl.models.gpe import GPE
from gpe_pl.nn.elastic_bodies import THINNEST
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from tests import scenes
from tests.elastic import ACCELERATION, DT, DoubleBuilder, beside_an_obstacle, bodies, simulator


@pytest.mark.parametrize(("wall_distance", "way"), [(0.0, -0.5), (1.0, -0.2), (2.0, 0.0)])
def test_nodes_stop_at_the_distance_of_walls(wall_distance: float, way: float) -> None:
    simulated, state = simulator(network=0.0, wall_distance=wall_distance), bodies(kind="lattice", walls=False)
    assert state.rest_pos is not None
    vel = torch.tensor([0.0, -0.5 * scenes.SPACING / DT], dtype=torch.float64).expand_as(state.pos)
    start = replace(state, pos=state.rest_pos, vel=vel, velocity_history=vel[:, None], frame_velocity=vel, gravity=0 * state.gravity)
    graph = simulated.builder(start)
    graph["elastomer"].wall = torch.tensor([0.0, 1.0, 1.2 * scenes.SPACING, 0.0]).expand(len(state.pos), 4)
    change = simulated(graph).acceleration["elastomer"][:, 1] * ACCELERATION * DT**2  # of the way over a frame
    torch.testing.assert_close(change / scenes.SPACING, torch.full_like(change, way + 0.5), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("friction", "expected"), [(0.2, 0.2 / (1 + 0.2 / 0.7)), (1e6, 0.7)])
@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_the_layer_of_a_wall_limits_its_friction(friction: float, expected: float, plain: bool) -> None:
    """The layer slows the fall of a block that slides over a wall, and friction takes that fraction of this impulse from the sliding."""
    simulated, state = simulator(network=0.0, wall_layer=2.0), bodies(kind="lattice", walls=False)
    assert state.rest_pos is not None
    vel = torch.tensor([3.0, -0.1], dtype=torch.float64).expand_as(state.pos) * scenes.SPACING / DT
    start = replace(state, pos=state.rest_pos, vel=vel, velocity_history=vel[:, None], frame_velocity=vel, gravity=0 * state.gravity)
    graph = simulated.builder(start)
    graph["elastomer"].wall = torch.tensor([0.0, 1.0, 1.0 * scenes.SPACING, friction]).expand(len(state.pos), 4)
    with torch.no_grad(), unfused() if plain else nullcontext():
        change = simulated(graph).frame_velocity["elastomer"] - vel * DT
    sideways, upwards = (graph["elastomer"].mass.double()[:, None] * change).sum(dim=0).tolist()
    assert upwards > 0.1 * scenes.SPACING
    assert -sideways / upwards == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_the_layer_pushes_less_where_a_wall_is_sharp(plain: bool) -> None:
    simulated, state = simulator(network=0.0, wall_layer=2.0), bodies(kind="lattice", walls=False)
    assert state.rest_pos is not None
    still = torch.zeros_like(state.pos)
    start = replace(state, pos=state.rest_pos, vel=still, velocity_history=still[:, None], frame_velocity=still, gravity=0 * state.gravity)
    graph = simulated.builder(start)
    graph["elastomer"].wall = torch.tensor([0.0, 1.0, 1.0 * scenes.SPACING, 0.0]).expand(len(state.pos), 4)
    pushed = []
    for relief in (0.0, 0.5, 1.5):
        graph["elastomer"].relief = torch.full((len(state.pos),), relief * scenes.SPACING)
        with torch.no_grad(), unfused() if plain else nullcontext():
            pushed.append(float(simulated(graph).frame_velocity["elastomer"][:, 1].mean()))
    assert pushed[0] > 2.0 * pushed[1] > 0.0 and pushed[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
@pytest.mark.parametrize(("has_shapes", "gap"), [(True, 0.5), (False, 0.5), (True, 0.0), (True, -1e-4)])
def test_the_layer_does_not_push_an_undeformed_body_that_starts_in_it(has_shapes: bool, gap: float, plain: bool) -> None:
    simulated, state = simulator(network=0.0, wall_layer=2.0), scenes.mesh_state("lattice", ("elastomer",), seed=0)
    assert state.rest_pos is not None
    floor = float(state.rest_pos[:, 1].min()) - gap * scenes.SPACING
    walls = Boundary.sample(domain_walls(((-1.0, 2.0), (floor, floor + 3.0)), 0.3), scenes.SPACING, 2)
    still = np.zeros_like(state.pos)
    boundary = walls if has_shapes else replace(walls, shapes=())
    start = replace(
        state,
        pos=state.rest_pos,
        vel=still,
        velocity_history=still[:, None],
        frame_velocity=still,
        gravity=0 * state.gravity,
        boundary=boundary,
    )
    with torch.no_grad(), unfused() if plain else nullcontext():
        way = float((simulated.step(start.to_torch()).pos - torch.from_numpy(state.rest_pos)).abs().max()) / scenes.SPACING
        assert way < (1e-6 if gap > 0 else THINNEST)
        lower = replace(start, pos=state.rest_pos - [0.0, 0.3 * scenes.SPACING]).to_torch()
        assert float(simulated.step(lower).vel[:, 1].max()) > 0.0, "nearer than at rest, it is pushed"
        graph, deeper = (
            simulated.builder(start.to_torch()),
            Boundary.sample(domain_walls(((-1.0, 2.0), (floor - 1.0, 2.0)), 0.3), scenes.SPACING, 2),
        )
        assert float(graph["elastomer"].rest_gap.min()) == pytest.approx(max(gap, 0.0) * scenes.SPACING, abs=1e-9)
        other = simulated.builder(replace(start, boundary=deeper if has_shapes else replace(deeper, shapes=())).to_torch())
        assert float(other["elastomer"].rest_gap.min()) > 0.9, "of the new walls"


def test_a_shape_at_rest_that_reaches_into_a_wall_says_nothing() -> None:
    simulated, state = simulator(network=0.0, wall_layer=2.0), scenes.mesh_state("lattice", ("elastomer",), seed=0)
    assert state.rest_pos is not None
    middle = float(np.median(state.rest_pos[:, 1])) + 0.25 * scenes.SPACING
    walls = Boundary.sample(domain_walls(((-1.0, 2.0), (middle, middle + 3.0)), 0.3), scenes.SPACING, 2)
    above = replace(state, pos=state.rest_pos + np.array([0.0, 1.0]), boundary=walls, velocity_history=state.vel[:, None])
    gap = simulated.builder(above.to_torch())["elastomer"].rest_gap.numpy()
    below = state.rest_pos[:, 1] < middle
    assert below.any() and np.isinf(gap[below]).all() and np.isfinite(gap[~below]).all()


def test_a_graph_has_the_relief_of_obstacles_and_none_of_domain_walls() -> None:
    """Nodes farther than 1.5 spacings have the relief of the point in front of the wall at this distance, since they may reach it within the frame."""
    simulated = simulator(("solid",), wall_layer=2.0)
    state = beside_an_obstacle(0, "triangles", 2)
    shapes, store, spacing = state.boundary.shapes, simulated.builder(state)["solid"], scenes.SPACING
    normal, distance = store.wall[:, :2].double().numpy(), store.wall[:, 2].double().numpy()
    near = normal.any(axis=1) & (np.abs(distance) < 3.0 * spacing)
    in_front = state.pos.numpy() - np.maximum(distance - 1.5 * spacing, 0.0)[:, None] * normal
    expected = np.where(near, reliefs(shapes, in_front, np.minimum(distance, 1.5 * spacing), spacing), 0.0)
    far = normal.any(axis=1) & (distance > 3.0 * spacing)
    assert ((expected > 0) & (distance > 2.0 * spacing)).any() and ((expected > 0) & (distance < 1.5 * spacing)).any()
    np.testing.assert_allclose(store.relief.numpy()[~far], expected[~far], rtol=0, atol=1e-5 * spacing)
    walls = replace(state, boundary=Boundary.sample(shapes[:-1], spacing, 2)).to_torch()
    assert not simulated.builder(walls)["solid"].relief.any()


def test_a_model_without_a_layer_of_walls_skips_the_relief(monkeypatch: pytest.MonkeyPatch) -> None:
    state, (thick, thin) = beside_an_obstacle(0, "triangles", 2), (simulator(("solid",), wall_layer=thickness) for thickness in (2.0, 0.0))
    assert thick.builder(state)["solid"].relief.any()
    with torch.no_grad():
        expected = thin.next_states([state])[0]
        computed = thin(replace(thin.builder, reads_relief=True)(state)).frame_velocity["solid"]

    def refuse(*_: object) -> None:
        raise AssertionError("the relief was computed")

    monkeypatch.setattr("gpe_pl.graphs.elastic_cells.reliefs", refuse)
    assert not thin.builder(state)["solid"].relief.any()
    with torch.no_grad():
        torch.testing.assert_close(thin(thin.builder(state)).frame_velocity["solid"], computed, rtol=0, atol=0)
        found = thin.next_states([state])[0]
    assert not thin.configured(skips=EVERYTHING).builder.reads_relief and not thin.builder.at(2.0 * scenes.SPACING, DT).reads_relief
    assert torch.equal(cast(State, found).pos, cast(State, expected).pos)
    with pytest.raises(AssertionError, match="the relief was computed"):
        thick.builder(state)


def test_the_way_to_a_corner_has_the_derivative_of_the_position() -> None:
    state = beside_an_obstacle(0, "triangles", 1)
    assert state.rest_pos is not None and state.cells is not None
    pos, edges = state.pos.clone().requires_grad_(), oriented_edges(state.rest_pos, state.cells)
    ends, corner = corners_near_edges(pos, edges, state.boundary, scenes.SPACING, 3.0 * scenes.SPACING)
    assert len(corner)
    (grad,) = torch.autograd.grad(corner[:, :2].sum(), pos)
    torch.testing.assert_close(grad, -torch.bincount(ends[:, 0], minlength=len(pos)).double()[:, None].expand_as(grad))


@pytest.mark.parametrize("name", ["pos", "normal", "friction"])
def test_gradients_of_walls_are_refused_because_shapes_have_none(name: str) -> None:
    simulated, state = Differentiable(simulator(("solid",))), beside_an_obstacle(0, "triangles", 1)
    sought = {name: getattr(state.boundary, name).clone().requires_grad_()}
    without = replace(state.boundary, shapes=())  # its corners are no less constant
    for boundary in (state.boundary, without):
        seeking = replace(state, boundary=replace(boundary, **sought))
        with pytest.raises(
            DerivativeError, match=f"boundary {name}: models with model.elastic=true have no gradients with respect to walls"
        ):
            simulated.step(seeking)
        with torch.no_grad():
            simulated.step(seeking)
    flat = Boundary.sample(domain_walls(((-1.0, 2.0),) * 2, 0.3), scenes.SPACING, 2)
    flat = replace(state, boundary=replace(flat, shapes=())).to_torch().boundary
    flat = replace(flat, pos=flat.pos.clone().requires_grad_())
    simulated.step(replace(state, boundary=flat))  # the planes of boundary nodes move with these


@pytest.mark.parametrize("num_bodies", [1, 2])
def test_derivatives_pass_from_walls_and_other_bodies_to_positions(num_bodies: int) -> None:
    """Gradients of unrolls need them. The planes of walls count as constant, which is exact in front of flat walls."""
    simulated = simulator(("solid",), wall_layer=2.0, body_layer=3.0)
    build, model = DoubleBuilder(simulated.builder.config, simulated.builder.metadata), cast(GPE, simulated.model).double()
    state = scenes.mesh_state("lattice", ("solid",), seed=0, num_bodies=num_bodies)
    assert state.rest_pos is not None
    noise, weight, way = np.random.default_rng(0).normal(size=(3, *state.pos.shape))
    pos, low = state.rest_pos + 0.02 * scenes.SPACING * noise, float(state.rest_pos[:, 0].min()) - 0.5 * scenes.SPACING
    boundary = Boundary.sample(domain_walls(((low, low + 3.0), (-1.0, 2.0)), 0.3), scenes.SPACING, 2)
    state = replace(state, pos=pos, boundary=boundary, velocity_history=state.vel[:, None]).to_torch()

    def total(pos: Tensor) -> Tensor:
        graph = build(replace(state, pos=pos))
        store = graph["solid"]
        assert (store.wall[:, 2] < 1.5 * scenes.SPACING).any() and (len(store.touch) > 0) == (num_bodies > 1)
        params, mass = {"solid": 0.0 * store.material_params.double()}, {"solid": torch.ones(len(pos), dtype=torch.float64)}
        moved = model.elastic_bodies(graph, {"solid": torch.zeros_like(pos)}, params, mass, False)
        return (torch.from_numpy(weight) * moved.acceleration["solid"]).sum()

    start, step = state.pos.clone().requires_grad_(), 1e-6 * scenes.SPACING * torch.from_numpy(way)
    total(start).backward()  # type: ignore[no-untyped-call]
    assert start.grad is not None
    with torch.no_grad():
        expected = (total(state.pos + step) - total(state.pos - step)) / 2.0
    assert float((start.grad * step).sum()) == pytest.approx(float(expected), rel=1e-6)
