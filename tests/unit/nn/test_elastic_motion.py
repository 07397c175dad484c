"""Motion of elastic bodies: exact cases, conservation, walls, stability, and the compiled version beside PyTorch's operations."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import gpe_pl.nn.elastic_motion as elastic_motion_module
from gpe_pl.nn.elastic_bodies_kernels import _is_unstable
from gpe_pl.nn.elastic_motion import MAX_SUBSTEPS, SOFTER, Cells, Walls, elastic_motion
from gpe_pl.nn.elastic_touch import Touching
from gpe_pl.nn.fused import unfused

KINDS = ("triangles", "quadrilaterals", "tetrahedra", "hexahedra")
SPACING = 0.1
PAIRS = ("touch", "way", "constants")


def mesh(kind: str, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A small irregular body: positions at rest [node, dim] and cells [cell, corner]."""
    rng, dim = np.random.default_rng(seed), 2 if kind in KINDS[:2] else 3
    size = (4, 3) if dim == 2 else (3, 2, 3)
    number = np.arange(math.prod(size)).reshape(size)
    pos = (np.argwhere(number >= 0) + rng.uniform(-0.1, 0.1, (number.size, dim))) * SPACING
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)] if dim == 2 else [(*c, z) for z in (0, 1) for c in ((0, 0), (1, 0), (1, 1), (0, 1))]
    if kind in ("triangles", "tetrahedra"):  # along every path of edges from the lowest to the highest corner of a box
        paths = [
            np.cumsum([np.zeros(dim, int), *np.eye(dim, dtype=int)[list(order)]], axis=0) for order in itertools.permutations(range(dim))
        ]
    else:
        paths = [np.array(corners)]
    boxes = [[number[tuple(slice(k, n - 1 + k) for k, n in zip(c, size, strict=True))].ravel() for c in path] for path in paths]
    cells = np.concatenate([np.stack(box, axis=1) for box in boxes])
    return torch.from_numpy(pos), torch.from_numpy(cells)


def masses(rest: Tensor, cells: Tensor) -> Tensor:
    """Masses of the nodes as a solver has them, about 1 each."""
    volume = Cells.of(cells, rest, torch.ones(len(rest), dtype=torch.float64), None).volume.sum(dim=1)
    share = (volume / cells.shape[1])[:, None].expand_as(cells).flatten()
    mass = torch.zeros(len(rest), dtype=torch.float64).index_add(0, cells.flatten(), share)
    return torch.where(mass > 0, mass, mass.mean()) / mass.mean()


def no_walls(pos: Tensor) -> Walls:
    return Walls(torch.zeros_like(pos), torch.zeros_like(pos[:, 0]), torch.zeros_like(pos[:, 0]))


def floor(pos: Tensor, friction: float = 0.0, height: float = 0.0) -> Walls:
    normal = torch.zeros_like(pos)
    normal[:, -1] = 1.0
    return Walls(normal, pos[:, -1] - height, torch.full_like(pos[:, 0], friction))


class Body:
    """A body with one set of constants, which moves frame by frame."""

    def __init__(self, kind: str, stiffness: float = 4.0, viscosity: float = 0.0, seed: int = 0) -> None:
        self.rest, nodes = mesh(kind, seed)
        self.mass = masses(self.rest, nodes)
        self.cells = Cells.of(nodes, self.rest, self.mass, None)
        modulus = stiffness * SPACING ** (2 - self.rest.shape[1])
        self.law = tuple(torch.full((len(nodes),), c * modulus, dtype=torch.float64) for c in (1.5, 1.0, viscosity))

    def moved(self, pos: Tensor, vel: Tensor, forcing: Tensor | None = None, walls: Walls | None = None) -> tuple[Tensor, Tensor]:
        forcing = torch.zeros_like(pos) if forcing is None else forcing
        walls = no_walls(pos) if walls is None else walls
        moved, vel, _ = elastic_motion(pos, vel, forcing, self.mass, self.law, self.cells, walls)  # type: ignore[arg-type]
        return pos + moved, vel

    def energy(self, pos: Tensor, vel: Tensor) -> float:
        """Kinetic and strain energy, by the formula of the module ``trajectory.strain``."""
        corner = pos[self.cells.nodes]
        f = torch.einsum("cai,cqaj->cqij", corner, self.cells.gradient)
        log = torch.linalg.det(f).log()
        density = (
            self.law[1][:, None] * (0.5 * (f.square().sum(dim=(2, 3)) - f.shape[-1]) - log) + 0.5 * self.law[0][:, None] * log.square()
        )
        return float((density * self.cells.volume).sum() + 0.5 * (self.mass[:, None] * vel.square()).sum())


