"""Writers of the formats that ``gpe_pl.data.importers`` reads. They follow the descriptions of the formats and share no code with the readers."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

DT, SPACING = 0.01, 0.05


def motion(num_frames: int = 10, num_nodes: int = 20, dim: int = 2, seed: int = 0, low: float = 0.2, high: float = 0.8) -> np.ndarray:
    """Return positions [frame, node, dim] of particles that swing about their centres."""
    rng = np.random.default_rng(seed)
    rest = rng.uniform(low, high, (num_nodes, dim))
    phase, rate = rng.uniform(0, 2 * np.pi, (2, num_nodes, dim))
    time = np.arange(num_frames)[:, None, None]
    return (rest + 0.05 * np.sin(phase + 0.1 * rate * time)).astype(np.float32)


def rigid(pos: np.ndarray, *bodies: slice) -> np.ndarray:
    """Return positions [frame, node, dim] in which each body, a slice of nodes, keeps its shape of frame 0 and moves with its first node."""
    pos = pos.copy()
    for body in bodies:
        pos[:, body] = pos[:1, body] + (pos[:, body.start] - pos[0, body.start])[:, None]
    return pos


def frames_of(pos: np.ndarray) -> list[bytes]:
    return [np.ascontiguousarray(frame, "<f4").tobytes() for frame in pos]


# --- TFRecord and protocol buffers ---------------------------------------------------------------------------------------------------------


def crc32c(data: bytes) -> int:
    """Return the CRC-32C, computed bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def checksum(data: bytes) -> bytes:
    crc = crc32c(data)
    return struct.pack("<I", ((crc >> 15 | crc << 17 & 0xFFFFFFFF) + 0xA282EAD8) % 2**32)


def record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    return length + checksum(length) + data + checksum(data)


def varint(value: int) -> bytes:
    value %= 2**64
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def message(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def feature(values: Any, packed: bool = True) -> bytes:
    """Encode bytes, floats or integers as a ``Feature``."""
    if isinstance(values, bytes):
        return message(1, message(1, values))
    array = np.asarray(values)
    if array.dtype.kind == "f":
        data = array.astype("<f4")
        return message(2, message(1, data.tobytes()) if packed else b"".join(varint(1 << 3 | 5) + x.tobytes() for x in data))
    return message(
        3, message(1, b"".join(map(varint, array.tolist()))) if packed else b"".join(varint(1 << 3) + varint(x) for x in array.tolist())
    )


def named(entries: Mapping[str, bytes]) -> bytes:
    """Encode a map from names to messages."""
    return b"".join(message(1, message(1, name.encode()) + message(2, value)) for name, value in entries.items())


def example(features: Mapping[str, Any]) -> bytes:
    return message(1, named({name: feature(value) for name, value in features.items()}))


def sequence_example(context: Mapping[str, Any], lists: Mapping[str, Sequence[Any]]) -> bytes:
    entries = {name: b"".join(message(1, feature(value)) for value in values) for name, values in lists.items()}
    return message(1, named({name: feature(value) for name, value in context.items()})) + message(2, named(entries))


# --- formats -------------------------------------------------------------------------------------------------------------------------------


def gns_metadata(folder: Path, pos: np.ndarray, **changes: Any) -> None:
    dim = pos.shape[2]
    values = {
        "bounds": [[0.0, 1.0]] * dim,
        "sequence_length": len(pos) - 1,
        "default_connectivity_radius": 0.15,
        "dim": dim,
        "dt": DT,
        **{f"{key}_{name}": [0.0] * dim for key in ("vel", "acc") for name in ("mean", "std")},
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(values | changes))


def gns_record(pos: np.ndarray, types: np.ndarray, key: int = 0) -> bytes:
    return sequence_example(
        {"key": np.array([key]), "particle_type": np.ascontiguousarray(types, "<i8").tobytes()}, {"position": frames_of(pos)}
    )


def gns_tfrecord(path: Path, trajectories: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(record(gns_record(pos, types, k)) for k, (pos, types) in enumerate(trajectories)))


def gns_npz(path: Path, trajectories: Sequence[tuple[Any, ...]]) -> None:
    arrays: dict[str, Any] = {}
    for k, parts in enumerate(trajectories):
        packed = np.empty(len(parts), dtype=object)
        packed[:] = parts
        arrays[f"simulation_trajectory_{k}"] = packed
    np.savez(path, **arrays)


def lagrangebench_metadata(folder: Path, dim: int = 2, **changes: Any) -> None:
    values = {
        "case": "TGV",
        "solver": "SPH",
        "dim": dim,
        "dx": SPACING,
        "dt": DT / 100,
        "write_every": 100,
        "viscosity": 0.02,
        "g_ext_magnitude": 0.0,
        "free_slip": False,
        "periodic_boundary_conditions": [True] * dim,
        "bounds": [[0.0, 1.0]] * dim,
        "default_connectivity_radius": 0.145,
        "sequence_length_train": 9,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metadata.json").write_text(json.dumps(values | changes))


def lagrangebench_h5(path: Path, trajectories: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    with h5py.File(path, "w") as file:
        for k, (pos, types) in enumerate(trajectories):
            file.create_dataset(f"{k:05d}/particle_type", data=types)
            file.create_dataset(f"{k:05d}/position", data=pos, dtype=np.float32, compression="gzip")


def sheet(num_frames: int = 10, rows: int = 5, columns: int = 6, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a cloth that hangs from two corners, as the fields of a cloth data set of MeshGraphNets."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    mesh_pos = SPACING * np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32)
    number = np.arange(rows * columns).reshape(rows, columns)
    low = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:]], axis=-1).reshape(-1, 3)
    high = np.stack([number[:-1, :-1], number[1:, 1:], number[1:, :-1]], axis=-1).reshape(-1, 3)
    types = np.zeros((rows * columns, 1), np.int32)
    types[[0, columns - 1]] = 3
    wave = 0.02 * np.sin(0.5 * np.arange(num_frames)[:, None] + 20 * mesh_pos.sum(axis=1) + rng.uniform(0, 6))
    wave *= types[:, 0] == 0
    flat = np.broadcast_to(mesh_pos, (num_frames, *mesh_pos.shape))
    return {
        "world_pos": np.concatenate([flat, wave[..., None]], axis=-1).astype(np.float32),
        "mesh_pos": mesh_pos[None],
        "cells": np.concatenate([low, high]).astype(np.int32)[None],
        "node_type": types[None],
    }


def mgn_meta(folder: Path, fields: Mapping[str, np.ndarray], **changes: Any) -> None:
    length = len(fields["world_pos"])
    features = {
        name: {"type": "dynamic" if len(a) == length else "static", "dtype": str(a.dtype), "shape": [len(a), -1, a.shape[2]]}
        for name, a in fields.items()
    }
    values = {"simulator": "arcsim", "dt": 0.02, "trajectory_length": length, "field_names": list(fields), "features": features}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "meta.json").write_text(json.dumps(values | changes))


