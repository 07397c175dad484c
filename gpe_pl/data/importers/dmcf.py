"""Importer of the fluids of DeepLagrangianFluids (Continuous Convolutions) and DMCF.

``source`` is a folder with ``train/``, ``valid/`` and ``test/``, a folder of files, or one file. Files named ``sim_{seed}_{part}.msgpack.zst`` contain
consecutive parts of a scene; a file with any other name contains a whole scene. A file is a list of frames with ``pos`` and ``vel`` [node, 3], ``m`` and
``viscosity`` [node], ``frame_id`` and ``scene_id``. The first frame of a scene also has ``box`` and ``box_normals`` [boundary_node, 3], and in some data sets
``grav``. Two-dimensional scenes have a constant third coordinate, which is dropped.

The files do not contain the time between frames. It is 0.02 s unless ``frame_dt`` is given (DMCF's WBC-SPH has 2.5e-3 s). The report compares it with the
displacements and velocities of particles. The importer needs ``msgpack`` and ``zstandard`` (``pip install 'gpe_pl[import]'``).

Sources: Ummenhofer et al. 2020, Prantl et al. 2022, and the layout of github.com/isl-org/DeepLagrangianFluids; msgpack-numpy for how arrays are stored.
"""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gpe_pl.data.importers.source import (
    Facts,
    ImportFailure,
    ImportSettings,
    Item,
    Loaded,
    Nodes,
    Refusal,
    Repair,
    Source,
    build,
    natural,
)
from gpe_pl.data.importers.split_places import split_folders
from gpe_pl.files import regular_files
from gpe_pl.files.hdf5_arrays import most_unpacked

ENDING = ".msgpack.zst"
PART = re.compile(r"(_\d+)_(\d+)$")
"""End of a file's name: the number of the scene and the number of the part."""
FRAME_DT = 0.02
"""Usual time between frames of the format [s]."""
GRAVITY = (0.0, -9.81, 0.0)
"""Usual gravity of the format [m/s²], for scenes without ``grav``."""
MAX_BYTES = 2**32
"""Maximum unpacked size of a file. The limit ``most_unpacked`` applies too; zstandard exceeds it only with constant data."""
BYTES_AT_ONCE = 2**20
MOST = {"max_array_len": 2**16, "max_map_len": 2**10, "max_str_len": 2**16, "max_ext_len": 0}
"""Limits on the frames of a file, the entries of a frame and the text in them. Longer lists would be allocated before they are read."""


def open_source(path: Path, settings: ImportSettings) -> Source:
    """Return the data set at ``path`` in the format of this module.

    Raises:
        ImportFailure: there are no such files, or a package is missing.
    """
    _libraries()
    if path.is_file():
        scenes, warnings = {"train": [[path]]}, tuple[str, ...]()
    else:
        folders, warnings = split_folders(path, ENDING)
        scenes = {split: _scenes(folder) for split, folder in (folders or {"train": path}).items()}
    if not any(scenes.values()):
        raise ImportFailure(f"{path}: {'no such file or folder' if not path.exists() else f'holds no *{ENDING}'}")
    notes = () if settings.frame_dt else (f"frame_dt is not in the source; {FRAME_DT:g} s is the format's usual one (frame_dt=…)",)
    facts = Facts(FRAME_DT, usual_gravity=GRAVITY, notes=notes).overridden(settings)
    items = {split: [Item(_scene_of(parts[0]), partial(_load, parts)) for parts in found] for split, found in scenes.items()}
    return Source(facts, items, warnings)


def _libraries() -> tuple[Any, Any]:
    try:
        import msgpack
        import zstandard
    except ImportError:
        raise ImportFailure(f"*{ENDING} needs msgpack and zstandard: `pip install msgpack zstandard`") from None
    return msgpack, zstandard


def _scene_of(path: Path) -> str:
    return PART.sub(r"\1", path.name.removesuffix(ENDING))


def _scenes(folder: Path) -> list[list[Path]]:
    """Return the files of each scene, in order of their parts."""
    scenes: dict[str, list[Path]] = {}
    for path in sorted(folder.glob(f"*{ENDING}"), key=lambda file: natural(file.name)):
        scenes.setdefault(_scene_of(path), []).append(path)
    return list(scenes.values())


def _require_all_parts(parts: list[Path]) -> None:
    numbers = [int(found[2]) for part in parts if (found := PART.search(part.name.removesuffix(ENDING)))]
    if len(parts) > 1 and (numbers[0] > 1 or numbers != [*range(numbers[0], numbers[0] + len(parts))]):
        raise Refusal(f"parts are numbered {', '.join(map(str, numbers))}, expected each number once, from 0 or 1 on")


