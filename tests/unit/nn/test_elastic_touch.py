"""Forces between the nodes of different bodies: their form, momentum, stability, and what the layer learns."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gpe_pl.nn.elastic_motion import Cells, Walls, elastic_motion
from gpe_pl.nn.elastic_touch import BodyLayer, Touching, touching_forces

SPACING = 0.1
PAIR = torch.tensor([[0, 1]])


def touching(distance: float, stiffness: float = 1.0, adhesion: float = 0.0, approach: float = 0.0, sliding: float = 0.0) -> Touching:
    """The first node to the right of the second. The layer is one unit thick."""
    law = torch.tensor([[1.0, stiffness, adhesion, approach, sliding]], dtype=torch.float64)
    return Touching(PAIR, torch.tensor([[distance, 0.0]], dtype=torch.float64), law)


def force_on_first(pair: Touching, velocity: tuple[float, float] = (0.0, 0.0)) -> list[float]:
    moved = torch.zeros(2, 2, dtype=torch.float64)
    forces = touching_forces(moved, torch.tensor([velocity, (0.0, 0.0)], dtype=torch.float64), pair)
    assert torch.equal(forces[0], -forces[1])
    return forces[0].tolist()


def test_forces_grow_with_the_square_of_the_depth_and_end_at_the_thickness() -> None:
    assert force_on_first(touching(0.6)) == pytest.approx([0.16, 0.0])
    assert force_on_first(touching(0.2)) == pytest.approx([0.64, 0.0])
    assert force_on_first(touching(1.1, 1.0, 0.5, 1.0, 1.0), (1.0, 1.0)) == [0.0, 0.0]


def test_adhesion_attracts_nodes_that_touch_lightly() -> None:
    assert force_on_first(touching(0.9, adhesion=0.2))[0] == pytest.approx(-0.01)
    assert force_on_first(touching(0.7, adhesion=0.2))[0] == pytest.approx(0.03)


def test_damping_opposes_approach_and_sliding_apart() -> None:
    assert force_on_first(touching(0.5, 0.0, 0.0, 2.0, 3.0), (-1.0, 0.0)) == pytest.approx([1.0, 0.0])
    assert force_on_first(touching(0.5, 0.0, 0.0, 2.0, 3.0), (0.0, 1.0)) == pytest.approx([0.0, -1.5])


def flown(pair: Touching, velocity: float, frames: int = 40) -> tuple[Tensor, Tensor]:
    """Two nodes of masses 1 and 3 without cells, which fly at each other: distances and velocities, frame by frame."""
    pos = torch.stack([pair.way[0], torch.zeros(2, dtype=torch.float64)])
    vel, mass, empty = (
        torch.tensor([[velocity, 0.0], [0.0, 0.0]], dtype=torch.float64),
        torch.tensor([1.0, 3.0]).double(),
        torch.empty(0).double(),
    )
    cells = Cells.of(torch.empty(0, 3, dtype=torch.int64), pos, mass, None)
    walls = Walls(torch.zeros_like(pos), torch.zeros(2).double(), torch.zeros(2).double())
    distances, velocities = [], []
    for _ in range(frames):
        now = Touching(PAIR, pos[:1] - pos[1:], pair.law)
        way, vel, _ = elastic_motion(pos, vel, torch.zeros_like(pos), mass, (empty, empty, empty), cells, walls, touching=now)
        pos = pos + way
        distances.append(pos[0, 0] - pos[1, 0])
        velocities.append(vel)
    return torch.stack(distances), torch.stack(velocities)


@pytest.mark.parametrize(
    ("pair", "ratio"), [(touching(1.2, 0.1), 1.0), (touching(1.2, 0.1, 0.0, 0.2, 0.0), 0.8)], ids=["elastic", "damped"]
)
def test_nodes_bounce_off_each_other_and_keep_their_momentum(pair: Touching, ratio: float) -> None:
    distances, velocities = flown(pair, -0.1)
    torch.testing.assert_close(velocities[:, 0] + 3.0 * velocities[:, 1], torch.tensor([[-0.1, 0.0]]).double().expand(40, 2))
    assert distances.min() > 0.1
    after = float(velocities[-1, 0, 0] - velocities[-1, 1, 0]) / 0.1
    assert after == pytest.approx(1.0, abs=0.05) if ratio == 1.0 else 0.2 < after < ratio


@pytest.mark.slow
@pytest.mark.parametrize(("distance", "speed"), [(0.9, 0.01), (1.3, 0.6), (1.4, 0.6), (1.9, 1.0), (0.5, 0.0)])
@pytest.mark.parametrize("adhesion", [0.0, 0.9])
def test_a_contact_that_is_far_too_stiff_for_the_substeps_stays_bounded(distance: float, speed: float, adhesion: float) -> None:
    distances, velocities = flown(touching(distance, 1e4, adhesion, 1e2, 1e2), -speed)
    assert float(velocities.abs().max()) < 2.0 and bool(distances.isfinite().all())


def test_coincident_nodes_have_no_direction_and_finite_gradients() -> None:
    way = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    pair = Touching(PAIR, way, touching(1.0, 1.0, 0.1, 0.2, 0.3).law)
    forces = touching_forces(torch.zeros(2, 2).double(), torch.tensor([[0.1, 0.0], [0.0, 0.0]]).double(), pair)
    forces.sum().backward()  # type: ignore[no-untyped-call]
    assert bool(forces.isfinite().all()) and way.grad is not None and bool(way.grad.isfinite().all())


def test_contacts_of_many_nodes_are_softened_until_the_substeps_suffice() -> None:
    stiff, mass, number = touching(0.9, 1e6, 0.1, 1e4, 1e4), torch.ones(2).double(), torch.full((2,), 4)
    still = torch.zeros(2, 2, dtype=torch.float64)
    many = Touching(PAIR.expand(30, 2), stiff.way.expand(30, 2), stiff.law.expand(30, 5))
    soft = many.softened(mass, number, still)
    assert float(soft.law[:, 1].sum()) < 4.0**2 and float(soft.law[:, 3].sum()) < 4.0
    assert torch.equal(soft.law[:, [0, 2]], many.law[:, [0, 2]])
    light = touching(0.9, 1e-3, 0.1, 1e-3, 1e-3)
    torch.testing.assert_close(light.softened(mass, number, still).law, light.law)


def test_a_layer_has_constants_by_parameter_and_none_without_thickness() -> None:
    layer = BodyLayer(3.0, 1, 5.0)
    params, modulus, spacing = torch.tensor([[-1.0], [1.0], [1.0]]), torch.tensor([4.0, 8.0, 8.0]), torch.tensor(SPACING).double()
    nodes = torch.tensor([[0, 1], [1, 2]])
    law = layer.law_of(nodes, params, modulus, spacing)
    assert law[:, 0].tolist() == pytest.approx([3.0 * SPACING] * 2)
    assert law[:, 1].tolist() == pytest.approx([0.1 * 6.0 / 3.0, 0.1 * 8.0 / 3.0])
    with torch.no_grad():
        layer.logarithm["weight"].fill_(0.1)
    read = layer.law_of(nodes, params, modulus, spacing)
    assert float((read[1, 2] / law[1, 2]).detach()) == pytest.approx(math.exp(0.5), rel=1e-4)
    read.sum().backward()  # type: ignore[no-untyped-call]
    assert all(p.grad is not None and bool(p.grad.any()) for p in layer.parameters())
    assert not [*BodyLayer(0.0, 1, 5.0).parameters()]
