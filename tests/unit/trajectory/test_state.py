"""``take``, ``joined`` and ``later`` of states, which follow from the kinds of their fields."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.trajectory.arrays import ArrayError
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.kinds import CELL, GROUP, NODE, PARTS, SCENE, STEP, names_of
from gpe_pl.trajectory.state import State, Stress
from tests import scenes

KINDS = (NODE, GROUP, CELL, SCENE, STEP, PARTS)


@dataclass(frozen=True)
class Warm(State):
    """A state with one further field of each kind, declared and nothing else."""

    temperature: Any = field(default=None, metadata=NODE)
    facets: Any = field(default=None, metadata=CELL)
    wind: float = field(default=0.0, metadata=SCENE)
    num_iterations: int = field(default=0, metadata=STEP)


def warm() -> Any:
    """Two meshed bodies, with a value in every field."""
    s = scenes.mesh_state(history=3)
    assert s.cells is not None
    stress = Stress(np.ones((s.num_nodes, 4)), np.ones((len(s.cells), 4)))
    known = {f.name: getattr(s, f.name) for f in fields(s)} | {"stress": stress, "num_substeps": 7, "internal": "opaque", "time": 2.0}
    known |= {"frame_velocity": 0.5 * s.vel, "node_id": np.arange(s.num_nodes)}
    return Warm(**known, temperature=np.arange(s.num_nodes) + 300.0, facets=s.cells[:, :2], wind=3.0, num_iterations=5)


@pytest.mark.parametrize("part", [State, Boundary])
def test_every_field_has_a_kind(part: type) -> None:
    declared = [name for kind in KINDS for name in names_of(part, kind)]
    assert sorted(declared) == sorted(f.name for f in fields(part))


def test_fields_of_steps_say_that_nothing_is_known_by_default() -> None:
    assert all(f.default is not MISSING for f in fields(State) if f.name in names_of(State, STEP))


@pytest.mark.parametrize("convert", [lambda s: s, lambda s: s.to_torch()], ids=["numpy", "torch"])
@pytest.mark.parametrize("as_mask", [True, False])
def test_some_of_the_nodes(convert: Any, as_mask: bool) -> None:
    state = warm()
    cell = np.unique(state.cells[3])
    rows = np.concatenate([cell, np.setdiff1d(np.arange(20), cell)])
    if as_mask:
        rows = np.sort(rows)
    nodes = np.isin(np.arange(state.num_nodes), rows) if as_mask else rows
    part = convert(state).take(nodes)
    for name in names_of(state, NODE):
        np.testing.assert_array_equal(np.asarray(getattr(part, name)), np.asarray(getattr(state, name))[rows], err_msg=name)
    whole = np.isin(state.cells, rows).all(axis=1)
    assert 3 in np.flatnonzero(whole)
    np.testing.assert_array_equal(rows[np.asarray(part.cells)], state.cells[whole])
    np.testing.assert_array_equal(rows[np.asarray(part.facets)], state.facets[np.isin(state.facets, rows).all(axis=1)])
    assert part.wind == 3.0 and part.time == 2.0
    assert (part.stress, part.num_substeps, part.num_iterations, part.internal) == (None, 0, 0, None)


def test_no_node_at_all() -> None:
    empty = warm().take(np.empty(0, np.int64))
    assert empty.num_nodes == 0 and empty.cells is not None and empty.cells.shape == (0, 3)


@pytest.mark.parametrize("convert", [lambda s: s, lambda s: s.to_torch()], ids=["numpy", "torch"])
def test_parts_joined_again_are_the_whole(convert: Any) -> None:
    state = warm()
    order = np.argsort(state.pos[:, 0])  # the bodies stand side by side
    bodies = np.split(order, [np.flatnonzero(np.diff(state.rest_pos[order, 0]) > 1.2 * scenes.SPACING)[0] + 1])
    again = State.joined([convert(state).take(rows) for rows in bodies])
    whole = convert(state).take(np.concatenate(bodies))
    assert type(again) is Warm and again.wind == 3.0
    for name in names_of(state, NODE):
        np.testing.assert_array_equal(np.asarray(getattr(again, name)), np.asarray(getattr(whole, name)), err_msg=name)
    for name in names_of(state, CELL):
        cells, expected = (sorted(np.asarray(getattr(s, name)).tolist()) for s in (again, whole))
        assert cells == expected, name
        assert len(cells) == len(getattr(state, name)), name
    assert (again.stress, again.num_substeps, again.num_iterations, again.internal) == (None, 0, 0, None)


def test_states_with_different_fields_are_not_joined() -> None:
    state = warm()
    with pytest.raises(ArrayError, match="rest_pos: state 1 has none, others have"):
        State.joined([state, replace(state, rest_pos=None)])


@pytest.mark.parametrize("convert", [lambda s: s, lambda s: s.to_torch()], ids=["numpy", "torch"])
def test_one_frame_later(convert: Any) -> None:
    state = convert(warm())
    periodicity = Periodicity(((0.0, 1.0),) * 2, (True, False))
    vel = 2.0 * state.vel
    after = replace(state, periodicity=periodicity).later(0.5, state.pos + 1.0, vel, num_substeps=4)
    assert after.time == 2.5 and after.num_substeps == 4 and after.wind == 3.0
    np.testing.assert_allclose(np.asarray(after.pos), np.asarray(state.pos) + np.array([0.0, 1.0]), atol=1e-12)
    np.testing.assert_array_equal(np.asarray(after.velocity_history[:, :-1]), np.asarray(state.velocity_history[:, 1:]))
    np.testing.assert_array_equal(np.asarray(after.velocity_history[:, -1]), np.asarray(vel))
    for name in {*names_of(state, NODE), *names_of(state, CELL)} - {"pos", "vel", "velocity_history", "frame_velocity"}:
        assert getattr(after, name) is getattr(state, name), name
    assert (after.stress, after.num_iterations, after.internal, after.frame_velocity) == (None, 0, None, None)
    assert replace(state, velocity_history=None).later(0.5, state.pos, vel).velocity_history is None
    assert state.later(0.5, state.pos, vel, velocity_history=None).velocity_history is None


def test_a_moving_boundary_moves_on() -> None:
    pos = np.array([[[0.0, 0.0]], [[0.0, 0.1]], [[0.0, 0.3]]])
    state = replace(warm(), boundary=Boundary.moving(pos, np.array([[0.0, 1.0]]), 0.1))
    for frame in (1, 2):
        state = state.later(0.1, state.pos, state.vel)
        np.testing.assert_allclose(state.boundary.pos, pos[frame])


@pytest.mark.parametrize("convert", [lambda s: s, lambda s: s.to_torch()], ids=["numpy", "torch"])
def test_a_corrected_state_is_of_the_same_instant(convert: Any) -> None:
    state = convert(warm())
    before = np.asarray(state.velocity_history).copy()
    after = state.corrected(state.pos + 1.0, 3.0 * state.vel)
    assert after.time == state.time and after.internal == state.internal and after.num_substeps == 7
    np.testing.assert_array_equal(np.asarray(after.velocity_history[:, -1]), 3.0 * np.asarray(state.vel))
    np.testing.assert_allclose(np.asarray(after.frame_velocity), np.asarray(state.frame_velocity) + 2.0 * np.asarray(state.vel))
    np.testing.assert_array_equal(np.asarray(after.velocity_history[:, :-1]), before[:, :-1])
    np.testing.assert_array_equal(np.asarray(state.velocity_history), before)


def test_tensors_of_every_array() -> None:
    state = warm().to_torch()
    assert isinstance(state, Warm) and state.stress is not None and state.internal is None
    held = {f.name: getattr(state, f.name) for f in fields(state)} | vars(state.stress)
    assert not [name for name, value in held.items() if isinstance(value, np.ndarray)]
    for name in (*names_of(Warm, NODE), "gravity", "cell"):
        assert held[name].dtype == (torch.int64 if name in ("node_type", "node_id") else torch.float64), name
    assert all(getattr(state.boundary, name).dtype == torch.float64 for name in names_of(Boundary, NODE))


def test_some_nodes_of_a_boundary_take_their_motion_along() -> None:
    pos = np.random.default_rng(0).uniform(size=(3, 5, 2))
    boundary = Boundary.moving(pos, np.tile([0.0, 1.0], (5, 1)), 0.1, friction=np.arange(5.0))
    part = boundary.take(np.array([4, 1]))
    assert part.friction.tolist() == [4.0, 1.0] and part.motion is not None and boundary.motion is not None
    for name in ("pos", "vel", "normal"):
        np.testing.assert_array_equal(getattr(part.motion, name), getattr(boundary.motion, name)[:, [4, 1]])
        np.testing.assert_array_equal(getattr(part, name), getattr(boundary, name)[[4, 1]])
