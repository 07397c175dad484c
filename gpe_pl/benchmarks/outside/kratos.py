"""Kratos' MPMApplication as an engine for columns of sand in plane strain: implicit MPM with Mohr–Coulomb plasticity of Hencky strain.

Each particle is the only material point of a square of one spacing. The background grid is bilinear, and its cells are two spacings wide. Sand does not slip on
walls. The engine runs in a process of its own, because it registers global components and prints to the output of its process.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.benchmarks.outside.engine import EngineError, frames_of
from gpe_pl.solvers.materials import Sand
from gpe_pl.trajectory.state import State

MODULE = "KratosMultiphysics.MPMApplication"
STEPS = 4
"""Time steps of the engine within a frame."""
PARTICLES_PER_CELL = 2
"""Along each axis. With one, the linear shape functions leave cells without stiffness."""
COHESION = 1.0
"""Cohesion of the engine's sand [Pa]. Without any, its return mapping has no apex to return to; this one carries a layer of 0.1 mm."""
SECONDS = 1800
"""A run that takes longer is stopped."""


def is_missing() -> bool:
    """Tell whether the packages are not installed."""
    return importlib.util.find_spec("KratosMultiphysics") is None or importlib.util.find_spec(MODULE) is None


def run(state: State, sand: Sand, bounds: tuple[tuple[float, float], ...], spacing: float, frame_dt: float, num_frames: int) -> np.ndarray:
    """Return positions [frame, node, 2] in m; the first frame is ``state``.

    Args:
        state: sand of one friction angle in 2D, at rest.
        sand: constants of the sand.
        bounds: ``(low, high)`` of the box along each axis [m].
        spacing: distance of neighbouring particles at the start [m].
        frame_dt: time between frames [s].
        num_frames: number of frames, the first one included.

    Raises:
        EngineError: the engine failed or stopped early; the message has its last lines.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "body.mdpa").write_text(_body(np.asarray(state.pos), spacing), encoding="ascii")
        (folder / "grid.mdpa").write_text(_grid(bounds, PARTICLES_PER_CELL * spacing), encoding="ascii")
        (folder / "materials.json").write_text(json.dumps(_materials(sand, float(state.material_params[0, 0]))), encoding="ascii")
        (folder / "parameters.json").write_text(json.dumps(_parameters(state, frame_dt, num_frames)), encoding="ascii")
        frames = frames_of("Kratos", __name__, folder, num_frames, SECONDS)
    if frames.shape != (num_frames, state.num_nodes, 2):
        raise EngineError(
            f"Kratos: has frames and nodes {frames.shape[:2]}, expected {(num_frames, state.num_nodes)}: particles left the grid"
        )
    return frames


def _mesh(nodes: np.ndarray, kind: str, corners: np.ndarray, parts: dict[str, tuple[Iterable[int], Iterable[int]]]) -> str:
    """Return a mesh in the engine's format: nodes [node, 2], quadrilaterals [cell, 4], and by name the nodes and cells of parts, as rows."""
    lines = ["Begin Properties 0", "End Properties", "Begin Nodes"]
    lines += [f"{i} {x:.12g} {y:.12g} 0.0" for i, (x, y) in enumerate(nodes, 1)]
    lines += ["End Nodes", f"Begin Elements {kind}"]
    lines += [f"{i} 0 {a} {b} {c} {d}" for i, (a, b, c, d) in enumerate(corners + 1, 1)]
    lines += ["End Elements"]
    for name, (own_nodes, own_cells) in parts.items():
        lines += [f"Begin SubModelPart {name}", "Begin SubModelPartNodes", *(str(i + 1) for i in own_nodes), "End SubModelPartNodes"]
        lines += ["Begin SubModelPartElements", *(str(i + 1) for i in own_cells), "End SubModelPartElements", "End SubModelPart"]
    return "\n".join(lines) + "\n"


def _body(pos: np.ndarray, spacing: float) -> str:
    around = spacing / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    nodes = (pos[:, None] + around).reshape(-1, 2)
    return _mesh(nodes, "MPMUpdatedLagrangian2D4N", np.arange(len(nodes)).reshape(-1, 4), {"Body": (range(len(nodes)), range(len(pos)))})


def _grid(bounds: tuple[tuple[float, float], ...], width: float) -> str:
    (left, right), (low, high) = bounds
    columns, rows = round((right - left) / width), round((high - low) / width)
    x, y = np.meshgrid(np.linspace(left, right, columns + 1), np.linspace(low, high, rows + 1), indexing="ij")
    number = np.arange(x.size).reshape(x.shape)
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    walls = np.unique(np.concatenate([number[0], number[-1], number[:, 0], number[:, -1]]))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    return _mesh(nodes, "Element2D4N", corners, {"Grid": (range(len(nodes)), range(len(corners))), "Walls": (walls.tolist(), ())})


