"""Periodic domains: neighbours, features, steps, rollouts and samples do not depend on the position of the seam."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from gpe_pl.data.dataset import WindowDataset, open_split
from gpe_pl.data.noise import Noise
from gpe_pl.data.statistics import combined, shard_moments
from gpe_pl.data.validate import validate
from gpe_pl.export.program import ExportedStep, scene_of
from gpe_pl.geometry.periodicity import NOWHERE, Periodicity, PeriodicityError
from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.graphs.islands import unwrapped
from gpe_pl.graphs.neighbors import radius_between, radius_pairs
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import per_frame_mse, rollout_metrics
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import BOUNDARY
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import iter_trajectories, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.coloring import Coloring
from gpe_pl.viz.panel import Panel
from tests import scenes
from tests.contracts.test_contact import assert_newton_and_euler

BOX = ((0.0, 1.0), (-0.5, 1.0), (0.25, 1.0))
AXES = {"x": (True, False), "y": (False, True), "both": (True, True)}
New = Callable[..., Trajectory]


def torus(periodic: tuple[bool, ...]) -> Periodicity:
    return Periodicity(BOX[: len(periodic)], periodic)


def builder(space: Periodicity, materials: tuple[str, ...] = ("sand",), **config: Any) -> GraphBuilder:
    metadata = replace(scenes.metadata(materials, len(space.bounds)), bounds=space.bounds, periodic=space.periodic)
    return GraphBuilder(GraphConfig(**{"history": 1, "islands": True, **config}), metadata)


def cloud(space: Periodicity, materials: tuple[str, ...] = ("sand",), num_nodes: int = 60, seed: int = 0, history: int = 1) -> State:
    """Return particles spread over the domain, with boundary nodes among them."""
    rng = np.random.default_rng(seed)
    low, high = np.array(space.bounds).T
    pos, wall = (rng.uniform(low, high, (n, len(low))) for n in (num_nodes, 25))
    boundary = Boundary(wall, np.zeros_like(wall), np.eye(len(low))[np.zeros(25, int)], np.full(25, 0.3), np.zeros(25))
    s = scenes.state(num_nodes, materials, history, seed, dim=len(low), walls=False)
    return replace(s, pos=pos, boundary=boundary, periodicity=space)


def shifted(s: State, shift: np.ndarray) -> State:
    """Return the scene translated, and folded back into the domain."""
    return replace(
        s, pos=s.periodicity.wrapped(s.pos + shift), boundary=replace(s.boundary, pos=s.periodicity.wrapped(s.boundary.pos + shift))
    )


def shifts(space: Periodicity, count: int = 4) -> list[np.ndarray]:
    """Return vectors along the periodic axes, some of them longer than the domain."""
    rng = np.random.default_rng(1)
    return list(rng.uniform(-2, 2, (count, len(space.bounds))) * (space.period > 0))


def images(space: Periodicity) -> np.ndarray:
    """Return the offsets of the nearest copies of the domain."""
    steps = [(-1, 0, 1) if repeats else (0,) for repeats in space.periodic]
    return np.array(list(itertools.product(*steps))) * space.period


def shortest_by_force(space: Periodicity, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the shortest difference to any copy [source, target, dim]."""
    every = target[None, None] - source[None, :, None] + images(space)[:, None, None]
    nearest = (every**2).sum(-1).argmin(0)
    return np.take_along_axis(every, nearest[None, ..., None], axis=0)[0]


# --- lengths -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("periodic", [(True, False), (False, True), (True, True), (True, False, True), (True, True, True)])
@pytest.mark.parametrize("array", [np.asarray, torch.as_tensor])
def test_shortest_and_wrapped_are_those_of_all_copies(periodic: tuple[bool, ...], array: Callable[[Any], Any]) -> None:
    space, rng = torus(periodic), np.random.default_rng(0)
    low, high = np.array(space.bounds).T
    a, b = rng.uniform(low, high, (2, 50, len(low)))
    expected = np.stack([shortest_by_force(space, p[None], q[None])[0, 0] for p, q in zip(a, b, strict=True)])
    np.testing.assert_allclose(space.shortest(array(b - a)), expected, atol=1e-14)
    far = a + 7 * space.period
    np.testing.assert_allclose(space.wrapped(array(far)), a, atol=1e-13)
    edge = np.where(space.period > 0, low - 1e-18, low)  # would round to the upper bound
    assert np.array_equal(np.asarray(space.wrapped(array(edge[None])))[0], low)


