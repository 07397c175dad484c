"""Scenes made from the first frame of a recording by another solver.

A scene has the recorded ground and either the recorded liquid or a flood. It is scaled to the particle spacing of a trained model. Gravity cannot be scaled,
so a scene that is s times as long stays similar at an equal Froude number v²/(g l)::

    length ∝ s      time ∝ √s      velocity ∝ √s      kinematic viscosity ∝ s^(3/2)

The file format is that of the data of DMCF [Prantl et al. 2022, "Guaranteed Conservation of Momentum for Learning Particle-based Fluid Dynamics"]: msgpack
compressed with zstandard. A file holds a list of frames. Each frame is a map of arrays, stored as msgpack-numpy stores them. Every frame has ``pos``, ``vel``,
``m`` and ``viscosity`` of its particles. The first frame also has ``box`` and ``box_normals``, the points and unit normals of the walls. The y axis points up.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.errors import GpeError
from gpe_pl.geometry.shapes import Shape, domain_walls, signed_distance
from gpe_pl.geometry.terrain import ground_of
from gpe_pl.schema import STICKY, MaterialValues, node_code
from gpe_pl.solvers.scenes import CLEARANCE, LiquidOnGrid, filled_box, parameter_columns
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.state import State

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]

MAX_BYTES = 2**31
"""Largest size of an unpacked recording [bytes]."""
WATER = 1000.0
"""Density of the recorded liquid [kg/m³]. The particle spacing follows from it and from the particle mass."""
HEADROOM = 0.25
"""Height of the domain above the highest wall, as a fraction of the height of the walls."""
FASTEST = 10.0
"""Largest speed of a recorded particle, in units of the speed of a free fall through the height of the domain; no limit applies without gravity."""
UPSTREAM = 1 / 3
"""Fraction of the domain, at low x, in which a flood starts."""


class RecordingError(GpeError, ValueError):
    """Raised when a recording cannot be used; the message names the file and says what is wrong."""


@plain_dataclass(frozen=True)
class Recording:
    """A recorded scene with its vertical axis last.

    Attributes:
        walls, normals: points on the ground [point, 3] in m, and unit normals into free space [point, 3].
        pos, vel: positions and velocities of the particles [node, 3] in m and m/s.
        viscosity: kinematic viscosity [m²/s].
        spacing: spacing of the particles [m].
    """

    walls: np.ndarray
    normals: np.ndarray
    pos: np.ndarray
    vel: np.ndarray
    viscosity: float
    spacing: float

    def scaled(self, s: float) -> Recording:
        """Return the similar scene that is s times as long."""
        return Recording(s * self.walls, self.normals, s * self.pos, math.sqrt(s) * self.vel, s**1.5 * self.viscosity, s * self.spacing)

    def moved(self, by: np.ndarray) -> Recording:
        """Return the scene translated by a vector [3] in m."""
        return replace(self, walls=self.walls + by, pos=self.pos + by)


def read_recording(path: Path | str) -> Recording:
    """Read the first frame of a recording. Nothing in the file is executed, and only the first frame is unpacked.

    Raises:
        RecordingError: the file is missing, damaged or of another format, or holds numbers that no scene can have; or msgpack and zstandard are not installed.
    """
    path = Path(path)
    try:
        import msgpack
        import zstandard
    except ModuleNotFoundError as error:
        raise RecordingError(f"{path}: needs the package {error.name}; install it with `pip install 'gpe_pl[import]'`") from None
    if not path.is_file():
        raise RecordingError(f"{path}: no such file (searched from {Path.cwd()})")
    try:
        with path.open("rb") as file, zstandard.ZstdDecompressor().stream_reader(file) as stream:
            unpacker = msgpack.Unpacker(stream, raw=True, strict_map_key=False, max_buffer_size=MAX_BYTES)
            if unpacker.read_array_header() < 1:
                raise ValueError("it has no frames")
            frame = unpacker.unpack()
        arrays = {name: _array(frame, name) for name in ("box", "box_normals", "pos", "vel", "m", "viscosity")}
    except Exception as error:  # these packages raise several types on damaged files
        raise RecordingError(f"{path}: not a recording in DMCF's format ({type(error).__name__}: {error})") from None
    points, nodes = len(arrays["box"]), len(arrays["pos"])
    wanted = {"box": (points, 3), "box_normals": (points, 3), "pos": (nodes, 3), "vel": (nodes, 3), "m": (nodes,), "viscosity": (nodes,)}
    for name, shape in wanted.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            raise RecordingError(f"{path}: {name} of the first frame is {arrays[name].shape}, expected {shape}, all finite")
    if min(shape[0] for shape in wanted.values()) < 1 or arrays["m"].min() <= 0 or arrays["viscosity"].min() <= 0:
        raise RecordingError(f"{path}: the first frame must have walls, and particles with positive mass and viscosity")
    if np.abs(np.linalg.norm(arrays["box_normals"], axis=1) - 1.0).max() > 1e-3:
        raise RecordingError(f"{path}: box_normals of the first frame are not unit vectors")
    up = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    walls, normals, pos, vel = (arrays[name] @ up.T for name in ("box", "box_normals", "pos", "vel"))
    return Recording(walls, normals, pos, vel, float(np.median(arrays["viscosity"])), float(np.cbrt(np.median(arrays["m"]) / WATER)))


def _array(frame: Any, name: str) -> np.ndarray:
    stored = frame[name.encode()]
    dtype = np.dtype(stored[b"type"].decode())
    if not stored[b"nd"] or dtype.kind not in "fiu":
        raise ValueError(f"{name} is not an array of numbers")
    return np.frombuffer(stored[b"data"], dtype).reshape(stored[b"shape"]).astype(np.float64)


@dataclass(frozen=True, config={"extra": "forbid"})
class RecordedScene(LiquidOnGrid):
    """A recorded canyon, scaled so that its particles have the spacing of a trained model.

    The walls are sampled again at that spacing. Vertical walls surround the scene, and its top is open.

    Attributes:
        file: path of the recording, relative to the working directory.
        grid_spacing: grid spacing of the solver that made the training data [m].
        particles_per_cell: particles along each axis of a cell; the rest spacing is ``grid_spacing / particles_per_cell``.
        num_particles: number of particles of a flood, which fills the lowest free places of the upstream third and starts at rest; None takes the
            recorded particles.
        density: density of the liquid [kg/m³].
        gravity: acceleration of gravity [m/s²].
        friction: friction coefficient of the ground and the walls around the scene. The solver ``flip`` does not use it.
        connectivity_cells: recommended connectivity radius in grid cells.
    """

    file: str
    grid_spacing: PositiveFloat
    particles_per_cell: Annotated[int, Field(ge=1)] = 2
    num_particles: Annotated[int, Field(ge=1)] | None = None
    density: PositiveFloat = 1000.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    friction: Annotated[float, Field(ge=0, allow_inf_nan=False)] = STICKY
    connectivity_cells: PositiveFloat = 1.5

    @property
    def scale(self) -> float:
        """Length of the scene divided by that of the recording; times scale with the square root of it."""
        return self.spacing / _read(self.file).spacing

    @property
    def recording(self) -> Recording:
        """The scaled recording, moved so that the low corner of its walls is the origin."""
        scaled = _read(self.file).scaled(self.scale)
        return scaled.moved(-scaled.walls.min(axis=0))

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        length, width, height = self.recording.walls.max(axis=0)
        return (0.0, float(length)), (0.0, float(width)), (0.0, float((1 + HEADROOM) * height))

    @property
    def max_nodes(self) -> int:
        """Largest number of dynamic nodes of a scene."""
        return self.num_particles or len(_read(self.file).pos)

    @property
    def input_files(self) -> dict[str, str]:
        return {"file": self.file}

    def sample(self, values: Mapping[str, MaterialValues], seed: int) -> State:
        """Make the scene. It depends only on the settings, the file, ``values`` and, for a flood, the seed.

        Args:
            values: kinematic viscosity [m²/s] under the key ``fluid``; without it the scaled viscosity of the recording applies.
            seed: seed of the positions of a flood's particles.

        Raises:
            ValueError: the flood does not fit.
            RecordingError: the walls form no ground, or a recorded particle lies in the ground or moves implausibly fast.
        """
        recording, bounds = self.recording, self.bounds
        sides = domain_walls(bounds, self.friction)[:4]
        try:
            ground = ground_of(recording.walls, recording.normals, bounds, self.grid_spacing, self.friction)
        except ValueError as error:
            raise RecordingError(f"{self.file}: its walls make no ground ({error})") from None
        shapes: tuple[Shape, ...] = (*sides, ground)
        pos, vel = recording.pos, recording.vel
        if self.num_particles is not None:
            pos = self._flood(self.num_particles, shapes, bounds, seed)
            vel = np.zeros_like(pos)
        else:
            self._check(pos, vel, shapes, bounds[2][1])
        count = len(pos)
        node_type = np.full(count, node_code("fluid"), dtype=np.uint8)
        params, names = parameter_columns({"fluid": recording.viscosity, **values}, node_type, self.materials)
        return State(
            pos=pos,
            vel=vel,
            node_type=node_type,
            mass=np.full(count, self.density * self.spacing**3),
            material_params=params,
            boundary=Boundary.sample(shapes, self.spacing, 3),
            gravity=np.array(self.gravity, dtype=np.float64),
            param_names=names,
        )

    def _check(self, pos: np.ndarray, vel: np.ndarray, shapes: tuple[Shape, ...], height: float) -> None:
        """Raise ``RecordingError`` for implausible particles, which would make a solver or model fail later without a clear reason."""
        depth = -signed_distance(shapes, pos)
        speed, falling = np.linalg.norm(vel, axis=1), math.sqrt(2 * float(np.linalg.norm(self.gravity)) * height)
        for values, limit, text in (
            (depth, self.spacing, "lies {:.3g} m deep in the ground or outside the walls, more than the particle spacing of {:.3g} m"),
            (speed, FASTEST * falling or math.inf, "moves at {:.3g} m/s, faster than {:.3g} m/s, the limit for a fall through this scene"),
        ):
            wrong = np.flatnonzero(~(values <= limit))
            if len(wrong):
                more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
                raise RecordingError(f"{self.file}: after scaling, particle {wrong[0]}{more} {text.format(values[wrong[0]], limit)}")

    def _flood(self, count: int, shapes: tuple[Shape, ...], bounds: tuple[tuple[float, float], ...], seed: int) -> np.ndarray:
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        points = filled_box(((0.0, UPSTREAM * bounds[0][1]), *bounds[1:]), self.spacing, rng)
        points = points[signed_distance(shapes, points) > CLEARANCE * self.spacing * (1 - 1e-6)]
        if len(points) < count:
            raise ValueError(
                f"{count} particles of spacing {self.spacing:g} m do not fit into the upstream third, at most {len(points)}; lower num_particles"
            )
        lowest = points[np.argsort(points[:, 2], kind="stable")[:count]]
        return np.ascontiguousarray(rng.permutation(lowest))


def _read(file: str) -> Recording:
    """Call ``read_recording``, once per content of the file."""
    path = Path(file)
    stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else (0, 0)
    return _read_once(str(path.absolute()), stamp)


@functools.lru_cache(maxsize=2)
def _read_once(path: str, stamp: tuple[int, int]) -> Recording:
    return read_recording(path)
