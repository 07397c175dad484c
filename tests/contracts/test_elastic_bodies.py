"""Elastic bodies in a model: batches, symmetries, what a rollout carries along, checkpoints, and clear refusals."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch_geometric.data import Batch

from gpe_pl.benchmarks.stability.subject import in_flight
from gpe_pl.export.program import export_model
from gpe_pl.geometry.shape_values import moved as moved_shape
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.elastic_cells import attaching_cells
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.approximate import Repeating, Sleeping
from gpe_pl.learned.differentiable import Differentiable
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.nn import elastic_motion
from gpe_pl.nn.elastic_bodies import CellError, _found_once
from gpe_pl.nn.elastic_motion import MAX_SUBSTEPS, Cells
from gpe_pl.rollout.containment import contain
from gpe_pl.rollout.loop import rollout
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import TOUCH_REACH, node_code
from gpe_pl.system.compiled import unfused
from gpe_pl.training.push_forward import MOVED, _moved
from gpe_pl.trajectory.reflection import Reflection
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, write_shard
from tests import scenes
from tests.elastic import ACCELERATION, BODIES, DT, MIXED, DoubleBuilder, beside_an_obstacle, bodies, simulator


def step(simulated: LearnedSimulator, state: State) -> tuple[Tensor, Tensor]:
    """Positions after a step, and velocities at its end."""
    after = simulated.step(state)
    assert after.frame_velocity is not None
    return after.pos, after.frame_velocity


def assert_close(found: tuple[Tensor, Tensor], expected: tuple[Tensor, Tensor], atol: float = 1e-5) -> None:
    """Features have single precision, so results agree to some 1e-6 of a spacing."""
    torch.testing.assert_close(found[0], expected[0], rtol=0, atol=atol * scenes.SPACING)
    torch.testing.assert_close(found[1], expected[1], rtol=0, atol=atol * scenes.SPACING / DT)


@pytest.mark.parametrize("kind", ["triangles", "lattice", "tetrahedra"])
def test_scenes_of_a_batch_move_as_alone(kind: str) -> None:
    simulated = simulator(dim=3 if kind == "tetrahedra" else 2)
    states = [bodies(seed, kind, num_bodies=count) for seed, count in ((0, 1), (1, 2), (2, 1))]
    for state, after in zip(states, simulated.step_all(states), strict=True):
        assert isinstance(after, State) and after.frame_velocity is not None
        assert_close((after.pos, after.frame_velocity), step(simulated, state))
    assert not torch.allclose(simulated.step(states[0]).pos, states[0].pos + DT * states[0].vel, atol=1e-3 * scenes.SPACING)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangles", "lattice", "tetrahedra"])
@pytest.mark.parametrize(("is_double", "tolerance"), [(True, 1e-10), (False, 1e-5)])
@pytest.mark.parametrize(("stiffness", "wall_layer"), [(0.0, 0.3), (2.0, 0.05)])  # cells with the second stiffness are softened
def test_the_compiled_motion_equals_the_plain_one(
    kind: str, is_double: bool, tolerance: float, stiffness: float, wall_layer: float
) -> None:
    simulated = simulator(("solid",), 3 if kind == "tetrahedra" else 2, stress=True, wall_layer=wall_layer, body_layer=3.0)
    build, model = simulated.builder, cast(GPE, simulated.model)
    if is_double:
        build, model = DoubleBuilder(build.config, build.metadata), model.double()
    with torch.no_grad():
        model.get_parameter("elastic_bodies.constants.solid.logarithm.bias").add_(stiffness)
    graph = batched([build(beside_an_obstacle(seed, kind, count)) for seed, count in ((0, 1), (1, 2), (2, 1))])
    store = graph["solid"]
    assert (kind == "tetrahedra" or len(store.corner)) and len(store.touch)
    if stiffness:
        store.body_pos[3] += 5.0 * scenes.SPACING  # tears the cells at this node
    forces = {"solid": torch.randn(store.pos.shape, generator=torch.Generator().manual_seed(0)).to(build.precision)}
    inputs = graph, forces, {"solid": store.material_params.to(build.precision)}, {"solid": store.mass}, True
    with torch.no_grad():
        found = model.elastic_bodies(*inputs)
        with unfused():
            expected = model.elastic_bodies(*inputs)
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value["solid"], other["solid"], rtol=0, atol=tolerance * float(other["solid"].abs().max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "softer", "speed", "first", "tries"),
    [("triangles", 1.5, 20.0, 23, 2), ("lattice", 1.0, 20.0, 3, 2), ("tetrahedra", 1.0, 100.0, MAX_SUBSTEPS, 4)],
)
def test_the_compiled_motion_of_cells_that_are_crushed_within_a_frame_equals_the_plain_one(
    kind: str, softer: float, speed: float, first: int, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of three scenes has such cells. It is tried with ``first`` substeps, and again with the most, if need be by softer laws."""
    simulated = simulator(("solid",), 3 if kind == "tetrahedra" else 2, wall_layer=0.3, body_layer=3.0)
    build, model = DoubleBuilder(simulated.builder.config, simulated.builder.metadata), cast(GPE, simulated.model).double()
    with torch.no_grad():
        model.get_parameter("elastic_bodies.constants.solid.logarithm.bias").sub_(softer)
    graph = batched([build(beside_an_obstacle(seed, kind, count)) for seed, count in ((0, 1), (1, 2), (2, 1))])
    store, num_nodes, dim = graph["solid"], len(graph["solid"].pos), graph["solid"].pos.shape[1]
    still = {"solid": torch.zeros(num_nodes, dim, dtype=torch.float64)}
    inputs = graph, still, {"solid": store.material_params.double()}, {"solid": store.mass}, True

    def moved() -> tuple[Tensor, ...]:
        return tuple(value["solid"] for value in model.elastic_bodies(*inputs))

    number = list[Tensor]()
    unstable = elastic_motion._unstable
    with torch.no_grad():
        calm = moved()
        is_thrown = store.batch == 1
        throw = torch.randn(num_nodes, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        store.velocity[is_thrown, dim:] = speed * scenes.SPACING * throw[is_thrown]
        found = moved()
        with unfused():
            monkeypatch.setattr(elastic_motion, "_unstable", lambda *args: number.append(args[-1]) or unstable(*args))  # type: ignore[func-returns-value]
            expected = moved()
    assert [int(n[1]) for n in number] == [first] + [MAX_SUBSTEPS] * (tries - 1)
    for value, other, before in zip(found, expected, calm, strict=True):
        torch.testing.assert_close(value, other, rtol=0, atol=1e-6 * float(other.abs().max()))
        torch.testing.assert_close(value[~is_thrown], before[~is_thrown], rtol=0, atol=0)


def test_scenes_with_and_without_cells_move_as_alone() -> None:
    simulated = simulator(MIXED)
    mixed, cloud = bodies(materials=MIXED), scenes.state(12, ("sand",)).to_torch()
    cloud = replace(cloud, material_params=cloud.material_params.repeat(1, 2))
    loose = replace(mixed, cells=None, rest_pos=None)
    for order in ((0, 1, 2), (2, 1, 0), (1, 0, 2)):
        states = [(mixed, cloud, loose)[k] for k in order]
        for state, after in zip(states, simulated.step_all(states), strict=True):
            assert isinstance(after, State)
            torch.testing.assert_close(after.pos, simulated.step(state).pos, rtol=0, atol=1e-5 * scenes.SPACING)
    assert simulated.step(cloud).frame_velocity is None


def test_materials_beside_each_other_have_constants_of_their_own() -> None:
    materials = ("elastomer", "solid")
    simulated, state = simulator(materials), bodies(kind="lattice", materials=materials, gap=20.0, walls=False)
    is_solid = state.node_type == node_code("solid")
    before = step(simulated, state)[0]
    with torch.no_grad():
        simulated.model.get_parameter("elastic_bodies.constants.solid.logarithm.bias").add_(0.3)
    moved = (step(simulated, state)[0] - before).norm(dim=1)
    assert float(moved[is_solid].min()) > 0 and not bool(moved[~is_solid].any())


def test_relabelling_and_translation_change_nothing() -> None:
    simulated, state = simulator(), bodies()
    found = step(simulated, state)
    order = torch.randperm(state.num_nodes, generator=torch.Generator().manual_seed(0))
    assert_close(step(simulated, state.take(order)), (found[0][order], found[1][order]))
    offset = torch.tensor([3.0, -2.0], dtype=torch.float64)
    assert state.rest_pos is not None
    shapes = tuple(moved_shape(shape, offset.numpy()) for shape in state.boundary.shapes)
    boundary = replace(state.boundary, pos=state.boundary.pos + offset, shapes=shapes)
    there = replace(state, pos=state.pos + offset, rest_pos=state.rest_pos - 0.7 * offset, boundary=boundary)
    moved, at_end = step(simulated, there)
    assert_close((moved - offset, at_end), found)


def test_a_mirror_image_moves_as_the_mirror_image_without_a_network() -> None:
    simulated, state = simulator(network=0.0), bodies()
    mirror = Reflection.at(0, 0.4, 2)
    moved, at_end = step(simulated, mirror.state(state, mirror.boundary(state.boundary)))
    assert_close((mirror.point(moved), mirror.vector(at_end)), step(simulated, state))


def test_bodies_cross_the_seam_of_a_periodic_domain() -> None:
    simulated = simulator(periodic=(True, False))
    state = replace(bodies(), periodicity=simulated.builder.metadata.periodicity)
    found = step(simulated, state)
    offset = torch.tensor([1.0 - float(state.pos[:, 0].mean()), 0.0], dtype=torch.float64)
    boundary = replace(state.boundary, pos=state.periodicity.wrapped(state.boundary.pos + offset))
    there = replace(state, pos=state.periodicity.wrapped(state.pos + offset), boundary=boundary)
    assert float(there.pos[:, 0].min()) < 0.1 and float(there.pos[:, 0].max()) > 0.9
    moved, at_end = step(simulated, there)
    assert_close((state.periodicity.shortest(moved - found[0] - offset) + found[0], at_end), found)


@pytest.mark.parametrize("radius", [2.4, 7.0])
@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_pairs_that_may_touch_are_those_of_different_bodies_within_reach(shift: float, radius: float) -> None:
    """Moved by half a period, bodies lie across the seam of the domain, and the pairs stay the same."""
    build = scenes.builder(BODIES, 2, mesh=True, cells=True, connectivity_spacings=radius)
    build = GraphBuilder(build.config, replace(build.metadata, periodic=(True, False)))
    state, periodicity = bodies(num_bodies=2, walls=False), build.metadata.periodicity
    pos = periodicity.wrapped(state.pos + torch.tensor([shift, 0.0], dtype=torch.float64))
    store = build(replace(state, pos=pos, periodicity=periodicity))["elastomer"]
    body = torch.from_numpy(connected_components(cell_graph(state))[1])
    way = state.pos[:, None] - state.pos[None]
    apart, reach = way.norm(dim=2) / scenes.SPACING, min(TOUCH_REACH, radius)
    near = (apart < reach) & (body[:, None] != body[None])
    assert bool(((apart > reach) & (apart < max(radius, reach + 1)) & (body[:, None] != body[None])).any())
    found = store.touch_index.sort(dim=1).values
    assert len(found) and {*map(tuple, found.tolist())} == {*map(tuple, torch.nonzero(near.triu()).tolist())}
    first, second = store.touch_index.T
    torch.testing.assert_close(store.touch, way[first, second].float())


def cell_graph(state: State) -> Any:
    """Sparse graph of the nodes that cells connect."""
    assert state.cells is not None
    cells = np.asarray(state.cells)
    ends = cells.ravel(), np.roll(cells, 1, axis=1).ravel()
    return coo_matrix((np.ones(cells.size), ends), shape=(state.num_nodes, state.num_nodes))


def test_nodes_without_a_cell_are_attached_to_the_body_beside_them() -> None:
    """The corner of a block has no cell. The best triangle attaches it, in the same way for its mirror image. A node far away stays loose."""
    rest = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 0.0], [2.0, 1.0], [9.0, 9.0]])
    cells, body = np.array([[0, 1, 2], [1, 3, 2], [1, 4, 3]]), np.zeros(7, np.int64)
    found = attaching_cells(rest, cells, body, 1.8)
    assert sorted(map(sorted, found.tolist())) == [[3, 4, 5]]
    mirror = attaching_cells(rest * [-1, 1], cells, body, 1.8)
    assert found.tolist() == mirror.tolist()
    assert not len(attaching_cells(rest, cells, np.array([0, 0, 0, 0, 0, 1, 0]), 1.8))


