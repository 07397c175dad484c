"""Random canyons for scenes of liquid. The last axis points up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpe_pl.geometry.grid_distance import Bounds, below_heights, columns_of, lattice
from gpe_pl.geometry.shapes import DistanceGrid
from gpe_pl.schema import STICKY


@dataclass(frozen=True)
class Canyon:
    """A canyon along x: a river bed that descends from a reservoir at low x, a waterfall, and a pool at high x.

    Attributes:
        terrain: the solid ground.
        reservoir: ``(low, high)`` per axis [m] of the region where the water starts. The headwall and the banks enclose it.
        fall: x coordinate of the edge of the waterfall [m].
        pool: height of the deepest ground below the waterfall [m].
    """

    terrain: DistanceGrid
    reservoir: Bounds
    fall: float
    pool: float


def canyon(seed: int, bounds: Bounds, spacing: float, friction: float = STICKY) -> Canyon:
    """Create a random canyon. The same seed gives the same canyon at any spacing.

    Args:
        seed: non-negative integer.
        bounds: ``(low, high)`` of the domain along x, y and z [m].
        spacing: spacing of the grid of signed distances [m].
        friction: Coulomb coefficient of the rock.

    Raises:
        ValueError: seed, bounds or spacing are invalid, or the grid would have too many nodes.
    """
    low, counts = lattice(bounds, spacing)
    room = np.ptp(np.array(bounds, float), axis=1)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    place = (columns_of(low, spacing, counts) - low[:2]) / room[:2]
    x, y = place[..., 0], place[..., 1]
    edge, lip, sink = rng.uniform(0.46, 0.58), rng.uniform(0.44, 0.5), rng.uniform(0.05, 0.1)
    bend, turns, phase = rng.uniform(0.05, 0.12), rng.uniform(0.8, 1.4), rng.uniform(0, 2 * math.pi)
    narrow, narrows = rng.uniform(0.13, 0.18), rng.uniform(0.34, 0.4)

    step = 0.03  # length of the fall, as a fraction of the domain's
    upper = lip + 0.15 * (edge - x) + 0.006 * _waves(rng, x, 0 * x, 3.0)
    lower = sink + 0.03 * _waves(rng, x, y, 5.0) * (1 - _rise(edge, edge + 0.2, x)) + 0.02
    bed = upper + (lower - upper) * _rise(edge, edge + step, x)
    width = narrow + (0.26 - narrow) * (1 - _rise(0.22, narrows, x)) + (0.29 - narrow) * _rise(edge, edge + 0.15, x)
    width = width * (1 + 0.1 * _waves(rng, x, 0 * y, 9.0)) + 0.02 * _waves(rng, x, y, 12.0)
    middle = 0.5 + bend * np.sin(2 * math.pi * turns * x + phase) * _rise(0.15, 0.35, x)
    outside = np.abs(y - middle) - width
    plateau = 0.86 + 0.08 * _waves(rng, x, y, 4.0)
    bank = 0.65 * _rise(0.0, 0.06, outside) + 0.35 * _rise(0.07, 0.14, outside)  # two steps with a ledge between them
    fraction = bed + (plateau - bed) * bank + 0.015 * _waves(rng, x, y, 25.0) * (0.3 + bank)
    heights = low[2] + room[2] * np.clip(fraction, 0.03, 0.97)
    terrain = DistanceGrid.from_values(low, spacing, below_heights(heights, low, spacing, counts), friction)
    # The banks enclose water up to the lowest place of their crests.
    banks = heights[: int(np.sum(x[:, 0] <= narrows))]
    level = min(bank.max(axis=1).min() for bank in np.array_split(banks, 2, axis=1))
    first, across, floor = (float(v) for v in low)
    reservoir = (
        (first, first + float(narrows * room[0])),
        (across, across + float(room[1])),
        (floor + float((lip - 0.05) * room[2]), float(level)),
    )
    return Canyon(terrain, reservoir, float(low[0] + room[0] * edge), float(heights.min()))


def _rise(start: float, end: float, x: np.ndarray) -> np.ndarray:
    """Return a smooth step from 0 at ``start`` to 1 at ``end``."""
    t = np.clip((x - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def _waves(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, frequency: float, number: int = 8) -> np.ndarray:
    """Return smooth random noise of about unit size: a sum of ``number`` waves with at most ``frequency`` periods per unit length."""
    total: np.ndarray = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for _ in range(number):
        angle, phase, k = rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi), 2 * math.pi * frequency * rng.uniform(0.3, 1.0)
        total = total + np.cos(k * (math.cos(angle) * x + math.sin(angle) * y) + phase)
    return total * math.sqrt(2 / number) / 2
