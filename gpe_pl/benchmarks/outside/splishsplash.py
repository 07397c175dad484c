"""SPlisHSPlasH as an engine for liquids in a box: divergence-free SPH (Bender and Koschier 2017) with implicit viscosity (Weiler et al. 2018).

Walls are particles (Akinci et al. 2012) and do not slip. The box of the engine is half a spacing larger on every side: its particles keep a spacing from walls,
and those of the scene half a spacing. The engine runs in a process of its own: it has one global simulation, and its native libraries can end a process.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import json
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.benchmarks.outside.engine import frames_of
from gpe_pl.trajectory.state import State

MODULE = "pysplishsplash"
STEPS = 5
"""Time steps of the engine within a frame."""
RELAXING = 30
"""Time steps before the first frame, after each of which the particles stop: they lose the pressure of places that are denser than the liquid."""
SECONDS = 1800
"""A run that takes longer is stopped."""
DISPATCH = "libGLdispatch.so.0"
"""Library that must be loaded before the module: the module has a copy of its own, and the first call of the system's libGLX into it would fail."""
QUADS = ((1, 4, 3, 2), (5, 6, 7, 8), (1, 2, 6, 5), (3, 4, 8, 7), (2, 3, 7, 6), (4, 1, 5, 8))
"""Faces of a box whose corners run around the bottom and then around the top, by their numbers from 1. Normals point outwards."""


def is_missing() -> bool:
    """Tell whether the package is not installed."""
    return importlib.util.find_spec(MODULE) is None


def run(state: State, bounds: tuple[tuple[float, float], ...], spacing: float, frame_dt: float, num_frames: int) -> np.ndarray:
    """Return positions [frame, node, 3] in m; the first frame is ``state`` after ``RELAXING`` steps.

    Args:
        state: liquid of one viscosity and 1000 kg/m³ in 3D.
        bounds: ``(low, high)`` of the box along each axis [m].
        spacing: distance of neighbouring particles at the start [m].
        frame_dt: time between frames [s].
        num_frames: number of frames, the first one included.

    Raises:
        EngineError: the engine failed or stopped early; the message has its last lines.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        low, high = np.array(bounds, float).T + spacing / 2 * np.array([[-1.0], [1.0]])
        corners = [
            (x, y, z) for z in (low[2], high[2]) for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        ]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for p, q, r, s in QUADS for a, b, c in ((p, q, r), (p, r, s))]
        (folder / "box.obj").write_text("\n".join(lines) + "\n", encoding="ascii")
        (folder / "scene.json").write_text(json.dumps(_scene(state, spacing, frame_dt)), encoding="ascii")
        (folder / "start.bgeo").write_bytes(points_file(state.pos))
        np.save(folder / "vel.npy", state.vel)
        return frames_of("SPlisHSPlasH", __name__, folder, num_frames, SECONDS)


def _scene(state: State, spacing: float, frame_dt: float) -> dict[str, Any]:
    """Return the scene without particles in the engine's format."""
    viscosity = float(state.material_params[0, 0])
    return {
        "Configuration": {
            "particleRadius": spacing / 2,
            "simulationMethod": 4,
            "gravitation": [float(g) for g in state.gravity],
            "cflMethod": 0,
            "enableZSort": False,  # it would change the order of the particles
            "timeStepSize": frame_dt / STEPS,
            "boundaryHandlingMethod": 0,
            "DFSPH": {"maxIterations": 100, "maxError": 0.05, "maxIterationsV": 100, "maxErrorV": 0.1, "enableDivergenceSolver": True},
        },
        "Materials": [
            {
                "id": "Fluid",
                "density0": 1000,
                "viscosityMethod": 6,
                "Weiler et al. 2018": {"viscosity": viscosity, "viscosityBoundary": viscosity, "viscoMaxIter": 100, "viscoMaxError": 0.01},
            }
        ],
        "RigidBodies": [
            {
                "geometryFile": "box.obj",
                "translation": [0, 0, 0],
                "rotationAxis": [1, 0, 0],
                "rotationAngle": 0,
                "scale": [1, 1, 1],
                "isDynamic": False,
                "isWall": True,
            }
        ],
        "FluidModels": [{"id": "Fluid", "particleFile": "start.bgeo", "translation": [0, 0, 0], "scale": [1, 1, 1]}],
    }


def points_file(pos: np.ndarray) -> bytes:
    """Return points [point, 3] as a file of Houdini's old binary format, version 5: big-endian, with a weight after each point, and nothing else."""
    header = struct.pack(">4sci8i", b"Bgeo", b"V", 5, len(pos), 0, 0, 0, 0, 0, 0, 0)
    return header + np.column_stack([pos, np.ones(len(pos))]).astype(">f4").tobytes() + bytes([0, 255])


def main(name: str, num_frames: int) -> None:
    """Run the scene in a folder for a number of frames and write ``frames.npy`` there."""
    with contextlib.suppress(OSError):  # a system without the library has no conflict
        ctypes.CDLL(DISPATCH, mode=ctypes.RTLD_GLOBAL)
    engine: Any = importlib.import_module(MODULE)
    folder = Path(name)
    vel = np.load(folder / "vel.npy").astype(np.float32)
    base = engine.Exec.SimulatorBase()
    base.init(sceneFile=str(folder / "scene.json"), outputDir=str(folder), useGui=False, useCache=False, initialPause=False)
    base.initSimulation()
    model = engine.Simulation.getCurrent().getFluidModel(0)
    frames = []
    number, particles, rest = 0, range(model.numActiveParticles()), np.zeros(3, np.float32)

    def record() -> None:
        nonlocal number
        number += 1
        if number <= RELAXING:
            for i in particles:
                model.setVelocity(i, vel[i] if number == RELAXING else rest)
        if number >= RELAXING and (number - RELAXING) % STEPS == 0:
            frames.append(np.array([model.getPosition(i) for i in particles]).reshape(-1, 3))

    base.setTimeStepCB(record)
    base.setValueFloat(base.STOP_AT, (RELAXING + (num_frames - 1) * STEPS - 0.5) * engine.TimeManager.getCurrent().getTimeStepSize())
    base.runSimulation()
    np.save(folder / "frames.npy", np.array(frames, dtype=np.float64))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
