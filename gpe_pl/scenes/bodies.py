"""Bodies of a scene: regions of one material, which become nodes at the spacing of a model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from gpe_pl.errors import GpeError
from gpe_pl.geometry.body_shapes import JITTER, MESHED, lattice_cells
from gpe_pl.geometry.meshing import MeshingError, triangulate
from gpe_pl.geometry.shapes import Polygon
from gpe_pl.solvers.solid_scenes import lumped_masses

log = logging.getLogger(__name__)

NUM_SIDES = 48
"""Number of corners of the outline of a disc of a meshed solid."""
MOST_NODES = 500_000
"""Largest number of nodes of a body."""
DARK = 0.5
"""Brightness below which a pixel of an image belongs to the body, from 0 to 1."""
MASS_TOLERANCE = 0.1
"""Fraction by which the mass of the nodes may differ from that of the body without a warning."""
MOST_SMALL = 2_000
"""Number of nodes above which the masses are not compared, because the difference is small then."""
MOST_LOOSE = 0.25
"""Largest fraction of the nodes of an elastic body that may be in no cell."""
Region = Callable[[np.ndarray], np.ndarray]
"""Tells which of points [point, dim] are inside."""


class BodyFault(GpeError, ValueError):
    """Raised for a body that has no nodes; the message says why."""


@dataclass(frozen=True)
class Body:
    """A region of one material.

    Attributes:
        name: name in messages, such as ``block 1 (sand)``.
        material: name of the material.
        low, high: corners of its bounding box [dim] in m.
        contains: tells which of points [point, dim] are inside.
        outline: corners of its outline [corner, 2] in m, counter-clockwise, if it has one.
        velocity: initial velocity [dim] in m/s.
        parameters: given material parameters by name.
        density: density [kg/m³]; None takes that of the training data.
    """

    name: str
    material: str
    low: np.ndarray
    high: np.ndarray
    contains: Region
    outline: np.ndarray | None
    velocity: np.ndarray
    parameters: Mapping[str, float]
    density: float | None = None


@dataclass(frozen=True)
class Nodes:
    """Nodes of a body: positions [node, dim] in m, masses [node] in kg, and nodes of mesh cells [cell, corner]."""

    pos: np.ndarray
    mass: np.ndarray
    cells: np.ndarray


def discretised(body: Body, spacing: float, density: float, rng: np.random.Generator) -> Nodes:
    """Fill a body with nodes: solids with a mesh, elastomers with a regular lattice and its cells, other materials with a jittered lattice.

    The distances of a lattice differ from the spacing so far that a whole number of nodes fills the sides of the body.

    Raises:
        BodyFault: the body is thinner than the spacing, has too many nodes, or its outline cannot be meshed.
    """
    dim = len(body.low)
    if body.material == "solid":
        return _meshed(body, spacing, density, rng)
    count = np.maximum(1, np.round((body.high - body.low) / spacing)).astype(int)
    if (body.high - body.low < (1 - 1e-6) * spacing).any():
        raise BodyFault(f"{body.name}: is {min(body.high - body.low):g} m thin, less than the distance of nodes, {spacing:g} m")
    if np.prod(count.astype(float)) > MOST_NODES:
        raise BodyFault(
            f"{body.name}: would have {np.prod(count.astype(float)):.3g} nodes {spacing:g} m apart, at most {MOST_NODES:,}; make it smaller"
        )
    sites = np.stack(np.meshgrid(*[np.arange(n) for n in count], indexing="ij"), axis=-1).reshape(-1, dim)
    distance = (body.high - body.low) / count
    centre = body.low + distance * (sites + 0.5)
    inside = body.contains(centre)
    if not inside.any():
        raise BodyFault(f"{body.name}: has no node, as nodes are {spacing:g} m apart; make it larger")
    is_meshed = body.material in MESHED
    cells = lattice_cells(sites[inside]) if is_meshed else np.empty((0, dim + 1), dtype=np.int64)
    num_loose = int(inside.sum()) - len(np.unique(cells))
    if is_meshed and num_loose > MOST_LOOSE * inside.sum():
        raise BodyFault(
            f"{body.name}: {num_loose} of its {int(inside.sum())} nodes are in no cell, so that it would fall to pieces; make it at least two distances of "
            f"nodes thick, {2 * spacing:g} m"
        )
    pos = centre[inside] + (0.0 if is_meshed else distance * rng.uniform(-JITTER, JITTER, (int(inside.sum()), dim)))
    nodes = Nodes(pos, np.full(len(pos), density * distance.prod()), cells)
    _warn_of_mass(body, nodes, density, spacing)
    return nodes


def overlap(one: Region, other: Region, pos: np.ndarray, spacing: float) -> bool:
    """Whether two regions overlap by about half a spacing [m] or more in every direction, near the nodes of the first at ``pos`` [node, dim] in m.

    Thinner overlaps are those of outlines that touch. Nodes alone do not tell, because the lattices of two bodies can interleave.
    """
    dim = pos.shape[1]
    corners = np.stack(np.meshgrid(*[(-0.25, 0.25)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    points = (pos[:, None] + spacing * corners).reshape(-1, dim)
    points = points[other(points)]
    for step in 0.24 * spacing * np.concatenate([np.zeros((1, dim)), np.eye(dim), -np.eye(dim)]):
        points = points[one(points + step) & other(points + step)]
    return bool(len(points))


def _warn_of_mass(body: Body, nodes: Nodes, density: float, spacing: float) -> None:
    """Warn if the nodes of a small or thin body have another mass than the body."""
    if len(nodes.pos) > MOST_SMALL:
        return
    ratio = float(nodes.mass.sum()) / (density * _volume(body, spacing))
    if abs(ratio - 1) > MASS_TOLERANCE:
        log.warning(
            "%s: its nodes have %.2f times its mass, because few nodes %g m apart fit into it; another size may fit better",
            body.name,
            ratio,
            spacing,
        )


def _volume(body: Body, spacing: float) -> float:
    """Return the volume of a body [m³], or its area in 2D [m²]: that of its outline, or of the sites of a lattice with four sites in a spacing [m]."""
    if body.outline is not None:
        return float(shapely.Polygon(body.outline).area)
    count = np.maximum(4, np.ceil(4 * (body.high - body.low) / spacing)).astype(int)
    sites = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n for n in count], indexing="ij"), axis=-1).reshape(-1, len(count))
    inside = body.contains(body.low + (body.high - body.low) * sites)
    return max(1, int(inside.sum())) / len(sites) * float(np.prod(body.high - body.low))


def _meshed(body: Body, spacing: float, density: float, rng: np.random.Generator) -> Nodes:
    if body.outline is None:
        raise BodyFault(f"{body.name}: solids need an outline in 2D; give a block, a ball or a polygon")
    try:
        pos, cells = triangulate([body.outline], spacing, rng)
    except MeshingError as error:
        raise BodyFault(f"{body.name}: {error}") from None
    nodes = Nodes(pos, lumped_masses(pos, cells, density), cells)
    _warn_of_mass(body, nodes, density, spacing)
    return nodes


def block(low: np.ndarray, high: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray | None]:
    """Return region and outline of a box."""
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]) if len(low) == 2 else None
    return lambda x: np.all((x >= low) & (x <= high), axis=-1), corners


def ball(center: np.ndarray, radius: float) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray | None]:
    """Return region and outline of a disc or ball."""
    angle = 2 * np.pi * np.arange(NUM_SIDES) / NUM_SIDES
    outline = center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1) if len(center) == 2 else None
    return lambda x: np.linalg.norm(x - center, axis=-1) <= radius, outline


def polygon(corners: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """Return region and outline of a simple polygon [corner, 2]; raises ``ValueError`` if it is none."""
    x, y = corners[:, 0], corners[:, 1]
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) < 0:
        corners = corners[::-1]
    shape = Polygon(tuple((float(a), float(b)) for a, b in corners), 0.0)
    return lambda points: shape.signed_distance(points) <= 0, corners


def image(path: Path, low: np.ndarray, high: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the region of the dark, opaque pixels of an image that is stretched over a rectangle.

    Raises:
        BodyFault: the file cannot be read, has pixels of an unknown range, or has no dark pixel.
    """
    from PIL import Image, ImageOps

    try:
        with Image.open(path) as file:
            opened = ImageOps.exif_transpose(file)  # upright, as viewers show it
            mode = opened.mode
            if mode.startswith("I;16"):
                brightness = np.asarray(opened, np.float64) / (2**16 - 1)
                values = np.stack([brightness, np.ones_like(brightness)], axis=-1)
            else:
                values = np.asarray(opened.convert("LA"), np.float64) / 255
    except FileNotFoundError:
        raise BodyFault(f"{path}: no such file (searched from {Path.cwd()})") from None
    except Exception as error:  # of the reader, of any type
        raise BodyFault(f"{path}: cannot be read as an image ({type(error).__name__})") from None
    if mode in ("I", "F"):  # white may be any number
        raise BodyFault(f"{path}: has pixels of mode {mode}, whose range is not known; save it with 8 or 16 bits")
    mask = (values[..., 0] < DARK) & (values[..., 1] > DARK)
    if not mask.any():
        raise BodyFault(f"{path}: has no dark pixels; draw the body black on white")
    rows, columns = mask.shape

    def contains(points: np.ndarray) -> np.ndarray:
        place = (points - low) / (high - low)
        column = np.clip((place[:, 0] * columns).astype(int), 0, columns - 1)
        row = np.clip(((1 - place[:, 1]) * rows).astype(int), 0, rows - 1)
        return np.all((place >= 0) & (place <= 1), axis=-1) & mask[row, column]

    return contains
