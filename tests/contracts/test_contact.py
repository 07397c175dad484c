"""The ``contact`` decoder: contacts move a mesh body as a whole, and nothing else does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch_geometric.data import HeteroData

from gpe_pl.export.program import EVERYTHING, ExportedStep, scene_of
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.multiscale import multiscale_graph
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE, IslandError
from gpe_pl.nn.edge_strength import ties
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import node_code
from gpe_pl.trajectory.state import State
from tests import scenes

BOTH = ("sand", "elastomer")


def builder(materials: tuple[str, ...] = BOTH, dim: int = 2, **config: Any) -> GraphBuilder:
    return scenes.builder(materials, dim, **{"mesh": True, "islands": True, **config})


def double(build: GraphBuilder, s: State) -> HeteroData:
    return scenes.to_dtype(build(s.to_torch()), torch.float64)


def contact_model(build: GraphBuilder) -> GPE:
    torch.manual_seed(0)
    island_momentum: Any = "ignored" if build.spec.materials == ("elastomer",) else "linear"
    return GPE(build.spec, decoder="contact", num_message_passing_steps=2, hidden_channels=16, island_momentum=island_momentum).double()


@pytest.mark.parametrize("kind", ["lattice", "tetrahedra"])
def test_contacts_alone_move_and_turn_a_body(kind: str) -> None:
    """Newton's and Euler's laws of each body under the forces of its contacts; what nodes add has no momentum."""
    build = builder(dim=3 if kind == "tetrahedra" else 2)
    s = scenes.mesh_state(kind, BOTH, num_bodies=2, gap=0.5)
    assert s.cells is not None
    cells = s.cells[~(s.cells == s.cells[0, 0]).any(axis=1)]  # which leaves a node, and more, without a cell
    data = double(build, replace(s, cells=cells))
    data.island_is_held[:] = True  # what flies freely has more to keep
    model = contact_model(build)
    predicted, decoded = prediction_and_parts(model, data)
    mass, pos, body = data["elastomer"].mass, data["elastomer"].pos, data["elastomer"].body
    force = decoded.contact["elastomer"] * mass[:, None]
    assert len(np.setdiff1d(np.flatnonzero(s.node_type == node_code("elastomer")), cells))
    assert body.unique().tolist() == [*range(int(data.num_bodies))]
    assert force.norm(dim=1).sum() > 1e-3
    for b in range(int(data.num_bodies)):
        m, r = mass[body == b][:, None], pos[body == b]
        r = r - (m * r).sum(dim=0) / m.sum()
        change, scale = m * predicted["elastomer"][body == b] - force[body == b], force.norm(dim=1).sum()
        assert change.sum(dim=0).norm() < 1e-12 * scale
        assert turning(r, change).norm() < 1e-12 * scale
    materials = [*predicted]
    island = torch.cat([data[m].island for m in materials])
    tie = ties(data, materials, island, int(data.num_islands)).node.split([data[m].num_nodes for m in materials])
    expected = tie[materials.index("sand")][:, None] * decoded.acceleration["sand"]
    torch.testing.assert_close(predicted["sand"], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("way", [(0.0, 0.0), (-3.0, 1.0), (-8.0, 4.0)])
def test_a_loose_node_that_has_left_its_body_turns_it_by_its_own_lever(way: tuple[float, float]) -> None:
    build, s = builder(("elastomer",)), with_loose_nodes()
    assert s.cells is not None
    loose = np.setdiff1d(np.arange(s.num_nodes), s.cells)
    pos = s.pos.copy()
    pos[loose[0]] += scenes.SPACING * np.array(way)
    assert_newton_and_euler(build, replace(s, pos=pos))


def assert_newton_and_euler(build: GraphBuilder, s: State) -> None:
    """Check that contacts alone move and turn each body, with levers that are those of the state. No body lies across a seam."""
    data = double(build, s)
    data.island_is_held[:] = True
    predicted, decoded = prediction_and_parts(contact_model(build), data)
    mass, body, pos = data["elastomer"].mass, data["elastomer"].body, torch.from_numpy(s.pos)[data["elastomer"].node_id]
    force = decoded.contact["elastomer"] * mass[:, None]
    assert int(data.num_bodies) >= 2
    for b in range(int(data.num_bodies)):
        m, r = mass[body == b][:, None], pos[body == b]
        r = r - (m * r).sum(dim=0) / m.sum()
        own = force[body == b]
        change, scale = m * predicted["elastomer"][body == b] - own, own.norm(dim=1).sum()
        assert turning(r, own).norm() > 1e-3 * (r.norm(dim=1) * own.norm(dim=1)).sum()
        assert change.sum(dim=0).norm() < 1e-6 * scale
        assert turning(r, change).norm() < 1e-6 * (r.norm(dim=1).max() * scale)


def with_loose_nodes(materials: tuple[str, ...] = ("elastomer",), gap: float = 0.5) -> State:
    """Return two touching bodies far from walls, each with a corner without cells, of masses that differ a hundredfold."""
    s = scenes.mesh_state("lattice", materials, num_bodies=2, gap=gap, walls=False)
    assert s.cells is not None and s.rest_pos is not None
    first, second = connected(s, s.cells)
    ends = [first[np.argmax(s.rest_pos[first].sum(axis=1))], second[np.argmin(s.rest_pos[second].sum(axis=1))]]
    mass = 10.0 ** np.random.default_rng(0).uniform(-1, 1, s.num_nodes)
    return replace(s, cells=s.cells[~np.isin(s.cells, ends).any(axis=1)], mass=mass)


def connected(s: State, cells: np.ndarray) -> list[np.ndarray]:
    """Return the nodes of each body, in the order of the bodies along x."""
    label = multiscale_graph(np.asarray(s.rest_pos), cells, scenes.SPACING, 1).body
    bodies = [np.flatnonzero(label[: s.num_nodes] == b) for b in np.unique(label[np.unique(cells)])]
    return sorted(bodies, key=lambda nodes: float(np.asarray(s.rest_pos)[nodes, 0].min()))


def momentum_error(before: State, after: State, frame_dt: float) -> tuple[float, float]:
    """Return |Σ m Δv| / Σ m |Δv|, and the same for angular momentum about the centre of mass, of velocity changes beyond gravity."""
    change = after.vel - before.vel - before.gravity * frame_dt
    mass = before.mass[:, None]
    arm, push = before.pos - (mass * before.pos).sum(dim=0) / mass.sum(), mass * change
    assert push.norm(dim=1).sum() > 1e-3
    turn = turning(arm, push).norm() / (arm.norm(dim=1) * push.norm(dim=1)).sum()
    return float(push.sum(dim=0).norm() / push.norm(dim=1).sum()), float(turn)


def single_simulator(build: GraphBuilder, island_momentum: Any = "ignored") -> LearnedSimulator:
    torch.manual_seed(0)
    model = GPE(build.spec, decoder="contact", num_message_passing_steps=2, hidden_channels=16, island_momentum=island_momentum)
    simulator = LearnedSimulator(model, build).eval()
    simulator.acceleration_std.fill_(30.0)
    return simulator


@pytest.mark.parametrize("skips", [Skips(), Skips(edges_at_once=7, sorted_from=1), EVERYTHING])
def test_bodies_with_loose_nodes_do_not_push_themselves(skips: Skips) -> None:
    """Also tests several scenes at once, and the exported program."""
    build = builder(("elastomer",))
    simulator, s = single_simulator(build), with_loose_nodes().to_torch()
    simulator.skips = skips
    dt = build.metadata.frame_dt
    assert momentum_error(s, simulator.step(s), dt)[0] < 1e-6
    graph = build(s)
    body, (j, i) = graph["elastomer"].body, graph["elastomer", "radius", "elastomer"].edge_index
    assert graph.num_bodies == 2 and bool((body[i] == body[j]).any()) and bool((body[i] != body[j]).any())
    mirrored = replace(s, pos=s.pos * torch.tensor([-1.0, 1.0]), rest_pos=None if s.rest_pos is None else s.rest_pos.flip(1))
    for before, after in zip((s, mirrored), simulator.step_all([s, mirrored]), strict=True):
        assert isinstance(after, State) and momentum_error(before, after, dt)[0] < 1e-6
    with torch.inference_mode():
        scene = scene_of(simulator, s)
        moved, _ = ExportedStep(simulator)(scene)
    change = moved["velocity_history.elastomer"][:, -1] - scene["velocity_history.elastomer"][:, -1] - s.gravity * dt
    push = scene["mass.elastomer"][:, None] * change
    assert push.sum(dim=0).norm() < 1e-6 * push.norm(dim=1).sum()


@pytest.mark.parametrize("island_momentum", ["linear", "angular"])
def test_sand_at_bodies_with_loose_nodes_keeps_the_momentum_that_is_asked_for(island_momentum: str) -> None:
    build = builder()
    s = with_loose_nodes(BOTH)
    pos = s.pos.copy()
    sand, elastomer = (np.flatnonzero(s.node_type == node_code(m)) for m in BOTH)
    pos[sand] = pos[elastomer[:1]] + np.random.default_rng(1).uniform(0.3, 0.6, (len(sand), 2)) * scenes.SPACING
    s = replace(s, pos=pos).to_torch()
    graph = build(s)
    assert graph.num_islands == 1 and not graph.island_is_held[0]
    linear, angular = momentum_error(s, single_simulator(build, island_momentum).step(s), build.metadata.frame_dt)
    assert linear < 1e-6
    if island_momentum == "angular":
        assert angular < 1e-6


def test_a_loose_node_moves_with_the_body_that_it_lies_beside_at_rest() -> None:
    """It lies beside the body directly, or through other loose nodes of its material. Without a body beside it, it is a separate body."""
    points: list[list[float]] = [[0, 0], [1, 0], [1, 1], [0, 1], [8, 0], [9, 0], [9, 1], [8, 1]]  # two cells
    points += [[2, 0], [3.5, 0], [10, 0], [20, 0]]  # beside the first, beside that one, beside the second, far from all
    points += [[11.5, 0], [13, 0]]  # sand, and an elastomer beside sand alone
    rest, cells = scenes.SPACING * np.array(points, dtype=float), np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    kind = np.full(len(points), node_code("elastomer"), np.int64)
    kind[12] = node_code("sand")
    graph = multiscale_graph(rest, cells, scenes.SPACING, 2)
    label, bonds = graph.moving_bodies(kind, scenes.SPACING)
    groups = {frozenset(np.flatnonzero(label == b).tolist()) for b in np.unique(label[kind == node_code("elastomer")])}
    assert groups == {frozenset({0, 1, 2, 3, 8, 9}), frozenset({4, 5, 6, 7, 10}), frozenset({11}), frozenset({13})}
    assert sorted(zip(*bonds.tolist(), strict=True)) == [(1, 8), (5, 10), (8, 9)]


def prediction_and_parts(model: GPE, data: HeteroData) -> tuple[dict[str, torch.Tensor], Any]:
    """Return the accelerations that a model predicts, and the parts from which it makes them."""
    parts: list[Any] = []
    compute = model.compute

    def recorded(*args: Any) -> Any:
        parts.append(compute(*args))
        return parts[-1]

    model.compute = recorded  # type: ignore[assignment, method-assign]
    try:
        return model(data).acceleration, parts[0]
    finally:
        del model.compute


def turning(arm: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Return the torque, with one component per rotation axis."""
    arm, force = (torch.nn.functional.pad(x, (0, 3 - x.shape[1])) for x in (arm, force))
    return torch.linalg.cross(arm, force).sum(dim=0)