def test_where_nothing_repeats_nothing_is_computed() -> None:
    x = np.array([[0.5, 7.0]])
    for space in (NOWHERE, torus((False, False))):
        assert space.shortest(x) is x
        assert space.wrapped(x) is x
        assert not space
        space.check_radius(100.0)


# --- neighbours and features ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("periodic", [(True, False), (False, True), (True, True), (True, False, True), (True, True, True)])
@pytest.mark.parametrize("radius", [0.15, 0.25, 0.37])
def test_neighbours_are_those_of_all_copies(periodic: tuple[bool, ...], radius: float) -> None:
    space, rng = torus(periodic), np.random.default_rng(3)
    low, high = np.array(space.bounds).T
    source, target = (rng.uniform(low, high, (n, len(low))) for n in (70, 40))
    moved = target + np.where(rng.uniform(size=target.shape) < 0.3, space.period, 0.0)  # no need to lie inside
    expected = np.argwhere((shortest_by_force(space, source, target) ** 2).sum(-1) <= radius**2)
    assert {tuple(e) for e in radius_between(source, moved, radius, space).T} == {tuple(e) for e in expected}
    expected = np.argwhere(np.triu((shortest_by_force(space, source, source) ** 2).sum(-1) <= radius**2, 1))
    found = radius_pairs(source, radius, space)
    assert {frozenset(e) for e in found.T.tolist()} == {frozenset(e) for e in expected.tolist()}
    assert found.shape[1] == len(expected) > radius_pairs(source, radius).shape[1]


@pytest.mark.parametrize("periodic", AXES.values(), ids=AXES)
def test_edges_have_the_shortest_displacement(periodic: tuple[bool, ...]) -> None:
    space = torus(periodic)
    build, s = builder(space, trim_boundary=False), cloud(space, num_nodes=200)
    data = build(s.to_torch())
    crossing = 0
    for relation, source in ((("sand", "radius", "sand"), s.pos), ((BOUNDARY, "radius", "sand"), s.boundary.pos)):
        j, i = data[relation].edge_index.numpy()
        expected = shortest_by_force(space, source, s.pos)[j, i]
        np.testing.assert_allclose(data[relation].offset, expected / build.scales.radius, atol=1e-6)
        crossing += int((np.abs(expected - (s.pos[i] - source[j])).max(axis=1) > 0.1).sum())
    assert crossing > 5


@pytest.mark.parametrize("radius", [0.5, 0.7])
def test_a_radius_of_half_the_period_is_refused(radius: float) -> None:
    space = torus((True, False))
    message = rf"radius {radius:g} m must be below half the period 1 m of axis x"
    with pytest.raises(PeriodicityError, match=message):
        builder(space, connectivity_spacings=radius / scenes.SPACING)
    with pytest.raises(PeriodicityError, match=message):
        radius_pairs(np.zeros((3, 2)), radius, space)
    with pytest.raises(PeriodicityError, match=message):
        radius_between(np.zeros((3, 2)), np.ones((1, 2)), radius, space)
    builder(torus((False, False)), connectivity_spacings=radius / scenes.SPACING)
    builder(space, connectivity_spacings=0.499 / scenes.SPACING)


def test_a_state_of_another_topology_is_refused() -> None:
    build, s = builder(torus((True, False))), cloud(torus((True, True)))
    with pytest.raises(GraphError, match="state is periodic along x, y, the data set 'test' along x; make the state"):
        build(s.to_torch())
    with pytest.raises(GraphError, match="state is periodic along no axis, the data set 'test' along x; make the state"):
        build(replace(s, periodicity=NOWHERE).to_torch())


# --- islands and meshes --------------------------------------------------------------------------------------------------------------------


def test_an_island_stays_together_at_the_seam() -> None:
    space = torus((True, True))
    rng = np.random.default_rng(0)
    blob = rng.normal(scale=0.05, size=(30, 2))
    s = replace(cloud(space, num_nodes=30), pos=space.wrapped(blob + np.array([0.99, -0.48])), boundary=Boundary.empty(2))
    store = builder(space)(s.to_torch())["sand"]
    assert len(store.island.unique()) == 1
    np.testing.assert_allclose(store.pos - store.pos[0], blob - blob[0], atol=1e-6)


