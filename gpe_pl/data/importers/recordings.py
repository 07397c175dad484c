"""Trajectories that are parts of one recording: they have frames in common, or one goes on where another ends.

Errors on a part say little about other scenes if the model was trained on another part. Parts in different splits are found. Scenes that start alike and
fall alike have frames in common at equal times; these are no parts unless one is the beginning of the other. Bodies that swing come back to where all of them
started, so scenes with the same first frame do not go on after each other. Nodes may be in another order where parts have frames in common, but not where one
goes on after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt64

from gpe_pl.data.importers.source import Item
from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.trajectory.rest_positions import coarse_axes, round_middle
from gpe_pl.trajectory.trajectory import Trajectory

NUM_FOLLOWED = 64
"""Number of nodes, evenly spaced, whose first and last positions are kept."""
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
_SIDES: tuple[Literal["left", "right"], ...] = ("left", "right")
_MIX = np.uint64(0xFF51AFD7ED558CCD)


@dataclass(frozen=True)
class Part:
    """What is known of one trajectory.

    Attributes:
        digests: digest of the positions of each frame, in the precision of the store; it does not depend on the order of the nodes.
        moves: whether each frame differs from the one before.
        num_nodes: number of nodes.
        first: positions of the followed nodes in the first frame [m].
        last: the same in the last two frames [m].
        periodicity: periodic axes.
    """

    digests: UInt64[np.ndarray, " frame"]
    moves: Bool[np.ndarray, " frame"]
    num_nodes: int
    first: Float[np.ndarray, "node dim"]
    last: Float[np.ndarray, "end node dim"]
    periodicity: Periodicity

    @property
    def size(self) -> tuple[int, tuple[int, ...]]:
        """Numbers of nodes, of followed nodes, and of axes, which parts that go on have in common."""
        return self.num_nodes, self.first.shape

    @classmethod
    def of(cls, trajectory: Trajectory) -> Part:
        """Return what has to be kept of a trajectory."""
        digests = np.array([_digest(pos) for pos in trajectory.pos], np.uint64)
        followed = np.unique(np.linspace(0, trajectory.num_nodes - 1, NUM_FOLLOWED).astype(int))
        ends = trajectory.pos[:, followed].astype(np.float64)
        moves = np.concatenate([digests[:1] != digests[1:2], digests[1:] != digests[:-1]])
        return cls(digests, moves, trajectory.num_nodes, ends[0], ends[-2:], trajectory.metadata.periodicity)


class Recordings:
    """The parts of all usable trajectories of a source."""

    def __init__(self) -> None:
        self.parts: dict[int, Part] = {}

    def add(self, item: Item, part: Part) -> None:
        """Add what is known of a trajectory."""
        self.parts[id(item)] = part

    def across(self, splits: Mapping[str, Sequence[Item]]) -> Iterator[str]:
        """Yield a warning for every split with parts of recordings of a split before it."""
        names: list[str] = []
        earlier: list[Part] = []
        for split, items in splits.items():
            own = [self.parts[id(item)] for item in items]
            known = _Earlier(earlier) if earlier else None
            found = [(item.name, relative) for item, part in zip(items, own, strict=True) if known and (relative := known.relative(part))]
            if found:
                name, (how, other) = found[0]
                yield (
                    f"{split}: {len(found)} of {len(items)} trajectories {'is' if len(found) == 1 else 'are'} of a recording that is also in another "
                    f"split, the first is {name}, which {how} {names[other]}: errors there say little about other scenes; keep each recording in one split"
                )
            names += [f"{split}, {item.name}" for item in items]
            earlier += own


class _Earlier:
    """Parts of earlier splits, in which relatives are searched for."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = parts
        digests = np.concatenate([part.digests for part in parts])
        order = np.argsort(digests, kind="stable")
        self.digests = digests[order]
        self.owners = np.repeat(np.arange(len(parts)), [len(part.digests) for part in parts])[order]
        self.frames = np.concatenate([np.arange(len(part.digests)) for part in parts])[order]
        alike: dict[tuple[int, tuple[int, ...]], list[int]] = {}
        for k, part in enumerate(parts):
            alike.setdefault(part.size, []).append(k)
        self.groups = {
            size: (members, np.stack([parts[k].first for k in members]), np.stack([parts[k].last for k in members]))
            for size, members in alike.items()
        }

    def relative(self, part: Part) -> tuple[str, int] | None:
        """Return how a part is related to an earlier one, and to which."""
        if (other := self._with_shared_frames(part)) is not None:
            return "has frames of", other
        if part.size in self.groups:
            members, first, last = self.groups[part.size]
            for how, next_frame, ends in (("goes on after", part.first, last), ("goes on before", first, part.last)):
                found = [members[k] for k in np.flatnonzero(_follows(next_frame, ends, part.periodicity))]
                if others := [k for k in found if self.parts[k].digests[0] != part.digests[0]]:
                    return how, others[0]
        return None

    def _with_shared_frames(self, part: Part) -> int | None:
        own = np.flatnonzero(part.moves)
        for side in _SIDES:  # the first and the last of those with this frame
            at = np.searchsorted(self.digests, part.digests[own], side) - (side == "right")
            at = np.clip(at, 0, len(self.digests) - 1)
            same = self.digests[at] == part.digests[own]
            if len(elsewhere := self.owners[at][same & (self.frames[at] != own)]):
                return int(elsewhere[0])
            for other in dict.fromkeys(self.owners[at][same].tolist()):
                length = min(len(part.digests), len(self.parts[other].digests))
                if np.array_equal(part.digests[:length], self.parts[other].digests[:length]):
                    return int(other)
        return None


def _follows(
    next_frame: Float[np.ndarray, "... node dim"], ends: Float[np.ndarray, "... 2 node dim"], periodicity: Periodicity
) -> Bool[np.ndarray, " pair"]:
    """Return whether a frame is what follows two frames: where the nodes would be one frame later, within one displacement."""
    displacement = periodicity.shortest(ends[..., 1, :, :] - ends[..., 0, :, :])
    error = periodicity.shortest(next_frame - ends[..., 1, :, :]) - displacement
    size, deviation = (np.square(x).sum(axis=(-2, -1)) for x in (displacement, error))
    return np.atleast_1d((size > 0) & (deviation <= size))


def _digest(pos: Float[np.ndarray, "node dim"]) -> np.uint64:
    """Return a digest of positions, in the precision of the store: the sum of the digests of the nodes, and of their origin as a further one."""
    origin = _origin(pos)
    seen = np.concatenate([pos - origin, origin[None]])
    bits = (np.ascontiguousarray(seen, np.float32) + np.float32(0)).view(np.uint32).astype(np.uint64)  # adding zero turns -0 into 0
    digests = (bits * _FACTORS[: pos.shape[1]]).sum(axis=1)
    digests ^= digests >> np.uint64(33)
    digests *= _MIX
    digests ^= digests >> np.uint64(29)
    return np.uint64(digests.sum())


def _origin(pos: Float[np.ndarray, "node dim"]) -> Float[np.ndarray, "dim"]:
    """Return a round point near the nodes if they are so far from 0 that float32 does not tell them apart, and 0 otherwise."""
    low, high = pos.min(axis=0).astype(np.float64), pos.max(axis=0).astype(np.float64)
    nowhere = np.zeros(len(low))
    return round_middle(low, high, nowhere) if (high > low).any() and coarse_axes(low, high).any() else nowhere
