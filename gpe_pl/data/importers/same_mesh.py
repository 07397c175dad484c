"""The same points and cells in all frames of a series of mesh files.

Programs that run in parallel, or sort their particles, write the points of each frame in another order. An array of the numbers of points (``NUMBERS``) tells
which rows are the same point.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gpe_pl.data.importers.mesh_files import Frame
from gpe_pl.data.importers.source import Refusal

NUMBERS = ("id", "idp", "particleid", "nodeid", "pointid", "globalid", "globalnodeid", "globalpointid", "pedigreeid", "vtkoriginalpointid")
"""Names of arrays with the numbers of points, in lower case, without ``_`` and without ``s`` at the end. ParaView's own numbers come last, because they are
rows of the data that a filter got.
"""


def in_one_order(frames: list[Frame]) -> list[Frame]:
    """Return the frames with the points of each in the order of the first frame.

    Args:
        frames: frames of a trajectory, at least one.

    Raises:
        Refusal: a frame has other points or cells than the first, or numbers of points that do not tell which point is which.
    """
    first = frames[0]
    for k, frame in enumerate(frames):
        if frame.points.shape != first.points.shape:
            rule = "meshes must not change" if first.cells else "particles must be the same in all frames; leave out those that come or go"
            raise Refusal(f"{frame.file} has {len(frame.points)} points, {first.file} has {len(first.points)}; {rule}", k)
    frames = _by_number(frames)
    for k, frame in enumerate(frames):
        same = frame.cells.keys() == first.cells.keys() and all(
            np.array_equal(frame.cells[kind], first.cells[kind]) for kind in first.cells
        )
        if not same:
            raise Refusal(f"{frame.file} has other cells than {first.file}; meshes must not change", k)
    return frames


def _by_number(frames: list[Frame]) -> list[Frame]:
    """Return the frames with their points in the order of the first; without numbers of points, or with the same in all frames, they are unchanged."""
    first = frames[0]
    found = {name: values for name in _names(first) if (values := _whole(first, name)) is not None}
    different = [name for name, values in found.items() if len(np.unique(values)) == len(values)]
    if not found:
        return frames
    name = next(iter(different or found))  # numbers that occur twice may be those of bodies
    usual = found[name]
    ordered = []
    for k, frame in enumerate(frames):
        own = _whole(frame, name)
        if own is None:
            raise Refusal(f"{frame.file} has no array {name!r} of whole numbers, {first.file} has one; write it in all frames", k)
        if np.array_equal(own, usual):
            ordered.append(frame)
            continue
        if not different:
            raise Refusal(
                f"{frame.file}: array {name!r} differs from {first.file} and has numbers twice, so points cannot be followed; number all points differently",
                k,
            )
        if len(missing := np.setxor1d(usual, own)):
            raise Refusal(
                f"{frame.file}: array {name!r} has other numbers of points than {first.file}, such as {missing[0]}; write the same points in all frames",
                k,
            )
        ordered.append(_reordered(frame, np.argsort(own)[np.argsort(np.argsort(usual))]))
    return ordered


def _names(frame: Frame) -> Iterator[str]:
    """Yield the names of arrays that may have the numbers of points, in the order of ``NUMBERS``."""
    for number in NUMBERS:
        yield from (name for name in frame.point_data if name.lower().replace("_", "").rstrip("s") == number)


def _whole(frame: Frame, name: str) -> np.ndarray | None:
    """Return an array of whole numbers [point]; None if the frame has none of this name."""
    values = frame.point_data.get(name)
    if values is None or values.size != len(frame.points) or values.dtype.kind not in "iuf" or not (values == np.rint(values)).all():
        return None
    return values.reshape(-1).astype(np.int64)


def _reordered(frame: Frame, rows: np.ndarray) -> Frame:
    """Return a frame whose point ``k`` was in row ``rows[k]``."""
    place = np.argsort(rows)
    return replace(
        frame,
        points=frame.points[rows],
        cells={kind: place[corners] for kind, corners in frame.cells.items()},
        point_data={name: values[rows] for name, values in frame.point_data.items()},
    )