def test_an_island_around_the_domain_has_no_lever_arms() -> None:
    space = torus((True, False))
    row = np.stack([np.arange(10) / 10, np.full(10, 0.2)], axis=1)
    s = replace(cloud(space, num_nodes=10), pos=row, boundary=Boundary.empty(2))
    assert not builder(space)(s.to_torch())["sand"].pos.any()
    _, goes_around = unwrapped(row, radius_pairs(row, 0.12, space), space)
    assert goes_around.all()
    open_row, goes_around = unwrapped(row[:9], radius_pairs(row[:9], 0.12, space), space)
    assert not goes_around.any()
    np.testing.assert_allclose(np.abs(np.diff(open_row, axis=0)), np.tile([0.1, 0.0], (8, 1)), atol=1e-12)


@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
def test_a_mesh_at_the_seam_is_the_mesh_inside(kind: str) -> None:
    dim = 3 if kind == "tetrahedra" else 2
    space = torus((True,) * dim)
    build = builder(space, ("elastomer",), mesh=True)
    s = replace(scenes.mesh_state(kind, walls=False), periodicity=space)
    s = replace(s, pos=s.pos + 0.3)  # inside
    inside = build(s.to_torch())
    for shift in shifts(space):
        assert_close_graphs(build(shifted(s, shift).to_torch()), inside, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
def test_rest_positions_that_were_folded_are_those_of_the_whole_mesh(kind: str) -> None:
    """Rest positions are folded if they come from a first frame in which a body lies across the seam. Also tests the exported program."""
    dim = 3 if kind == "tetrahedra" else 2
    space = torus((True,) * dim)
    build = builder(space, ("elastomer",), mesh=True)
    s = replace(scenes.mesh_state(kind, walls=False), periodicity=space)
    assert s.rest_pos is not None
    s = replace(s, pos=s.pos + 0.3)  # inside
    whole = build(s.to_torch())
    torn = 0
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=4), build)
    for shift in shifts(space):
        folded = replace(s, rest_pos=space.wrapped(s.rest_pos + shift))
        torn += bool(np.ptp(np.asarray(folded.rest_pos) - s.rest_pos, axis=0).max() > 0.1)
        assert_close_graphs(build(folded.to_torch()), whole, atol=2e-5)
        rest = scene_of(simulator, folded.to_torch())["rest_pos.elastomer"].numpy()
        edge = whole["elastomer", "cell", "elastomer"].edge_index.numpy()
        expected = np.asarray(s.rest_pos)[whole["elastomer"].node_id]
        np.testing.assert_allclose(rest[edge[0]] - rest[edge[1]], expected[edge[0]] - expected[edge[1]], atol=1e-9)
    assert torn


def test_a_mesh_around_the_domain_is_refused() -> None:
    space = torus((True, False))
    x = np.arange(10) / 10
    pos = np.concatenate([np.stack([x, np.full(10, y)], axis=1) for y in (0.2, 0.3)])
    k = np.arange(10)
    cells = np.stack([k, (k + 1) % 10, (k + 1) % 10 + 10, k + 10], axis=1)
    s = scenes.state(20, ("elastomer",), walls=False)
    s = replace(s, pos=pos, rest_pos=pos, cells=cells, periodicity=space)
    with pytest.raises(GraphError, match="the mesh of node 0 goes around the periodic domain"):
        builder(space, ("elastomer",), mesh=True)(s.to_torch())


def ring() -> tuple[GraphBuilder, State]:
    """Return bodies that go around the domain together, the last beside the first; each is inside."""
    s = scenes.mesh_state("lattice", num_bodies=3, gap=1.0, walls=False)
    assert s.rest_pos is not None
    low, high = float(s.rest_pos[:, 0].min()), float(s.rest_pos[:, 0].max())
    space = Periodicity(((low - 0.5 * scenes.SPACING, high + 0.5 * scenes.SPACING), (-0.5, 1.0)), (True, False))
    rng = np.random.default_rng(0)
    s = replace(s, pos=s.rest_pos + 0.05 * scenes.SPACING * rng.normal(size=s.pos.shape), periodicity=space)
    return builder(space, ("elastomer",), mesh=True), s


