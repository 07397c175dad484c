"""Constants of the layer of walls: by modulus and mass, thinner at sharp solids, and none without thickness."""

from __future__ import annotations

import math

import pytest
import torch

from gpe_pl.nn.elastic_bodies import THINNEST, WallLayer
from gpe_pl.nn.elastic_kernels import _wall_contact
from gpe_pl.nn.elastic_motion import _stopped

SPACING = torch.tensor(0.02).double()
MODULUS, MASS = torch.tensor([4.0, 8.0, 8.0]), torch.tensor([1.0, 1.0, 2.0])


FAR = (math.inf, math.inf, math.inf)


def of_nodes(layer: WallLayer, relief: tuple[float, ...] = (0.0, 0.0, 0.0), rest_gap: tuple[float, ...] = FAR) -> torch.Tensor:
    found = layer.of_nodes(torch.tensor(relief).double() * SPACING, torch.tensor(rest_gap).double() * SPACING, MODULUS, MASS, SPACING)
    assert found is not None
    return found


def test_stiffness_and_damping_depend_on_modulus_and_mass() -> None:
    found = of_nodes(WallLayer(2.0, damping=0.3))
    assert found[:, 1].tolist() == pytest.approx([0.5 * 4.0 / 2.0, 0.5 * 8.0 / 2.0, 0.5 * 8.0 / 4.0])
    assert found[:, 2].tolist() == pytest.approx([2 * 0.3 * math.sqrt(k) for k in found[:, 1].tolist()])


def test_the_layer_is_thinner_by_the_relief_of_a_sharp_solid() -> None:
    layer = WallLayer(2.0)
    found = of_nodes(layer, (0.0, 0.6, 5.0))
    assert found[:, 0].tolist() == pytest.approx([2.0 * 0.02, 1.4 * 0.02, THINNEST * 0.02])
    assert found[:, 1].tolist() == pytest.approx(of_nodes(layer)[:, 1].tolist())


def test_the_layer_is_no_thicker_than_the_distance_of_the_undeformed_body() -> None:
    layer = WallLayer(2.0)
    found = of_nodes(layer, (0.0, 0.6, 0.0), (0.5, 3.0, 0.0))
    assert found[:, 0].tolist() == pytest.approx([0.5 * 0.02, 1.4 * 0.02, THINNEST * 0.02])
    assert found[:, 1].tolist() == pytest.approx(of_nodes(layer)[:, 1].tolist())


def test_everything_but_the_damping_is_learned() -> None:
    layer = WallLayer(2.0)
    (of_nodes(layer, (0.0, 0.6, 0.1)).sum() + layer.slipping(torch.ones(3)).sum()).backward()  # type: ignore[no-untyped-call]
    assert all(p.grad is not None and bool(p.grad.any()) for p in layer.parameters())


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(("speed", "damped"), [(-0.01, 0.01), (0.01, 0.0)], ids=["approaching", "leaving"])
def test_push_and_damping_grow_with_the_depth(compiled: bool, speed: float, damped: float) -> None:
    thickness, stiffness, damping, h = 0.04, 3.0, 5.0, 0.1
    layer = torch.tensor([[thickness, stiffness, damping]], dtype=torch.float64)
    for depth in (-0.5, 0.0, 0.25, 0.75):
        distance = torch.tensor([thickness * (1.0 - depth)], dtype=torch.float64)
        if compiled:
            change, is_stopped = _wall_contact(float(distance), speed, layer[0].numpy(), h)
            assert not is_stopped
        else:
            velocity, normal = torch.tensor([[0.0, speed]], dtype=torch.float64), torch.tensor([[0.0, 1.0]], dtype=torch.float64)
            moved, friction = torch.zeros(1, 2).double(), torch.zeros(1).double()
            new = _stopped(velocity, moved, normal, distance, friction, layer, torch.tensor([h], dtype=torch.float64))
            change = float(new[0, 1]) - speed
        depth = max(depth, 0.0)
        assert change == pytest.approx(h * (stiffness * thickness * depth**2 + damping * depth * damped), rel=1e-9, abs=1e-12)


def test_a_layer_without_thickness_does_nothing() -> None:
    layer, h = torch.tensor([[0.0, 3.0, 5.0]], dtype=torch.float64), 0.1
    velocity, normal = torch.tensor([[0.0, -0.01]], dtype=torch.float64), torch.tensor([[0.0, 1.0]], dtype=torch.float64)
    none, step = torch.zeros(1, dtype=torch.float64), torch.tensor([h], dtype=torch.float64)
    new = _stopped(velocity, torch.zeros_like(velocity), normal, none + 1.0, none, layer, step)
    assert torch.equal(new, velocity) and _wall_contact(1.0, -0.01, layer[0].numpy(), h) == (0.0, False)


def test_without_thickness_there_is_no_layer() -> None:
    layer = WallLayer(0.0)
    assert layer.of_nodes(torch.zeros(3), torch.zeros(3), MODULUS, MASS, SPACING) is None
    assert not [*layer.parameters()] and layer.slipping(torch.ones(3)).tolist() == [1.0] * 3
