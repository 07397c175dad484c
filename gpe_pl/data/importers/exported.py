"""Archives of trajectories that this package exported (``export.trajectories.write_npz``), as files of the format ``arrays``.

They hold the arrays and texts of the store, so the store reads and checks them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np

from gpe_pl.data.importers import npz
from gpe_pl.data.importers.source import Facts, Loaded, Refusal
from gpe_pl.schema import FIELDS
from gpe_pl.trajectory import source_origin
from gpe_pl.trajectory.arrays import numbers
from gpe_pl.trajectory.store import ADVICE, ATTRIBUTES, FURTHER, PREDICTION, StoreError, UnsoundError, fill_group, trajectory_in

KEY = "metadata"
"""Name of an array that every exported archive has, and no other file of the format ``arrays``."""


def load(path: Path, names: Sequence[str], given: Facts) -> Loaded:
    """Return the trajectory of an exported archive.

    Args:
        path: archive.
        names: names of its arrays.
        given: what the settings of the command state.

    Raises:
        Refusal: an array is missing, unknown, damaged or invalid, the scene is open, the trajectory is a rollout of a model, or a setting would change what the
            archive states.
    """
    if PREDICTION in names:
        raise Refusal("is a rollout of a model and no ground truth; leave the file out")
    if wrong := [field.name for field in fields(Facts) if getattr(given, field.name) != getattr(Facts(), field.name)]:
        raise Refusal(f"is an exported trajectory, which states {wrong[0]} itself; leave {wrong[0]} out of the command")
    texts = [name for name in names if name in (*ATTRIBUTES, *FURTHER)]
    if unknown := [name for name in names if name not in (*FIELDS, *texts, source_origin.KEY)]:
        raise Refusal(f"has an unknown key {unknown[0]!r} beside those of an exported trajectory")
    arrays = {name: npz.read(path, name) for name in names}
    origin = arrays.pop(source_origin.KEY, None)
    for name in texts:
        if arrays[name].dtype.kind != "U" or arrays[name].ndim:
            raise Refusal(f"{name} is {arrays[name].dtype}{list(arrays[name].shape)}, expected text")
    attributes = {name: str(arrays.pop(name)) for name in texts}
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:  # in memory only
        group = file.create_group("trajectory")
        fill_group(group, {name: np.ascontiguousarray(array) for name, array in arrays.items()}, attributes)
        try:
            trajectory = trajectory_in(group)
        except UnsoundError as error:
            raise Refusal(error.fault) from None
        except StoreError as error:
            raise Refusal(str(error).removeprefix(f"{path.name}:trajectory: ").removesuffix(f"; {ADVICE}")) from None
    if trajectory.openings:
        raise Refusal("is an open scene, which cannot be imported")
    if origin is not None:  # back to the coordinates of the source, as positions of any other archive
        trajectory = trajectory.seen_from(-numbers("origin", origin, {"dim": trajectory.metadata.dim}).astype(np.float64))
    what = "its name is that of a rollout of a model, which is no ground truth (evaluation.export); leave the file out if it is one"
    return Loaded(trajectory, warnings=(what,) if path.name.startswith("rollout_") else ())