def test_a_node_without_a_cell_stays_with_its_body() -> None:
    """A body that was stretched springs back, and its loose corner with it, alone and in a batch. Cells in graphs stay those of the mesh."""
    simulated, state = simulator(network=0.0), bodies(walls=False)
    assert state.cells is not None
    corner = int(state.pos.sum(dim=1).argmin())
    loose = replace(state, cells=state.cells[~(state.cells == corner).any(dim=1)])
    store = simulated.builder(loose)["elastomer"]
    assert set(store.attached_index[:, 0].tolist()) >= {corner} and len(store.cell_index) == len(loose.cells)  # type: ignore[arg-type]
    pulled = loose.pos.clone()
    pulled[corner] -= 0.5 * scenes.SPACING
    still = 0.0 * state.pos
    start = replace(loose, pos=pulled, vel=still, velocity_history=still[:, None], frame_velocity=still, gravity=0.0 * state.gravity)
    after = simulated.step(start)
    assert float((after.pos - pulled)[corner].min()) > 0.01 * scenes.SPACING
    for alone, other in zip((start, state), simulated.step_all([start, state]), strict=True):
        assert isinstance(other, State) and other.frame_velocity is not None
        assert_close((other.pos, other.frame_velocity), step(simulated, alone))


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_bodies_with_coincident_nodes_move_finitely(plain: bool) -> None:
    simulated, state = simulator(network=0.0, body_layer=3.0), bodies(num_bodies=2, walls=False)
    body = torch.from_numpy(connected_components(cell_graph(state))[1])
    pos = state.pos.clone()
    pos[body == 1] += pos[body == 0][0] - pos[body == 1][0]
    with unfused() if plain else nullcontext():
        assert bool(simulated.step(replace(state, pos=pos)).pos.isfinite().all())


