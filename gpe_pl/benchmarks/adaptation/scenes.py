"""Random scenes of other engines: the same initial state run by the engine and by the solver of a data set.

- ``kratos``: a column of sand at rest on a rough floor collapses, with random width, height, place and friction angle.
- ``calculix``: a block of a solid falls on a floor, with random size, height, speed and Young's modulus. The engine gives up most blocks that slide.
- ``splishsplash``: a block of liquid falls into a box, with random size, place, velocity and viscosity.

Values of the material parameter lie in the range that the model was trained on.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

from gpe_pl.benchmarks.acceptance import scenes
from gpe_pl.benchmarks.acceptance.trial import Candidate
from gpe_pl.benchmarks.outside.engine import Motion
from gpe_pl.benchmarks.outside.engines import SCENES, EngineName
from gpe_pl.files.atomic import replacing
from gpe_pl.geometry.body_shapes import JITTER, integer_lattice
from gpe_pl.geometry.shapes import domain_walls
from gpe_pl.rollout.loop import rollout
from gpe_pl.schema import STICKY
from gpe_pl.trajectory.state import State, Stress
from gpe_pl.trajectory.trajectory import Trajectory

COLUMN_WIDTH, COLUMN_HEIGHT = (8, 20), (10, 28)
"""Smallest and largest number of particles of a column of sand along each axis."""
BLOCK_COLUMNS, BLOCK_ROWS = (3, 7), (5, 10)
"""Smallest and largest half number of columns, and number of rows, of squares of a block."""
BLOCK_GAP, BLOCK_SPEED = (0.01, 0.08), (0.5, 1.5)
"""Gap between the block and the floor [m], and its downward speed [m/s]."""
LIQUID_SIZE, LIQUID_SPEED = (5, 9), 0.5
"""Smallest and largest number of particles of a block of liquid along each axis, and the largest velocity along each axis [m/s]."""

Start = Callable[[Candidate, float, np.random.Generator], State]


@dataclass(frozen=True)
class Pair:
    """The same scene by an engine and by the solver.

    Attributes:
        engine: trajectory of the engine, with its velocities, or mean ones over the last frame, and its stress if it has one.
        solver: positions of the solver [frame, node, dim] in m.
    """

    engine: Trajectory
    solver: np.ndarray


def _column(candidate: Candidate, value: float, rng: np.random.Generator) -> State:
    spec = candidate.spec
    low, high = np.array(spec.scene.bounds, float).T
    counts = np.array([rng.integers(*COLUMN_WIDTH, endpoint=True), rng.integers(*COLUMN_HEIGHT, endpoint=True)])
    free = (high - low)[0] - counts[0] * spec.scene.spacing
    corner = low + np.array([rng.uniform(0.2, 0.8) * free, 0.0])
    lattice = integer_lattice(np.zeros(2, int), counts - 1) + 0.5
    pos = corner + spec.scene.spacing * (lattice + rng.uniform(-JITTER, JITTER, lattice.shape))
    return scenes.start(spec, value, pos, np.zeros(2), domain_walls(spec.scene.bounds, STICKY))


def _block(candidate: Candidate, value: float, rng: np.random.Generator) -> State:
    columns, rows = 2 * int(rng.integers(*BLOCK_COLUMNS, endpoint=True)), int(rng.integers(*BLOCK_ROWS, endpoint=True))
    return scenes.dropped_block(candidate.spec, value, columns, rows, rng.uniform(*BLOCK_GAP), rng.uniform(*BLOCK_SPEED))


def _liquid(candidate: Candidate, value: float, rng: np.random.Generator) -> State:
    spec = candidate.spec
    low, high = np.array(spec.scene.bounds, float).T
    counts = rng.integers(*LIQUID_SIZE, endpoint=True, size=3)
    corner = low + rng.uniform(0.1, 0.9, 3) * (high - low - counts * spec.scene.spacing) * [1.0, 1.0, 0.4]
    pos = corner + spec.scene.spacing * (integer_lattice(np.zeros(3, int), counts - 1) + 0.5)
    walls = domain_walls(spec.scene.bounds, spec.scene.friction)  # type: ignore[attr-defined]
    return scenes.start(spec, value, pos, rng.uniform(-LIQUID_SPEED, LIQUID_SPEED, 3), walls)


STARTS: dict[EngineName, Start] = {"kratos": _column, "calculix": _block, "splishsplash": _liquid}
DIMENSIONS: dict[EngineName, int] = {"kratos": 2, "calculix": 2, "splishsplash": 3}


def start(name: EngineName, candidate: Candidate, seed: int) -> State:
    """Return the initial state of a scene. The parameter is uniform in its logarithm."""
    rng = np.random.default_rng(seed)
    low, _, high = candidate.values
    return STARTS[name](candidate, float(np.exp(rng.uniform(np.log(low), np.log(high)))), rng)


def pair(name: EngineName, candidate: Candidate, seed: int, folder: Path) -> Pair:
    """Return a scene by engine and solver. What the engine did is kept in ``folder``, so that a stopped command goes on.

    Raises:
        EngineError: the engine failed.
    """
    scene, solver, state = SCENES[name], candidate.spec.solver, start(name, candidate, seed)
    count = candidate.simulator.builder.config.history + round(scene.seconds / solver.frame_dt)
    settings = json.dumps(candidate.spec.provenance, sort_keys=True).encode()  # engines read further constants from them
    digest = digest_of(state.pos, state.vel, state.material_params, np.array(count), np.frombuffer(settings, np.uint8))
    motion = _kept(folder / f"{digest}.npz", lambda: scene.run(candidate, state, count + 1))
    whole = rollout(solver, state, count, candidate.metadata())
    mean = np.concatenate([np.asarray(state.vel)[None], np.diff(motion.pos, axis=0) / solver.frame_dt])
    vel = mean if motion.vel is None else motion.vel
    stress = None if motion.stress is None else Stress(*(a.astype(np.float32) for a in (motion.stress.node, motion.stress.cell)))
    return Pair(replace(whole, pos=motion.pos.astype(whole.pos.dtype), vel=vel.astype(whole.vel.dtype), stress=stress), whole.pos)


def _kept(path: Path, run: Callable[[], Motion]) -> Motion:
    """Return the motion in a file. If there is none, run the engine and write it."""
    if not path.is_file():
        motion = run()
        arrays = {"pos": motion.pos, "vel": motion.vel}
        arrays |= {} if motion.stress is None else {"node_stress": motion.stress.node, "cell_stress": motion.stress.cell}
        with replacing(path) as new, new.open("wb") as file:
            np.savez(file, **{name: values for name, values in arrays.items() if values is not None})  # type: ignore[arg-type]
    with np.load(path, allow_pickle=False) as stored:
        stress = Stress(stored["node_stress"], stored["cell_stress"]) if "cell_stress" in stored else None
        return Motion(stored["pos"], stored.get("vel"), stress)


def digest_of(*arrays: np.ndarray) -> str:
    """Return a short digest of the bytes of arrays."""
    return sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:16]
