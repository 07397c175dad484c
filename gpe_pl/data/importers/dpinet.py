"""Importer of the particles of DPI-Net: falling fluid (FluidFall), and a rigid box in a bath (BoxBath).

``source`` is a folder ``data_{Environment}`` with ``train/`` and ``valid/``. Each has a folder per rollout with a file ``{frame}.h5`` per frame. A file has
``positions`` [node, 3] and ``velocities`` [node, 3] in m/s. Frames are 1/60 s apart. BoxBath files also have ``clusters``; their first 64 nodes are the rigid
box, which becomes a ``solid``. All other nodes are ``fluid``. The y axis points up and the ground is at y = 0. The bath's walls are at the extremes of all
positions.

FluidShake and RiceGrip also store moving walls and grippers as the poses of bodies (``shape_quats``), without their shape. They are refused.

Source: Li et al. 2019, and the layout of the data of github.com/YunzhuLi/DPI-Net.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

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
    split_folders,
)
from gpe_pl.files.hdf5_arrays import is_named

FRAME_DT = 1 / 60
"""Time between frames [s]; it is not in the files."""
GRAVITY = (0.0, -9.8, 0.0)
"""Usual gravity of the format [m/s²]; it is not in the files. In some data sets other forces nearly cancel it."""
NUM_RIGID = 64
"""Number of nodes of the box in BoxBath, which come first."""
GROUND_FRICTION = 0.5
"""Assumed friction coefficient of ground and walls."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such folders, or they hold no rollouts.
    """
    folders, warnings = split_folders(path)
    if not folders:
        raise ImportFailure(f"{path}: {'no such folder' if not path.exists() else 'holds no folder train or valid'}")
    rollouts = {split: _numbered(folder, "") for split, folder in folders.items()}
    first = next((rollout for found in rollouts.values() for rollout in found), None)
    if first is None:
        raise ImportFailure(f"{path}: train and valid hold no rollouts, which are folders with numbers as names")
    has_bath = _has_clusters(first)
    sides = ("x_low", "x_high", "y_low", "z_low", "z_high") if has_bath else ("y_low",)
    notes = [
        f"walls {', '.join(sides)} at the extremes of all positions, with friction {GROUND_FRICTION:g}: neither is in the source",
        "frame_dt = 1/60 s is the format's, not in the files",
    ]
    facts = Facts(FRAME_DT, usual_gravity=GRAVITY, walls=dict.fromkeys(sides, GROUND_FRICTION), notes=tuple(notes)).overridden(settings)
    return Source(
        facts,
        {split: [Item(f"{r.parent.name}/{r.name}", partial(_load, r, settings)) for r in found] for split, found in rollouts.items()},
        warnings,
    )


def _numbered(folder: Path, ending: str) -> list[Path]:
    """Return files and folders with a number as name, in order of the numbers."""
    found = [p for p in folder.iterdir() if re.fullmatch(rf"[0-9]+{re.escape(ending)}", p.name)]
    return sorted(found, key=lambda p: natural(p.name))


def _has_clusters(rollout: Path) -> bool:
    files = _numbered(rollout, ".h5")
    if not files:
        return False
    try:
        with hdf5.opened(files[0]) as file:
            return is_named(file, "clusters")
    except Refusal:
        return False


def _load(rollout: Path, settings: ImportSettings, facts: Facts) -> Loaded:
    files = _numbered(rollout, ".h5")
    wrong = next((k for k, file in enumerate(files) if int(file.stem) != k), None)
    if not files or wrong is not None:
        raise Refusal(f"has no {wrong or 0}.h5", wrong or 0)
    pos: list[np.ndarray] = []
    vel: list[np.ndarray] = []
    clusters = False
    for k, path in enumerate(files):
        try:
            with hdf5.opened(path) as file:
                if is_named(file, "shape_quats"):
                    raise Refusal("has shape_quats: moving walls or grippers, but the files do not contain their shape")
                clusters = clusters or is_named(file, "clusters")
                for name, arrays in (("positions", pos), ("velocities", vel)):
                    arrays.append(hdf5.array(file, name, "node, component", "f"))
                    if arrays[-1].shape != (len(pos[0]), 3):
                        raise Refusal(f"{name} is {list(arrays[-1].shape)}, expected [{len(pos[0])}, 3]")
        except Refusal as refusal:
            raise Refusal(str(refusal), k) from None
    kind = np.full(len(pos[0]), "fluid", dtype="U16")
    if clusters:
        if len(kind) <= NUM_RIGID:
            raise Refusal(f"has clusters, as BoxBath, but only {len(kind)} nodes; the first {NUM_RIGID} should be the box")
        kind[:NUM_RIGID] = "solid"
    return build(Nodes(np.stack(pos), kind, vel=np.stack(vel)), facts)
