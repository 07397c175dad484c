"""Importer of the particles of DPI-Net (FluidFall, BoxBath, FluidShake, RiceGrip) and of VGPL (RigidFall).

``source`` is a folder ``data_{Environment}`` with ``train/`` and ``valid/``, or a folder of rollouts. A rollout is a folder with a file ``{frame}.h5`` for
each frame. A file has ``positions`` [node, 3] and mostly ``velocities`` [node, 3] in m/s. Frames are 1/60 s apart. The y axis points up and the ground is at
y = 0. The arrays tell the environment:

- FluidFall has nothing else. All nodes are ``fluid``.
- BoxBath also has ``clusters``. Its first 64 nodes are a rigid box, a ``solid``. The others are ``fluid``. The walls are at the extremes of all positions.
- FluidShake also has ``shape_quats`` [5, 4] and ``scene_params`` [8]. Its last 5 nodes are the centres of the floor and four walls of a box that moves. Their
  sizes follow from ``scene_params``, which end with width and depth of the box, and from ``WALL`` and ``HEIGHT``.
- RiceGrip has ``shape_quats`` [2, 4], ``scene_params`` [6], and ``positions`` [node, 6]: a rest position and the position. Its last 2 nodes are the centres of
  grippers with the half edges ``GRIPPER``. The rice is ``snow``, which is plastic and has three parameters; see ``_rice``.
- RigidFall has ``shape_quats`` [1, 4] of the ground. Its ``scene_params`` begin with the number of cubes and gravity. A cube is a rigid body of 64 nodes.

Quaternions have their scalar part last. Boundary nodes of moving bodies are sampled on the surfaces of their boxes.

Source: Li et al. 2019 and Li et al. 2020, and the layout of the data of github.com/YunzhuLi/DPI-Net and github.com/YunzhuLi/VGPL-Dynamics-Prior.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers import hdf5
from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Nodes,
    Refusal,
    Source,
    build,
    natural,
)
from gpe_pl.data.importers.split_places import split_folders
from gpe_pl.files.hdf5_arrays import is_named
from gpe_pl.geometry.shapes import Box
from gpe_pl.trajectory.arrays import typical_spacing

FRAME_DT = 1 / 60
"""Time between frames [s]; it is not in the files."""
GRAVITY = (0.0, -9.8, 0.0)
"""Usual gravity of the format [m/s²]; it is not in the files. In some data sets other forces nearly cancel it."""
NUM_RIGID = 64
"""Number of nodes of a rigid box or cube."""
GROUND_FRICTION = 0.5
"""Assumed friction coefficient of ground and walls."""
WALL, HEIGHT = 0.025, 1.0
"""Thickness and height of the walls of FluidShake's box [m]; they are not in the files."""
GRIPPER = (0.15, 0.8, 0.15)
"""Half edges of RiceGrip's grippers [m]; they are not in the files."""
NUM_WALLS, NUM_GRIPPERS, NUM_GROUNDS = 5, 2, 1
"""Numbers of bodies in ``shape_quats`` of FluidShake, RiceGrip and RigidFall."""
SIDES = {"bath": ("x_low", "x_high", "y_low", "z_low", "z_high"), "shake": ()}
"""Walls at the extremes of all positions, by environment. All others have the ground only."""
NAMES = {"fall": "FluidFall", "bath": "BoxBath", "shake": "FluidShake", "grip": "RiceGrip", "rigid": "RigidFall"}
MAX_CUBES = 100


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such folders, they hold no rollouts, or as many of one environment as of another.
    """
    folders, warnings = split_folders(path)
    if not folders and path.is_dir() and any(p.is_dir() for p in _numbered(path, "")):
        folders = {"train": path}
    if not folders:
        raise ImportFailure(f"{path}: {'no such folder' if not path.exists() else 'holds no folder train or valid, and no rollouts'}")
    rollouts = {split: _numbered(folder, "") for split, folder in folders.items()}
    if not any(rollouts.values()):
        raise ImportFailure(f"{path}: train and valid hold no rollouts, which are folders with numbers as names")
    environments = {rollout: _environment(rollout) for found in rollouts.values() for rollout in found}
    known = Counter(environment for environment in environments.values() if environment is not None)
    (usual, count), *others = known.most_common(2) or [("fall", 0)]
    if others and others[0][1] == count:
        raise ImportFailure(
            f"{path}: holds {count} rollouts each of {NAMES[usual]} and {NAMES[others[0][0]]}; put each into a folder of its own"
        )
    sides = SIDES.get(usual, ("y_low",))
    walls = f"walls {', '.join(sides)} at the extremes of all positions, the ground at most at y = 0, friction {GROUND_FRICTION:g}: none is in the source"
    notes = [*([walls] if sides else []), "frame_dt = 1/60 s is the format's, not in the files"]
    facts = Facts(FRAME_DT, usual_gravity=GRAVITY, walls=dict.fromkeys(sides, GROUND_FRICTION), notes=tuple(notes)).overridden(settings)
    return Source(
        facts,
        {
            split: [Item(f"{r.parent.name}/{r.name}", partial(_load, r, environments[r], usual)) for r in found]
            for split, found in rollouts.items()
        },
        warnings,
    )


def _numbered(folder: Path, ending: str) -> list[Path]:
    """Return files and folders with a number as name, in order of the numbers."""
    found = [p for p in folder.iterdir() if re.fullmatch(rf"[0-9]+{re.escape(ending)}", p.name)]
    return sorted(found, key=lambda p: natural(p.name))


def _environment(rollout: Path) -> str | None:
    """Return ``fall``, ``bath``, ``shake``, ``grip`` or ``rigid``, as the first file tells that can be read; None if no file can."""
    for path in _numbered(rollout, ".h5"):
        try:
            with hdf5.opened(path) as file:
                if is_named(file, "shape_quats"):
                    count = len(hdf5.array(file, "shape_quats", "body, component", "f"))
                    return {NUM_WALLS: "shake", NUM_GRIPPERS: "grip", NUM_GROUNDS: "rigid"}.get(count, "fall")
                return "bath" if is_named(file, "clusters") else "fall"
        except Refusal:
            continue
    return None


def _load(rollout: Path, environment: str | None, usual: str, facts: Facts) -> Loaded:
    files = _numbered(rollout, ".h5")
    wrong = next((k for k, file in enumerate(files) if int(file.stem) != k), None)
    if not files or wrong is not None:
        raise Refusal(f"has no {wrong or 0}.h5", wrong or 0)
    arrays: dict[str, list[np.ndarray]] = {"positions": [], "velocities": [], "shape_quats": []}
    scene, num_clusters = np.empty(0), 0
    for k, path in enumerate(files):
        try:
            with hdf5.opened(path) as file:
                num_clusters += is_named(file, "clusters")
                for name, found in arrays.items():
                    if name == "positions" or is_named(file, name):
                        found.append(hdf5.array(file, name, "node, component", "f"))
                        if found[-1].shape != found[0].shape:
                            raise Refusal(f"{name} is {list(found[-1].shape)}, expected {list(found[0].shape)} as in the first frame")
                        if found[-1].shape[1] not in (3, 4, 6):
                            raise Refusal(f"{name} has {found[-1].shape[1]} components, expected 3, 4 or 6")
                if k == 0 and is_named(file, "scene_params"):
                    scene = hdf5.array(file, "scene_params", "parameter", "f")
        except Refusal as refusal:
            raise Refusal(str(refusal), k) from None
    for name, found in arrays.items():
        if found and len(found) != len(files):
            raise Refusal(f"has {name} in {len(found)} of {len(files)} frames")
    if num_clusters not in (0, len(files)):
        raise Refusal(f"has clusters in {num_clusters} of {len(files)} frames")
    pos, vel, quats = (np.stack(found) if found else None for found in arrays.values())
    assert pos is not None
    if vel is not None and vel.shape != pos.shape:
        raise Refusal(f"velocities is {list(vel.shape[1:])}, expected {list(pos.shape[1:])}")
    nodes = _nodes(pos, vel, quats, scene, num_clusters > 0)
    if environment != usual:
        raise Refusal(f"is of {NAMES[environment or 'fall']}, most rollouts are of {NAMES[usual]}; put it into a folder of its own")
    return build(replace(nodes, ground=0.0), facts)


def _nodes(pos: np.ndarray, vel: np.ndarray | None, quats: np.ndarray | None, scene: np.ndarray, has_clusters: bool) -> Nodes:
    """Return the nodes of a rollout whose arrays tell the environment."""
    count = pos.shape[1]
    if quats is None:
        kind = np.full(count, "fluid", dtype="U16")
        if not has_clusters:
            return Nodes(_plain(pos), kind, vel=vel)
        if count <= NUM_RIGID:
            raise Refusal(f"has clusters, as BoxBath, but only {count} nodes; the first {NUM_RIGID} should be the box")
        kind[:NUM_RIGID] = "solid"
        return Nodes(_plain(pos), kind, vel=vel, rigid_body=np.where(kind == "solid", 0, -1))
    num_bodies = quats.shape[1]
    if num_bodies >= count:
        raise Refusal(f"has shape_quats of {num_bodies} bodies, but only {count} nodes")
    centres, own = pos[:, -num_bodies:, -3:], slice(0, count - num_bodies)
    values: dict[str, Any] = {"vel": None if vel is None else vel[:, own, -3:]}
    if num_bodies == NUM_GROUNDS:
        return _cubes(_plain(pos)[:, own], scene, values)
    spacing = typical_spacing(pos[0, own, -3:].astype(np.float64))
    if num_bodies == NUM_WALLS and len(scene) == 8:
        width, depth = scene[6:8].tolist()
        side = (WALL / 2, (HEIGHT + WALL) / 2, depth / 2)
        face = (width / 2 + WALL, (HEIGHT + WALL) / 2, WALL / 2)
        boxes = [(width / 2, WALL / 2, depth / 2), side, side, face, face]
        walls = _surfaces(boxes, centres, quats, spacing)
        return Nodes(_plain(pos)[:, own], np.full(count - num_bodies, "fluid", "U16"), moving_walls=walls, **values)
    if num_bodies == NUM_GRIPPERS and len(scene) == 6:
        walls = _surfaces([GRIPPER] * NUM_GRIPPERS, centres, quats, spacing)
        return _rice(pos[:, own, -3:], scene, walls, values)
    raise Refusal(f"has shape_quats of {num_bodies} bodies and {len(scene)} scene_params, as none of FluidShake, RiceGrip and RigidFall")


def _plain(pos: np.ndarray) -> np.ndarray:
    if pos.shape[2] != 3:
        raise Refusal(f"positions is {list(pos.shape[1:])}, expected [{pos.shape[1]}, 3]")
    return pos


def _cubes(pos: np.ndarray, scene: np.ndarray, values: dict[str, Any]) -> Nodes:
    """Return the nodes of RigidFall."""
    num_cubes = int(scene[0]) if len(scene) > 1 and 1 <= scene[0] <= MAX_CUBES else 0
    if pos.shape[1] != NUM_RIGID * num_cubes:
        raise Refusal(f"has {pos.shape[1]} nodes, expected {NUM_RIGID} for each of {num_cubes} cubes of scene_params")
    body = np.repeat(np.arange(num_cubes), NUM_RIGID)
    return Nodes(pos, np.full(len(body), "solid", "U16"), gravity=(0.0, float(scene[1]), 0.0), rigid_body=body, **values)


def _rice(pos: np.ndarray, scene: np.ndarray, walls: tuple[np.ndarray, np.ndarray], values: dict[str, Any]) -> Nodes:
    """Return the nodes of RiceGrip. Stiffness, plastic threshold and plastic creep are stored as the three parameters of snow, with the source's numbers."""
    names = ("hardening_coefficient", "critical_compression", "critical_stretch")
    note = "clusterStiffness, 1000 clusterPlasticThreshold and clusterPlasticCreep of the source are stored as hardening_coefficient, critical_compression "
    return Nodes(
        pos,
        np.full(pos.shape[1], "snow", "U16"),
        parameters={"snow": dict(zip(names, scene[3:6].tolist(), strict=True))},
        moving_walls=walls,
        notes=[note + "and critical_stretch of snow: a model learns what they do"],
        **values,
    )


def _surfaces(
    half_edges: list[tuple[float, float, float]], centres: np.ndarray, quats: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and normals [frame, boundary_node, 3] of points about ``spacing`` [m] apart on moving boxes, without those below the ground."""
    parts = []
    for k, half in enumerate(half_edges):
        points, normals = Box(tuple(-h for h in half), tuple(half), 0.0).sample(spacing)
        turn = _rotations(quats[:, k])
        pos = centres[:, k, None] + np.einsum("fij,nj->fni", turn, points)
        above = pos[0, :, 1] >= 0
        parts.append((pos[:, above], np.einsum("fij,nj->fni", turn, normals)[:, above]))
    pos, normal = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return pos, normal


def _rotations(quats: np.ndarray) -> np.ndarray:
    """Return rotation matrices [frame, 3, 3] of quaternions [frame, 4] with the scalar part last."""
    from scipy.spatial.transform import Rotation

    if quats.shape[1] != 4 or not (np.isfinite(quats).all() and (np.linalg.norm(quats, axis=1) > 0).all()):
        raise Refusal("shape_quats has a quaternion of length 0, or one that is not finite")
    matrices: np.ndarray = Rotation.from_quat(quats.astype(np.float64)).as_matrix()
    return matrices