def test_the_embedding_decides_whether_the_law_reads_the_parameter() -> None:
    state = bodies(kind="lattice")
    other = replace(state, material_params=1.5 * state.material_params)
    for embedding, reads in (("affine", True), ("none", False)):
        simulated = simulator(network=0.0, material_embedding=embedding)
        assert torch.equal(simulated.step(state).pos, simulated.step(other).pos) != reads


def test_models_in_double_precision_have_gradients() -> None:
    precise, state = simulator().double(), bodies()
    after, expected = Differentiable(precise).step(state), precise.step(state)
    assert after.pos.requires_grad and after.frame_velocity is not None and expected.frame_velocity is not None
    assert_close((after.pos.detach(), after.frame_velocity.detach()), (expected.pos, expected.frame_velocity))


def test_the_loss_reaches_the_network_and_the_constants() -> None:
    simulated, state = simulator().train(), bodies(kind="lattice")
    _found_once.cache_clear()
    simulated.step(state)  # in inference mode
    predicted = simulated(simulated.builder(state))
    predicted.acceleration["elastomer"].square().sum().backward()
    names = [name for name, p in simulated.model.named_parameters() if p.grad is not None and bool(p.grad.any())]
    assert any("node_decoder" in name for name in names) and any("node_encoder" in name for name in names)
    assert {"elastic_bodies.constants.elastomer.logarithm.weight", "elastic_bodies.constants.elastomer.logarithm.bias"} <= {*names}