def test_contacts_turn_bodies_that_go_around_the_domain_together() -> None:
    """Also tests that the seam changes nothing, and the exported program."""
    build, s = ring()
    graph = build(s.to_torch())
    assert int(graph.num_islands) == 1 and int(graph.num_bodies) == 3 and not graph["elastomer"].pos.any()
    assert_newton_and_euler(build, s)
    simulator = LearnedSimulator(GPE(build.spec, decoder="contact", num_message_passing_steps=1, hidden_channels=8), build).eval()
    simulator.acceleration_std.fill_(30.0)
    state = s.to_torch()
    with torch.no_grad():
        after = simulator.step(state)
        for shift in shifts(s.periodicity):
            moved = simulator.step(shifted(s, shift).to_torch())
            torch.testing.assert_close(moved.vel, after.vel, rtol=0, atol=1e-4 * float((after.vel - state.vel).abs().max()))
        later, _ = ExportedStep(simulator)(scene_of(simulator, state))
    torch.testing.assert_close(later["velocity_history.elastomer"][:, -1], after.vel[graph["elastomer"].node_id], rtol=0, atol=1e-6)


def test_levers_of_bodies_have_gradients() -> None:
    build, s = ring()
    pos = torch.from_numpy(s.pos).requires_grad_()
    with_gradient = build(replace(s.to_torch(), pos=pos))["elastomer"].body_arm
    torch.testing.assert_close(with_gradient.detach(), build(s.to_torch())["elastomer"].body_arm)
    (grad,) = torch.autograd.grad(with_gradient[0, 0], pos)
    assert float(grad[:, 0].max()) > 0.5 and float(grad.sum()) == pytest.approx(0.0, abs=1e-6)


def test_a_loose_node_at_the_seam_stays_beside_its_body() -> None:
    space = torus((True, False))
    build, s = builder(space, ("elastomer",), mesh=True), scenes.mesh_state("lattice", num_bodies=2, gap=3.0, walls=False)
    assert s.cells is not None and s.rest_pos is not None
    cells, rest = s.cells[~(s.cells == s.cells[0, 0]).any(axis=1)], s.rest_pos
    s = replace(s, periodicity=space, cells=cells)
    whole = build(s.to_torch())["elastomer"]
    assert len(np.setdiff1d(np.arange(s.num_nodes), cells))
    for shift in shifts(space):
        folded = replace(shifted(s, shift), rest_pos=space.wrapped(rest + 0.7 * shift))
        found = build(folded.to_torch())["elastomer"]
        assert torch.equal(found.body, whole.body)
        torch.testing.assert_close(found.body_arm, whole.body_arm, rtol=0, atol=1e-6)


# --- shift ---------------------------------------------------------------------------------------------------------------------------------


def assert_close_graphs(a: Any, b: Any, atol: float = 1e-5) -> None:
    """Compare stores up to rounding, and up to the order and direction of edges, which the search may choose."""
    assert (a.node_types, a.edge_types) == (b.node_types, b.edge_types)
    for t in a.node_types:
        torch.testing.assert_close(a[t].x, b[t].x, atol=atol, rtol=1e-5)
    for relation in a.edge_types:
        assert a[relation].edge_index.shape == b[relation].edge_index.shape, relation
        edges, others = (_by_ends(g[relation], relation[0] == relation[2]) for g in (a, b))
        assert edges.keys() == others.keys(), relation
        for ends, values in edges.items():
            torch.testing.assert_close(values, others[ends], atol=atol, rtol=1e-5)


def _by_ends(store: Any, same_type: bool) -> dict[tuple[int, int], torch.Tensor]:
    found = {}
    for (j, i), odd, even in zip(store.edge_index.T.tolist(), store.odd, store.even, strict=True):
        swap = same_type and j > i
        found[(i, j) if swap else (j, i)] = torch.cat([-odd if swap else odd, even])
    return found


