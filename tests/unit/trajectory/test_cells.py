"""Cells with fewer corners than others: averages over them, and rows that are not cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.learned.approximate import Sleeping
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.models.gpe import GPE
from gpe_pl.rollout.skips import Skips
from gpe_pl.trajectory.cells import bodies, is_corner, mean_over_corners
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.values import faults
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
        ([0, 1, 1, 1], 2, False),
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


@pytest.mark.parametrize(("dim", "cell_dim", "allowed"), [(2, 0, "2"), (2, 3, "2"), (3, 7, "2 or 3")])
def test_dimensions_that_no_cell_has(dim: int, cell_dim: int, allowed: str) -> None:
    arrays: dict[str, np.ndarray] = {
        "pos": np.zeros((3, 8, dim)),
        "node_type": np.zeros(8, np.uint8),
        "cells": np.array([[0, 1, 2]]),
        "cell_dim": np.array([cell_dim], np.uint8),
    }
    (found,) = [str(fault) for fault in faults(arrays, ["elastomer"], ["elastomer"], []) if fault.field == "cell_dim"]
    assert found.endswith(f"is {cell_dim}, must be {allowed} in {dim}D")


def test_bodies_are_the_nodes_that_cells_connect() -> None:
    """Nodes 3, 4 and 6 are in no cell; the triangle among quadrilaterals repeats its last corner."""
    cells = np.array([[0, 5, 2, 1], [5, 10, 2, 2], [7, 8, 9, 9]], np.int32)
    assert [own.tolist() for own in bodies(cells, 12)] == [[0, 1, 2, 5, 10], [7, 8, 9]]
    assert bodies(np.empty((0, 3), np.int32), 4) == []
