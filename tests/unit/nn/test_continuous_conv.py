"""The continuous convolution compared with its formula, with interpolation by ``grid_sample`` and the map from ball to cube written point by point."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from gpe_pl.nn.continuous_conv import ContinuousConv, ball_to_cube, interpolate

DOUBLE = torch.float64


def ball(num_points: int, dim: int, seed: int = 0) -> Tensor:
    """Draw uniform points of the unit ball."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(num_points, dim))
    radii = rng.uniform(size=(num_points, 1)) ** (1 / dim)
    return torch.tensor(directions / np.linalg.norm(directions, axis=1, keepdims=True) * radii)


def cube_point(u: list[float]) -> list[float]:
    """Map one point, in scalars."""
    x, y, *z = u
    if z:
        rho, r = math.hypot(x, y), math.sqrt(x * x + y * y + z[0] ** 2)
        if 5 * z[0] ** 2 > 4 * rho**2:
            s, z = math.sqrt(3 * r / (r + abs(z[0]))), [math.copysign(r, z[0])]
        else:
            s, z = (r / rho if rho else 1.0), [1.5 * z[0]]
        x, y = s * x, s * y
    rho = math.hypot(x, y)
    if rho == 0:
        return [0.0, 0.0, *z]
    if abs(y) <= abs(x):
        return [math.copysign(rho, x), math.copysign(rho, x) * 4 / math.pi * math.atan(y / x), *z]
    return [math.copysign(rho, y) * 4 / math.pi * math.atan(x / y), math.copysign(rho, y), *z]


@pytest.mark.parametrize("dim", [2, 3])
def test_map_of_the_ball_equals_its_formula(dim: int) -> None:
    u = ball(200, dim)
    expected = torch.tensor([cube_point(point) for point in u.tolist()], dtype=DOUBLE)
    torch.testing.assert_close(ball_to_cube(u), expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(("dim", "ratio"), [(2, 4 / math.pi), (3, 6 / math.pi)])
def test_map_keeps_ratios_of_volumes(dim: int, ratio: float) -> None:
    """The Jacobian is the ratio of the volumes of cube and ball at every point."""
    for point in ball(100, dim):
        jacobian = torch.autograd.functional.jacobian(lambda u: ball_to_cube(u[None])[0], point)
        assert float(torch.linalg.det(jacobian).abs()) == pytest.approx(ratio, rel=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_sphere_becomes_the_surface_and_the_centre_stays(dim: int) -> None:
    u = ball(500, dim)
    u = u / u.norm(dim=1, keepdim=True)
    torch.testing.assert_close(ball_to_cube(u).abs().amax(dim=1), torch.ones(500, dtype=DOUBLE))
    axes = 0.7 * torch.eye(dim, dtype=DOUBLE)
    torch.testing.assert_close(ball_to_cube(axes), axes)
    assert not ball_to_cube(torch.zeros(1, dim, dtype=DOUBLE)).any()
    torch.testing.assert_close(ball_to_cube(-u), -ball_to_cube(u))


def test_map_by_hand() -> None:
    diagonal = torch.tensor([[1.0, 1.0]], dtype=DOUBLE) / math.sqrt(2)
    torch.testing.assert_close(ball_to_cube(diagonal), torch.ones(1, 2, dtype=DOUBLE))
    diagonal = torch.tensor([[1.0, 1.0, 1.0]], dtype=DOUBLE) / math.sqrt(3)  # to (1, 1)/√2 and 3/2 · 1/√3 on the cylinder
    torch.testing.assert_close(ball_to_cube(diagonal), torch.tensor([[1.0, 1.0, math.sqrt(3) / 2]], dtype=DOUBLE))


@pytest.mark.parametrize("dim", [2, 3])
def test_interpolation_reproduces_linear_functions(dim: int) -> None:
    u, size = ball(300, dim), 4
    cells, weights = interpolate(u, size)
    assert cells.shape == weights.shape == (300, 2**dim)
    assert cells.min() >= 0 and cells.max() < size**dim and weights.min() >= 0
    window = (1 - u.square().sum(dim=1)) ** 3
    axes = [torch.linspace(-1, 1, size, dtype=DOUBLE)] * dim
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).view(-1, dim)
    torch.testing.assert_close(weights.sum(dim=1), window)
    torch.testing.assert_close((weights[..., None] * points[cells]).sum(dim=1), window[:, None] * ball_to_cube(u))


def test_window_closes_at_the_radius() -> None:
    u = torch.tensor([[0.6, 0.8], [1.0, 0.0], [0.9, 0.9], [0.0, 0.0]], dtype=DOUBLE)
    torch.testing.assert_close(interpolate(u, 4)[1].sum(dim=1), torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=DOUBLE))