def test_velocity_at_the_frame_is_carried_along() -> None:
    simulated, state = simulator(), bodies(kind="lattice")
    after = simulated.step(state)
    assert after.frame_velocity is not None
    assert not torch.allclose(after.frame_velocity, after.vel, atol=1e-3 * float(after.vel.abs().max()))
    dropped = simulated.step(replace(after, frame_velocity=None))
    assert not torch.allclose(simulated.step(after).pos, dropped.pos, atol=1e-4 * scenes.SPACING)
    mean = simulated.step(replace(after, frame_velocity=after.vel))
    assert torch.equal(mean.pos, dropped.pos)


def test_a_rollout_continues_from_a_recorded_frame(tmp_path: Path) -> None:
    """Positions of the store have single precision. Without it, only the last digit of mean velocities, which are differences of positions, is another one."""
    simulated, start = simulator(), bodies(kind="lattice")
    seen = dict[int, State]()
    whole = rollout(simulated, start, 10, simulated.builder.metadata, on_frame=seen.__setitem__)
    at_frame = seen[6].frame_velocity
    assert at_frame is not None and np.array_equal(whole.vel[6], at_frame.numpy())
    assert not np.allclose(whole.vel[6], seen[6].vel.numpy(), atol=1e-3 * np.abs(whole.vel[6]).max())
    state = simulated.initial_state(whole, 6)
    assert torch.equal(state.frame_velocity, at_frame)  # type: ignore[arg-type]
    torch.testing.assert_close(state.vel, seen[6].vel, rtol=1e-9, atol=1e-9)
    again = rollout(simulated, state, 4, simulated.builder.metadata)
    np.testing.assert_array_equal(again.vel, whole.vel[6:])
    np.testing.assert_allclose(again.pos, whole.pos[6:], rtol=0, atol=1e-12)

    write_shard(tmp_path / "rollout.h5", [whole])
    stored = simulated.initial_state(read_trajectory(tmp_path / "rollout.h5", "00000", verify=True), 6)
    again = rollout(simulated, stored, 4, simulated.builder.metadata)
    np.testing.assert_allclose(again.pos, whole.pos[6:], rtol=0, atol=1e-3 * scenes.SPACING)
    without = rollout(simulated, replace(stored, frame_velocity=None), 4, simulated.builder.metadata)
    assert np.abs(without.pos - whole.pos[6:]).max() > 3e-3 * scenes.SPACING