def strained(rest: Tensor, seed: int = 0, size: float = 0.05) -> tuple[Tensor, Tensor]:
    """Positions and velocities of a body that is strained and moves."""
    random = torch.Generator().manual_seed(seed)
    noise = [torch.randn(rest.shape, generator=random, dtype=torch.float64) for _ in range(2)]
    return rest + size * SPACING * noise[0], size * SPACING * noise[1]


def several(kind: str, count: int = 3) -> tuple[list[Body], dict[str, Any]]:
    """Bodies of different stiffness near walls, and the inputs of all of them as one batch. A node of each body has no cell."""
    bodies = [Body(kind, 2.0 * 8.0**k, 0.05, seed=k) for k in range(count)]
    random = torch.Generator().manual_seed(1)
    parts: dict[str, list[Tensor]] = {
        name: []
        for name in ("pos", "vel", "forcing", "mass", "normal", "gap", "friction", "layer", "lam", "mu", "eta", "touch", "way", "constants")
    }
    rests, nodes, start = [], [], 0
    for k, body in enumerate(bodies):
        rest = torch.cat([body.rest, body.rest[:1] - 3.0])
        pos, vel = strained(rest, k)
        normal = torch.zeros_like(rest)
        normal[::2, -1] = 1.0
        normal[1::4, 0] = -1.0
        values = {
            "pos": pos, "vel": vel - 0.3 * SPACING * normal, "forcing": 0.1 * SPACING * torch.randn(rest.shape, generator=random, dtype=torch.float64),
            "mass": torch.cat([body.mass, body.mass[:1]]), "normal": normal,
            "gap": 0.1 * SPACING * torch.rand(len(rest), generator=random, dtype=torch.float64),
            "friction": torch.rand(len(rest), generator=random, dtype=torch.float64),
            "layer": torch.rand(len(rest), 3, generator=random, dtype=torch.float64) * torch.tensor([0.2 * SPACING, 20.0, 1.0]).double(),
            "touch": start + torch.tensor([[0, 1], [2, 0], [3, len(rest) - 1]]),
            "way": SPACING * torch.randn(3, rest.shape[1], generator=random, dtype=torch.float64),
            "constants": torch.tensor([[3.0 * SPACING, 2.0, 0.1, 0.5, 0.8]]).double() * (1 + 0.5 * torch.rand(3, 5, generator=random, dtype=torch.float64)),
            **{name: c * (1 + torch.rand(len(c), generator=random, dtype=torch.float64)) for name, c in zip(("lam", "mu", "eta"), body.law, strict=True)},
        }  # fmt: skip
        for name, value in values.items():
            parts[name].append(value)
        rests.append(rest)
        nodes.append(body.cells.nodes + start)
        start += len(rest)
    together: dict[str, Any] = {name: torch.cat(part) for name, part in parts.items()}
    scene = torch.cat([torch.full((len(rest),), k) for k, rest in enumerate(rests)])
    together["cells"] = Cells.of(torch.cat(nodes), torch.cat(rests), together["mass"], scene)
    return bodies, together


