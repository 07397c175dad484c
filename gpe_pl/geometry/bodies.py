"""Random bodies around the origin: outlines of unit area in 2D, and signed distances of bodies of unit volume in 3D."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gpe_pl.geometry.meshing import Distance, Loop


def _arc(count: int = 240) -> np.ndarray:
    return 2 * math.pi * np.arange(count) / count


def _polar(radius: np.ndarray) -> Loop:
    angle = _arc(len(radius))
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _rounded(corners: np.ndarray, radius: float) -> Loop:
    """Replace the corners of a polygon by quadratic curves that are close to arcs of this radius, or of a smaller one where edges are short."""
    pieces = []
    for before, at, after in zip(np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0), strict=True):
        a, b = before - at, after - at
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        half = 0.5 * math.acos(max(-1.0, min(1.0, float(a @ b) / (la * lb))))
        cut = min(radius / math.tan(half), 0.45 * la, 0.45 * lb)
        start, end = at + cut * a / la, at + cut * b / lb
        t = np.linspace(0, 1, 12)[:, None]
        # a quadratic curve between the points of tangency
        pieces.append((1 - t) ** 2 * start + 2 * t * (1 - t) * at + t**2 * end)
    return np.concatenate(pieces)


def _ellipse(rng: np.random.Generator) -> list[Loop]:
    return [_polar(np.ones(240)) * [rng.uniform(1.0, 1.8), 1.0]]


def _rectangle(rng: np.random.Generator) -> list[Loop]:
    w = rng.uniform(1.0, 3.0)
    return [np.array([(0.0, 0.0), (w, 0.0), (w, 1.0), (0.0, 1.0)])]


def _polygon(rng: np.random.Generator) -> list[Loop]:
    sides = int(rng.integers(3, 8))
    angle = 2 * math.pi * (np.arange(sides) + rng.uniform(-0.2, 0.2, sides)) / sides
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * rng.uniform(0.85, 1.15, (sides, 1))
    return [_rounded(corners, rng.uniform(0.1, 0.3))]


def _star(rng: np.random.Generator) -> list[Loop]:
    arms = int(rng.integers(3, 7))
    depth = rng.uniform(0.15, 0.35) * (1.0 if arms < 6 else 0.7)
    return [_polar(1 + depth * np.cos(arms * _arc()))]


def _blob(rng: np.random.Generator) -> list[Loop]:
    angle, radius = _arc(), np.ones(240)
    for k in range(2, 6):
        radius += rng.uniform(-0.3, 0.3) / k * np.cos(k * angle + rng.uniform(0, 2 * math.pi))
    return [_polar(radius)]


def _ring(rng: np.random.Generator) -> list[Loop]:
    hole, shift = rng.uniform(0.3, 0.5), rng.uniform(0.0, 0.12)
    return [_polar(np.ones(240)), (hole * _polar(np.ones(240)) + [shift, 0.0])[::-1]]


def _plate(rng: np.random.Generator) -> list[Loop]:
    w, hole = rng.uniform(1.5, 2.2), rng.uniform(0.18, 0.26)
    loops = [_rounded(np.array([(-w, -1.0), (w, -1.0), (w, 1.0), (-w, 1.0)]) / 2, 0.2)]
    return [*loops, *((hole * _polar(np.ones(240)) + [x, 0.0])[::-1] for x in (-w / 4, w / 4))]


def _gear(rng: np.random.Generator) -> list[Loop]:
    teeth, depth = int(rng.integers(5, 9)), rng.uniform(0.25, 0.35)
    angle = 2 * math.pi * (np.arange(teeth)[:, None] + np.array([-0.3, -0.17, 0.17, 0.3])) / teeth
    radius = np.array([1.0, 1 + depth, 1 + depth, 1.0])
    outer = (radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)).reshape(-1, 2)
    return [outer, (rng.uniform(0.3, 0.45) * _polar(np.ones(240)))[::-1]] if rng.random() < 0.5 else [outer]


def _letter(rng: np.random.Generator) -> list[Loop]:
    """Return the outline of an L, T, U or plus with arms of random width."""
    t = rng.uniform(0.34, 0.45)
    w, kind = rng.uniform(1.0, 1.4), int(rng.integers(4))
    m, r = w / 2, t / 2
    corners = {
        0: [(0, 0), (w, 0), (w, t), (t, t), (t, 1), (0, 1)],
        1: [(m - r, 0), (m + r, 0), (m + r, 1 - t), (w, 1 - t), (w, 1), (0, 1), (0, 1 - t), (m - r, 1 - t)],
        2: [(0, 0), (w, 0), (w, 1), (w - t, 1), (w - t, t), (t, t), (t, 1), (0, 1)],
        3: [
            (m - r, 0), (m + r, 0), (m + r, 0.5 - r), (w, 0.5 - r), (w, 0.5 + r), (m + r, 0.5 + r),
            (m + r, 1), (m - r, 1), (m - r, 0.5 + r), (0, 0.5 + r), (0, 0.5 - r), (m - r, 0.5 - r),
        ],
    }[kind]  # fmt: skip
    return [np.array(corners, dtype=float)]


OUTLINES: dict[str, Callable[[np.random.Generator], list[Loop]]] = {
    "ellipse": _ellipse,
    "rectangle": _rectangle,
    "polygon": _polygon,
    "star": _star,
    "blob": _blob,
    "ring": _ring,
    "plate": _plate,
    "gear": _gear,
    "letter": _letter,
}
"""Families of bodies in 2D."""


def random_outline(rng: np.random.Generator, family: str | None = None) -> list[Loop]:
    """Return the loops of a body of unit area around the origin, of a given or random family. The outer loop comes first."""
    names = tuple(OUTLINES)
    loops = OUTLINES[family or names[rng.integers(len(names))]](rng)
    size = 1 / math.sqrt(sum(_area(loop) for loop in loops))
    low, high = loops[0].min(axis=0), loops[0].max(axis=0)
    return [size * (loop - (low + high) / 2) for loop in loops]


def _area(loop: Loop) -> float:
    after = np.roll(loop, -1, axis=0)
    return float(np.sum(loop[:, 0] * after[:, 1] - loop[:, 1] * after[:, 0]) / 2)


def _ellipsoid(rng: np.random.Generator) -> Distance:
    axes = np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.6, 1.0)])

    def distance(x: np.ndarray) -> np.ndarray:
        scaled, slope = np.linalg.norm(x / axes, axis=-1), np.linalg.norm(x / axes**2, axis=-1)
        return np.where(slope > 0, scaled * (scaled - 1) / np.maximum(slope, 1e-12), -axes.min())

    return distance


def _cuboid(rng: np.random.Generator) -> Distance:
    half, radius = np.array([rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.0), 0.6]), rng.uniform(0.3, 0.45)
    return lambda x: _box_distance(x, half - radius) - radius


def _box_distance(x: np.ndarray, half: np.ndarray) -> np.ndarray:
    q = np.abs(x) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def _cylinder(rng: np.random.Generator) -> Distance:
    length, radius = rng.uniform(0.5, 1.2), 0.3

    def distance(x: np.ndarray) -> np.ndarray:
        q = np.stack([np.hypot(x[..., 0], x[..., 1]) - 0.7 + radius, np.abs(x[..., 2]) - length + radius], axis=-1)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) - radius

    return distance


def _torus(rng: np.random.Generator) -> Distance:
    thickness = rng.uniform(0.42, 0.5)
    return lambda x: np.hypot(np.hypot(x[..., 0], x[..., 1]) - 1.0, x[..., 2]) - thickness


def _bend(rng: np.random.Generator) -> Distance:
    """Return the signed distance of two arms at a right angle."""
    arm = rng.uniform(1.0, 1.3)
    a, b = np.array([arm, 0.5, 0.5]), np.array([0.5, arm, 0.5])

    def distance(x: np.ndarray) -> np.ndarray:
        one = _box_distance(x - [arm - 0.5, 0.0, 0.0], a - 0.35)
        return np.minimum(one, _box_distance(x - [0.0, arm - 0.5, 0.0], b - 0.35)) - 0.35

    return distance


def _dumbbell(rng: np.random.Generator) -> Distance:
    """Return the signed distance of two balls on a rod, with smooth transitions."""
    span, second = rng.uniform(0.7, 0.9), rng.uniform(0.5, 0.7)

    def distance(x: np.ndarray) -> np.ndarray:
        rod = np.linalg.norm(x - np.stack([np.clip(x[..., 0], -span, span), *[np.zeros(x.shape[:-1])] * 2], axis=-1), axis=-1) - 0.42
        parts = [rod, *(np.linalg.norm(x - [s, 0.0, 0.0], axis=-1) - r for s, r in ((-span, 0.65), (span, second)))]
        return -0.08 * np.log(np.sum(np.exp(-np.stack(parts) / 0.08), axis=0))

    return distance


SOLIDS: dict[str, Callable[[np.random.Generator], Distance]] = {
    "ellipsoid": _ellipsoid,
    "cuboid": _cuboid,
    "cylinder": _cylinder,
    "torus": _torus,
    "bend": _bend,
    "dumbbell": _dumbbell,
}
"""Families of bodies in 3D."""


def random_solid(rng: np.random.Generator, family: str | None = None) -> tuple[Distance, float]:
    """Create a body of about unit volume, of a given or random family.

    Returns:
        The signed distance of the body, in some families only approximate, and half the width of a cube around the origin that contains the body.
    """
    names = tuple(SOLIDS)
    distance = SOLIDS[family or names[rng.integers(len(names))]](rng)
    reach, count = 2.2, 40
    axis = reach * (2 * np.arange(count) + 1 - count) / count
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = distance(grid) < 0
    width = float(np.sum(inside)) ** (1 / 3) * 2 * reach / count
    return (lambda x: distance(x * width) / width), (float(np.max(np.abs(grid[inside]))) + 2 * reach / count) / width