def test_without_contact_a_body_falls_freely_and_deforms() -> None:
    build = builder(("elastomer",))
    data = double(build, scenes.mesh_state(walls=False, gap=9.0))
    acceleration = contact_model(build)(data).acceleration["elastomer"]
    mass = data["elastomer"].mass[:, None]
    assert acceleration.norm(dim=1).sum() > 1e-3
    assert (data["elastomer"].body >= 0).all()
    for b in range(int(data.num_bodies)):
        chosen = data["elastomer"].body == b
        assert (mass * acceleration)[chosen].sum(dim=0).norm() <= 1e-13 * (mass * acceleration).norm(dim=1).sum()


@pytest.mark.parametrize("skips", [Skips(), Skips(sorted_from=0)])
def test_a_body_that_touches_itself_does_not_turn_itself(skips: Skips) -> None:
    """Two heaps of cells that touch, far apart at rest and tied together by one long cell: forces at their contact are no forces from outside."""
    build = builder(("elastomer",))
    s = scenes.mesh_state("triangles", ("elastomer",), num_bodies=2, gap=0.5, walls=False)
    store = double(build, s)["elastomer"]
    first, second = (store.node_id[store.body == b].numpy() for b in range(2))
    assert s.cells is not None and s.rest_pos is not None
    s = replace(s, cells=np.concatenate([s.cells, [[*first[:2], second[0]]]]))
    rest = np.array(s.rest_pos)
    rest[second, 0] += 50 * scenes.SPACING
    data = double(build, replace(s, rest_pos=rest))
    assert data.num_bodies == 1
    assert data["elastomer", "radius", "elastomer"].edge_index.shape[1]
    model = contact_model(build)
    model.skips = skips
    acceleration = model.eval()(data).acceleration["elastomer"]
    mass, pos = data["elastomer"].mass[:, None], data["elastomer"].pos
    force, arm = mass * acceleration, pos - (mass * pos).sum(dim=0) / mass.sum()
    assert force.norm(dim=1).sum() > 1e-3
    assert force.sum(dim=0).norm() < 1e-12 * force.norm(dim=1).sum()
    assert turning(arm, force).norm() < 1e-12 * force.norm(dim=1).sum()


