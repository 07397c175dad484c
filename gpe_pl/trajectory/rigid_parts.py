"""Finds rigid parts among nodes with known paths, and turns the normals of the nodes with their parts.

Nodes belong to one rigid part if one motion describes them in every frame::

    x_n(t) = c(t) + R(t) (x_n(0) − c(0))

R(t) is the rotation that best maps the part from the first frame to its present position [Kabsch 1976]. Nodes that are near each other need not belong to one
part: a piston that slides over a floor is a part of its own. Nodes of a membrane that happen to move alike are not a rigid part, because most nodes connected
to them move differently.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from gpe_pl.geometry.periodicity import NOWHERE, Periodicity

TOLERANCE = 1e-5
"""Differences of positions below this fraction of the boundary's extent are rounding."""

STRETCH = 0.25
"""Two near nodes count as connected if their distance changes by at most this fraction in all frames."""

PARTNERS = 8
NEIGHBOURS = 16
FEW_FRAMES = 8
"""Number of evenly spread frames that are compared first. They exclude most of the nodes that move differently."""


@dataclass(frozen=True)
class _Paths:
    """Paths of nodes.

    Attributes:
        first: positions in the first frame [node, dim] in m.
        moved: displacements since the first frame [frame, node, dim] in m.
        periodicity: axes along which space repeats.
        tolerance: tolerance of positions [m].
    """

    first: np.ndarray
    moved: np.ndarray
    periodicity: Periodicity
    tolerance: float

    def arms(self, nodes: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Return vectors from ``centre`` [dim] to the nearest images of nodes in the first frame [node, dim] in m."""
        return np.asarray(self.periodicity.shortest(self.first[nodes] - centre))

    @cached_property
    def few(self) -> _Paths:
        """The paths in ``FEW_FRAMES`` frames."""
        return replace(self, moved=self.moved[self._stages[0]])

    @cached_property
    def _stages(self) -> tuple[np.ndarray, slice]:
        """Selections of frames in the order in which they are compared: few frames, then all."""
        return np.linspace(0, len(self.moved) - 1, FEW_FRAMES).astype(int), slice(None)

    def keep_distance(self, nodes: np.ndarray, node: int) -> np.ndarray:
        """Return those of ``nodes`` whose distance from ``node`` is the same in every frame."""
        for frames in self._stages:
            arm = self.arms(nodes, self.first[node])
            length = np.linalg.norm(arm + self.moved[frames][:, nodes] - self.moved[frames][:, node, None], axis=-1)
            nodes = nodes[(np.abs(length - np.linalg.norm(arm, axis=-1)) <= 2 * self.tolerance).all(axis=0)]
        return nodes

    def part_of(self, nodes: np.ndarray, reference: int) -> _Part:
        """Return the rigid motion that describes nodes best. Their images are those nearest to a reference node."""
        arms = self.arms(nodes, self.first[reference])
        mean, path = arms.mean(axis=0), self.moved[:, nodes].mean(axis=1)
        change = self.moved[:, nodes] - path[:, None]
        turn = None if np.abs(change).max() <= self.tolerance else rotations(arms - mean, change, self.tolerance)
        return _Part(self.first[reference] + mean, path, turn)

    def described(self, nodes: np.ndarray, part: _Part) -> np.ndarray:
        """Return a mask [node] of those of ``nodes`` that a motion describes in every frame."""
        fits = np.ones(len(nodes), dtype=bool)
        for frames in self._stages:
            rows, predicted = nodes[fits], part.path[frames][:, None]
            if part.turn is not None:
                arms = self.arms(rows, part.centre)
                predicted = predicted + np.einsum("fde,ne->fnd", part.turn[frames], arms) - arms
            fits[fits] = (np.abs(self.moved[frames][:, rows] - predicted) <= 2 * self.tolerance).all(axis=(0, 2))
        return fits


@dataclass(frozen=True)
class _Part:
    """A rigid motion.

    Attributes:
        centre: centre in the first frame [dim] in m.
        path: displacement of the centre [frame, dim] in m.
        turn: rotation since the first frame [frame, dim, dim]; None if the part does not turn.
    """

    centre: np.ndarray
    path: np.ndarray
    turn: np.ndarray | None


def carried_along(pos: np.ndarray, normal: np.ndarray, periodicity: Periodicity = NOWHERE) -> np.ndarray:
    """Return unit normals [frame, boundary_node, dim] that turn with the rigid part of each node.

    Normals of parts that do not turn stay equal bit for bit. The normal of a node outside rigid parts, such as a node of a membrane, turns with the connected
    nodes outside rigid parts. The normal of a single node does not turn. In 3D, parts whose nodes lie in a row do not turn about this row.

    Args:
        pos: positions [frame, boundary_node, dim] in m, continuous across seams.
        normal: unit normals in the first frame [boundary_node, dim].
        periodicity: axes along which space repeats.
    """
    turned = np.array(np.broadcast_to(normal, pos.shape))
    if pos.shape[1] < 2:
        return turned
    paths = _Paths(pos[0], pos - pos[0], periodicity, _tolerance(pos))
    label, parts = _parts(paths)
    for number, part in enumerate(parts):
        if part.turn is not None:
            rows = label == number
            turned[:, rows] = np.einsum("fde,ne->fnd", part.turn, normal[rows])
    loose = np.flatnonzero(label < 0)
    if len(loose) > 1:
        for frame, turn in enumerate(_local_rotations(paths, loose)):
            turned[frame, loose] = np.einsum("nde,ne->nd", turn, normal[loose])
    return turned


def _tolerance(pos: np.ndarray) -> float:
    """Return the difference of positions [m] that rounding can cause. Positions in float64 may have been rounded to float32 before."""
    is_single = bool((pos.astype(np.float32) == pos).all())
    rounding = float(np.finfo(np.float32 if is_single else np.float64).eps) * float(np.abs(pos).max())
    return max(TOLERANCE * float(np.ptp(pos[0], axis=0).max()), 8 * rounding)


def _parts(paths: _Paths) -> tuple[np.ndarray, list[_Part]]:
    """Return the number of each node's rigid part [node], -1 for none, and the parts."""
    label = np.full(len(paths.first), -1)
    parts: list[_Part] = []
    left = np.arange(len(paths.first))
    while len(left):
        seed, nodes = int(left[0]), paths.keep_distance(left, int(left[0]))
        found, part = np.array([seed]), None
        for some in _hypotheses(paths, nodes, seed):
            if len(_grown(paths.few, nodes, some, seed)[0]) <= len(found):
                continue
            members, motion = _grown(paths, nodes, some, seed)
            if len(members) > len(found):
                found, part = members, motion
            if len(found) == len(nodes):
                break
        if part is not None:
            label[found] = len(parts)
            parts.append(part)
        left = np.setdiff1d(left, np.append(found, seed))
    if parts:
        _settle(paths, label, parts)
    label[~_hold_together(paths, label)] = -1
    return label, parts


def _hold_together(paths: _Paths, label: np.ndarray) -> np.ndarray:
    """Return a mask [node] of the nodes in accepted parts.

    A part is accepted if at least half of the nodes that are connected to its nodes belong to it. Nodes of accepted parts are then no longer counted.
    """
    is_rigid = np.zeros(len(label), dtype=bool)
    while True:
        nodes = np.flatnonzero(~is_rigid)
        if not (label[nodes] >= 0).any():
            return is_rigid
        near, _, hangs = _surroundings(paths, nodes)
        of_part, count = label[nodes] >= 0, np.bincount(label[nodes] + 1)
        own = (label[near] == label[nodes][:, None]).sum(axis=1)
        most = np.minimum(hangs.sum(axis=1), count[label[nodes] + 1] - 1)
        fraction, whole = (np.bincount(label[nodes][of_part], values[of_part]) for values in (own, most))
        accepted = np.flatnonzero((2 * fraction >= whole) & (count[1:] > 0))
        if not len(accepted):
            return is_rigid
        is_rigid |= np.isin(label, accepted)


def _hypotheses(paths: _Paths, nodes: np.ndarray, seed: int) -> Iterator[np.ndarray]:
    """Yield small sets of nodes whose common motion may be that of the part of ``seed``. All of ``nodes`` keep their distance from ``seed``."""
    yield np.array([seed])  # no turn
    others = nodes[nodes != seed]
    distance = np.linalg.norm(paths.arms(others, paths.first[seed]), axis=1)
    others = others[distance > 100 * paths.tolerance]  # rounding dominates the direction to nearer nodes
    order = np.argsort(distance[distance > 100 * paths.tolerance], kind="stable")
    ends = np.unique(np.concatenate([np.arange(min(len(order), PARTNERS)), np.arange(max(0, len(order) - PARTNERS), len(order))]))
    for partner in others[order[ends]]:
        pair = np.array([seed, partner])
        if paths.first.shape[1] == 2:
            yield pair
            continue
        third = paths.keep_distance(others, int(partner))
        arms, along = paths.arms(third, paths.first[seed]), paths.arms(pair[1:], paths.first[seed])[0]
        away = np.linalg.norm(np.cross(arms, along / np.linalg.norm(along)), axis=1)
        near = np.argsort(np.linalg.norm(arms, axis=1), kind="stable")[:NEIGHBOURS]
        yield pair if away[near].max(initial=0.0) <= 100 * paths.tolerance else np.append(pair, third[near[away[near].argmax()]])
        yield pair if away.max(initial=0.0) <= 100 * paths.tolerance else np.append(pair, third[away.argmax()])


def _grown(paths: _Paths, nodes: np.ndarray, some: np.ndarray, seed: int) -> tuple[np.ndarray, _Part]:
    """Return those of ``nodes`` that move with ``some`` of them, and their motion. It is fitted again to all nodes found, which is more exact."""
    part = paths.part_of(some, seed)
    for _ in range(4):
        found = nodes[paths.described(nodes, part)]
        if len(found) <= len(some):
            break
        some, part = found, paths.part_of(found, seed)
    return some, part


def _settle(paths: _Paths, label: np.ndarray, parts: list[_Part]) -> None:
    """Assign nodes to the nearest part whose motion describes them; changes ``label``.

    This concerns nodes that several motions describe, as on the axis of a wheel, and nodes without a part.
    """
    fits = np.stack([paths.described(np.arange(len(label)), part) for part in parts])
    open_ones = np.flatnonzero(fits.sum(axis=0) > (label >= 0))
    for node in open_ones:
        others = np.setdiff1d(np.flatnonzero(np.isin(label, np.flatnonzero(fits[:, node]))), open_ones)
        if len(others):
            label[node] = label[others[np.linalg.norm(paths.arms(others, paths.first[node]), axis=1).argmin()]]


def rotations(arms: np.ndarray, change: np.ndarray, tolerance: float) -> np.ndarray:
    """Return rotations [frame, dim, dim] that bring the arms of the first frame closest to those of each frame.

    Args:
        arms: vectors from the centre to nodes in the first frame [node, dim] in m.
        change: change of the arms since the first frame [frame, node, dim] in m.
        tolerance: tolerance of positions [m]. Nodes that lie in a row, to 100 times this tolerance, do not turn about the row.
    """
    now = arms + change
    if arms.shape[1] == 2:
        angle = np.arctan2((arms[:, 0] * now[..., 1] - arms[:, 1] * now[..., 0]).sum(axis=1), (arms * now).sum(axis=(1, 2)))
        return np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=1).reshape(-1, 2, 2)
    if np.linalg.svd(arms, compute_uv=False)[1:2].max(initial=0.0) <= 100 * tolerance:
        return _transported(now[:, np.linalg.norm(arms, axis=1).argmax()])
    return _closest(np.einsum("nd,fne->fde", arms, now))