@pytest.mark.parametrize("periodic", AXES.values(), ids=AXES)
@pytest.mark.parametrize("features", ["paper", "contact"])
def test_a_shift_changes_no_graph(periodic: tuple[bool, ...], features: Any) -> None:
    space = torus(periodic)
    build, s = builder(space, ("sand", "fluid"), features=features), cloud(space, ("sand", "fluid"))
    data = build(s.to_torch())
    for shift in shifts(space):
        other = build(shifted(s, shift).to_torch())
        assert_close_graphs(other, data)
        assert torch.equal(other.island_is_held, data.island_is_held)
        for m in ("sand", "fluid"):
            assert torch.equal(other[m].island, data[m].island)


@pytest.mark.slow
@pytest.mark.parametrize("periodic", AXES.values(), ids=AXES)
@pytest.mark.parametrize("island_momentum", ["ignored", "angular"])
def test_a_shift_changes_neither_step_nor_rollout(periodic: tuple[bool, ...], island_momentum: Any) -> None:
    space = torus(periodic)
    build = builder(space, history=2)
    torch.manual_seed(0)
    model = GPE(build.spec, num_message_passing_steps=2, hidden_channels=8, island_momentum=island_momentum)
    simulator = LearnedSimulator(model.double(), build).double().eval()
    simulator.acceleration_std.fill_(100.0)
    s = cloud(space, num_nodes=25, history=2)
    plain = rollout(simulator, s.to_torch(), 8, build.metadata)
    assert np.abs(plain.vel[-1] - s.vel - 8 * build.metadata.frame_dt * s.gravity).max() > 0.1  # the network answers
    for shift in shifts(space, 2):
        other = rollout(simulator, shifted(s, shift).to_torch(), 8, build.metadata)
        np.testing.assert_allclose(other.vel[1], plain.vel[1], atol=1e-6)
        difference = space.shortest(other.pos - plain.pos - shift)
        assert np.abs(difference).max() < 1e-5
        for trajectory in (plain, other):
            for axis in space.axes:
                low, high = space.bounds[axis]
                assert trajectory.pos[1:, :, axis].min() >= low
                assert trajectory.pos[1:, :, axis].max() < high
    assert np.abs(np.diff(plain.pos, axis=0)).max() > 0.5  # nodes went over the seam


# --- stored data ---------------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def drifting(new_trajectory: New) -> Trajectory:
    """Return particles that cross the seam of x within a few frames."""
    trajectory = new_trajectory(num_frames=12, periodic=(True, False))
    rng = np.random.default_rng(0)
    start = rng.uniform([0.0, 0.2], [1.0, 0.8], (trajectory.num_nodes, 2))
    path = start + np.cumsum(rng.normal([0.05, 0.0], 0.01, (12, trajectory.num_nodes, 2)), axis=0)
    pos = trajectory.metadata.periodicity.wrapped(np.clip(path, [-9, 0.1], [9, 0.9])).astype(np.float32)
    assert np.abs(np.diff(pos, axis=0)).max() > 0.5
    return replace(trajectory, pos=pos)


def moved(trajectory: Trajectory, shift: float) -> Trajectory:
    space = trajectory.metadata.periodicity
    pos, wall = (space.wrapped(x.astype(np.float64) + np.array([shift, 0.0])) for x in (trajectory.pos, trajectory.boundary.pos))
    return replace(trajectory, pos=pos, boundary=replace(trajectory.boundary, pos=wall, shapes=()))


def test_velocities_cross_the_seam(drifting: Trajectory) -> None:
    past = drifting.state(5, history=3).velocity_history
    assert past is not None
    np.testing.assert_allclose(past[..., 0].mean(), 0.05 / drifting.metadata.frame_dt, rtol=0.2)
    assert np.abs(past).max() < 0.1 / drifting.metadata.frame_dt


def test_samples_and_statistics_do_not_depend_on_the_seam(tmp_path: Path, drifting: Trajectory) -> None:
    samples, statistics = [], []
    for k, shift in enumerate((0.0, 0.37)):
        path = tmp_path / str(k) / "train" / "shard-00000.h5"
        write_shard(path, [moved(drifting, shift)])
        stored = open_split(tmp_path / str(k), "train")
        build = GraphBuilder(GraphConfig(history=2), stored[0].window(0, 1).metadata)
        samples.append(WindowDataset(stored, build, Noise(0.0, 0.5), 1.0, seed=3)[4, 5])
        statistics.append(combined([shard_moments(path)[1]]))
    scale = float(samples[0]["sand"].target.abs().max())
    torch.testing.assert_close(samples[1]["sand"].target, samples[0]["sand"].target, atol=2e-3 * scale, rtol=1e-2)  # float32 positions
    assert scale < 2000
    assert_close_graphs(samples[1], samples[0], atol=1e-3)
    assert statistics[1]["acceleration_std"] == pytest.approx(statistics[0]["acceleration_std"], rel=1e-4)
    assert statistics[0]["velocity_std"] < 10


