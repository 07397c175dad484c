"""CalculiX as an engine for solids in plane strain: implicit dynamics (HHT-α) of the same mesh, with contact to the floor by penalty.

Each triangle becomes a wedge of one spacing in depth, whose nodes do not move along the depth. The material is the neo-Hookean one of ``*HYPERELASTIC``::

    Ψ = μ/2 (J^(-2/3) tr C - 3) + κ/2 (J - 1)²,   κ = λ + 2μ/3

It equals the law of ``solvers.fem`` for small strains. Masses are consistent, not lumped, and damping is proportional to the stiffness (see
``stiffness_damping``). The stress is elastic; nodes have the mean over their cells. Only the floor takes part in contact: a scene must keep the body away from
the other walls.
"""

from __future__ import annotations

import math
import shutil
import tempfile
from pathlib import Path

import numpy as np

from gpe_pl.benchmarks.outside.engine import EngineError, Motion, last_lines, output_of
from gpe_pl.solvers.fem import FEM
from gpe_pl.solvers.fem.elements import build_mesh
from gpe_pl.solvers.materials import lame_parameters
from gpe_pl.trajectory.state import State, Stress

PROGRAM = "ccx"
ATTEMPTS = ((20, 0.1), (20, 1.0), (60, 1.0))
"""Time steps of the engine within a frame, and stiffness of sticking contact as a fraction of the penalty, one attempt after the other. With friction,
the engine stops in some scenes with a message about impacts, and the next attempt may pass."""
STIFFNESS = 2.0
"""Penalty of contact, as a multiple of Young's modulus over the spacing."""
SECONDS = 600
"""A run that takes longer is stopped."""


def is_missing() -> bool:
    """Tell whether the program is not on the path."""
    return shutil.which(PROGRAM) is None


def run(state: State, solver: FEM, num_frames: int) -> Motion:
    """Return positions, velocities and stress of a scene.

    Args:
        state: one body of triangles above the floor of a box, whose friction is that of the floor. Its cells have no stress.
        solver: solver whose Poisson's ratio, damping and frames are used.
        num_frames: number of frames, the first one included.

    Raises:
        EngineError: the engine failed or stopped early; the message has its last lines.
    """
    pos, cells = np.asarray(state.pos), np.asarray(state.cells)
    for increments, sticking in ATTEMPTS:
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "scene.inp").write_text(deck(state, solver, num_frames, increments, sticking), encoding="ascii")
            said = output_of("CalculiX", [PROGRAM, "-i", "scene"], Path(folder), SECONDS)
            table = Path(folder, "scene.dat")
            text = table.read_text(encoding="ascii") if table.is_file() else ""
        moved, vel = (of_nodes(text, quantity, len(pos)) for quantity in ("displacements", "velocities"))
        stress = cell_stresses(text, len(cells))
        if len(moved) == len(vel) == len(stress) == num_frames - 1:
            at_cells = np.concatenate([np.zeros_like(stress[:1]), stress])
            averaging = build_mesh(pos, cells, np.asarray(state.mass)).averaging
            at_nodes = np.stack([averaging @ frame for frame in at_cells])
            whole = np.concatenate([pos[None], pos + moved]), np.concatenate([np.asarray(state.vel)[None], vel])
            return Motion(*whole, Stress(at_nodes, at_cells))
    raise EngineError(f"CalculiX: has {len(moved)} of {num_frames - 1} frames; its last lines are: {last_lines(said)}")


def stiffness_damping(viscosity: float, modulus: float, poisson_ratio: float) -> float:
    """Return the damping per stiffness [s] with which a bar in plane strain, free at its sides, stretches as with the viscous stress ``2η Ė``.

    The two kinds of damping cannot agree in all modes. A body that bounces or bends mostly stretches so; per elastic energy, ``2η Ė`` damps its shear 1.2 times
    and its volume 0.4 times as much, for a Poisson's ratio of 0.35.

    Args:
        viscosity: η in Pa s.
        modulus: Young's modulus [Pa].
        poisson_ratio: Poisson's ratio.
    """
    across = poisson_ratio / (1 - poisson_ratio)
    return 2 * viscosity * (1 + across**2) * (1 - poisson_ratio**2) / modulus


def of_nodes(text: str, quantity: str, num_nodes: int) -> np.ndarray:
    """Return ``displacements`` in m or ``velocities`` in m/s [frame, node, 2] of the frames that a ``.dat`` file has in full."""
    return _table(text, quantity, num_nodes, 4)[:, :, 1:3]


def cell_stresses(text: str, num_cells: int) -> np.ndarray:
    """Return Cauchy stresses [frame, cell, 4] in Pa of the frames that a ``.dat`` file has in full, in the order of ``State.stress``.

    A wedge has two integration points, one above the other; its stress is their mean.
    """
    points = _table(text, "stresses", 2 * num_cells, 8)[:, :, 2:]  # xx, yy, zz, xy, xz, yz
    cells = points.reshape(len(points), num_cells, 2, 6).mean(axis=2)
    return np.asarray(cells[..., [0, 3, 1, 2]])