def test_containment_changes_the_velocity_at_the_frame() -> None:
    state = bodies()
    assert state.frame_velocity is not None
    out = replace(state, pos=state.pos - torch.tensor([0.0, float(state.pos[:, 1].min()) + 0.01]))
    contained, corrected = contain(out, DT)
    assert bool(corrected.any()) and contained.frame_velocity is not None
    change = contained.frame_velocity - state.frame_velocity
    torch.testing.assert_close(change, contained.vel - out.vel)
    assert bool(change[torch.as_tensor(corrected)].any())


def test_static_friction_stops_the_velocity_at_the_frame() -> None:
    simulated = simulator(network=0.0)
    state = bodies(num_bodies=1)
    assert state.rest_pos is not None
    rest = state.rest_pos - state.rest_pos.amin(dim=0) + torch.tensor([0.3, 0.01])
    still = torch.zeros_like(state.vel)
    state = replace(state, pos=rest, rest_pos=rest, vel=still, velocity_history=still[:, None], frame_velocity=1e-3 + still)
    simulated.static_friction = 0.9
    after = simulated.step(state)
    stays = (after.pos == state.pos).all(dim=1)
    assert bool(stays.any()) and after.frame_velocity is not None and not bool(after.frame_velocity[stays].any())


def test_sleeping_and_repeated_predictions_keep_the_velocity_at_the_frame() -> None:
    simulated, state = simulator(), bodies()
    simulated.skips = Skips(sleep_after=2)
    full = simulated.step(state)
    awake = Sleeping(simulated).step(state)
    assert full.frame_velocity is not None and awake.frame_velocity is not None
    torch.testing.assert_close(awake.frame_velocity, full.frame_velocity)
    asleep = Sleeping(simulated)._combined(
        state, full, torch.zeros(state.num_nodes, dtype=torch.bool), torch.ones(state.num_nodes, dtype=torch.bool)
    )
    assert asleep.frame_velocity is not None and not bool(asleep.frame_velocity.any())
    repeated = Repeating(simulated, DT, 2)
    first = repeated.step(state)
    second = repeated.step(first)
    assert first.frame_velocity is not None and second.frame_velocity is not None
    torch.testing.assert_close(second.frame_velocity - first.frame_velocity, second.vel - first.vel)