def problem(dim: int, in_channels: int, num_source: int = 9, num_target: int = 7, num_edges: int = 30) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    edges = torch.stack([torch.randint(num_source, (num_edges,), generator=g), torch.randint(num_target, (num_edges,), generator=g)])
    return torch.randn(num_source, in_channels, generator=g, dtype=DOUBLE), edges, ball(num_edges, dim)


def make(in_channels: int, out_channels: int, dim: int, kernel_size: int = 4) -> ContinuousConv:
    torch.manual_seed(0)
    conv = ContinuousConv(in_channels, out_channels, dim, kernel_size).double()
    torch.nn.init.normal_(conv.bias)
    return conv


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("in_channels", "out_channels"), [(3, 5), (5, 3), (4, 4)])
@pytest.mark.parametrize("kernel_size", [3, 4])
def test_equals_a_filter_matrix_per_edge(dim: int, in_channels: int, out_channels: int, kernel_size: int) -> None:
    conv = make(in_channels, out_channels, dim, kernel_size)
    features, edges, u = problem(dim, in_channels)
    out = conv(features, edges, *interpolate(u, kernel_size), 7)

    volume = conv.weight.flatten(1).T.reshape(1, in_channels * out_channels, *[kernel_size] * dim)
    expected = conv.bias.expand(7, -1).clone()
    for (j, i), offset in zip(edges.T.tolist(), u.tolist(), strict=True):
        where = torch.tensor(cube_point(offset)[::-1], dtype=DOUBLE).view(1, *[1] * dim, dim)  # grid_sample wants the last axis first
        matrix = functional.grid_sample(volume, where, mode="bilinear", align_corners=True).view(in_channels, out_channels)
        expected[i] += (1 - sum(c * c for c in offset)) ** 3 * features[j] @ matrix
    torch.testing.assert_close(out, expected, rtol=1e-11, atol=1e-12)


def test_a_filter_of_ones_sums_the_window() -> None:
    """By hand: neighbours at 0, 0.6 and 0.8 radii with features 1, 2 and 4 give 1 + 2 · 0.64³ + 4 · 0.36³."""
    conv = ContinuousConv(1, 1, 2, 4).double()
    torch.nn.init.ones_(conv.weight)
    u = torch.tensor([[0.0, 0.0], [0.6, 0.0], [0.0, -0.8]], dtype=DOUBLE)
    features = torch.tensor([[1.0], [2.0], [4.0]], dtype=DOUBLE)
    out = conv(features, torch.tensor([[0, 1, 2], [0, 0, 0]]), *interpolate(u, 4), 2)
    torch.testing.assert_close(out, torch.tensor([[1 + 2 * 0.64**3 + 4 * 0.36**3], [0.0]], dtype=DOUBLE))


@pytest.mark.parametrize("in_channels", [2, 5])
def test_no_edges_leave_the_bias(in_channels: int) -> None:
    conv = make(in_channels, 3, 2)
    out = conv(
        torch.ones(4, in_channels, dtype=DOUBLE), torch.empty(2, 0, dtype=torch.int64), *interpolate(torch.empty(0, 2).double(), 4), 4
    )
    assert torch.equal(out, conv.bias.expand(4, -1))


@pytest.mark.parametrize(("in_channels", "out_channels"), [(2, 3), (3, 2)])
@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_are_correct(dim: int, in_channels: int, out_channels: int) -> None:
    conv = make(in_channels, out_channels, dim, 3)
    features, edges, u = problem(dim, in_channels, num_source=3, num_target=2, num_edges=4)

    def f(features: Tensor, u: Tensor, weight: Tensor) -> Tensor:
        return torch.func.functional_call(conv, {"weight": weight}, (features, edges, *interpolate(u, 3), 2))

    inputs = (features.requires_grad_(), u.requires_grad_(), conv.weight.detach().clone().requires_grad_())
    assert torch.autograd.gradcheck(f, inputs, eps=1e-7, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("dim", [2, 3])
def test_coincident_points_have_finite_gradients(dim: int) -> None:
    u = torch.zeros(1, dim, dtype=DOUBLE, requires_grad=True)
    cells, weights = interpolate(u, 4)
    (weights * (1 + cells)).sum().backward()
    assert u.grad is not None and torch.isfinite(u.grad).all()