def _table(text: str, quantity: str, num_rows: int, num_columns: int) -> np.ndarray:
    """Return the numbers [frame, row, column] of a quantity in the frames that a ``.dat`` file has in full. Headings begin with the name of the quantity."""
    rows, is_wanted = list[list[float]](), False
    for words in map(str.split, text.splitlines()):
        if words and words[0][0].isalpha():
            is_wanted = words[0] == quantity
        elif words and is_wanted:
            rows.append([float(word) for word in words])
    whole = len(rows) // num_rows
    return np.array(rows[: whole * num_rows]).reshape(whole, num_rows, num_columns)


def deck(state: State, solver: FEM, num_frames: int, increments: int, sticking: float) -> str:
    """Return the input file of a scene, with one of ``ATTEMPTS``."""
    cells, pos = np.asarray(state.cells), np.asarray(state.pos)
    count = len(pos)
    mesh = build_mesh(pos, cells, np.asarray(state.mass))
    area = float(mesh.weight.sum())
    density = float(np.sum(state.mass)) / area
    depth = float(np.sqrt(2 * area / len(cells)))
    modulus = float(state.material_params[0, 0])
    lam, mu = (float(value) for value in lame_parameters(modulus, solver.poisson_ratio))
    damping = stiffness_damping(solver.damping * math.sqrt((2 * mu + 2 * lam) / mesh.scale), modulus, solver.poisson_ratio)
    low = solver.bounds[1][0]
    left, right = solver.bounds[0]
    friction = next(shape.friction for shape in state.boundary.shapes if abs(getattr(shape, "normal", (0, 0))[1] - 1) < 1e-9)
    stiffness = STIFFNESS * modulus / depth
    floor = np.array(
        [(x, y, z) for y in (low - depth, low) for x, z in ((left, -depth), (right, -depth), (right, 2 * depth), (left, 2 * depth))]
    )
    # a wedge's corners run around the axis from the first triangle to the second
    nodes = np.concatenate([np.column_stack([pos, np.zeros(count)]), np.column_stack([pos, np.full(count, depth)]), floor])
    wedges = np.concatenate([cells, cells + count], axis=1) + 1
    box = 2 * count + np.array([1, 4, 3, 2, 5, 8, 7, 6])
    skin = np.unique(mesh.edges)
    step = solver.frame_dt / increments
    lines = ["*NODE, NSET=ALL", *(f"{i}, {x:.12e}, {y:.12e}, {z:.12e}" for i, (x, y, z) in enumerate(nodes, 1))]
    lines += ["*ELEMENT, TYPE=C3D6, ELSET=BODY", *(", ".join(map(str, [i, *wedge])) for i, wedge in enumerate(wedges, 1))]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=FLOOR", ", ".join(map(str, [len(wedges) + 1, *box]))]
    lines += ["*NSET, NSET=FRONT, GENERATE", f"1, {count}", "*NSET, NSET=SOLID, GENERATE", f"1, {2 * count}"]
    lines += ["*NSET, NSET=FIXED, GENERATE", f"{2 * count + 1}, {2 * count + 8}"]
    lines += ["*MATERIAL, NAME=ELASTIC", "*HYPERELASTIC, NEO HOOKE", f"{mu / 2:.9e}, {2 / (lam + 2 * mu / 3):.9e}"]
    lines += ["*DENSITY", f"{density:.9e}"]
    lines += [f"*DAMPING, ALPHA=0., BETA={damping:.9e}"]
    lines += ["*MATERIAL, NAME=RIGID", "*ELASTIC", f"{100 * modulus:.9e}, 0.3", "*DENSITY", f"{density:.9e}"]
    lines += ["*SOLID SECTION, ELSET=BODY, MATERIAL=ELASTIC", "*SOLID SECTION, ELSET=FLOOR, MATERIAL=RIGID"]
    lines += [
        "*SURFACE, NAME=SKIN, TYPE=NODE",
        *map(str, skin + 1),
        *map(str, skin + count + 1),
        "*SURFACE, NAME=TOP, TYPE=ELEMENT",
        f"{len(wedges) + 1}, S2",
    ]
    lines += ["*SURFACE INTERACTION, NAME=TOUCH", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{stiffness:.9e}"]
    if friction > 0:
        lines += ["*FRICTION", f"{min(friction, 10.0)}, {sticking * stiffness:.9e}"]
    lines += ["*CONTACT PAIR, INTERACTION=TOUCH, TYPE=NODE TO SURFACE", "SKIN, TOP"]
    lines += ["*BOUNDARY", "SOLID, 3, 3", "FIXED, 1, 3"]
    lines += ["*INITIAL CONDITIONS, TYPE=VELOCITY"]
    lines += [
        f"{i + 1 + shift}, {axis + 1}, {v:.9e}" for shift in (0, count) for i, vel in enumerate(state.vel) for axis, v in enumerate(vel)
    ]
    gravity = float(np.linalg.norm(state.gravity))
    direction = np.asarray(state.gravity) / gravity
    lines += [
        f"*STEP, NLGEOM, INC={10 * increments * num_frames}",
        "*DYNAMIC, DIRECT",
        f"{step:.9e}, {(num_frames - 1) * solver.frame_dt:.9e}",
    ]
    lines += ["*DLOAD", f"BODY, GRAV, {gravity:.9e}, {direction[0]:.9e}, {direction[1]:.9e}, 0."]
    lines += [f"*NODE PRINT, NSET=FRONT, FREQUENCY={increments}", "U, V"]
    lines += [f"*EL PRINT, ELSET=BODY, FREQUENCY={increments}", "S", "*END STEP", ""]
    return "\n".join(lines)
