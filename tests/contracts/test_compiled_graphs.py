"""Compiled passes and plain operations make the same graphs and the same steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.shapes import Box, domain_walls
from gpe_pl.graphs import compiled_graph, joined
from gpe_pl.graphs.batching import batched
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.compiled_graph import works_on
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.loop import sound
from gpe_pl.schema import node_code, param_names
from gpe_pl.system.compiled import unfused
from gpe_pl.trajectory.boundary import Boundary, BoundaryMotion
from gpe_pl.trajectory.state import State
from tests import scenes

Scene = tuple[GraphBuilder, State]


class DoubleBuilder(GraphBuilder):
    """Builder of graphs in double precision."""

    precision = torch.float64


def particles(materials: tuple[str, ...] = ("sand",), dim: int = 2, num_nodes: int = 90, walls: bool = True, **config: Any) -> Scene:
    build = scenes.builder(materials, dim, **{"history": 3, **config})
    return build, scenes.state(num_nodes, materials, build.config.history, seed=1, dim=dim, walls=walls, high=0.5)


def meshes(kind: str, materials: tuple[str, ...] = ("elastomer",), gap: float = 1.5, **config: Any) -> Scene:
    build = scenes.builder(materials, 3 if kind == "tetrahedra" else 2, **{"history": 3, "mesh": True, **config})
    return build, scenes.mesh_state(kind, materials, gap=gap, history=3, seed=2)


def one_of_several() -> Scene:
    build, s = particles(("sand", "snow", "fluid"))
    return build, scenes.permuted(s, np.flatnonzero(s.node_type == node_code("snow")))


def periodic(axes: tuple[bool, ...], materials: tuple[str, ...], high: float, **config: Any) -> Scene:
    space = Periodicity(((0.0, high),) * len(axes), axes)
    build, s = particles(materials, len(axes), 120, walls=False, **config)
    metadata = replace(build.metadata, bounds=space.bounds, periodic=axes)
    wall = np.random.default_rng(3).uniform(0.0, high, (20, len(axes)))
    boundary = Boundary(wall, np.ones_like(wall), np.eye(len(axes))[np.zeros(20, int)], np.full(20, 0.3), np.zeros(20))
    pos = np.random.default_rng(4).uniform(0.0, high, s.pos.shape)
    return GraphBuilder(build.config, metadata), replace(s, pos=pos, boundary=boundary, periodicity=space)


def periodic_mesh() -> Scene:
    build, s = meshes("lattice")
    space = Periodicity(((0.0, 1.0),) * 2, (True, False))
    pos, rest_pos = (space.wrapped(x + np.array([0.85, 0.0])) for x in (s.pos, s.rest_pos))  # across the seam
    return GraphBuilder(build.config, replace(build.metadata, periodic=space.periodic)), replace(
        s, pos=pos, rest_pos=rest_pos, periodicity=space
    )


def cells(kind: str, materials: tuple[str, ...] = ("elastomer",), shapes: bool = True) -> Scene:
    """Return bodies whose graphs have cells, with an obstacle beside one of them, and with velocities at the frame."""
    build, s = meshes(kind, materials, cells=True)
    corner, dim = s.pos[0], s.pos.shape[1]
    box = Box(tuple(corner - 3.2 * scenes.SPACING), tuple(corner - 0.2 * scenes.SPACING), 0.4)
    boundary = Boundary.sample((*domain_walls(((-1.0, 2.0),) * dim, 0.3), box), scenes.SPACING, dim)
    boundary = boundary if shapes else replace(boundary, shapes=())
    return build, replace(s, boundary=boundary, frame_velocity=1.1 * s.vel)


def moving_walls() -> Scene:
    build, s = particles()
    b, steps = s.boundary, np.arange(4)[:, None, None]
    motion = BoundaryMotion(b.pos + 0.002 * steps, np.full((4, *b.pos.shape), 0.4), np.repeat(b.normal[None], 4, axis=0))
    return build, replace(s, boundary=replace(b, motion=motion).at(1))


def further_parameters() -> Scene:
    build, s = particles(("elastomer", "fluid"))
    names = param_names(("elastomer", "fluid"), ("poisson_ratio",))
    params = np.random.default_rng(5).uniform(0.1, 0.4, (s.num_nodes, len(names)))
    return GraphBuilder(build.config, replace(build.metadata, param_names=names)), replace(s, material_params=params, param_names=names)


def at_another_scale(use: str, **config: Any) -> Scene:
    build, s = particles(scales=use, **config)
    return build.at(0.8 * scenes.SPACING, 0.007), s


def lattice() -> Scene:
    """Return nodes with neighbours exactly at the radius."""
    build, s = particles(num_nodes=100)
    pos = scenes.SPACING * np.stack(np.unravel_index(np.random.default_rng(6).permutation(100), (10, 10)), axis=1) + 0.01
    return replace(build, metadata=replace(build.metadata, connectivity_radius=2 * scenes.SPACING)), replace(s, pos=pos)


def scattered() -> Scene:
    build, s = particles()
    far = s.pos.copy()
    far[::9] *= 1e4
    return build, replace(s, pos=far)


SCENES: dict[str, Callable[[], Scene]] = {
    "particles": particles,
    "particles in 3D": lambda: particles(dim=3, num_nodes=200),
    "materials": lambda: particles(("sand", "snow", "fluid")),
    "one of several materials": one_of_several,
    "no boundary": lambda: particles(walls=False),
    "one node": lambda: particles(num_nodes=1),
    "paper": lambda: particles(features="paper", boundary_condition=False),
    "all boundary nodes": lambda: particles(trim_boundary=False, islands=False),
    "one velocity": lambda: particles(history=1),
    "no mesh": lambda: (particles(("elastomer",))[0], meshes("lattice")[1]),
    "quadrilaterals": lambda: meshes("lattice"),
    "bodies in contact": lambda: meshes("triangles", gap=0.7),
    "tetrahedra": lambda: meshes("tetrahedra"),
    "paper mesh": lambda: meshes("triangles", features="paper"),
    "levels": lambda: meshes("triangles", num_levels=2),
    "no levels": lambda: meshes("triangles", num_levels=0),
    "two kinds of bodies and sand": lambda: meshes("triangles", ("sand", "elastomer", "solid")),
    "periodic": lambda: periodic((True, False), ("sand",), 1.0),
    "periodic materials": lambda: periodic((True, True), ("sand", "fluid"), 1.0),
    "two cells around": lambda: periodic((True, True, False), ("sand",), 0.3),
    "periodic mesh": periodic_mesh,
    "moving walls": moving_walls,
    "cells": lambda: cells("triangles"),
    "cells in 3D": lambda: cells("tetrahedra"),
    "cells of two materials and sand": lambda: cells("lattice", ("sand", "elastomer", "solid")),
    "cells without shapes": lambda: cells("triangles", shapes=False),
    "further parameters": further_parameters,
    "another scale": lambda: at_another_scale("dimensionless"),
    "another scale without features": lambda: at_another_scale("dimensional"),
    "another scale in a paper graph": lambda: at_another_scale("dimensionless", features="paper"),
    "ties": lattice,
    "scattered": scattered,
}


def both(build: GraphBuilder, s: State) -> tuple[Any, Any]:
    """Return the compiled and the plain graph of a state."""
    assert works_on(s)
    with unfused():
        assert not works_on(s)
        plain = build(s)
    return build(s), plain


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("cls", "tolerance"), [(GraphBuilder, 1e-6), (DoubleBuilder, 1e-12)])
def test_compiled_graphs_equal_plain_ones(scene: str, cls: type[GraphBuilder], tolerance: float) -> None:
    build, s = SCENES[scene]()
    compiled, plain = both(cls(build.config, build.metadata), s.to_torch())
    assert [list(store.keys()) for store in compiled.stores] == [list(store.keys()) for store in plain.stores]
    assert [v.dtype for store in compiled.stores for v in store.values()] == [v.dtype for store in plain.stores for v in store.values()]
    assert all(torch.equal(compiled[r].edge_index, plain[r].edge_index) for r in build.spec.relations)
    scenes.assert_equal_graphs(compiled, plain, rtol=tolerance, atol=tolerance)
    assert scene == "one node" or sum(plain[r].edge_index.shape[1] for r in build.spec.relations) > 50


def test_cells_have_walls_and_corners_beside_them() -> None:
    build, s = cells("triangles")
    store = build(s.to_torch())["elastomer"]
    assert len(store.corner) and 0 < int((store.wall[:, :2] != 0).any(dim=1).sum()) < s.num_nodes


def test_what_bodies_have_at_rest_is_found_once() -> None:
    build, s = cells("triangles")
    first, later = build(s.to_torch())["elastomer"], build(replace(s, pos=s.pos + 1e-3).to_torch())["elastomer"]
    assert first.rest_pos is later.rest_pos and first.cell_index is later.cell_index
    other = build(replace(s, rest_pos=1.1 * np.asarray(s.rest_pos)).to_torch())["elastomer"]
    torch.testing.assert_close(other.rest_pos, 1.1 * first.rest_pos)


def simulator(build: GraphBuilder, s: State, clamps: bool = True, **settings: Any) -> LearnedSimulator:
    """Return a simulator with statistics of a graph, whose trained ranges are narrower than the scene."""
    torch.manual_seed(0)
    graph = build(s)
    for m in build.spec.materials:
        graph[m].target = torch.randn(graph[m].num_nodes, build.spec.dim)
    model = GPE(build.spec, **{"num_message_passing_steps": 2, "hidden_channels": 8, **settings})
    made = LearnedSimulator(model, build).eval()
    made.fit_statistics([graph])
    for _, trained in made.trained_ranges():
        if bool(trained.isfinite().all()):
            trained.copy_(trained.mean(dim=0) + 0.25 * (trained - trained.mean(dim=0)))
    made.clamps_parameters = clamps
    return made


def another(s: State) -> State:
    """Return some of the nodes of a state, under other gravity and with fewer walls."""
    rest, b = s.take(np.arange(2 * s.num_nodes // 3)), s.boundary
    walls = {name: getattr(b, name)[::2] for name in ("pos", "vel", "normal", "friction", "restitution")}
    return replace(rest, gravity=1.5 * s.gravity[::-1], boundary=Boundary(**walls))


@pytest.mark.slow
@pytest.mark.parametrize("is_standardized", [False, True])
@pytest.mark.parametrize("scene", [name for name in SCENES if "cells " not in name and name != "cells"])
def test_batches_in_one_pass_are_the_joined_graphs(scene: str, is_standardized: bool) -> None:
    build, s = SCENES[scene]()
    states = [s.to_torch(), another(s).to_torch(), s.take(np.arange(min(2, s.num_nodes))).to_torch()]
    standards = simulator(build, states[0]).standardizer.standards() if is_standardized else None
    topologies = [build.topology(state) for state in states]
    assert joined.covers(topologies, states, build.spec) is all(t.mesh is None for t in topologies)
    expected = batched([build.graph(*pair, standards) for pair in zip(topologies, states, strict=True)])
    scenes.assert_equal_graphs(build.batch(topologies, states, standards), expected)


def test_scenes_with_walls_at_rest_and_moving_walls_are_joined() -> None:
    build, s = moving_walls()
    states = [s.to_torch(), particles()[1].to_torch()]
    topologies = [build.topology(state) for state in states]
    expected = batched([build.graph(*pair) for pair in zip(topologies, states, strict=True)])
    scenes.assert_equal_graphs(build.batch(topologies, states), expected)


def test_scenes_with_rigid_bodies_and_open_scenes_are_joined_with_others() -> None:
    build, s = particles()
    states = [s.to_torch(), replace(s, rigid_body=np.arange(s.num_nodes) // 30).to_torch(), s.opened(()).to_torch()]
    found = [sound(after) for after in simulator(build, states[0]).step_all(states)]
    torch.testing.assert_close(found[0].pos, found[2].pos, rtol=0, atol=1e-9)
    assert float((found[0].pos - found[1].pos).abs().max()) > 1e-6  # bodies move as a whole


@pytest.mark.parametrize("clamps", [True, False])
@pytest.mark.parametrize("scene", ["materials", "one of several materials", "bodies in contact", "further parameters", "paper mesh"])
def test_standardized_graphs_equal_plain_ones_that_are_standardised(scene: str, clamps: bool) -> None:
    build, s = SCENES[scene]()
    s = s.to_torch()
    made = simulator(build, s, clamps)
    standards = made._standards([s])
    assert standards is not None
    with unfused():
        plain = made.standardizer(build(s), True, dict(made.trained_ranges()) if clamps else None)
    scenes.assert_equal_graphs(build.graph(build.topology(s), s, standards), plain, rtol=1e-5, atol=1e-5)


def test_changed_statistics_are_seen() -> None:
    build, s = particles()
    made = simulator(build, s.to_torch())
    sand: Any = made.standardizer.node["sand"]

    def standardized() -> torch.Tensor:
        state = s.to_torch()
        return build.graph(build.topology(state), state, made.standardizer.standards())["sand"].x

    x = [standardized()]
    sand.mean += 1.0
    x.append(standardized())
    made.double()
    x.append(standardized())
    torch.testing.assert_close(x[1], x[0] - (1 / sand.std).float())
    assert x[2].dtype == torch.float64
    torch.testing.assert_close(x[2].float(), x[1])
    for change in (sand.mean.data.add_, sand.mean.numpy().__iadd__):  # PyTorch does not count these
        change(1.0)
        x.append(standardized())
        torch.testing.assert_close(x[-1], x[-2] - 1 / sand.std)
    with torch.inference_mode():
        sand.mean += 1.0
        x.append(standardized())
    torch.testing.assert_close(x[-1], x[-2] - 1 / sand.std)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "settings", "static_friction"),
    [
        ("materials", {"island_momentum": "angular"}, 0.0),
        ("particles", {"decoder": "pair"}, 0.5),
        ("bodies in contact", {"decoder": "contact", "node_norm": "layer"}, 0.0),
        ("periodic", {"island_momentum": "linear"}, 0.0),
        ("moving walls", {}, 0.0),
        ("moving walls", {}, 0.5),
    ],
)
def test_steps_with_compiled_passes_equal_plain_ones(scene: str, settings: dict[str, Any], static_friction: float) -> None:
    build, s = SCENES[scene]()
    first = s.to_torch()
    made = simulator(build, first, **settings)
    made.static_friction = static_friction
    a = b = first
    for _ in range(4):
        a, (c, d) = made.step(a), made.step_all([a, first])
        with unfused():
            b = made.step(b)
        for other in (b, c):
            assert isinstance(other, State)
            torch.testing.assert_close(a.pos, other.pos, rtol=0, atol=1e-6 * scenes.SPACING)
            torch.testing.assert_close(a.velocity_history, other.velocity_history, rtol=1e-5, atol=1e-5)
    assert isinstance(d, State)
    assert a.time == b.time and (a.boundary.motion is None) == (b.boundary.motion is None)
    assert (a.pos - first.pos).abs().max() > 0.01 * scenes.SPACING


def test_stress_is_the_same() -> None:
    build, s = meshes("triangles", ("solid",))
    made = simulator(build, s.to_torch(), stress=True)
    made.stress_std.fill_(1e4)
    compiled = made.step(s.to_torch()).stress
    with unfused():
        plain = made.step(s.to_torch()).stress
    assert compiled is not None and plain is not None
    torch.testing.assert_close(compiled.node, plain.node, rtol=1e-5, atol=1e-2)
    torch.testing.assert_close(compiled.cell, plain.cell, rtol=1e-5, atol=1e-2)
    assert float(compiled.cell.abs().max()) > 10


def test_gradients_of_positions_take_the_plain_path(monkeypatch: pytest.MonkeyPatch) -> None:
    build, s = particles()
    state = s.to_torch()
    made = simulator(build, state)
    monkeypatch.setattr(compiled_graph.compiled_features, "contacts", lambda *_: pytest.fail("compiled"))
    pos = state.pos.requires_grad_()
    (after,) = made.next_states([replace(state, pos=pos)])
    assert isinstance(after, State)
    after.pos.square().sum().backward()
    assert pos.grad is not None and float((pos.grad - 2 * after.pos).abs().max()) > 1e-6