@pytest.mark.parametrize("swings", [True, False])
def test_sleeping_judges_by_the_velocity_at_the_frame(swings: bool) -> None:
    simulated, state = simulator(), bodies(num_bodies=1)
    simulated.skips = Skips(sleep_after=2)
    fast, still = torch.ones_like(state.vel), torch.zeros_like(state.vel)
    mean, at_frame = (still, fast) if swings else (fast, still)
    state = replace(state, vel=mean, frame_velocity=at_frame)
    everything = torch.ones(state.num_nodes, dtype=torch.bool)
    after = Sleeping(simulated)._combined(state, replace(state, velocity_history=None), everything, everything)
    assert (after.internal.count == (0 if swings else 1)).all()


def test_cells_at_rest_are_found_once_in_a_rollout(monkeypatch: pytest.MonkeyPatch) -> None:
    simulated, state, calls, found = simulator(), bodies(kind="lattice"), list[int](), Cells.of

    def counted(*arguments: Any) -> Cells:
        calls.append(1)
        return found(*arguments)

    monkeypatch.setattr(Cells, "of", counted)
    _found_once.cache_clear()
    for _ in range(3):
        state = simulated.step(state)
    assert len(calls) == 1
    assert state.rest_pos is not None and state.cells is not None
    others = [replace(state, rest_pos=1.1 * state.rest_pos), replace(state, mass=2 * state.mass), replace(state, cells=state.cells[1:])]
    for number, other in enumerate(others, start=2):
        after = step(simulated, other)
        assert len(calls) == number
        _found_once.cache_clear()
        again = step(simulated, other)
        calls.pop()
        assert all(torch.equal(a, b) for a, b in zip(after, again, strict=True))
    assert simulated.step_all([state, state])[0] is not None and len(calls) == len(others) + 2


def test_a_checkpoint_has_the_constants_and_units(tmp_path: Path) -> None:
    simulated, state = simulator(), bodies()
    simulated.save(tmp_path / "elastic.ckpt")
    again = LearnedSimulator.from_checkpoint(tmp_path / "elastic.ckpt")
    assert torch.equal(again.step(state).pos, simulated.step(state).pos)


@pytest.mark.parametrize("known", [True, False])
def test_an_unroll_continues_with_its_velocity_at_the_frame(known: bool) -> None:
    """A checkpoint of another model, or an older one, has none."""
    start = bodies()
    after = simulator().step(start)
    stored = {name: getattr(after, name) for name in MOVED}
    if not known:
        del stored["frame_velocity"]
    again = _moved(start, stored)
    assert torch.equal(again.pos, after.pos)
    assert (again.frame_velocity is not None) == known
    assert not known or torch.equal(again.frame_velocity, after.frame_velocity)  # type: ignore[arg-type]


# --- refusals ---------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("materials", "config"), [(BODIES, {"mesh": True}), (("sand",), {"mesh": True, "cells": True})])
def test_elastic_models_need_cells(materials: tuple[str, ...], config: dict[str, Any]) -> None:
    with pytest.raises(
        CellError, match=r"model.elastic=true needs graph.cells=true graph.mesh=true graph.islands=true and a material with cells"
    ):
        GPE(scenes.builder(materials, **config).spec, elastic=True)


@pytest.mark.parametrize("config", [{"mesh": False}, {"mesh": True, "islands": False}])
def test_cells_need_meshes_and_islands(config: dict[str, Any]) -> None:
    with pytest.raises(GraphError, match=r"graph.cells=true needs graph.mesh=true graph.islands=true; choose these, or law=none"):
        _ = GraphBuilder(GraphConfig(cells=True, **{"islands": True, **config}), scenes.metadata(BODIES)).spec


def test_surfaces_and_mixed_meshes_are_refused() -> None:
    build, state = simulator().builder, bodies(kind="lattice")
    assert state.cells is not None
    cells = state.cells.clone()
    cells[0, 3] = cells[0, 2]
    with pytest.raises(GraphError, match="elastomer: graph.cells=true needs triangles or quadrilaterals, this mesh mixes them"):
        build(replace(state, cells=cells))
    solid = scenes.mesh_state("tetrahedra", BODIES).to_torch()
    assert solid.cells is not None
    with pytest.raises(GraphError, match="elastomer: graph.cells=true needs tetrahedra or hexahedra, this mesh is a surface"):
        simulator(dim=3).builder(replace(solid, cells=solid.cells[:, :3], cell_dim=2))