def motion(v: dict[str, Any]) -> tuple[Tensor, Tensor]:
    law, walls = (v["lam"], v["mu"], v["eta"]), Walls(v["normal"], v["gap"], v["friction"], v["layer"])
    touching = Touching(v["touch"], v["way"], v["constants"])
    return elastic_motion(v["pos"], v["vel"], v["forcing"], v["mass"], law, v["cells"], walls, touching=touching)[:2]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_compiled_motion_and_its_gradients_equal_the_plain_ones(kind: str) -> None:
    _, together = several(kind)
    names = ("pos", "vel", "forcing", "lam", "mu", "eta", "gap", "friction", "layer", "way", "constants")
    results = []
    for plain in (False, True):
        values = together | {name: together[name].clone().requires_grad_() for name in names}
        with unfused() if plain else torch.enable_grad():
            moved, at_end = motion(values)
            weight = torch.sin(torch.arange(moved.numel(), dtype=torch.float64)).view_as(moved)
            (weight * moved + 0.7 * weight.flip(0) * at_end).sum().backward()
        results.append([moved, at_end, *(values[name].grad for name in names)])
    for name, a, b in zip(("moved", "at_end", *names), *results, strict=True):
        assert bool(b.any()), name
        torch.testing.assert_close(a, b, rtol=0, atol=1e-10 * max(1.0, float(b.detach().abs().max())), msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_those_of_finite_differences(kind: str) -> None:
    _, together = several(kind, 1)
    names = ("pos", "vel", "forcing", "mass", "lam", "mu", "eta", "gap", "friction", "way")

    def of(*inputs: Tensor) -> tuple[Tensor, Tensor]:
        return motion(together | dict(zip(names, inputs, strict=True)))

    inputs = [together[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(of, inputs, eps=1e-7, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_scenes_of_a_batch_do_not_influence_each_other(plain: bool) -> None:
    bodies, together = several("triangles")
    number, _ = together["cells"].substeps(together["pos"], (together["lam"], together["mu"], together["eta"]))
    assert len({*number.tolist()}) == len(bodies)
    with unfused() if plain else torch.enable_grad():
        moved, at_end = motion(together)
        first, first_cell = 0, 0
        for k, body in enumerate(bodies):
            rows, own = slice(first, first + len(body.rest) + 1), slice(first_cell, first_cell + len(body.cells.nodes))
            one = {name: v[own if name in ("lam", "mu", "eta") else rows] for name, v in together.items() if name not in ("cells", *PAIRS)}
            one |= {name: together[name][3 * k : 3 * k + 3] for name in PAIRS}
            one["touch"] = one["touch"] - first
            rest = torch.cat([body.rest, body.rest[:1] - 3.0])
            one["cells"] = Cells.of(body.cells.nodes, rest, one["mass"], None)
            for whole, alone in zip((moved, at_end), motion(one), strict=True):
                torch.testing.assert_close(whole[rows], alone, rtol=0, atol=1e-13)
            first, first_cell = rows.stop, own.stop


@pytest.mark.parametrize("kind", KINDS)
def test_free_fall_is_exact(kind: str) -> None:
    body = Body(kind)
    gravity, vel = torch.zeros_like(body.rest), torch.full_like(body.rest, 0.3)
    gravity[:, -1] = -0.2
    pos, at_end = body.moved(body.rest, vel, gravity)
    torch.testing.assert_close(pos, body.rest + vel + 0.5 * gravity, rtol=0, atol=1e-13)
    torch.testing.assert_close(at_end, vel + gravity, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_momentum_and_angular_momentum_are_conserved(kind: str) -> None:
    body = Body(kind, viscosity=0.05)
    pos, vel = start = strained(body.rest)

    def momenta(pos: Tensor, vel: Tensor) -> Tensor:
        p = body.mass[:, None] * vel
        angular = [(pos[:, i] * p[:, j] - pos[:, j] * p[:, i]).sum() for i, j in itertools.combinations(range(pos.shape[1]), 2)]
        return torch.stack([*p.sum(dim=0), *angular])

    for _ in range(5):
        pos, vel = body.moved(pos, vel)
    assert not torch.allclose(vel, start[1], atol=1e-3 * SPACING)
    before = momenta(*start)
    size = float((body.mass[:, None] * start[1]).norm())
    torch.testing.assert_close(momenta(pos, vel)[: pos.shape[1]], before[: pos.shape[1]], rtol=0, atol=1e-13 * size)
    # a viscous force depends on the velocity half a substep earlier, so leapfrog conserves angular momentum up to the step
    torch.testing.assert_close(momenta(pos, vel), before, rtol=0, atol=1e-2 * size * SPACING)


@pytest.mark.parametrize("kind", KINDS)
def test_undamped_angular_momentum_is_conserved_by_rounding(kind: str) -> None:
    body = Body(kind)
    pos, vel = start = strained(body.rest)

    def spin(pos: Tensor, vel: Tensor) -> Tensor:
        p = body.mass[:, None] * vel
        return torch.stack([(pos[:, i] * p[:, j] - pos[:, j] * p[:, i]).sum() for i, j in itertools.combinations(range(pos.shape[1]), 2)])

    for _ in range(5):
        pos, vel = body.moved(pos, vel)
    torch.testing.assert_close(spin(pos, vel), spin(*start), rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_a_mirror_image_moves_as_the_mirror_image(kind: str) -> None:
    body = Body(kind, viscosity=0.02)
    pos, vel = strained(body.rest)
    normal = torch.zeros_like(pos)
    normal[:, 0] = 1.0
    walls = Walls(normal, torch.full_like(pos[:, 0], 0.02 * SPACING), torch.full_like(pos[:, 0], 0.4))
    mirror = torch.ones(pos.shape[1], dtype=torch.float64)
    mirror[0] = -1.0
    found = body.moved(pos, vel, walls=walls)
    body.cells = Cells.of(body.cells.nodes, mirror * body.rest, body.mass, None)
    image = body.moved(mirror * pos, mirror * vel, walls=Walls(mirror * normal, walls.gap, walls.friction))
    for a, b in zip(found, image, strict=True):
        torch.testing.assert_close(mirror * b, a, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_energy_is_kept_without_viscosity_and_dissipated_with_it(kind: str) -> None:
    """Substeps change from frame to frame, so leapfrog's energy changes by up to 10 % in 200 frames."""
    energies: dict[float, np.ndarray] = {}
    for viscosity in (0.0, 0.02):
        body = Body(kind, viscosity=viscosity)
        pos, vel = strained(body.rest)
        found = [body.energy(pos, vel)]
        for _ in range(200):
            pos, vel = body.moved(pos, vel)
            found.append(body.energy(pos, vel))
        energies[viscosity] = np.array(found) / found[0]
    kept = energies[0.0]
    assert kept.min() > 0.9 and kept.max() < 1.15
    assert energies[0.02][-1] < 0.7


def test_a_node_reaches_its_plane_and_does_not_pass_it() -> None:
    body = Body("quadrilaterals")
    start = body.rest.clone()
    vel = torch.zeros_like(start)
    vel[:, 1] = -0.5 * SPACING
    walls = floor(start, height=float(start[:, 1].min()) - 0.2 * SPACING)
    pos, at_end = body.moved(start, vel, walls=walls)
    depth = pos[:, 1] - float(start[:, 1].min()) + 0.2 * SPACING
    assert -1e-12 < float(depth.min()) < 0.1 * SPACING
    assert float((body.mass * at_end[:, 1]).sum()) > float((body.mass * vel[:, 1]).sum())


def falling(damping: float, thickness: float = SPACING, frames: int = 12) -> tuple[Tensor, Tensor]:
    """Heights over a wall and velocities of a node that flies into the layer of the wall, frame by frame. Its stiffness is 0.5 per frame²."""
    rest = torch.tensor([[0.0, SPACING]], dtype=torch.float64)
    cells = Cells.of(torch.empty(0, 3, dtype=torch.int64), rest, torch.ones(1, dtype=torch.float64), None)
    empty, layer = torch.empty(0, dtype=torch.float64), torch.tensor([[thickness, 0.5, damping]], dtype=torch.float64)
    pos, vel = rest, torch.tensor([[0.03 * SPACING, -0.2 * SPACING]], dtype=torch.float64)
    heights, velocities = [], []
    for _ in range(frames):
        walls = replace(floor(pos), layer=layer)
        way, vel, _ = elastic_motion(pos, vel, torch.zeros_like(pos), torch.ones(1).double(), (empty, empty, empty), cells, walls)
        pos = pos + way
        heights.append(pos[0, 1])
        velocities.append(vel[0])
    return torch.stack(heights), torch.stack(velocities)


def test_the_layer_of_a_wall_pushes_with_the_square_of_the_depth() -> None:
    """A node bounces off at its own speed. At its deepest, k x³/(3 D) is its kinetic energy v²/2."""
    heights, velocities = falling(0.0)
    assert float(velocities[-1, 1]) == pytest.approx(0.2 * SPACING, rel=0.15)
    assert float(heights.min()) == pytest.approx((1 - 0.12 ** (1 / 3)) * SPACING, abs=0.02 * SPACING)
    torch.testing.assert_close(velocities[-4:, 1], velocities[-1:, 1].expand(4))
    torch.testing.assert_close(velocities[:, 0], torch.full_like(velocities[:, 0], 0.03 * SPACING))


def test_the_damping_of_a_layer_takes_energy() -> None:
    assert 0.3 * SPACING > float(falling(0.0)[1][-1, 1]) > float(falling(0.3)[1][-1, 1]) > 0.05 * SPACING


def test_a_layer_does_not_act_beyond_its_thickness() -> None:
    heights, _ = falling(0.3, thickness=0.3 * SPACING, frames=3)
    torch.testing.assert_close(heights, SPACING * torch.tensor([0.8, 0.6, 0.4], dtype=torch.float64))


def test_a_node_behind_its_plane_is_not_pushed_out_at_once() -> None:
    body = Body("triangles")
    pos, _ = body.moved(body.rest, torch.zeros_like(body.rest), walls=floor(body.rest, height=float(body.rest[:, 1].max()) + SPACING))
    torch.testing.assert_close(pos, body.rest, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [20.0, 40.0])
@pytest.mark.parametrize("coefficient", [0.5, 0.7])
def test_friction_holds_or_lets_slip_as_coulomb_says(coefficient: float, angle: float) -> None:
    """A body on an inclined plane accelerates with g (sin α - μ cos α) if tan α > μ, and else stays."""
    body = Body("quadrilaterals", stiffness=40.0, viscosity=4.0)
    pos, size = (torch.argwhere(torch.ones(4, 3)) * SPACING).double(), 1e-3 * SPACING
    body.cells = Cells.of(body.cells.nodes, pos, body.mass, None)
    slope = math.radians(angle)
    forcing = (size * torch.tensor([math.sin(slope), -math.cos(slope)], dtype=torch.float64)).expand_as(pos)
    vel, start = torch.zeros_like(pos), pos
    for _ in range(40):
        walls = floor(pos, coefficient)
        walls = Walls(torch.where(pos[:, 1:] < 0.5 * SPACING, walls.normal, 0.0), walls.gap, walls.friction)
        pos, vel = body.moved(pos, vel, forcing, walls)
    moved = float((body.mass * (pos - start)[:, 0]).sum() / body.mass.sum())
    expected = 0.5 * size * 40**2 * max(0.0, math.sin(slope) - coefficient * math.cos(slope))
    assert moved == pytest.approx(expected, rel=0.05, abs=0.02 * SPACING)


def test_nodes_without_cells_follow_their_forcing_and_stop_at_walls() -> None:
    body = Body("triangles")
    rest = torch.cat([body.rest, torch.tensor([[5.0, 5.0], [6.0, 0.1]], dtype=torch.float64)])
    body.mass = torch.cat([body.mass, torch.ones(2, dtype=torch.float64)])
    body.cells = Cells.of(body.cells.nodes, rest, body.mass, None)
    forcing = torch.zeros_like(rest)
    forcing[-2:, 1] = -0.5
    walls = floor(rest)
    walls = Walls(torch.where(rest[:, :1] > 5.5, walls.normal, 0.0), walls.gap, walls.friction)
    pos, vel = body.moved(rest, torch.zeros_like(rest), forcing, walls)
    assert pos[-2].tolist() == pytest.approx([5.0, 4.75]) and vel[-2].tolist() == pytest.approx([0.0, -0.5])
    assert float(pos[-1, 1]) == pytest.approx(0.0, abs=1e-12)


def test_stiff_scenes_take_more_substeps() -> None:
    counts = []
    for stiffness in (1.0, 16.0, 256.0):
        body = Body("quadrilaterals", stiffness)
        number, excess = body.cells.substeps(body.rest, body.law)  # type: ignore[arg-type]
        counts.append(int(number))
        assert bool((excess == 1.0).all())
    assert counts[1] == pytest.approx(4 * counts[0], abs=4) and counts[2] == pytest.approx(4 * counts[1], abs=4)
    body = Body("quadrilaterals", 1e6)
    number, excess = body.cells.substeps(body.rest, body.law)  # type: ignore[arg-type]
    assert int(number) == MAX_SUBSTEPS and float(excess.max()) == pytest.approx(1000 * counts[0] / MAX_SUBSTEPS, rel=0.2)


def test_only_cells_that_need_too_many_substeps_are_softened() -> None:
    body = Body("triangles", 4.0)
    body.law[1][0] *= 1e6
    number, excess = body.cells.substeps(body.rest, body.law)  # type: ignore[arg-type]
    assert int(number) == MAX_SUBSTEPS and float(excess[0]) > 2.0 and bool((excess[1:] == 1.0).all())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_any_constants_keep_a_body_finite(kind: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(6):
        body = Body(kind)
        scale = SPACING ** (2 - body.rest.shape[1])
        body.law = tuple(torch.from_numpy(scale * 10 ** rng.uniform(-4, 8, len(body.law[0]))) for _ in range(3))
        pos, vel = strained(body.rest, size=0.02)
        before = float(pos.std())
        for _ in range(10):
            pos, vel = body.moved(pos, vel)
        assert torch.isfinite(pos).all() and torch.isfinite(vel).all()
        assert float(pos.std()) < 3 * before


@pytest.mark.parametrize("part", ["start", "forcing", "cell", "layer"])
@pytest.mark.parametrize("result", ["displacement", "velocity"])
def test_both_versions_take_the_same_speed_for_unstable(part: str, result: str) -> None:
    """One part of the bound is large. A result just below the bound is stable, one just above it is not, and neither is one that is not finite."""
    body, number = Body("triangles"), torch.tensor([7])
    zero = torch.zeros_like(body.rest)
    vel, forcing, layer, moved, last = zero.clone(), zero.clone(), torch.zeros(len(zero), 3).double(), zero.clone(), zero.clone()
    vel[1] = torch.tensor([3.0, 4.0]) if part == "start" else 0.0
    forcing[2] = torch.tensor([3.0, 4.0]) if part == "forcing" else 0.0
    layer[3, 0] = 5.0 if part == "layer" else 0.0
    length = float(body.cells.volume.sum(dim=1).sqrt().mean())
    bound = 7 * length + {"start": 5.0, "forcing": 5.0, "cell": 0.0, "layer": 7 * 5.0}[part]
    for speed, expected in ((0.999 * bound, False), (1.001 * bound, True), (math.inf, True), (math.nan, True)):
        (moved if result == "displacement" else last)[4, 1] = speed
        assert elastic_motion_module._unstable(vel, forcing, layer, moved, last, body.cells, number).tolist() == [expected]
        arrays = [t.numpy() for t in (body.rest, vel, forcing, layer, body.rest + moved, last)]
        assert _is_unstable(*arrays, float(body.cells.length), int(number), 0, len(zero)) == expected


CRUSHING = [("triangles", 5.0), ("quadrilaterals", 8.0), ("tetrahedra", 3.0), ("hexahedra", 4.0)]
"""Kinds of bodies, and the scale of random velocities in lengths of a cell per frame that crush their cells within the frame."""


def crushed(kind: str, scale: float) -> tuple[Body, Tensor]:
    """A body at rest and velocities that crush it within the frame."""
    body = Body(kind)
    return body, scale * SPACING * torch.randn(body.rest.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
@pytest.mark.parametrize(("kind", "scale"), CRUSHING)
def test_cells_that_are_crushed_within_a_frame_stay_finite(kind: str, scale: float, plain: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    body, vel = crushed(kind, scale)
    with unfused() if plain else torch.enable_grad():
        _, after = body.moved(body.rest, vel)
        monkeypatch.setattr(elastic_motion_module, "_unstable", lambda *args: torch.tensor([False]))
        _, unstable = body.moved(body.rest, vel)
    assert not float(unstable.abs().max()) < 1e6 * SPACING
    assert float(after.norm(dim=1).max()) < 3 * float(vel.norm(dim=1).max())
    momentum = [(body.mass[:, None] * v).sum(dim=0) for v in (vel, after)]
    torch.testing.assert_close(*momentum, rtol=0, atol=1e-10)


def test_the_softer_laws_are_tried_in_order() -> None:
    """The faster nodes are thrown at each other, the softer is the law that keeps them finite; the first of all is the law itself."""
    factors = set()
    for scale in (1.0, 5.0, 20.0, 40.0, 80.0, 160.0):
        body, vel = crushed("triangles", scale)
        law = elastic_motion(body.rest, vel, 0 * vel, body.mass, body.law, body.cells, no_walls(vel)).law  # type: ignore[arg-type]
        factors |= {*(law[0] / body.law[0]).tolist()}
    assert {1.0, SOFTER[1]} < factors <= {*SOFTER}


def test_the_push_of_a_thick_layer_is_not_taken_for_unstable() -> None:
    body, still = Body("triangles", 1.0), torch.zeros_like(mesh("triangles")[0])
    walls = floor(body.rest, height=float(body.rest[:, -1].min()))
    layer = torch.tensor([1.7 * SPACING, 5000.0, 0.0]).double().expand(len(still), 3)
    walls = replace(walls, layer=layer)
    _, vel, law = elastic_motion(body.rest, still, still, body.mass, body.law, body.cells, walls)  # type: ignore[arg-type]
    assert float(vel.norm(dim=1).max()) > SPACING * int(body.cells.substeps(body.rest, body.law)[0])  # type: ignore[arg-type]
    assert all(torch.equal(a, b) for a, b in zip(law, body.law, strict=True))


def test_a_body_that_was_unstable_moves_as_by_shorter_substeps(monkeypatch: pytest.MonkeyPatch) -> None:
    body, vel = crushed("triangles", 5.0)
    found = body.moved(body.rest, vel)
    monkeypatch.setattr(Cells, "substeps", lambda self, pos, law: (torch.tensor([MAX_SUBSTEPS]), torch.ones(len(law[0])).double()))
    assert_close(found, body.moved(body.rest, vel), rtol=0, atol=0)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_an_unstable_scene_changes_no_other_of_its_batch(plain: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    _, together = several("triangles")
    is_first = torch.arange(len(together["pos"])) < together["cells"].node_start[1]
    faster = together | {"vel": torch.where(is_first[:, None], 400.0 * together["vel"], together["vel"])}
    found, unstable = list[list[bool]](), elastic_motion_module._unstable

    def recorded(*args: Any) -> Tensor:
        result = unstable(*args)
        found.append(result.tolist())
        return result

    with unfused() if plain else torch.enable_grad():
        before = motion(together)
        monkeypatch.setattr(elastic_motion_module, "_unstable", recorded)
        after = motion(faster)
    assert found == [[True, False, False], [False, False, False]]
    for one, other in zip(before, after, strict=True):
        assert_close(one[~is_first], other[~is_first], rtol=0, atol=0)
        assert bool(other.isfinite().all())


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "scale"), CRUSHING)
def test_gradients_of_an_unstable_scene_are_those_of_the_last_try(kind: str, scale: float) -> None:
    body, vel = crushed(kind, scale)
    gradients = []
    for plain in (False, True):
        start = vel.clone().requires_grad_()
        with unfused() if plain else torch.enable_grad():
            pos, _ = body.moved(body.rest, start)
            (gradient,) = torch.autograd.grad(torch.sin(torch.arange(pos.numel()).double()) @ pos.flatten(), start)
        gradients.append(gradient)
    assert bool(gradients[0].isfinite().all())
    assert_close(*gradients, rtol=0, atol=1e-6 * float(gradients[1].abs().max()))


def test_a_batch_without_any_cell() -> None:
    pos = torch.rand(4, 2, dtype=torch.float64)
    cells = Cells.of(torch.empty(0, 3, dtype=torch.int64), pos, torch.ones(4, dtype=torch.float64), None)
    none = torch.empty(0, dtype=torch.float64)
    make: Callable[[], Any] = lambda: elastic_motion(pos, pos, pos, torch.ones(4).double(), (none, none, none), cells, no_walls(pos))  # noqa: E731
    moved, vel, _ = make()
    torch.testing.assert_close(moved, 1.5 * pos)
    torch.testing.assert_close(vel, 2 * pos)


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
@pytest.mark.parametrize("kind", ["triangles", "tetrahedra"])
def test_a_torn_cell_carries_no_forces(kind: str, plain: bool) -> None:
    """A corner of the body is pulled away. The cells at it let it fly, and the rest of the body stays as it is."""
    body = Body(kind)
    pos = body.rest
    near, far = pos.clone(), pos.clone()
    near[0] -= 0.5 * SPACING
    far[0] -= 20.0 * SPACING
    with unfused() if plain else torch.enable_grad():
        pulled, _ = body.moved(near, torch.zeros_like(pos))
        torn, vel = body.moved(far, torch.zeros_like(pos))
    assert float((pulled - near)[0].norm()) > 0.05 * SPACING
    torch.testing.assert_close(torn, far, rtol=0, atol=1e-9 * SPACING)
    assert not bool((vel.abs() > 1e-9 * SPACING).any())


@pytest.mark.parametrize("plain", [False, True], ids=["compiled", "plain"])
def test_walls_do_not_move_held_nodes(plain: bool) -> None:
    body = Body("triangles")
    held = torch.zeros_like(body.rest, dtype=torch.bool)
    held[:3] = True
    still, layer = torch.zeros_like(body.rest), torch.tensor([SPACING, 1.0, 0.5]).double().expand(len(body.rest), 3)
    walls = replace(floor(body.rest, height=float(body.rest[:, 1].min()) - 0.2 * SPACING), layer=layer)
    with unfused() if plain else torch.enable_grad():
        moved, vel, _ = elastic_motion(body.rest, still, still, body.mass, body.law, body.cells, walls, held=held)  # type: ignore[arg-type]
    assert float(moved[:3].abs().max()) < 1e-6 * SPACING and float(vel[:3].abs().max()) < 1e-6 * SPACING
    assert float(moved[3:].abs().max()) > 0.01 * SPACING
