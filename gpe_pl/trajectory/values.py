"""Checks the values of stored arrays by the rules that ``schema.FIELDS`` declares.

The store checks arrays that it reads, importers check their input, and rollouts check their initial state. The validator lists all faults.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gpe_pl.schema import CELL_KINDS, FIELDS, LARGEST, MOTION, MaterialParameter, stored_parameters
from gpe_pl.trajectory.cells import kinds_of

UNIT_TOLERANCE = 1e-4
"""Maximum difference of a unit vector's length from 1."""
PADDED = ", but for the last one, which a cell with fewer corners than others repeats at the end"
SMALLEST = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True)
class Fault:
    """A stored array that breaks its rule.

    Attributes:
        field: name of the array in ``schema.FIELDS``.
        place: index of the first wrong element, by axis.
        message: the place, the number of further wrong elements, and what is wrong.
    """

    field: str
    place: tuple[tuple[str, int], ...]
    message: str

    def __str__(self) -> str:
        return f"field {self.field!r}: {self.message}"

    def index(self, axis: str) -> int:
        """Return the index along an axis; -1 if the field has no such axis."""
        return dict(self.place).get(axis, -1)


def size_conflicts(arrays: Mapping[str, np.ndarray], dim: int, num_params: int) -> list[str]:
    """Return a sentence for each contradiction of a field's shape with the schema, the numbers of dimensions and parameters, or an earlier field."""
    sizes = {"dim": dim, "param": num_params}
    conflicts = []
    for key, array in arrays.items():
        if array.ndim != len(FIELDS[key].dims):
            conflicts.append(f"field {key!r} has shape {list(array.shape)}, expected [{', '.join(FIELDS[key].dims)}]")
            continue
        for axis, size in zip(FIELDS[key].dims, array.shape, strict=True):
            if axis == MOTION:
                first = len(arrays.get("boundary_pos", array))
                if size != first or size not in (1, sizes.get("frame", size)):
                    conflicts.append(
                        f"field {key!r} has size {size} along {axis!r}, expected 1 or, for all three fields of a motion, the number of frames"
                    )
                continue
            if sizes.setdefault(axis, size) != size:
                conflicts.append(f"field {key!r} has size {size} along {axis!r}, expected {sizes[axis]}")
    return conflicts


def faults(
    arrays: Mapping[str, np.ndarray], names: Sequence[str], materials: Sequence[str], param_names: Sequence[str], first_frame: int = 0
) -> Iterator[Fault]:
    """Yield a fault for each array that breaks the rule of its field; for ``material_params``, one for each column that does. Fields without frames come first.

    Args:
        arrays: arrays by their names in ``schema.FIELDS``, without conflicts of size (``size_conflicts``).
        names: node types by the codes of ``node_type``.
        materials, param_names: as in the metadata of the data set.
        first_frame: number of the first frame of ``arrays``, for messages.
    """
    scene = _Scene(arrays, [name if name in materials else "" for name in names], param_names, materials)
    for key in sorted((key for key in FIELDS if key in arrays), key=lambda key: FIELDS[key].dims[0] == "frame"):
        for found in _RULES[FIELDS[key].values](scene, arrays[key]):
            where, more = _place(key, found.bad, first_frame), int(found.bad.sum()) - 1
            text = ", ".join(f"{axis} {k}" for axis, k in where) + (f" and {more} more" if more else "")
            first = tuple(np.argwhere(found.bad)[0].tolist())
            yield Fault(key, where, f"{found.column}{text}: {found.wrong(first)}")


@dataclass(frozen=True)
class _Scene:
    """Data that rules need besides the array that they check. A name is empty if its node type is not one of the materials."""

    arrays: Mapping[str, np.ndarray]
    names: Sequence[str]
    param_names: Sequence[str]
    materials: Sequence[str]

    def is_type(self, *wanted: str) -> np.ndarray:
        """Return a mask [node] of the nodes of the wanted types."""
        codes = self.arrays["node_type"]
        return np.isin(codes, [k for k, name in enumerate(self.names) if name in wanted])


@dataclass(frozen=True)
class _Found:
    """Wrong elements of an array.

    Attributes:
        bad: mask of the wrong elements; at least one is true.
        wrong: returns what is wrong with the element at an index.
        column: beginning of the message.
    """

    bad: np.ndarray
    wrong: Callable[[tuple[int, ...]], str]
    column: str = ""


_Rule = Callable[[_Scene, np.ndarray], Iterator[_Found]]


def _place(key: str, bad: np.ndarray, first_frame: int) -> tuple[tuple[str, int], ...]:
    """Return the index of the first wrong element, by axis; without the frame if the boundary does not move."""
    place = []
    for axis, k, size in zip(FIELDS[key].dims, np.argwhere(bad)[0].tolist(), bad.shape, strict=False):
        if axis == "frame" or (axis == MOTION and size > 1):
            place.append(("frame", k + first_frame))
        elif axis != MOTION:
            place.append((axis, k))
    return tuple(place)