def _materials(sand: Sand, friction_angle: float) -> dict[str, Any]:
    variables = {
        "THICKNESS": 1.0,
        "MATERIAL_POINTS_PER_ELEMENT": 1,
        "DENSITY": sand.density,
        "YOUNG_MODULUS": sand.youngs_modulus,
        "POISSON_RATIO": sand.poisson_ratio,
        "COHESION": COHESION,
        "INTERNAL_FRICTION_ANGLE": math.radians(friction_angle),
        "INTERNAL_DILATANCY_ANGLE": 0.0,
    }
    law = {"constitutive_law": {"name": "HenckyMCPlasticPlaneStrain2DLaw"}, "Variables": variables, "Tables": {}}
    return {"properties": [{"model_part_name": "Initial_MPM_Material.Body", "properties_id": 1, "Material": law}]}


def _parameters(state: State, frame_dt: float, num_frames: int) -> dict[str, Any]:
    step, gravity = frame_dt / STEPS, float(np.linalg.norm(state.gravity))
    direction = [*(np.asarray(state.gravity) / gravity).tolist(), 0.0]
    end = (num_frames - 1) * frame_dt - step / 2
    fixed = {"model_part_name": "Background_Grid.Walls", "variable_name": "DISPLACEMENT", "constrained": [True] * 3, "value": [0.0] * 3}
    pull = {"model_part_name": "MPM_Material", "modulus": gravity, "direction": direction}
    return {
        "problem_data": {"problem_name": "column", "parallel_type": "OpenMP", "echo_level": 0, "start_time": 0.0, "end_time": end},
        "solver_settings": {
            "solver_type": "Dynamic",
            "model_part_name": "MPM_Material",
            "domain_size": 2,
            "echo_level": 0,
            "analysis_type": "non_linear",
            "time_integration_method": "implicit",
            "scheme_type": "newmark",
            "model_import_settings": {"input_type": "mdpa", "input_filename": "body"},
            "grid_model_import_settings": {"input_type": "mdpa", "input_filename": "grid"},
            "material_import_settings": {"materials_filename": "materials.json"},
            "time_stepping": {"time_step": step},
            "convergence_criterion": "residual_criterion",
            "residual_relative_tolerance": 1e-4,
            "residual_absolute_tolerance": 1e-6,
            "max_iteration": 15,
            "problem_domain_sub_model_part_list": ["Body", "Grid"],
            "processes_sub_model_part_list": ["Walls"],
            "linear_solver_settings": {"solver_type": "skyline_lu_factorization"},
        },
        "processes": {
            "constraints_process_list": [
                {"python_module": "assign_vector_variable_process", "kratos_module": "KratosMultiphysics", "Parameters": fixed}
            ],
            "gravity": [{"python_module": "assign_gravity_to_material_point_process", "kratos_module": MODULE, "Parameters": pull}],
        },
    }


def main(name: str, num_frames: int) -> None:
    """Run the scene in a folder for a number of frames and write ``frames.npy`` there."""
    import os

    os.chdir(name)
    core: Any = importlib.import_module("KratosMultiphysics")
    application: Any = importlib.import_module(MODULE)
    analysis: Any = importlib.import_module(f"{MODULE}.mpm_analysis").MpmAnalysis
    core.Logger.GetDefaultOutput().SetSeverity(core.Logger.Severity.WARNING)
    frames: list[np.ndarray] = []

    class Recorded(analysis):  # type: ignore[misc]
        def _record(self) -> None:
            points = self.model["MPM_Material"]
            found = [e.CalculateOnIntegrationPoints(application.MP_COORD, points.ProcessInfo)[0] for e in points.Elements]
            frames.append(np.array([[x[0], x[1]] for x in found]))

        def ModifyAfterSolverInitialize(self) -> None:
            super().ModifyAfterSolverInitialize()
            self._record()

        def FinalizeSolutionStep(self) -> None:
            super().FinalizeSolutionStep()
            if self.model["Background_Grid"].ProcessInfo[core.STEP] % STEPS == 0:
                self._record()

    Recorded(core.Model(), core.Parameters(Path("parameters.json").read_text(encoding="ascii"))).Run()
    np.save("frames.npy", np.array(frames))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
