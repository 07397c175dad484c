"""Frames of a trajectory that are repeated, missing, swapped or in the order of text.

Most sources have neither times nor numbers of frames, so only the motion tells. A way is the displacement of the nodes from one frame to the next. The
roughness of some ways in a row is the sum of squares of their changes, over nodes. A fault is reported where one repair leaves only a small fraction of the
roughness: dividing a way that is a multiple of the ways before and after, exchanging two frames, or sorting the frames by number. No such repair smooths an
impact, which reverses a motion once, or a vibration, which reverses it again and again. Velocities of a source tell of missing frames, too.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int64

from gpe_pl.trajectory.trajectory import Trajectory

Ways = Float[np.ndarray, "way node dim"]
Products = Float[np.ndarray, "window 5 5"]

MOST_NODES = 1000
"""Maximum number of nodes, evenly spaced, whose ways are compared."""
STANDING = 0.01
"""Fraction of the median way in a frame above which nodes move."""
MOVING = 0.1
"""Fraction of the rms way in a frame above which ways tell of missing or swapped frames."""
LEFT = 0.1
"""Largest fraction of the roughness that a repair leaves if frames are wrong."""
FAR = 1.7
"""Smallest ratio of a way to those before and after if a frame is missing."""
FITS = 1.25
"""Largest ratio of a way to that by velocities where no frame is missing."""
MOST_FAULTS = 0.1
"""Largest fraction of the frames that can be wrong. With more, the motion itself is rough."""
EVEN = 0.7
"""Smallest inner product of two ways in a row after a repair, relative to the square of the longer one: they are alike in length and direction."""
WINDOW = 5
"""Number of ways in a row that are compared."""

EXCHANGED = np.array([[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, -1, 0, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 1]], np.float64)
"""Ways after the frames at both ends of the middle way are exchanged, as combinations of five ways [way, way]."""


def wrong_frames(trajectory: Trajectory) -> Iterator[tuple[int, str]]:
    """Yield the first frame of each kind of fault, with what is wrong. Frames in the order of text are looked for no other faults."""
    ways = _ways(trajectory, trajectory.pos)
    if (frame := _repeated_frame(ways)) is not None:
        yield frame, f"is equal to frame {frame - 1}, and nodes move before and after: was it written twice?"
    followed = np.unique(np.linspace(0, trajectory.num_nodes - 1, MOST_NODES).astype(int))
    ways = ways[:, followed]
    if len(ways) < WINDOW or not ways.any():
        return
    if (frame := _frame_in_text_order(trajectory, followed, ways)) is not None:
        yield (
            frame,
            "does not go on from the frame before: frames are in the order of text (1, 10, 11, …, 2); put them in the order of their numbers",
        )
        return
    products = _products(ways)
    moves = np.einsum("wii->wi", products) > MOVING**2 * np.mean(np.einsum("wnd,wnd->w", ways, ways))
    places, times = _missing(products, moves)
    own, times_as_far = _farther_than_velocities(ways, trajectory.vel[:, followed].astype(np.float64) * trajectory.metadata.frame_dt)
    most = max(1, MOST_FAULTS * len(ways))
    if 0 < len(own) <= most:
        yield (
            int(own[0]) + 1,
            f"nodes move {times_as_far:.1f} times as far as their velocities say: is a frame missing before it{_and_more(own + 1)}?",
        )
    elif 0 < len(places) <= most:
        frames = places + WINDOW // 2 + 1
        what = f"nodes move {times[places[0]]:.1f} times as far as in the frames before and after"
        yield int(frames[0]), f"{what}: is a frame missing before it{_and_more(frames)}?"
    frames = _exchanged(products, moves) + WINDOW // 2
    if 0 < len(frames) <= most:
        yield int(frames[0]), f"nodes go forward, back and forward again: is it swapped with frame {frames[0] + 1}{_and_more(frames)}?"


def _and_more(frames: Int64[np.ndarray, " place"]) -> str:
    shown = ", ".join(map(str, frames[1:6])) + ", …" * (len(frames) > 6)
    return f" (alike: frame{'s' * (len(frames) > 2)} {shown})" if len(frames) > 1 else ""


def _ways(trajectory: Trajectory, pos: Float[np.ndarray, "frame node dim"]) -> Ways:
    return trajectory.metadata.periodicity.shortest(np.diff(pos.astype(np.float64), axis=0))


def _repeated_frame(ways: Ways) -> int | None:
    """Return the first frame that is equal to the one before, although nodes move on in the frames before and after; None if there is none.

    Nodes that turn back, as at the top of a throw, may be at the same place in two frames.
    """
    farthest = np.abs(ways).max(axis=(1, 2), initial=0.0)
    if not farthest.any():
        return None
    moves = farthest > STANDING * np.median(farthest[farthest > 0])
    goes_on = np.einsum("fnd,fnd->f", ways[:-2], ways[2:]) > 0
    repeated = np.flatnonzero((farthest[1:-1] == 0) & moves[:-2] & moves[2:] & goes_on)
    return int(repeated[0]) + 2 if len(repeated) else None


def _frame_in_text_order(trajectory: Trajectory, followed: Int64[np.ndarray, " node"], ways: Ways) -> int | None:
    """Return the first frame that sorting by number would move; None if that would not smooth the motion. Counting starts at 0 or 1."""
    given, num_frames = float(np.square(np.diff(ways, axis=0)).sum()), trajectory.num_frames
    for start in (0, 1):
        numbers = sorted(range(start, start + num_frames), key=str)
        by_number = np.argsort(numbers)
        moved = np.flatnonzero(by_number != np.arange(num_frames))
        if len(moved):
            right = _ways(trajectory, trajectory.pos[by_number][:, followed])
            if np.square(np.diff(right, axis=0)).sum() < LEFT * given:
                return int(moved[0])
    return None


def _products(ways: Ways) -> Products:
    """Return the inner products of the ways in each window."""
    count = len(ways) - WINDOW + 1
    products = np.empty((count, WINDOW, WINDOW))
    for lag in range(WINDOW):
        own = np.einsum("wnd,wnd->w", ways[: len(ways) - lag], ways[lag:])
        for k in range(WINDOW - lag):
            products[:, k, k + lag] = products[:, k + lag, k] = own[k : k + count]
    return products


def _roughness(products: Products) -> Float[np.ndarray, " window"]:
    change = np.diff(np.eye(WINDOW), axis=0)
    return np.asarray(np.einsum("ci,wij,cj->w", change, products, change))


def _missing(products: Products, moves: np.ndarray) -> tuple[Int64[np.ndarray, " place"], Float[np.ndarray, " window"]]:
    """Return the windows whose middle way is a multiple of the others, and for all windows how many times as long it is as the mean of its neighbours."""
    around = products[:, [1, 1, 3, 3], [1, 3, 1, 3]].sum(axis=1) / 4
    times = (products[:, 2, 1] + products[:, 2, 3]) / 2 / np.where(around > 0, around, 1.0)
    scale = np.ones((len(products), WINDOW))
    scale[:, 2] = 1 / np.maximum(times, 1.0)
    is_far = (times > FAR) & (products[:, 2, 2] > FAR**2 * np.maximum(products[:, 1, 1], products[:, 3, 3]))
    return np.flatnonzero(is_far & moves.all(axis=1) & _is_smoothed(products, products * scale[:, :, None] * scale[:, None, :])), times


def _farther_than_velocities(ways: Ways, steady: Float[np.ndarray, "frame node dim"]) -> tuple[Int64[np.ndarray, " place"], float]:
    """Return the ways that are a multiple of those by velocities, between ways that are not, and the first multiple.

    Args:
        ways: displacements from frame to frame in m.
        steady: velocities × time between frames in m.
    """
    mean, ends = (steady[1:] + steady[:-1]) / 2, np.einsum("fnd,fnd->f", steady, steady)
    squares, along, own = (np.einsum("wnd,wnd->w", a, b) for a, b in ((mean, mean), (ways, mean), (ways, ways)))
    times = along / np.where(squares > 0, squares, 1.0)
    left = own - times * along  # what of the way is not along the velocities
    fits = (np.abs(np.log(np.maximum(times, 1e-9))) < np.log(FITS)) & (left < LEFT * own)
    far = (times > FAR) & (own > FAR**2 * np.maximum(ends[1:], ends[:-1])) & (left < LEFT * own) & (own > MOVING**2 * own.mean())
    far[1:-1] &= fits[:-2] & fits[2:]
    far[[0, -1]] &= fits[[1, -2]]
    places = np.flatnonzero(far) if fits.mean() > 0.5 else np.empty(0, np.int64)
    return places, float(times[places[0]]) if len(places) else 1.0


def _exchanged(products: Products, moves: np.ndarray) -> Int64[np.ndarray, " place"]:
    """Return the windows in which the frames at both ends of the middle way are exchanged."""
    goes_back = (products[:, 1, 2] < 0) & (products[:, 2, 3] < 0)
    return np.flatnonzero(
        goes_back & moves.all(axis=1) & _is_smoothed(products, np.einsum("ai,wij,bj->wab", EXCHANGED, products, EXCHANGED))
    )


def _is_smoothed(products: Products, repaired: Products) -> Bool[np.ndarray, " window"]:
    """Return the windows in which a repair leaves little of the roughness, and ways that are all alike."""
    squares, k = np.einsum("wii->wi", repaired), np.arange(WINDOW - 1)
    is_even = (repaired[:, k, k + 1] > EVEN * np.maximum(squares[:, 1:], squares[:, :-1])).all(axis=1)
    return np.asarray(is_even & (_roughness(repaired) < LEFT * _roughness(products)))