def test_metrics_go_the_short_way(drifting: Trajectory) -> None:
    other = replace(drifting, pos=drifting.pos + np.array([1.0, 0.0]))
    assert per_frame_mse(other, drifting).max() < 1e-12
    values = {r.metric: r.value for r in rollout_metrics(other, drifting, ["full"])}
    assert values["velocity_error"] < 1e-5
    assert values["momentum_error"] < 1e-4
    assert "energy_distance" not in values


def test_a_stored_radius_that_is_too_large_is_a_violation(tmp_path: Path, drifting: Trajectory) -> None:
    metadata = replace(drifting.metadata, connectivity_radius=0.6)
    write_shard(tmp_path / "train" / "shard-00000.h5", [replace(drifting, metadata=metadata)])
    messages = [str(v) for v in validate([tmp_path]).violations]
    assert any("connectivity_radius: radius 0.6 m must be below half the period 1 m of axis x" in m for m in messages)


def test_free_islands_are_followed_over_the_seam(tmp_path: Path, new_trajectory: New) -> None:
    """A pair in free flight through the seam accelerates with g, as the validator finds."""
    t = new_trajectory(num_frames=12, num_nodes=2, periodic=(True, False), frame_dt=0.05)
    time = 0.05 * np.arange(12)[:, None]
    path = np.array([0.8, 0.85]) + time * np.array([1.0, 0.0])
    other = path + np.array([0.1, 0.0])
    fall = 0.5 * np.array(t.metadata.gravity) * time * (time + 0.05) * 0.02  # gravity of the data set below
    pos = t.metadata.periodicity.wrapped(np.stack([path + fall, other + fall], axis=1))
    metadata = replace(t.metadata, gravity=tuple(0.02 * g for g in t.metadata.gravity))
    write_shard(tmp_path / "train" / "shard-00000.h5", [replace(t, pos=pos, metadata=metadata, boundary=Boundary.empty(2))])
    result = validate([tmp_path])
    assert not result.violations
    (group,) = result.groups.values()
    assert (group.flight.num_free, group.flight.num_disturbed) == (10, 0)


def test_stored_and_read_back(tmp_path: Path, drifting: Trajectory) -> None:
    write_shard(tmp_path / "train" / "shard-00000.h5", [drifting])
    (read,) = iter_trajectories(tmp_path, "train")
    assert read.metadata.periodicity == drifting.metadata.periodicity
    assert read.state(3).periodicity.axes == (0,)


# --- pictures ------------------------------------------------------------------------------------------------------------------------------


def test_a_mesh_at_the_seam_is_drawn_whole(new_trajectory: New) -> None:
    points, cells = scenes.mesh("lattice")
    t = new_trajectory(num_frames=2, num_nodes=len(points), periodic=(True, False))
    pos = t.metadata.periodicity.wrapped(0.05 * points + np.array([0.88, 0.3]))
    t = replace(t, pos=np.stack([pos, pos]), rest_pos=0.05 * points, cells=cells)
    panel = Panel(Figure((3, 3)), (0.0, 0.0, 1.0, 1.0), t, Coloring("height", [t], [0]))
    panel.show_frame(1)
    drawn = [path.vertices for path in panel.mesh.get_paths()]
    assert max(np.ptp(corners, axis=0).max() for corners in drawn) < 0.06
    assert max(np.ptp(segment, axis=0).max() for segment in panel.outline.get_segments()) < 0.06
    crossing = [
        corners
        for corners in drawn
        if corners[:, 0].min() < 1 - 1e-9 < corners[:, 0].max() or corners[:, 0].min() < -1e-9 < corners[:, 0].max()
    ]
    assert len(drawn) == len(cells) + len(crossing) // 2  # those at the seam on both of its sides
    assert len(crossing) > 2
    assert len(panel.mesh.get_facecolor()) == len(drawn)