def _finite(_: _Scene, array: np.ndarray) -> Iterator[_Found]:
    flat = array.reshape(-1)
    if float(np.vdot(flat, flat)) < LARGEST**2:  # one fast pass: no square is larger than the sum
        return
    bad = ~(np.abs(array) <= LARGEST)
    if bad.any():
        yield _Found(bad, lambda k: f"is {array[k]:.6g}, too large" if np.isfinite(array[k]) else "not finite")


def _within(low: float, high: float, wrong: str) -> _Rule:
    """Return the rule that numbers lie between ``low`` and ``high``."""

    def rule(_: _Scene, array: np.ndarray) -> Iterator[_Found]:
        if array.size and not (array.min() >= low and array.max() <= high):  # also catches NaN
            yield _Found(~((array >= low) & (array <= high)), lambda k: f"{wrong}, is {array[k]:.6g}")

    return rule


def _unit_vectors(scene: _Scene, array: np.ndarray) -> Iterator[_Found]:
    yield from (unsound := list(_finite(scene, array)))
    if unsound or not array.size:
        return
    square = np.square(array) @ np.ones(array.shape[-1], array.dtype)
    if square.min() < (1 - UNIT_TOLERANCE) ** 2 or square.max() > (1 + UNIT_TOLERANCE) ** 2:
        length = np.sqrt(square)
        yield _Found(np.abs(length - 1) >= UNIT_TOLERANCE, lambda k: f"length {length[k]:.6g}, must be 1")


def _node_types(scene: _Scene, array: np.ndarray) -> Iterator[_Found]:
    bad = ~scene.is_type(*scene.materials)
    if bad.any():
        yield _Found(bad, lambda _: f"the code stands for none of the data set's materials ({', '.join(scene.materials)})")


def _parameters(scene: _Scene, array: np.ndarray) -> Iterator[_Found]:
    """Check ``MaterialParameter.rule`` at nodes whose material has the parameter. Other nodes may have any value."""
    for material in scene.materials:
        for spec in stored_parameters(material, scene.param_names):
            values = array[:, scene.param_names.index(spec.name)]
            bad = scene.is_type(material) & ~spec.accepts(values)
            if bad.any():
                yield _Found(bad, partial(_wrong_parameter, material, spec, values), f"{spec.name}: ")


def _wrong_parameter(material: str, spec: MaterialParameter, values: np.ndarray, place: tuple[int, ...]) -> str:
    if np.isnan(values[place]):
        return "NaN, but the material has this parameter"
    return f"is {spec.quantity(values[place])} of {material}, must be {spec.rule}"


def _cells(scene: _Scene, array: np.ndarray) -> Iterator[_Found]:
    count, dims = len(scene.arrays["node_type"]), scene.arrays.get("cell_dim", np.array([]))
    if array.size and not (array.min() >= 0 and array.max() < count):
        yield _Found((array < 0) | (array >= count), lambda _: f"no such node, there are {count}")
        return
    bad = kinds_of(array, int(dims[0]) if len(dims) else None, scene.arrays["pos"].shape[2]) < 0
    if bad.any():
        yield _Found(
            bad, lambda place: f"has the nodes {array[place[0]].tolist()}, and is none of {', '.join(CELL_KINDS)}; corners differ{PADDED}"
        )


def _dimension_of_cells(scene: _Scene, array: np.ndarray) -> Iterator[_Found]:
    dim = scene.arrays["pos"].shape[2]
    bad = (array < 1) | (array > dim)
    if bad.any():
        yield _Found(bad, lambda place: f"is {array[place]}, must be {'1, 2 or 3' if dim == 3 else '1 or 2'} in {dim}D")


def _bodies(_: _Scene, array: np.ndarray) -> Iterator[_Found]:
    if array.size and array.min() < -1:
        yield _Found(array < -1, lambda k: f"is {array[k]}, must be -1 or the number of a body")


def _one_stretch(_: _Scene, array: np.ndarray) -> Iterator[_Found]:
    if array.size and array.max() > 1:
        yield _Found(array > 1, lambda k: f"is {array[k]}, must be 0 or 1")
    elif not array.all():
        enters = np.diff(array.astype(np.int8), axis=0, prepend=0) == 1
        again = enters & (np.cumsum(enters, axis=0) > 1)
        if again.any():
            yield _Found(again, lambda _: "enters the scene again; a node that comes back needs a new number")


_RULES: dict[str, _Rule] = {
    "finite": _finite,
    "positive": _within(SMALLEST, LARGEST, "must be positive and finite"),
    "at least 0": _within(0.0, LARGEST, "negative or not finite"),
    "0 to 1": _within(0.0, 1.0, "must lie between 0 and 1"),
    "unit vectors": _unit_vectors,
    "node types": _node_types,
    "parameters": _parameters,
    "nodes of cells": _cells,
    "numbers of bodies": _bodies,
    "one stretch": _one_stretch,
    "dimension of cells": _dimension_of_cells,
}
