"""``Scene``: bodies and obstacles in a box, rolled out by a model and by the solver that made its training data.

Example::

    scene = Scene(box=(1.5, 1.0)).block("sand", at=(0.1, 0.0), size=(0.2, 0.5), friction_angle=30).obstacle(Circle((0.7, 0.2), 0.1))
    scene.compare("sand", seconds=1).show()

A scene gives no spacing, masses, history or limits: they follow from the model.
"""

from __future__ import annotations

import itertools
import logging
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.geometry.mesh_points import in_mesh
from gpe_pl.geometry.shape_values import shape_fault
from gpe_pl.geometry.shapes import Shape, domain_walls, signed_distance
from gpe_pl.geometry.terrain import Up
from gpe_pl.learned.pretrained import model_name, names
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.scenes import bodies as region
from gpe_pl.scenes.bodies import Body, BodyFault, Nodes, discretised, overlap
from gpe_pl.scenes.film import Film
from gpe_pl.scenes.obstacles import FRICTION, MeshObstacle
from gpe_pl.scenes.recorded import NotRecorded, recorded_solver, settings
from gpe_pl.scenes.rollouts import middle_values, predicted, solved
from gpe_pl.scenes.united_obstacles import united
from gpe_pl.scenes.zones import AT_ONCE, Zone, is_number, nodes_of, opening_of, speed_of
from gpe_pl.schema import MATERIALS, node_code
from gpe_pl.solvers.materials import limits_fault
from gpe_pl.trajectory.boundary import Boundary
from gpe_pl.trajectory.openings import Opening
from gpe_pl.trajectory.source_origin import without_origin
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

log = logging.getLogger(__name__)

Point = Sequence[float | int]

EARTH = 9.81
"""Acceleration of gravity [m/s²] if none is given."""
CLOSEST = 0.3
"""Smallest distance of nodes of two bodies [spacings]."""
OF_ONE_DENSITY = ("mpm", "flip")
"""Solvers that take the volume of a node from its mass at the density of the data, so another mass would be another volume."""
TAKEN = ("solver", "ground truth", "prediction")
"""Names of rollouts of a film that no model has."""
SHIPPED = {"sand": "sand", "snow": "snow", "elastomer": "elastomer", "fluid": "fluid", "solid": "fem"}
"""Shipped model of each material, which a scene takes if none is named."""


def _is_friction(value: Any) -> bool:
    return is_number(value) and bool(0 <= value < math.inf)


class SceneFault(GpeError, ValueError):
    """Raised when a scene is impossible. The message names each body or obstacle with its fault, and ``faults`` has them by name."""

    def __init__(self, faults: Mapping[str, str], scene: Scene | None = None) -> None:
        super().__init__("; ".join(f"{name}: {fault}" if name else fault for name, fault in faults.items()))
        self.faults, self.scene = dict(faults), scene


