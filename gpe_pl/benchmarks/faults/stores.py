"""Faults of shards: truncation, flipped bits, and content that contradicts the schema."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gpe_pl.benchmarks.faults.verdict import Fault, Verdict, verdict_of
from gpe_pl.schema import FIELDS
from gpe_pl.trajectory.store import digest, read_trajectory, stored_arrays, stored_attributes, trajectory_names
from gpe_pl.trajectory.trajectory import Trajectory


def content(trajectory: Trajectory) -> str:
    """Return a digest of the whole content of a trajectory."""
    return digest(stored_arrays(trajectory), stored_attributes(trajectory))


def read_damaged(sound: Path, damage: Callable[[bytes], bytes], folder: Path) -> Verdict:
    """Read every trajectory of a shard with damaged bytes, as ``fit`` does: with HDF5's checksums, without the digest."""
    path = folder / sound.name
    path.write_bytes(damage(sound.read_bytes()))
    return verdict_of(lambda: contents(path), lambda found: found == contents(sound))


def read_rewritten(sound: Path, rewrite: Callable[[Path], None], folder: Path) -> Verdict:
    """Read a shard with other content and matching checksums of HDF5."""
    path = folder / sound.name
    path.write_bytes(sound.read_bytes())
    rewrite(path)
    return verdict_of(lambda: contents(path), lambda found: found == contents(sound))


def contents(path: Path) -> dict[str, str]:
    """Return digests of a shard's trajectories, by name."""
    return {name: content(read_trajectory(path, name)) for name in trajectory_names(path)}


# --- damage to bytes ----------------------------------------------------------------------------------------------------------------------


def truncated(fraction: float, data: bytes) -> bytes:
    return data[: int(len(data) * fraction)]


def flipped(seed: int, data: bytes) -> bytes:
    """Flip one bit at a random position."""
    bit = int(np.random.default_rng(seed).integers(8 * len(data)))
    return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]


def overwritten(seed: int, data: bytes) -> bytes:
    """Overwrite a block with random bytes, as a bad sector does."""
    rng = np.random.default_rng(seed)
    length = min(len(data), int(rng.integers(1, 4096)))
    start = int(rng.integers(len(data) - length + 1))
    return data[:start] + rng.bytes(length) + data[start + length :]


def damages(count: int, seed: int) -> Iterator[tuple[str, str, Callable[[bytes], bytes]]]:
    """Yield kind, name and function of ``count`` damages: a quarter truncated, a quarter overwritten, half with a flipped bit."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        number = int(rng.integers(2**31))
        if k % 4 == 0:
            fraction = float(rng.uniform(0, 1) ** 0.5)
            yield "truncated", f"at {fraction:.6f}", partial(truncated, fraction)
        elif k % 4 == 1:
            yield "overwritten", f"block {number}", partial(overwritten, number)
        else:
            yield "bit flipped", f"bit {number}", partial(flipped, number)


# --- other content ------------------------------------------------------------------------------------------------------------------------


def _without(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["00000"][key]


def _other_type(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        values = file["00000"][key][()]
        del file["00000"][key]
        file["00000"][key] = values.astype("float64" if values.dtype.kind != "f" else "int64")


def _other_shape(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        values = file["00000"][key][()]
        del file["00000"][key]
        file["00000"][key] = np.concatenate([values, values[:1]], axis=0) if len(values) else np.zeros((3, *values.shape), values.dtype)


def _other_axes(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        values = file["00000"][key][()]
        del file["00000"][key]
        file["00000"][key] = values[..., None]


def _group(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["00000"][key]
        file["00000"].create_group(key)


def _link(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["00000"][key]
        file["00000"][key] = h5py.ExternalLink("/dev/zero", "/x") if len(key) % 2 else h5py.SoftLink("/00000/pos")


def _huge(key: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        dims = len(FIELDS[key].dims)
        del file["00000"][key]
        file["00000"].create_dataset(key, (2**20,) * dims, FIELDS[key].dtype, chunks=(1,) * dims)


def _version(version: Any, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = version


def _text(key: str, text: bytes | None, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["00000"].attrs[key]
        if text is not None:
            file["00000"].attrs[key] = np.bytes_(text)


def _metadata(key: str, value: Any, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        values = json.loads(file["00000"].attrs["metadata"])
        if value is None:
            del values[key]
        else:
            values[key] = value
        file["00000"].attrs["metadata"] = np.bytes_(json.dumps(values).encode())


def _no_hdf5(text: bytes, path: Path) -> None:
    path.write_bytes(text)


def _folder(path: Path) -> None:
    os.unlink(path)
    path.mkdir()


def rewrites(sound: Path) -> Iterator[tuple[str, Callable[[Path], None]]]:
    """Yield each altered content of a shard: a name, and a function that alters the file."""
    trajectory = read_trajectory(sound, "00000")
    for key in stored_arrays(trajectory):
        if FIELDS[key].required:
            yield f"{key} missing", partial(_without, key)
        for name, change in (("type", _other_type), ("axes", _other_axes), ("group", _group), ("link", _link), ("huge", _huge)):
            yield f"{key}: {name}", partial(change, key)
        if "one" not in FIELDS[key].dims[0] and FIELDS[key].dims[0] not in ("frame", "cell", "boundary_node"):
            yield f"{key}: shape", partial(_other_shape, key)
    for version in (0, -1, 10**6, 1.5, "1", b"1"):
        yield f"schema version {version!r}", partial(_version, version)
    for key in ("metadata", "shapes", "node_types"):
        for text in (None, b"", b"{", b"[1]", b"null", b"\xff\xfe", b"[" * 10_000, b'{"__class__": "os.system"}'):
            yield f"{key}: {text if text is None else text[:12]!r}", partial(_text, key, text)
    for key in json.loads(stored_attributes(trajectory)["metadata"]):
        for value in (None, {"a": 1}, [[[1]]]):
            yield f"metadata.{key}: {value}", partial(_metadata, key, value)
    for text in (b"", b"hello", b"\x89HDF\r\n\x1a\n", b"PK\x03\x04" + bytes(100), bytes(10_000)):
        yield f"no HDF5: {text[:8]!r}", partial(_no_hdf5, text)
    yield "a folder", _folder


def faults(sound: Path, num_damages: int, seed: int = 0) -> list[Fault]:
    """Return damages to the bytes of a sound shard, and every other content of it."""
    found = [Fault(f"shard, {kind}", name, partial(read_damaged, sound, damage)) for kind, name, damage in damages(num_damages, seed)]
    return found + [Fault("shard, other content", name, partial(read_rewritten, sound, rewrite)) for name, rewrite in rewrites(sound)]
