"""Data at every ``stride``-th stored frame: their statistics, and the connectivity radius that the longer frames need.

An edge has to connect a node with what it meets within a frame. With the radius R of the data and frames k times as long, the radius is

    R_k = max(R, min(REACH v k Δt, MOST_RADII R))

where v is the largest speed in the train split and Δt the time between stored frames. In periodic domains it also stays below half a period.

REACH was chosen by two measurements. The first asks whether groups of nodes without an edge to anything else fall freely, in sand and snow at k = 2, 4 and 8.
Their mean squared acceleration without gravity, over that of all nodes, is less than 3e-4 with REACH = 1/2, and up to 1e-2 with the radius R. The second
compares models of sand with k = 4 after 4,000 steps (one seed, 20 scenes). Their errors with REACH = 1/2 and REACH = 1 differ by less than a quarter, and
neither is always lower. REACH = 1 took 1.4 times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.dataset import StoredTrajectory, every
from gpe_pl.data.statistics import acceleration_std, motion
from gpe_pl.files import sealed
from gpe_pl.trajectory.store import StoreError
from gpe_pl.trajectory.trajectory import Metadata

REACH = 0.5
"""Radius as a fraction of the largest distance that a node moves in a frame."""
MOST_RADII = 2.0
"""Largest radius with a stride, as a multiple of the radius of the data. In 3D this already means eight times as many edges."""
OF_PERIOD = 0.49
"""Largest radius with a stride in a periodic domain, as a fraction of the period."""


@dataclass(frozen=True)
class StrideStatistics:
    """Statistics of a train split at every ``stride``-th frame.

    Attributes:
        acceleration_std: rms per component of the accelerations without gravity [m/s²], over the longer frames that begin at stored frame 0.
        max_speed: largest speed of a node between stored frames [m/s].
    """

    acceleration_std: float
    max_speed: float


def stride_statistics(root: Path | str, stride: int, train: Sequence[StoredTrajectory]) -> StrideStatistics:
    """Return the statistics of the train split at every ``stride``-th frame.

    They are read from ``statistics_stride_{stride}.json`` in the data set's folder if this file belongs to the data. Otherwise they are computed and, if the
    folder can be written, stored there.

    Args:
        root: folder of the data set.
        stride: number of stored frames in a frame.
        train: usable trajectories of the train split with all stored frames.
    """
    path, checksum = Path(root) / f"statistics_stride_{stride}.json", split_checksum(root, "train")
    with suppress(sealed.SealError, OSError, KeyError, TypeError, ValueError):
        known = sealed.read(path, "")
        if known["data_sha256"] == checksum:
            return StrideStatistics(float(known["acceleration_std"]), float(known["max_speed"]))
    std = acceleration_std(view.window(0, view.num_frames) for view in every(train, stride))
    found = StrideStatistics(std, max(map(_max_speed, train)))
    with suppress(OSError):  # data may be read-only
        sealed.write(path, {"data_sha256": checksum, "acceleration_std": found.acceleration_std, "max_speed": found.max_speed})
    return found


def _max_speed(stored: StoredTrajectory) -> float:
    parts = (values for key, values in motion(stored.window(0, stored.num_frames)) if key == "velocity")
    return max(float(np.linalg.norm(values, axis=-1).max(initial=0.0)) for values in parts)


def connectivity_radius(metadata: Metadata, stride: int, max_speed: float) -> float:
    """Return the connectivity radius [m] of graphs with a stride.

    Args:
        metadata: metadata of the stored data.
        stride: number of stored frames in a frame.
        max_speed: largest speed of a node [m/s].

    Raises:
        StoreError: a node may move by half a period or more in a frame, so that its direction is not known.
    """
    radius, step, most = metadata.connectivity_radius, max_speed * stride * metadata.frame_dt, MOST_RADII * metadata.connectivity_radius
    if stride > 1 and metadata.periodicity:
        period = float(min(metadata.periodicity.period[axis] for axis in metadata.periodicity.axes))
        if step >= 0.5 * period:
            raise StoreError(
                f"data.stride={stride}: nodes move up to {step:.3g} m in a frame, and only less than half the period of {period:.3g} m is known; "
                f"choose at most {max(1, int(0.5 * period / (max_speed * metadata.frame_dt)))}"
            )
        most = min(most, OF_PERIOD * period)
    return max(radius, min(REACH * step, most)) if stride > 1 else radius
