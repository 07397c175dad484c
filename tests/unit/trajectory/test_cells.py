"""Cells with fewer corners than others: averages over them, and rows that are not cells."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.graphs.builder import GraphBuilder, GraphError
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.approximate import Sleeping
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.deformation import strain_energy
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.skips import Skips
from gpe_pl.schema import CELL_KINDS
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.cells import bodies, cell_edges, is_corner, kinds_of, mean_over_corners
from gpe_pl.trajectory.cells_at_rest import suspects
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.store import read_trajectory, write_shard
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.trajectory.values import faults
from gpe_pl.viz.panel import drawn_faces
from tests import scenes

MIXED = np.array([[0, 1, 2, 3], [1, 4, 5, 5]])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_a_mean_counts_every_corner_once(kind: Callable[[np.ndarray], Any]) -> None:
    values = np.arange(12.0).reshape(6, 2) ** 2
    expected = [values[[0, 1, 2, 3]].mean(axis=0), values[[1, 4, 5]].mean(axis=0)]
    np.testing.assert_allclose(mean_over_corners(kind(values), kind(MIXED)), expected)
    np.testing.assert_allclose(mean_over_corners(kind(values[:, 0]), kind(MIXED)), [e[0] for e in expected])
    assert is_corner(kind(MIXED)).tolist() == [[True] * 4, [True] * 3 + [False]]


def padded(state: State) -> State:
    """Return the triangles in the form in which they are stored beside quadrilaterals."""
    assert state.cells is not None
    return replace(state, cells=torch.cat([state.cells, state.cells[:, -1:]], dim=1))


@pytest.mark.parametrize("asleep", [False, True])
def test_predicted_stress_does_not_depend_on_how_cells_are_stored(asleep: bool) -> None:
    build = scenes.builder(("solid",), mesh=True)
    torch.manual_seed(0)
    learned = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8, stress=True), build).eval()
    learned.skips = Skips(sleep_after=1)
    simulator = Sleeping(learned) if asleep else learned
    state = scenes.mesh_state("triangles", ("solid",)).to_torch()
    with torch.no_grad():
        plain, wide = (simulator.step(s).stress for s in (state, padded(state)))
    assert plain is not None and wide is not None
    torch.testing.assert_close(wide.cell, plain.cell, rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("cell", "dim", "is_sound"),
    [
        ([0, 1, 2, 3], 2, True),
        ([0, 1, 2, 2], 2, True),
        ([0, 1, 2, 2], 3, True),
        ([0, 1, 0, 2], 2, False),
        ([0, 1, 1, 2], 2, False),
        ([0, 0, 1, 2], 2, False),
        ([0, 1, 1, 2, 3, 3, 3, 3], 3, False),
        ([0, 1, 2, 3, 3, 3, 3, 3], 3, True),
        ([0, 1, 1, 1], 2, True),
        ([0, 0, 0, 0], 2, False),
        ([0, 1, 2, 3, 4, 5], 3, True),
        ([0, 1, 2, 3, 4, 5, 5, 5], 3, True),
        ([0, 1, 2, 3, 4, 5], 2, False),
        ([0, 1, 2, 3, 4], 2, False),
        ([0, 1, 2, 3, 4, 5, 6, 7], 2, False),
        ([0, 1, 2, 3, 4, 5, 6, 7], 3, True),
    ],
)
def test_a_stored_row_that_is_no_cell_is_a_fault(cell: list[int], dim: int, is_sound: bool) -> None:
    arrays: dict[str, np.ndarray] = {"pos": np.zeros((3, 8, dim)), "node_type": np.zeros(8, np.uint8), "cells": np.array([cell])}
    found = [fault for fault in faults(arrays, ["elastomer"], ["elastomer"], []) if fault.field == "cells"]
    assert bool(found) != is_sound
    assert all("triangle" in str(fault) and str(cell) in str(fault) for fault in found)


@pytest.mark.parametrize(("dim", "cell_dim", "allowed"), [(2, 0, "1 or 2"), (2, 3, "1 or 2"), (3, 7, "1, 2 or 3")])
def test_dimensions_that_no_cell_has(dim: int, cell_dim: int, allowed: str) -> None:
    arrays: dict[str, np.ndarray] = {
        "pos": np.zeros((3, 8, dim)),
        "node_type": np.zeros(8, np.uint8),
        "cells": np.array([[0, 1, 2]]),
        "cell_dim": np.array([cell_dim], np.uint8),
    }
    (found,) = [str(fault) for fault in faults(arrays, ["elastomer"], ["elastomer"], []) if fault.field == "cell_dim"]
    assert found.endswith(f"is {cell_dim}, must be {allowed} in {dim}D")


def mixed() -> Trajectory:
    """Return two bodies of all kinds of cells in space but quadrilaterals, which move."""
    random = np.random.default_rng(0)
    start = random.uniform(0.2, 0.8, (20, 3))
    start[:11] = 0.2 + 0.3 * np.concatenate([CORNERS["hexahedron"], [[1.5, 0.5, 0], [1.5, 0.5, 1], [1.5, 1.5, 0.5]]])
    pos = start + np.cumsum(random.normal(scale=1e-3, size=(8, 20, 3)), axis=0)
    kinds = {
        "hexahedron": [[0, 1, 2, 3, 4, 5, 6, 7]],
        "wedge": [[1, 2, 8, 5, 6, 9]],
        "tetrahedron": [[2, 8, 6, 10]],
        "triangle": [[11, 12, 13]],
        "line": [[13, 14], [8, 15]],
    }
    return Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, spacing=0.1, cells=kinds, bounds=((0.0, 1.0),) * 3)


def test_a_mesh_of_many_kinds_is_stored_and_connected(tmp_path: Path) -> None:
    write_shard(tmp_path / "a.h5", [mixed()])
    found = read_trajectory(tmp_path / "a.h5", "00000", verify=True)
    assert found.cell_dim == 3 and found.cells is not None
    names = [list(CELL_KINDS)[k] for k in kinds_of(found.cells, 3, 3)]
    assert names == ["hexahedron", "wedge", "tetrahedron", "triangle", "line", "line"]
    edges = {tuple(edge) for edge in cell_edges(found.cells.astype(np.int64), 20).T.tolist()}
    assert {(13, 14), (8, 15), (2, 10)} <= edges and (14, 15) not in edges and (0, 8) not in edges
    assert [own.tolist() for own in bodies(found.cells, 20)] == [[*range(11), 15], [11, 12, 13, 14]]
    assert strain_energy(found) is None


def test_a_model_moves_a_mesh_of_many_kinds() -> None:
    whole = mixed()
    build = GraphBuilder(GraphConfig(history=2, mesh=True, islands=True), whole.metadata)
    simulator = LearnedSimulator(GPE(build.spec, num_message_passing_steps=1, hidden_channels=8), build).eval()
    state = simulator.initial_state(whole, 2)
    assert torch.isfinite(simulator.step(state).pos).all()
    cells = GraphBuilder(GraphConfig(history=2, mesh=True, islands=True, cells=True), whole.metadata)
    with pytest.raises(GraphError, match="needs tetrahedra or hexahedra, this mesh mixes them or has others"):
        cells(state)
    wedges = replace(state, cells=state.cells[1:2, :6])  # type: ignore[index]
    with pytest.raises(GraphError, match="needs tetrahedra or hexahedra, this mesh mixes them or has others"):
        cells(wedges)


def test_pictures_show_outer_faces_of_volumes_and_all_other_cells() -> None:
    faces, of_cell = drawn_faces(mixed())
    shown = {(cell, frozenset(face.tolist())) for face, cell in zip(faces, of_cell, strict=True)}
    assert (1, frozenset({1, 2, 6, 5})) not in shown and (0, frozenset({1, 2, 6, 5})) not in shown  # between hexahedron and wedge
    assert (1, frozenset({1, 2, 8})) in shown and (2, frozenset({2, 8, 10})) in shown
    assert (3, frozenset({11, 12, 13})) in shown and (4, frozenset({13, 14})) in shown


def test_bodies_are_the_nodes_that_cells_connect() -> None:
    """Nodes 3, 4 and 6 are in no cell; the triangle among quadrilaterals repeats its last corner."""
    cells = np.array([[0, 5, 2, 1], [5, 10, 2, 2], [7, 8, 9, 9]], np.int32)
    assert [own.tolist() for own in bodies(cells, 12)] == [[0, 1, 2, 5, 10], [7, 8, 9]]
    assert bodies(np.empty((0, 3), np.int32), 4) == []


def mesh_of(cells: np.ndarray, **changes: Any) -> Trajectory:
    """Return a mesh of quadrilaterals on a lattice of 3 × 3 nodes, with a node in no cell after them."""
    rest = 0.1 * np.concatenate([np.stack(np.meshgrid(np.arange(3), np.arange(3), indexing="ij"), axis=-1).reshape(-1, 2), [[8, 8]]])
    pos = rest + 1e-3 * np.random.default_rng(0).normal(size=(5, *rest.shape))
    return Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, cells=cells, **changes)


QUADRILATERALS = np.array([[0, 3, 4, 1], [1, 4, 5, 2], [3, 6, 7, 4], [4, 7, 8, 5]])


def test_cells_counted_from_1_beside_a_loose_node_are_refused() -> None:
    mesh_of(QUADRILATERALS)
    with pytest.raises(
        ArrayError, match=r"cells: node 0 is in no cell, and the nodes of cell 0, \[1, 4, 5, 2\], .* counted from 1; subtract 1"
    ):
        mesh_of(QUADRILATERALS + 1)


def test_a_loose_first_node_is_no_fault() -> None:
    without_corner = QUADRILATERALS[1:]
    assert without_corner.min() == 1
    mesh_of(without_corner)


def test_rest_positions_far_from_0_and_from_all_positions_keep_their_shape() -> None:
    near, far = mesh_of(QUADRILATERALS), np.array([500000.3, 4649776.2])
    assert near.rest_pos is not None
    rest = mesh_of(QUADRILATERALS, rest_pos=near.rest_pos + far).rest_pos
    assert rest is not None and np.abs(rest).max() < 2
    np.testing.assert_allclose(np.diff(rest.astype(np.float32), axis=0), np.diff(near.rest_pos, axis=0), atol=1e-6)


def test_rest_positions_in_periodic_domains_move_by_whole_periods() -> None:
    near, space = mesh_of(QUADRILATERALS), {"bounds": [[-0.3, 0.9], [-0.3, 0.9]], "periodic": [True, False]}
    assert near.rest_pos is not None
    rest = mesh_of(QUADRILATERALS, rest_pos=near.rest_pos + np.array([1.2 * 10**6, 0]), **space).rest_pos
    assert rest is not None
    np.testing.assert_allclose(rest, near.rest_pos, atol=1e-8)


@pytest.mark.parametrize("offset", [0.4, 500000.3])
def test_rest_positions_in_the_coordinates_of_the_positions_keep_these(offset: float) -> None:
    near = mesh_of(QUADRILATERALS)
    assert near.rest_pos is not None
    rest = near.rest_pos + offset
    there = Trajectory.from_numpy(near.pos + offset, 0.01, "elastomer", {"elastomer": 1e5}, cells=QUADRILATERALS, rest_pos=rest)
    np.testing.assert_array_equal(there.rest_pos, rest)


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
UP = np.array([0, 0, 1])
CORNERS = {
    "quadrilateral": SQUARE,
    "wedge": np.concatenate([SQUARE[:3], SQUARE[:3] + UP]),
    "hexahedron": np.concatenate([SQUARE, SQUARE + UP]),
    "tetrahedron": np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float),
    "triangle": SQUARE[:3],
}


def single(kind: str, order: list[int], dim: int, stretch: float = 1.0, **space: Any) -> Trajectory:
    """Return a trajectory of two cells of a kind, the second with another order of its corners; all of them are turned and sheared."""
    shear = np.random.default_rng(1).normal(size=(dim, dim)) * 0.2 + np.eye(dim) * 0.1
    corners = CORNERS[kind][:, :dim] @ shear
    rest = np.concatenate([corners, corners + 0.5])
    rest[:, 0] *= stretch
    pos = rest + 1e-3 * np.random.default_rng(0).normal(size=(5, *rest.shape))
    cells = {kind: np.stack([np.arange(len(corners)), len(corners) + np.array(order)])}
    return Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, cells=cells, rest_pos=rest, spacing=0.1, **space)


@pytest.mark.parametrize(
    ("kind", "dim", "order"),
    [
        ("quadrilateral", 2, [0, 1, 3, 2]),
        ("quadrilateral", 3, [0, 1, 3, 2]),
        ("quadrilateral", 2, [0, 2, 1, 3]),
        ("wedge", 3, [0, 1, 2, 3, 5, 4]),
        ("hexahedron", 3, [0, 1, 3, 2, 4, 5, 7, 6]),
        ("hexahedron", 3, [0, 1, 2, 3, 7, 6, 5, 4]),
        ("hexahedron", 3, [0, 1, 2, 3, 4, 5, 7, 6]),
    ],
)
def test_tangled_cells_are_refused(kind: str, dim: int, order: list[int]) -> None:
    with pytest.raises(ArrayError, match=f"cells: {kind} 1 with the corners .* is tangled: .* corners must run in VTK's order"):
        single(kind, order, dim)


@pytest.mark.parametrize(
    ("kind", "dim", "order"),
    [
        ("triangle", 2, [0, 2, 1]),
        ("triangle", 3, [0, 2, 1]),
        ("tetrahedron", 3, [0, 2, 1, 3]),
        ("quadrilateral", 2, [0, 3, 2, 1]),
        ("quadrilateral", 3, [1, 2, 3, 0]),
        ("wedge", 3, [3, 4, 5, 0, 1, 2]),
        ("hexahedron", 3, [4, 5, 6, 7, 0, 1, 2, 3]),
    ],
)
@pytest.mark.parametrize("stretch", [1.0, 1e-3])
def test_cells_of_either_orientation_are_sound(kind: str, dim: int, order: list[int], stretch: float) -> None:
    """Thin cells, too."""
    trajectory = single(kind, order, dim, stretch)
    assert trajectory.cells is not None and trajectory.rest_pos is not None
    assert [*suspects(trajectory.cells, trajectory.cell_dim, trajectory.rest_pos, trajectory.metadata.periodicity)] == []


def test_cells_across_a_seam_are_not_tangled() -> None:
    space: dict[str, Any] = {"bounds": [[0, 0.25], [0, 0.9]], "periodic": [True, False], "connectivity_radius": 0.11}
    lattice = mesh_of(QUADRILATERALS)
    assert lattice.rest_pos is not None
    pos, rest = np.mod(lattice.pos, [0.25, 0.9]), np.mod(lattice.rest_pos, [0.25, 0.9])
    across = np.array([[6, 0, 1, 7]])  # from 0.2 to 0.25, the image of 0
    for cells, sound in ((across, True), (across[:, [0, 1, 3, 2]], False)):
        with contextlib.nullcontext() if sound else pytest.raises(ArrayError, match="tangled"):
            Trajectory.from_numpy(pos, 0.01, "elastomer", {"elastomer": 1e5}, cells=cells, rest_pos=rest, spacing=0.1, **space)


@pytest.mark.parametrize("offset", [0.0, 500000.25])
def test_cells_without_volume_and_cells_that_occur_twice_are_suspects(offset: float) -> None:
    """The three nodes of a row are in one line. A cell is the same one whichever corner comes first."""
    trajectory = mesh_of(QUADRILATERALS[:, :3])
    assert trajectory.cells is not None and trajectory.rest_pos is not None
    cells = np.concatenate([trajectory.cells, [[0, 1, 2], [4, 1, 0]], trajectory.cells[2:3]])
    rest, space = trajectory.rest_pos.round(1) + offset, trajectory.metadata.periodicity
    flat, twice = suspects(cells, 2, rest, space)
    assert flat == "1 cells have no volume at rest, the first is cell 4: are corners in one line or plane?"
    assert twice.startswith("1 cells have the corners of another cell, the first is cell 6")