def _closest(covariance: np.ndarray) -> np.ndarray:
    """Return the rotations R [..., dim, dim] that maximise tr(R C) for covariances C = Σ a bᵀ of arms a before and b after."""
    u, _, vt = np.linalg.svd(covariance)
    u[..., -1] *= np.linalg.det(u @ vt)[..., None]  # makes it a rotation, not a reflection
    return np.asarray(np.swapaxes(u @ vt, -1, -2))


def _transported(direction: np.ndarray) -> np.ndarray:
    """Return rotations [frame, 3, 3] since the first frame. Each step is the smallest rotation that turns a direction [frame, 3] to the next."""
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    turn = [np.eye(3)]
    for before, after in itertools.pairwise(unit):
        x, y, z = np.cross(before, after)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        turn.append((np.eye(3) + cross + cross @ cross / max(1 + before @ after, 1e-12)) @ turn[-1])
    return np.stack(turn)


def _surroundings(paths: _Paths, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest others among ``nodes`` [node, neighbour], the vectors to them [node, neighbour, dim] in m, and a mask of those that are connected."""
    points, box = paths.first[nodes], None
    if paths.periodicity:
        points, box = paths.periodicity.from_corner(points), paths.periodicity.period
    count = min(2 ** points.shape[1], len(nodes) - 1)
    found = cKDTree(points, boxsize=box).query(points, k=1 + count)[1].reshape(len(nodes), 1 + count)
    near = nodes[found[:, 1:]]
    arms = paths.periodicity.shortest(paths.first[near] - paths.first[nodes][:, None])
    length = np.linalg.norm(arms, axis=-1)
    hangs = length > 0
    for moved in paths.moved:
        now = np.linalg.norm(arms + moved[near] - moved[nodes][:, None], axis=-1)
        hangs &= np.abs(now - length) <= STRETCH * length
    return near, arms, hangs


def _local_rotations(paths: _Paths, nodes: np.ndarray) -> Iterator[np.ndarray]:
    """Yield, for every frame, the rotations [node, dim, dim] of the nodes around each of ``nodes``."""
    near, arms, hangs = _surroundings(paths, nodes)
    arms, dim = np.where(hangs[..., None], arms, 0.0), arms.shape[2]
    extent = np.linalg.svd(np.einsum("nkd,nke->nde", arms, arms), compute_uv=False)
    unknown = extent[:, dim - 2] <= 1e-6 * extent[:, 0] if dim == 3 else extent[:, 0] == 0  # neighbours in a row in 3D, or none
    for moved in paths.moved:
        turn = _closest(np.einsum("nkd,nke->nde", arms, arms + moved[near] - moved[nodes][:, None]))
        yield np.where(unknown[:, None, None], np.eye(dim), turn)