def test_the_bodies_of_a_batch_are_told_apart() -> None:
    build = builder()
    model = contact_model(build)
    graphs = [double(build, scenes.mesh_state(kind, BOTH, num_bodies=n, gap=0.5)) for kind, n in (("lattice", 2), ("triangles", 1))]
    together = model(batched(graphs)).acceleration["elastomer"]
    torch.testing.assert_close(together, torch.cat([model(g).acceleration["elastomer"] for g in graphs]), rtol=1e-12, atol=1e-14)


def test_contacts_move_nothing_but_bodies() -> None:
    spec = builder(mesh=False).spec
    torch.manual_seed(0)
    contact = GPE(spec, decoder="contact", num_message_passing_steps=1, hidden_channels=8)
    torch.manual_seed(0)
    node = GPE(spec, num_message_passing_steps=1, hidden_channels=8)
    assert contact.state_dict().keys() == node.state_dict().keys()
    assert contact.num_hops == node.num_hops


@pytest.mark.slow
@pytest.mark.parametrize("materials", [BOTH, ("elastomer", "snow", "sand")])
def test_bodies_beside_other_materials_need_something_that_keeps_the_sum(materials: tuple[str, ...]) -> None:
    spec = builder(materials).spec
    others = ", ".join(m for m in spec.materials if m != "elastomer")
    with pytest.raises(
        IslandError, match=f"does not conserve momentum between elastomer and {others}; choose model.island_momentum=linear or angular, or"
    ):
        GPE(spec, decoder="contact")
    GPE(spec, decoder="contact", island_momentum="linear")
    GPE(builder(("elastomer",)).spec, decoder="contact")
    GPE(builder(("sand", "snow")).spec, decoder="contact")


def test_bodies_without_their_graphs_labels_are_refused() -> None:
    with pytest.raises(IslandError, match=r"decoder=contact needs graph\.islands=true"):
        GPE(builder(islands=False).spec, decoder="contact")
