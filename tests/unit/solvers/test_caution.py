"""Warnings of scenes and parameters that solvers do not resolve."""

from dataclasses import replace

import numpy as np
import pytest

from gpe_pl.solvers.caution import thin_nodes, unresolved
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.flip import FLIP
from gpe_pl.solvers.mpm import MPM
from tests.particles import block

BOX = ((0.0, 1.0), (0.0, 1.0))


def strip(length, width):
    """Return quadrilaterals [cell, 4] of a strip and the number of its nodes."""
    number = np.arange((length + 1) * (width + 1)).reshape(length + 1, width + 1)
    return np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4), number.size


def triangles(quads):
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


@pytest.mark.parametrize("divide", [lambda cells: cells, triangles], ids=["quads", "triangles"])
def test_thin_is_what_has_fewer_than_four_cells_across(divide):
    for width, is_thin in ((1, True), (2, True), (3, True), (4, False), (6, False)):
        cells, count = strip(20, width)
        assert np.mean(thin_nodes(divide(cells), count, 2)) == (1.0 if is_thin else pytest.approx(0.0, abs=0.08)), width


def test_only_the_thin_part_of_a_body_is_thin():
    """A square of eight cells with a handle of two."""
    square, _ = strip(8, 8)
    handle, count = strip(10, 2)
    number = np.arange(count) + 81
    number[:3] = [8 * 9 + 3, 8 * 9 + 4, 8 * 9 + 5]  # it begins at the middle of a side
    cells = np.concatenate([square, number[handle]])
    _, cells = np.unique(cells, return_inverse=True)
    thin = thin_nodes(cells.reshape(-1, 4), int(cells.max()) + 1, 2)
    assert not thin[:81].any() and thin[81:].mean() > 0.8


def test_tetrahedra_are_thin_where_few():
    """One has no node inside."""
    assert thin_nodes(np.arange(4)[None], 4, 3).all()


def test_a_thin_mesh_and_a_thin_liquid_are_named():
    cells, count = strip(20, 2)
    pos = np.random.default_rng(0).random((count, 2))
    mesh = replace(block((0.2, 0.2), (0.2, 0.2), 0.1, "elastomer"), pos=pos, rest_pos=pos, cells=cells)
    cells, count = strip(8, 8)
    pos = np.random.default_rng(0).random((count, 2))
    thick = replace(block((0.2, 0.2), (0.3, 0.3), 0.1, "elastomer"), pos=pos, rest_pos=pos, cells=cells)
    (said,) = unresolved(FEM(bounds=BOX), {"solid": (1e6,)}, [thick, mesh])
    assert "in 1 of the first 2 scenes, up to 100 % of the nodes lie where the mesh has fewer than 4 cells across" in said
    assert not [*unresolved(FEM(bounds=BOX), {"solid": (1e6,)}, [thick])]
    liquid = FLIP(bounds=BOX, grid_spacing=0.1)
    (said,) = unresolved(liquid, {"fluid": (2e-3, 1e-2)}, [])
    assert said.startswith("kinematic_viscosity = 0.002 m^2/s is below 0.00855 m^2/s")
    assert not [*unresolved(liquid, {"fluid": (1e-2,)}, [])]


@pytest.mark.parametrize("solver", [FLIP(bounds=BOX, grid_spacing=0.1), MPM(bounds=BOX, grid_spacing=0.1, materials=("snow", "fluid"))])
def test_a_viscosity_below_the_grids_own_is_named_for_every_solver_of_liquids(solver):
    own = solver.numerical_viscosity
    (said,) = unresolved(solver, {"fluid": (0.5 * own, 2 * own)}, [])
    assert f"below {own:.3g} m^2/s, which the grid of the solver {solver.name} adds" in said
    assert not [*unresolved(solver, {"fluid": (2 * own,)}, [])]


def test_sand_alone_has_no_viscosity_to_resolve():
    assert not [*unresolved(MPM(bounds=BOX, grid_spacing=0.1, materials=("sand",)), {"sand": (30.0,)}, [])]