def _load(parts: list[Path], facts: Facts) -> Loaded:
    _require_all_parts(parts)
    frames = [frame for part in parts for frame in _frames(part)]
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("pos", "vel")}
    for k, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise Refusal(f"is {type(frame).__name__}, expected a map", k)
        if "frame_id" in frame and _number(frame, "frame_id", k) != _number(frames[0], "frame_id", 0) + k:
            raise Refusal("frame_id does not follow that of the frame before: a part is missing, or parts are of several scenes", k)
        if frame.get("scene_id", frames[0].get("scene_id")) != frames[0].get("scene_id"):
            raise Refusal(f"scene_id is {frame['scene_id']!r:.50}, that of frame 0 {frames[0].get('scene_id')!r:.50}", k)
        for name, arrays in columns.items():
            arrays.append(_array(frame, name, k))
            if arrays[-1].shape != (len(columns["pos"][0]), 3):
                raise Refusal(
                    f"{name} is {list(arrays[-1].shape)}, expected [{len(columns['pos'][0])}, 3]; the number of nodes must not change", k
                )
    if not frames:
        raise Refusal("has no frames")
    pos, vel = (np.stack(arrays) for arrays in columns.values())
    first, count = frames[0], pos.shape[1]
    walls = None
    if "box" in first:
        walls = _array(first, "box", 0), _array(first, "box_normals", 0)
        if walls[0].shape != walls[1].shape or walls[0].ndim != 2 or walls[0].shape[1] != 3:
            raise Refusal(f"box and box_normals are {list(walls[0].shape)} and {list(walls[1].shape)}, expected [boundary_node, 3] both", 0)
        for name, values in zip(("box", "box_normals"), walls, strict=True):
            _require_constant(frames, name, values)
    nodes = Nodes(pos, np.full(count, "fluid", dtype="U16"), vel=vel, walls=walls, friction=0.0)
    for name in ("m", "viscosity"):
        if name in first:
            values = _array(first, name, 0)
            if values.shape not in ((count,), ()):
                raise Refusal(f"{name} is {list(values.shape)}, expected [{count}]", 0)
            _require_constant(frames, name, values)
            if name == "m":
                nodes.mass = values
            else:
                if values.any():
                    nodes.parameters = {"fluid": values}
                else:
                    nodes.notes.append("viscosity is 0, which cannot be stored: models take its logarithm (parameters={fluid: …})")
    if "grav" in first:
        gravity = _array(first, "grav", 0).astype(np.float64).ravel()
        _require_constant(frames, "grav", gravity)
        if gravity.shape != (3,):
            raise Refusal(f"grav has {gravity.size} components, expected 3", 0)
        nodes.gravity = tuple(gravity.tolist())
    if (pos[..., 2] == pos[0, 0, 2]).all():
        nodes.repairs.append(Repair("the third coordinate never changes and was dropped: the scene is two-dimensional"))
        nodes.pos, nodes.vel = pos[..., :2], vel[..., :2]
        if walls is not None:
            flat = np.linalg.norm(walls[1][:, :2], axis=1) > 0.5  # the other nodes are walls across the third dimension
            nodes.walls = walls[0][flat, :2], walls[1][flat, :2]
    return build(nodes, facts)


def _require_constant(frames: list[dict[str, Any]], name: str, first: np.ndarray) -> None:
    for k, frame in enumerate(frames):
        if name in frame:
            values = _array(frame, name, k)
            if values.size != first.size or not np.allclose(values.ravel(), first.ravel()):
                raise Refusal(f"{name} changes with time; the store keeps the same for all frames of a trajectory", k)


# --- msgpack -------------------------------------------------------------------------------------------------------------------------------


def _frames(path: Path) -> list[Any]:
    msgpack, zstandard = _libraries()
    data = bytearray()
    try:
        regular_files.check(path)
        most = min(MAX_BYTES, most_unpacked(path.stat().st_size))
        with (
            open(path, "rb") as file,
            zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(file, read_across_frames=True) as stream,
        ):
            while part := stream.read(BYTES_AT_ONCE):
                data += part
                if len(data) > most:
                    raise Refusal(f"{path.name}: unpacks to more than {most} bytes")
        frames = msgpack.unpackb(data, **MOST)
    except Refusal:
        raise
    except (OSError, ValueError, MemoryError, RecursionError, zstandard.ZstdError, msgpack.UnpackException) as error:
        raise Refusal(f"{path.name}: damaged or truncated ({type(error).__name__}: {error})") from None
    if not isinstance(frames, list):
        raise Refusal(f"{path.name}: holds {type(frames).__name__}, expected a list of frames")
    return frames


def _number(frame: dict[str, Any], name: str, number: int) -> float:
    value = _array(frame, name, number)
    if value.size != 1 or not np.isfinite(value).all():
        raise Refusal(f"{name} is {value.tolist()!r:.50}, expected a number", number)
    return float(value.item())


def _array(frame: dict[str, Any], name: str, number: int) -> np.ndarray:
    """Read an array as msgpack-numpy stores it: a map of ``nd``, ``type``, ``kind``, ``shape`` and ``data``. Arrays of Python objects are refused."""
    stored = frame.get(name)
    if isinstance(stored, (int, float)) and not isinstance(stored, bool):
        return np.asarray(stored)
    if not isinstance(stored, dict):
        found = "missing" if name not in frame else type(stored).__name__
        raise Refusal(f"{name} is {found}, expected an array; there are {', '.join(sorted(map(str, frame)))}", number)
    entries = {key.decode() if isinstance(key, bytes) else key: value for key, value in stored.items()}
    kind, shape, data = entries.get("type"), entries.get("shape", []), entries.get("data")
    if entries.get("kind") not in (None, b"", "") or not isinstance(kind, str) or not isinstance(data, bytes):
        raise Refusal(f"{name} is an array of Python objects or structures, expected numbers", number)
    try:
        dtype = np.dtype(kind)
    except TypeError:
        raise Refusal(f"{name} has type {kind!r}, expected numbers", number) from None
    sound = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if dtype.kind not in "fiu" or not sound or math.prod(shape) * dtype.itemsize != len(data):
        raise Refusal(f"{name} claims {kind}{shape} and has {len(data)} bytes", number)
    return np.frombuffer(data, dtype).reshape(shape)