def test_scenes_with_different_cells_are_not_joined() -> None:
    with pytest.raises(
        CellError, match="elastomer: model.elastic=true needs cells of one kind, these scenes have triangles and quadrilaterals"
    ):
        simulator().step_all([bodies(), bodies(kind="lattice")])


def test_batches_of_pyg_are_refused() -> None:
    simulated = simulator()
    graphs = [simulated.builder(bodies()) for _ in range(2)]
    with pytest.raises(CellError, match=r"join graphs with gpe_pl.graphs.batching.batched"):
        simulated(Batch.from_data_list(graphs))


def test_programs_have_no_cells(tmp_path: Path) -> None:
    with pytest.raises(CellError, match=r"exported programs have no cells; export a model with model.elastic=false graph.cells=false"):
        export_model(simulator(), tmp_path / "model.pt2")
    assert not [*tmp_path.iterdir()]


def test_walls_that_move_are_refused() -> None:
    simulated, state = simulator(), bodies()
    sliding = replace(state.boundary, vel=state.boundary.vel + 1.0)
    with pytest.raises(GraphError, match="needs walls at rest"):
        simulated.step(replace(state, boundary=sliding))


def test_a_body_without_a_network_falls_freely() -> None:
    simulated, state = simulator(network=0.0), bodies(kind="lattice", walls=False)
    assert state.rest_pos is not None
    vel = torch.tensor([0.3, -0.2], dtype=torch.float64).expand_as(state.pos)
    start = replace(state, pos=state.rest_pos + 1.0, vel=vel, velocity_history=vel[:, None], frame_velocity=vel)
    pos, at_end = step(simulated, start)
    torch.testing.assert_close(pos, start.pos + DT * vel + 0.5 * DT**2 * state.gravity, rtol=0, atol=1e-7)
    torch.testing.assert_close(at_end, vel + DT * state.gravity, rtol=0, atol=1e-4)


def test_nodes_without_cells_keep_the_mean_velocities_of_free_flight() -> None:
    simulated, state = simulator(network=0.0), bodies(walls=False)
    state = in_flight(replace(state, cells=None, rest_pos=None), DT)
    after = simulated.step(state)
    torch.testing.assert_close(after.vel, state.vel + DT * state.gravity, rtol=0, atol=1e-6)
    assert after.frame_velocity is not None
    torch.testing.assert_close(after.frame_velocity, after.vel + 0.5 * DT * state.gravity, rtol=0, atol=1e-6)


def test_a_fresh_model_gets_the_units_of_a_simulator() -> None:
    simulated = simulator()
    fresh = GPE(simulated.builder.spec, **simulated.model.settings)
    simulated.set_units_of(fresh)
    assert float(fresh.get_buffer("elastic_bodies.acceleration_unit")) == pytest.approx(ACCELERATION * DT**2)
    assert float(fresh.get_buffer("elastic_bodies.spacing")) == pytest.approx(scenes.SPACING)


@pytest.mark.parametrize("walls", [True, False])
@pytest.mark.parametrize("only_contacts", [True, False])
def test_with_contacts_alone_the_network_leaves_bodies_apart_from_others_to_the_law(only_contacts: bool, walls: bool) -> None:
    state = bodies(kind="lattice", num_bodies=1, walls=True) if walls else bodies(kind="lattice", walls=False, gap=20.0)
    law, both = (simulator(network=size, decoder="contact", island_momentum="angular", only_contacts=only_contacts) for size in (0.0, 0.1))
    assert torch.equal(step(law, state)[0], step(both, state)[0]) == only_contacts


def test_cells_without_volume_are_refused() -> None:
    simulated, state = simulator(), bodies(kind="triangles")
    assert state.rest_pos is not None and state.cells is not None
    rest = state.rest_pos.clone()
    a, b, c = state.cells[0].tolist()
    rest[c] = 0.5 * (rest[a] + rest[b])
    with pytest.raises(CellError, match="has no volume at rest"):
        simulated.step(replace(state, rest_pos=rest))