def mgn_tfrecord(path: Path, trajectories: Sequence[Mapping[str, np.ndarray]]) -> None:
    path.write_bytes(b"".join(record(example({name: a.tobytes() for name, a in fields.items()})) for fields in trajectories))


def mgn_h5(path: Path, trajectories: Sequence[Mapping[str, np.ndarray]]) -> None:
    with h5py.File(path, "w") as file:
        for k, fields in enumerate(trajectories):
            for name, array in fields.items():
                file.create_dataset(f"trajectory_{k}/{name}", data=array)


def dpinet(folder: Path, pos: np.ndarray, vel: np.ndarray | None, **extra: np.ndarray) -> None:
    """Write one rollout, a file per frame."""
    folder.mkdir(parents=True)
    for k, x in enumerate(pos):
        with h5py.File(folder / f"{k}.h5", "w") as file:
            for name, array in {"positions": x, **({} if vel is None else {"velocities": vel[k]}), **extra}.items():
                file[name] = array


def msgpack_array(array: np.ndarray) -> dict[bytes, Any]:
    """Encode an array as msgpack-numpy does."""
    kind = b"O" if array.dtype.hasobject else b""
    return {b"nd": True, b"type": array.dtype.str, b"kind": kind, b"shape": list(array.shape), b"data": array.tobytes()}


def dmcf_frames(pos: np.ndarray, vel: np.ndarray, first: int = 0, **static: np.ndarray) -> list[dict[str, Any]]:
    """Return the frames of one part; the first contains ``static``."""
    count = pos.shape[1]
    frames: list[dict[str, Any]] = []
    for k, (x, v) in enumerate(zip(pos, vel, strict=True)):
        arrays = {"pos": x, "vel": v, "m": np.full(count, 0.125, np.float32), "viscosity": np.full(count, 0.01, np.float32)}
        if k == 0:
            arrays |= static
        frames.append({"frame_id": first + k, "scene_id": "sim", **{name: msgpack_array(a) for name, a in arrays.items()}})
    return frames


def dmcf(path: Path, frames: Any) -> None:
    import msgpack
    import zstandard

    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(zstandard.ZstdCompressor().compress(msgpack.packb(frames)))
