"""Mirror symmetry of scenes, of rollouts and of simulators."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from gpe_pl.geometry.shapes import Box, domain_walls
from gpe_pl.metrics import rollout_metrics
from gpe_pl.metrics.mirror import equivariance_error, mirrors
from gpe_pl.rollout.baselines import ConstantVelocity
from gpe_pl.rollout.loop import Simulator, rollout
from gpe_pl.rollout.mirrored import Mirrored
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Trajectory

DT = 0.05


def beam(dim: int = 2, **changes: object) -> Trajectory:
    """A lattice of particles, not in the middle of the domain, that falls level onto the floor; nodes are in random order."""
    axes = [np.arange(5), *[np.arange(3)] * (dim - 2), np.arange(2)]
    rest = 0.05 * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    rest = rest[np.random.default_rng(0).permutation(len(rest))] + ([0.3] * (dim - 1) + [0.4])
    down = np.eye(dim)[-1] * -1.0
    pos = rest + DT * np.arange(6)[:, None, None] * down
    bounds = ((0.0, 1.0),) * dim
    values: dict[str, object] = {"gravity": 9.81 * down, "boundary": Boundary.sample(domain_walls(bounds, 0.3), 0.05, dim), **changes}
    return Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, bounds=bounds, spacing=0.05, **values)  # type: ignore[arg-type]


def test_a_level_beam_is_symmetric_about_its_middle() -> None:
    (mirror,) = mirrors(beam())
    assert mirror.axis == 0 and mirror.offset == pytest.approx(0.4)
    truth = beam()
    np.testing.assert_allclose(mirror.image(truth.pos[0].astype(float))[mirror.partner], truth.pos[0], atol=1e-7)
    assert [m.axis for m in mirrors(beam(3))] == [0, 1]


def clamped(t: Trajectory, ends: str = "left", moves: float = 0.0, pulls: str = "") -> Trajectory:
    """Hold the nodes at ends of the beam, at rest or with the right end moving outwards, and pull at ends."""
    x = t.pos[0, :, 0]
    end = {"left": x < x.min() + 1e-3, "right": x > x.max() - 1e-3}
    held = np.any([end[name] for name in ends.split()], axis=0)[:, None] & np.ones(2, bool)
    pos = np.where(held, t.pos[:1], t.pos)
    pos[:, end["right"], 0] += moves * np.arange(len(pos))[:, None]
    force = np.zeros_like(pos)
    for name in pulls.split():
        force[:, end[name], 0] = 1.0 if name == "right" else -1.0
    return replace(t, pos=pos, prescribed=held, force=force if pulls else None)


@pytest.mark.parametrize("case", [{"ends": "left right"}, {"ends": "left right", "pulls": "left right"}])
def test_clamps_and_forces_may_be_symmetric(case: dict[str, Any]) -> None:
    assert len(mirrors(clamped(beam(), **case))) == 1


@pytest.mark.parametrize("case", [{}, {"ends": "left right", "moves": 0.01}, {"ends": "left right", "pulls": "left"}])
def test_clamps_and_forces_on_one_side_leave_no_symmetry(case: dict[str, Any]) -> None:
    assert mirrors(clamped(beam(), **case)) == []


def spun(t: Trajectory) -> Trajectory:
    return replace(t, vel=t.vel + np.float32(0.5) * (t.pos[:, :, ::-1] - t.pos.mean()))


def displaced(t: Trajectory) -> Trajectory:
    pos = t.pos.copy()
    pos[:, 3, 0] += 0.01
    return replace(t, pos=pos)


def heavier(t: Trajectory) -> Trajectory:
    return replace(t, mass=np.where(np.arange(t.num_nodes) == 3, 2.0, 1.0).astype(np.float32))


def with_box(t: Trajectory) -> Trajectory:
    shapes = (*t.boundary.shapes, Box((0.55, 0.0), (0.7, 0.2), 0.3))
    return replace(t, boundary=Boundary.sample(shapes, 0.05, 2))


def tilted_gravity(t: Trajectory) -> Trajectory:
    return replace(t, metadata=replace(t.metadata, gravity=(1.0, -9.0)))


def periodic(t: Trajectory) -> Trajectory:
    return replace(t, metadata=replace(t.metadata, periodic=(True, False)))


def nodes_only(t: Trajectory) -> Trajectory:
    return replace(t, boundary=replace(t.boundary, shapes=()))


def rougher_on_the_right(t: Trajectory) -> Trajectory:
    """The floor is two boxes that meet below the middle of the beam."""
    boxes = (Box((0.0, 0.0), (0.4, 0.2), 0.3), Box((0.4, 0.0), (1.0, 0.2), 0.8))
    return replace(t, boundary=Boundary.sample((*t.boundary.shapes, *boxes), 0.05, 2))


def nodes_beside_shapes(t: Trajectory) -> Trajectory:
    own = t.boundary
    pos, normal = np.concatenate([own.pos, [[0.5, 0.3]]]), np.concatenate([own.normal, [[0.0, 1.0]]])
    return replace(t, boundary=Boundary.from_numpy(pos, normal, friction=0.3, shapes=own.shapes))


@pytest.mark.parametrize(
    "change", [spun, displaced, heavier, with_box, tilted_gravity, periodic, nodes_only, rougher_on_the_right, nodes_beside_shapes]
)
def test_scenes_without_symmetry(change: Callable[[Trajectory], Trajectory]) -> None:
    assert mirrors(change(beam())) == []


def pair_of_triangles(stretch: float = 1.0, bodies: list[int] | None = None, turn: float = 0.0) -> Trajectory:
    """Two triangles on both sides of x = 0.5, the right one of another size or direction at rest; or loose nodes and rigid bodies at their places."""
    pos = np.array([[0.2, 0.5], [0.3, 0.5], [0.2, 0.6], [0.8, 0.5], [0.7, 0.5], [0.8, 0.6]])
    frames, about = np.repeat(pos[None], 4, axis=0), {"bounds": [(0, 1)] * 2, "spacing": 0.1, "gravity": [0, -9.81]}
    if bodies is not None:
        return Trajectory.from_numpy(frames, DT, "sand", {"sand": 30.0}, rigid_body=bodies, **about)  # type: ignore[arg-type]
    rest, cells = pos.copy(), np.array([[0, 1, 2], [3, 4, 5]])
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    rest[3:] = (rest[3:] - rest[3]) / stretch @ turned + rest[3]
    law = {"elastomer": {"youngs_modulus": 1e5, "poisson_ratio": 0.3}}
    return Trajectory.from_numpy(frames, DT, "elastomer", law, cells=cells, rest_pos=rest, mass=1.0, **about)  # type: ignore[arg-type]


def test_meshes_and_rigid_bodies_may_be_symmetric() -> None:
    for scene in (pair_of_triangles(), pair_of_triangles(turn=0.7), pair_of_triangles(bodies=[7, 7, 7, 2, 2, 2])):
        assert [mirror.axis for mirror in mirrors(scene)] == [0]


@pytest.mark.parametrize("bodies", [[0, 0, 0, -1, -1, -1], [0, 0, 0, 1, 1, 2], [0, 0, 1, 1, 1, 1]])
def test_rigid_bodies_on_one_side_leave_no_symmetry(bodies: list[int]) -> None:
    assert mirrors(pair_of_triangles(bodies=bodies)) == []


def test_meshes_of_another_rest_shape_or_on_one_side_leave_no_symmetry() -> None:
    scene = pair_of_triangles()
    assert mirrors(pair_of_triangles(stretch=2.0)) == []
    assert mirrors(replace(scene, cells=scene.cells[:1])) == []  # type: ignore[index]


def test_floors_of_equal_friction_on_both_sides_are_symmetric() -> None:
    boxes = (Box((0.0, 0.0), (0.4, 0.2), 0.3), Box((0.4, 0.0), (1.0, 0.2), 0.3))
    t = beam()
    assert [m.axis for m in mirrors(replace(t, boundary=Boundary.sample((*t.boundary.shapes, *boxes), 0.05, 2)))] == [0]


def test_the_mirror_error_of_a_beam_that_drifts_and_tilts() -> None:
    """A drift d per frame is seen twice, by the prediction and by its image; what is symmetric is not seen."""
    truth, frames = beam(), np.arange(6)[:, None]
    pos = truth.pos.astype(float)
    pos[..., 0] += 0.01 * frames
    pos[..., 1] *= 0.9
    pos[0] = truth.pos[0]
    found = {(r.metric, r.horizon): r.value for r in rollout_metrics(replace(truth, pos=pos), truth, ("full",))}
    assert found["mirror_error", "full"] == pytest.approx(2 * 0.01 / DT)
    assert [r.value for r in rollout_metrics(truth, truth, ("full",)) if r.metric == "mirror_error"] == pytest.approx([0], abs=1e-5)
    assert "mirror_error" not in {r.metric for r in rollout_metrics(displaced(truth), displaced(truth), ("full",))}


@dataclass(frozen=True)
class Wind:
    """Blows every node along x, and has a stress with a shear."""

    speed: float

    def step(self, state: State) -> State:
        blown = state.vel + self.speed * np.eye(state.dim)[0]
        components = 4 if state.dim == 2 else 6
        stress = Stress(np.tile(np.arange(1.0, components + 1), (state.num_nodes, 1)), np.empty((0, components)))
        return state.later(DT, state.pos + DT * blown, blown, stress=stress)


@dataclass(frozen=True)
class Attraction:
    """Draws every node towards the centre of the boundary nodes."""

    def step(self, state: State) -> State:
        vel = 0.1 / DT * (state.boundary.pos.mean(axis=0) - state.pos)
        return state.later(DT, state.pos + DT * vel, vel)


def rolled_out(simulator: Simulator, dim: int = 2) -> Trajectory:
    truth = beam(dim)
    return rollout(simulator, truth.state(0), 4, truth.metadata)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("simulator", [ConstantVelocity(DT), Attraction()])
def test_a_simulator_without_left_and_right_is_equivariant(simulator: Simulator, dim: int) -> None:
    assert equivariance_error(rolled_out(simulator, dim), rolled_out(Mirrored(simulator, 0, 0.7), dim)) < 1e-6


def test_a_simulator_with_wind_is_not() -> None:
    """Wind that blows to the right blows the image to the left."""
    one, other = rolled_out(Wind(0.3)), rolled_out(Mirrored(Wind(0.3), 0, 0.7))
    steps = DT * 0.3 * np.cumsum(np.arange(1, 5))
    np.testing.assert_allclose((one.pos - other.pos)[1:, :, 0], np.broadcast_to(2 * steps[:, None], (4, one.num_nodes)), atol=1e-6)
    np.testing.assert_allclose(one.pos[..., 1], other.pos[..., 1], atol=1e-6)
    assert equivariance_error(one, other) == pytest.approx(2 * np.linalg.norm(one.pos[1:, 0, 0] - one.pos[0, 0, 0]) / _moved(one), rel=1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_shears_with_the_mirrored_axis_change_sign(dim: int) -> None:
    after = Mirrored(Wind(0.3), 0, 0.7).step(beam(dim).state(0))
    assert after.stress is not None
    expected = [1, -2, 3, 4] if dim == 2 else [1, -2, -3, 4, 5, 6]
    np.testing.assert_allclose(after.stress.node, np.tile(expected, (after.num_nodes, 1)))


def _moved(trajectory: Trajectory) -> float:
    return float(np.sqrt(((trajectory.pos - trajectory.pos[0]) ** 2).sum() / trajectory.num_nodes))


def test_a_rollout_that_stops_on_one_side_only_is_infinitely_wrong() -> None:
    one = rolled_out(ConstantVelocity(DT))
    assert equivariance_error(one, one.frames(0, 3)) == math.inf


def test_the_way_of_a_node_around_a_periodic_domain_is_not_folded() -> None:
    way = np.array([0.2, 0.0]) * np.arange(6)[:, None, None] + np.array([[0.1, 0.5], [0.15, 0.5]])
    one, other = (
        Trajectory.from_numpy(pos, DT, "sand", {"sand": 30.0}, bounds=((0.0, 1.0), (0.0, 1.0)), periodic=(True, False), spacing=0.05)
        for pos in (way, way + 0.001 * np.arange(6)[:, None, None] * np.array([0.0, 1.0]))
    )
    assert equivariance_error(one, other) == pytest.approx(0.001 / 0.2, rel=1e-3)