@dataclass(frozen=True)
class Scene:
    """Bodies and obstacles in a box with walls. The methods return a new scene with one more part.

    Attributes:
        box: lengths of the sides [m], from the origin on; or ``(low, high)`` for each axis. The last axis points up. 2 or 3 axes.
        gravity: acceleration [m/s²]; None stands for 9.81 downward.
        friction: Coulomb coefficient of the walls, or one per wall by name (``x_low``, ``x_high``, ``y_low``, …).
        title: name of the scene in pictures.
        bodies, obstacles, zones: parts that were added, by name; zones are inlets and outlets.
        seed: integer of at least 0, seed of the random displacements of nodes from their lattice.
        spacing, frame_dt: spacing of nodes [m] and frame interval [s], for models of several; None takes those that a model names.

    Raises:
        SceneFault: a value is impossible.
    """

    box: Any
    gravity: Any = None
    friction: float | int | dict[str, float] = FRICTION
    title: str = "scene"
    bodies: tuple[Body, ...] = ()
    obstacles: tuple[tuple[str, Any], ...] = ()
    seed: Any = 0
    zones: tuple[Zone, ...] = ()
    spacing: float | int | None = None
    frame_dt: float | int | None = None

    def __post_init__(self) -> None:
        fault = "must have 2 or 3 sides [m], or (low, high) for each axis, such as (1.5, 1.0)"
        try:
            box = tuple((0.0, float(side)) if np.ndim(side) == 0 else (float(side[0]), float(side[1])) for side in self.box)
        except (TypeError, ValueError, IndexError):
            raise SceneFault({"box": f"{fault}, got {self.box!r}"}) from None
        if len(box) not in (2, 3) or not all(math.isfinite(high - low) and low < high for low, high in box):
            raise SceneFault({"box": f"{fault}, got {self.box!r}"})
        object.__setattr__(self, "box", box)
        if isinstance(self.seed, bool) or not isinstance(self.seed, (int, np.integer)) or self.seed < 0:
            raise SceneFault({"seed": f"must be a whole number of at least 0, got {self.seed!r}"})
        for name in ("spacing", "frame_dt"):
            if getattr(self, name) is not None:
                self._positive("", name, getattr(self, name))
        down = (*(0.0,) * (len(box) - 1), -EARTH) if self.gravity is None else self.gravity
        object.__setattr__(self, "gravity", tuple(self._vector("gravity", "gravity", down).tolist()))
        walls = {f"{axis}_{side}" for axis in "xyz"[: len(box)] for side in ("low", "high")}
        given = self.friction if isinstance(self.friction, dict) else dict.fromkeys(walls, self.friction)
        if set(given) != walls or not all(map(_is_friction, given.values())):
            raise SceneFault(
                {"friction": f"must be a number of at least 0, or one for each of {', '.join(sorted(walls))}, got {self.friction!r}"}
            )

    @property
    def dim(self) -> int:
        return len(self.box)

    # --- parts ---------------------------------------------------------------------------------------------------------------------------

    def block(self, material: str, at: Point, size: Point, **properties: Any) -> Scene:
        """Add a box-shaped body.

        Args:
            material: a name of ``schema.MATERIALS``.
            at: its low corner [dim] in m.
            size: its sides [dim] in m.
            properties: ``velocity`` [dim] in m/s, ``density`` in kg/m³, and parameters of the material by name, such as ``friction_angle=30``.
        """
        name = self._next("block", material)
        low, sides = self._vector(name, "at", at), self._vector(name, "size", size)
        self._positive(name, "size", *sides.tolist())
        contains, outline = region.block(low, low + sides)
        return self._with(name, material, low, low + sides, contains, outline, properties)

    def ball(self, material: str, at: Point, radius: float | int, **properties: Any) -> Scene:
        """Add a disc (2D) or ball (3D) with its centre at ``at`` [dim] in m and a radius [m]. Properties as in ``block``."""
        name = self._next("ball", material)
        center = self._vector(name, "at", at)
        self._positive(name, "radius", radius)
        contains, outline = region.ball(center, radius)
        return self._with(name, material, center - radius, center + radius, contains, outline, properties)

    def polygon(self, material: str, corners: Sequence[Point], **properties: Any) -> Scene:
        """Add a body with straight sides, given by its corners [corner, 2] in m. Properties as in ``block``."""
        name = self._next("polygon", material)
        self._plane(name)
        points = np.array([self._vector(name, "corners", corner) for corner in corners]).reshape(-1, 2)
        try:
            contains, outline = region.polygon(points)
        except ValueError as error:
            raise SceneFault({name: f"corners: {error}"}) from None
        return self._with(name, material, points.min(axis=0), points.max(axis=0), contains, outline, properties)

    def image(self, material: str, path: Path | str, at: Point, size: Point, **properties: Any) -> Scene:
        """Add a body where an image is dark. ``at`` and ``size`` [m] place the image as in ``block``. Properties as in ``block``."""
        name = self._next("image", material)
        self._plane(name)
        low, sides = self._vector(name, "at", at), self._vector(name, "size", size)
        self._positive(name, "size", *sides.tolist())
        return self._with(name, material, low, low + sides, region.image(Path(path), low, low + sides), None, properties)

    def obstacle(
        self,
        shape: Any = None,
        *,
        mesh: Path | str | None = None,
        at: Point | None = None,
        size: float | int | None = None,
        up: Up = "z",
        friction: float | int = FRICTION,
    ) -> Scene:
        """Add an obstacle: a shape of ``geometry.shapes`` or ``Circle``, or a mesh file (OBJ, STL, PLY).

        Args:
            shape: the shape, with its own friction.
            mesh: file of a closed triangle mesh. In 2D, its section through the middle is the obstacle.
            at: low corner of the mesh in the scene [dim] in m; None keeps the coordinates of the file.
            size: largest side of the mesh in the scene [m]; None keeps the size in the file.
            up: axis of the file that points up.
            friction: Coulomb coefficient of the mesh.
        """
        name = f"obstacle {len(self.obstacles) + 1}"
        if (shape is None) == (mesh is None):
            raise SceneFault({name: "give either a shape, such as Circle((0.5, 0.2), 0.1), or mesh=FILE"})
        if mesh is None:
            if not isinstance(shape, Shape):
                raise SceneFault({name: f"must be a shape, such as Circle((0.5, 0.2), 0.1), got {shape!r}"})
            if fault := shape_fault(shape, self.dim):
                raise SceneFault({name: fault})
            return replace(self, obstacles=(*self.obstacles, (name, shape)))
        if up not in ("x", "y", "z"):
            raise SceneFault({name: f"up={up!r}: must be x, y or z"})
        if size is not None:
            self._positive(name, "size", size)
        if not _is_friction(friction):
            raise SceneFault({name: f"friction={friction!r}: must be a number of at least 0"})
        if not Path(mesh).is_file():
            raise SceneFault({name: f"mesh={mesh}: no such file (searched from {Path.cwd()})"})
        placed = MeshObstacle(Path(mesh), None if at is None else self._vector(name, "at", at), size, up, float(friction))
        return replace(self, obstacles=(*self.obstacles, (name, placed)))

    def inlet(
        self,
        material: str,
        side: str,
        at: Point,
        size: Point,
        speed: Any = None,
        flow_rate: Any = None,
        **properties: Any,
    ) -> Scene:
        """Add a box that is full of material which enters the scene.

        Args:
            material: a name of ``schema.MATERIALS`` without mesh.
            side: side of the box where the material comes from, such as ``x_low``.
            at, size: low corner and sides of the box [dim] in m. Along the axis of ``side`` it is at least as deep as nodes see each other.
            speed: speed into the scene [m/s]; or pairs of a time [s] and the speed then, linear in between. While it is negative, the box takes material out.
            flow_rate: instead of the speed, volume that enters in a time [m³/s], or area in 2D [m²/s]; a number or pairs, too.
            properties: density and material parameters as in ``block``.
        """
        name = f"inlet {len(self.zones) + 1} ({material})"
        if material not in MATERIALS:
            raise SceneFault({name: f"unknown material{did_you_mean(str(material), MATERIALS)}; known are {', '.join(MATERIALS)}"})
        zone = self._zone(name, side, at, size, speed, flow_rate, is_inlet=True)
        if zone.speed is None:
            raise SceneFault({name: f"speed, flow_rate: missing; {AT_ONCE}"})
        velocity = zone.opening.velocity_at(0.0)
        contains, outline = region.block(zone.low, zone.high)
        if "velocity" in properties:
            raise SceneFault({name: "velocity: follows from speed and side; leave it out"})
        filled = self._with(name, material, zone.low, zone.high, contains, outline, {**properties, "velocity": velocity})
        return replace(self, zones=(*self.zones, replace(zone, body=filled.bodies[-1])))

    def outlet(self, side: str, at: Point, size: Point, speed: Any = None, flow_rate: Any = None) -> Scene:
        """Add a box where material leaves the scene.

        Without speed and flow rate, material disappears as soon as it is in the box, so it flows out freely. Otherwise material in the box moves towards
        ``side`` with the speed, and disappears there. Speeds and rates are positive. Other arguments as in ``inlet``.
        """
        zone = self._zone(f"outlet {len(self.zones) + 1}", side, at, size, speed, flow_rate, is_inlet=False)
        return replace(self, zones=(*self.zones, zone))

    # --- rollouts --------------------------------------------------------------------------------------------------------------------------

    def predict(self, model: str | None = None, seconds: float | int = 1.0) -> Film:
        """Roll a model out.

        Args:
            model: shipped model, folder of a run, or checkpoint; None takes the shipped model of the material.
            seconds: length [s].

        Raises:
            SceneFault: the scene is impossible, or does not fit the model.
        """
        return self._film(model, seconds, with_model=True, with_solver=False)

    def solve(self, seconds: float | int = 1.0, like: str | None = None) -> Film:
        """Roll the solver out that made the training data of the model ``like``, with the same nodes; other arguments as in ``predict``."""
        return self._film(like, seconds, with_model=False, with_solver=True)

    def compare(self, model: str | None = None, seconds: float | int = 1.0) -> Film:
        """Roll a model and its solver out from the same nodes; arguments as in ``predict``."""
        return self._film(model, seconds, with_model=True, with_solver=True)

    def sliders(self, model: str | None = None, seconds: float | int = 1.0) -> Any:
        """Return a widget for notebooks: a slider for each material parameter, and the viewer of the model's prediction; arguments as in ``predict``.

        Raises:
            NotebookError: ipywidgets is not installed.
            SceneFault: the scene is impossible, or does not fit the model.
        """
        from gpe_pl.scenes.sliders import sliders

        return sliders(self, model or self.shipped(), seconds)

    def show(self) -> Path:
        """Draw the scene to a file, and return its path. Bodies and zones that reach out of the box are red."""
        from gpe_pl.scenes.picture import draw
        from gpe_pl.viz.browser import open_page

        path = Path(tempfile.mkdtemp(prefix="gpe_")) / "scene.png"
        draw(self, self._misplaced(), path)
        if not open_page(path):
            print(f"no browser here; open {path}")
        return path

    def state(self, simulator: LearnedSimulator) -> tuple[State, Metadata]:
        """Return the scene at the spacing of a model, and its metadata.

        Raises:
            SceneFault: the scene is impossible, or does not fit the model.
        """
        own = simulator.builder.metadata
        if any(zone.has_rate and zone.body is not None for zone in self.zones):
            return replace(self, zones=tuple(zone.at_spacing(own.spacing) for zone in self.zones)).state(simulator)
        if any(own.periodic):
            raise SceneFault({"model": "is for a periodic domain; scenes have walls"})
        if own.dim != self.dim:
            raise SceneFault({"box": f"has {self.dim} axes, the model is for {own.dim}D"}, self)
        if not self.filled:
            raise SceneFault({"": "the scene has no body; add one, such as .block('sand', at=(0.1, 0.0), size=(0.2, 0.4))"}, self)
        rng, faults = np.random.default_rng(self.seed), self._misplaced()
        shapes = self._shapes(own.spacing, faults)
        values = {body.name: self._values(body, simulator, faults) for body in self.filled}
        found: dict[str, Nodes] = {}
        for body in self.bodies:
            if body.name not in faults:
                try:
                    found[body.name] = discretised(body, own.spacing, self._density(body, simulator), rng)
                except (BodyFault, NotRecorded) as error:
                    faults[body.name] = str(error).removeprefix(f"{body.name}: ")
        openings = self._openings(simulator, values, faults)
        found |= {zone.name: nodes_of(opening) for zone, opening in openings if zone.body is not None}
        self._check_contacts(found, shapes, own.spacing, faults)
        solids = [body.name for body in self.bodies if body.material == "solid"]
        if len(solids) > 1:
            faults[solids[1]] = "contact between solids is not computed; keep one solid in a scene"
        if faults:
            raise SceneFault(faults, self)
        self._warn_of_pushes(found, simulator)
        metadata = replace(without_origin(own), dataset="scene", bounds=self.box, gravity=self.gravity, split="", seed=self.seed)
        state = self._joined(found, values, united(shapes, own.spacing), own)
        return state.opened([opening for _, opening in openings]) if openings else state, metadata

    # --- details ---------------------------------------------------------------------------------------------------------------------------

    def _film(self, model: str | None, seconds: float | int, with_model: bool, with_solver: bool) -> Film:
        if not 0 < seconds <= 3600:
            raise SceneFault({"seconds": f"must be more than 0 and at most 3600, got {seconds}"})
        chosen = model or self.shipped()
        simulator = self.model_for(chosen)
        state, metadata = self.state(simulator)
        num_frames, name = max(2, round(seconds / metadata.frame_dt)), model_name(chosen, ".")
        if name in TAKEN:
            name = f"model {name}"
        rollouts: dict[str, Trajectory] = {}
        if with_solver:
            solver = self.solver_of(simulator)
            rollouts["solver"] = solved(solver, state, metadata, num_frames, f"solver {solver.name}")
        if with_model:
            rollouts[name] = predicted(simulator, state, metadata, num_frames, f"model {name}")
        first, *_ = rollouts
        return Film(self.title, rollouts[first], {key: rollout for key, rollout in rollouts.items() if key != first})

    def model_for(self, checkpoint: str) -> LearnedSimulator:
        """Return a model for the spacing and the frames of the scene, if the scene sets them.

        Args:
            checkpoint: shipped model, folder of a run, or checkpoint.

        Raises:
            SceneError: the model is of one scale, and the scene sets another.
        """
        simulator = LearnedSimulator.from_checkpoint(checkpoint)
        return simulator.at(self.spacing, self.frame_dt) if self.spacing or self.frame_dt else simulator

    def solver_of(self, simulator: LearnedSimulator) -> Any:
        """Return the solver of the model's training data for this box, rounded up to whole cells of its grid.

        Raises:
            SceneFault: a body has another density than the solver, whose nodes have the volume of a mass at its own density.
        """
        own = simulator.builder.metadata
        if own.solver in OF_ONE_DENSITY:
            usual = {body.name: self._density(replace(body, density=None), simulator) for body in self.filled}
            fault = "density: the solver of these data computes with {:g} kg/m³ only; leave density out, or predict without solving"
            wrong = {body.name: fault.format(usual[body.name]) for body in self.filled if body.density not in (None, usual[body.name])}
            if wrong:
                raise SceneFault(wrong, self)
        cell = settings(own)["solver"].get("grid_spacing")
        at_scale: dict[str, float] = {}
        if simulator.builder.reference is not None:  # the settings are those of another scale
            cell = None if cell is None else cell * simulator.builder.scales.length_ratio
            at_scale = {"frame_dt": own.frame_dt} | ({} if cell is None else {"grid_spacing": cell})
        box = self.box if cell is None else [(low, low + cell * math.ceil((high - low) / cell - 1e-6)) for low, high in self.box]
        return recorded_solver(own, bounds=box, materials=own.materials, **at_scale)

    def shipped(self) -> str:
        """Return the name of the shipped model of the material; raises ``SceneFault`` if there are several materials."""
        materials = {body.material for body in self.filled}
        if len(materials) != 1:
            here = ", ".join(sorted(materials)) or "the scene"
            raise SceneFault({"model": f"name one for {here}; shipped models ({', '.join(names())}) have one material each"})
        return SHIPPED[materials.pop()]

    def _next(self, kind: str, material: str) -> str:
        name = f"{kind} {len(self.bodies) + 1} ({material})"
        if material not in MATERIALS:
            raise SceneFault({name: f"unknown material{did_you_mean(str(material), MATERIALS)}; known are {', '.join(MATERIALS)}"})
        return name

    def _with(self, name: str, material: str, low: Any, high: Any, contains: Any, outline: Any, properties: Mapping[str, Any]) -> Scene:
        given, known = dict(properties), [parameter.name for parameter in MATERIALS[material]]
        velocity = self._vector(name, "velocity", given.pop("velocity", (0.0,) * self.dim))
        density = given.pop("density", None)
        if density is not None:
            self._positive(name, "density", density)
            density = float(density)
        for key, value in given.items():
            if key not in known:
                raise SceneFault(
                    {name: f"{key}: unknown key{did_you_mean(key, (*known, 'velocity', 'density'))}; {material} has {', '.join(known)}"}
                )
            if not is_number(value):
                raise SceneFault({name: f"{key}={value!r}: must be a number"})
            if fault := limits_fault(MATERIALS[material][known.index(key)], float(value)):
                raise SceneFault({name: fault})
        parameters = {key: float(value) for key, value in given.items()}
        body = Body(name, material, low, high, contains, outline, velocity, parameters, density)
        return replace(self, bodies=(*self.bodies, body))

    @property
    def filled(self) -> tuple[Body, ...]:
        """Bodies, and what is in inlets at the start."""
        return (*self.bodies, *(zone.body for zone in self.zones if zone.body is not None))

    def _zone(self, name: str, side: str, at: Point, size: Point, speed: Any, flow_rate: Any, is_inlet: bool) -> Zone:
        sides = [f"{axis}_{end}" for axis in "xyz"[: self.dim] for end in ("low", "high")]
        if side not in sides:
            raise SceneFault({name: f"side={side!r}: must be one of {', '.join(sides)}"})
        low, lengths = self._vector(name, "at", at), self._vector(name, "size", size)
        self._positive(name, "size", *lengths.tolist())
        try:
            given = speed_of(low, low + lengths, side, speed, flow_rate, is_inlet)
            return Zone(name, low, low + lengths, side, given, has_rate=flow_rate is not None)
        except BodyFault as fault:
            raise SceneFault({name: str(fault)}) from None

    def _openings(
        self, simulator: LearnedSimulator, values: Mapping[str, dict[str, float]], faults: dict[str, str]
    ) -> list[tuple[Zone, Opening]]:
        """Return the openings of the zones; faults are added to ``faults``."""
        own, openings = simulator.builder.metadata, []
        for zone in self.zones:
            if zone.name in faults:
                continue
            params = [values[zone.name].get(name, math.nan) if zone.body is not None else math.nan for name in own.param_names]
            try:
                mass = 0.0 if zone.body is None else self._density(zone.body, simulator) * own.spacing**self.dim
                openings.append((zone, opening_of(zone, own.spacing, own.connectivity_radius, mass, params)))
            except (BodyFault, NotRecorded) as error:
                faults[zone.name] = str(error)
        return openings

    def _plane(self, name: str) -> None:
        if self.dim != 2:
            raise SceneFault({name: f"exists in 2D only, the box has {self.dim} axes"})

    def _vector(self, name: str, key: str, values: Any) -> np.ndarray:
        try:
            vector = np.array(values, dtype=np.float64)
        except (TypeError, ValueError):
            vector = np.array(np.nan)
        if vector.shape != (self.dim,) or not np.isfinite(vector).all():
            raise SceneFault({name: f"{key}={values!r}: must be {self.dim} numbers, one for each axis of the box"})
        return vector

    @staticmethod
    def _positive(name: str, key: str, *values: Any) -> None:
        for value in values:
            if not is_number(value) or not 0 < value < math.inf:
                raise SceneFault({name: f"{key}={value!r}: must be a positive number"})

    def _misplaced(self) -> dict[str, str]:
        """Return the bodies and zones that reach out of the box, with how far."""
        faults = {}
        parts: tuple[Body | Zone, ...] = (*self.bodies, *self.zones)
        for body in parts:
            for axis, (low, high) in enumerate(self.box):
                if body.low[axis] < low - 1e-9 or body.high[axis] > high + 1e-9:
                    reach = f"from {body.low[axis]:g} to {body.high[axis]:g} m along {'xyz'[axis]}"
                    faults[body.name] = f"at, size: reaches {reach}, the box from {low:g} to {high:g} m"
        return faults

    def _shapes(self, spacing: float, faults: dict[str, str]) -> dict[str, Shape]:
        """Return the shapes of the obstacles by name."""
        shapes: dict[str, Shape] = {}
        low, high = np.array(self.box).T
        for name, obstacle in self.obstacles:
            try:
                shapes[name] = obstacle.shape(self.box, spacing) if isinstance(obstacle, MeshObstacle) else obstacle
                shapes[name].signed_distance(np.zeros((1, self.dim)))
                surface, _ = shapes[name].sample(spacing)
                if not np.all((low < surface) & (surface < high), axis=1).any():
                    faults[name] = "no part of its surface is in the box; move it, or leave it out"
            except GpeError as error:
                faults[name] = str(error)
            except (ValueError, IndexError):
                faults[name] = f"{obstacle} is not a shape in {self.dim}D"
                del shapes[name]
        return shapes

    def _values(self, body: Body, simulator: LearnedSimulator, faults: dict[str, str]) -> dict[str, float]:
        """Return the stored parameters of a body; those that are not given have the middle of their trained range."""
        middle = middle_values(simulator)
        if body.material not in middle:
            faults[body.name] = f"the model is for {', '.join(middle)}"
            return {}
        own = middle[body.material]
        if unknown := [name for name in body.parameters if name not in own]:
            faults[body.name] = f"{unknown[0]}: the model was not trained with it, only with {', '.join(own)}"
        return {**own, **body.parameters}

    def _density(self, body: Body, simulator: LearnedSimulator) -> float:
        if body.density is not None:
            return body.density
        own = settings(simulator.builder.metadata)["scene"].get("density")
        return float(own[body.material] if isinstance(own, dict) else own)

    def _check_contacts(self, found: Mapping[str, Nodes], shapes: Mapping[str, Shape], spacing: float, faults: dict[str, str]) -> None:
        """Find nodes in obstacles, obstacles in meshes, and bodies that overlap."""
        trees: dict[str, cKDTree] = {}
        regions = {body.name: body.contains for body in self.filled}
        for name, nodes in found.items():
            for obstacle, shape in shapes.items():
                depth = -signed_distance((shape,), nodes.pos)
                if (depth > 0).any():
                    faults[name] = f"{int((depth > 0).sum())} of its {len(nodes.pos)} nodes are inside {obstacle}; move one of the two"
                elif in_mesh(shape.sample(spacing)[0], nodes.pos, nodes.cells).any():  # a plate thinner than the spacing
                    faults[name] = f"{obstacle} passes through it between its nodes; move one of the two"
            for other, tree in trees.items():
                distance, _ = tree.query(nodes.pos)
                if distance.min() < CLOSEST * spacing or overlap(regions[name], regions[other], nodes.pos, spacing):
                    faults[name] = f"overlaps {other}; move one of the two"
            trees[name] = cKDTree(nodes.pos)

    def _warn_of_pushes(self, found: Mapping[str, Nodes], simulator: LearnedSimulator) -> None:
        """Warn of bodies that the elastic law of the model pushes apart from the start."""
        spacing, law = simulator.builder.metadata.spacing, getattr(simulator.model, "elastic_bodies", None)
        layers = {} if law is None else dict(law.body_layer.items())
        bodies = [body for body in self.filled if body.material in layers]
        for one, other in itertools.combinations(bodies, 2):
            gap = float(cKDTree(found[one.name].pos).query(found[other.name].pos)[0].min())
            reach = layers[one.material].thickness * spacing
            if one.material == other.material and gap < reach:
                text = "%s and %s are %.2g m apart; the model pushes bodies apart that are nearer than %.2g m, which the solver does not"
                log.warning(text, one.name, other.name, gap, reach)

    def _joined(self, found: Mapping[str, Nodes], values: Mapping[str, dict[str, float]], shapes: Sequence[Shape], own: Metadata) -> State:
        pos = np.concatenate([nodes.pos for nodes in found.values()])
        params, first, cells = np.full((len(pos), len(own.param_names)), np.nan), 0, []
        vel, node_type = np.empty_like(pos), np.empty(len(pos), np.uint8)
        for body in self.filled:
            nodes = found[body.name]
            rows = slice(first, first + len(nodes.pos))
            vel[rows], node_type[rows] = body.velocity, node_code(body.material)
            for name, value in values[body.name].items():
                params[rows, own.param_names.index(name)] = value
            cells.append(nodes.cells + first)
            first += len(nodes.pos)
        has_mesh = any(map(len, cells))
        has_stress = any(body.material == "solid" for body in self.bodies)
        joined = np.concatenate(cells)
        walls = domain_walls(tuple(self.box), self.friction)
        return State(
            pos=pos,
            vel=vel,
            node_type=node_type,
            mass=np.concatenate([nodes.mass for nodes in found.values()]),
            material_params=params,
            boundary=Boundary.sample((*walls, *shapes), own.spacing, self.dim),
            gravity=np.array(self.gravity),
            rest_pos=pos.copy() if has_mesh else None,
            cells=joined if has_mesh else None,
            stress=Stress(np.zeros((len(pos), 4)), np.zeros((len(joined), 4))) if has_stress else None,
            param_names=own.param_names,
        )
