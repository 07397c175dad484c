"""Conversion of shapes to the plain values that are stored, and checks of these values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from gpe_pl.geometry.periodicity import Periodicity
from gpe_pl.geometry.repeated_shapes import Repeated
from gpe_pl.geometry.shapes import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, Wall
from gpe_pl.schema import LARGEST

SHAPES: dict[str, type] = {cls.kind: cls for cls in (Wall, Sphere, Bowl, Box, Polygon, DistanceGrid, Repeated)}
"""Classes of shapes that can be stored, by their ``kind``."""


def shape_to_dict(shape: Shape) -> dict[str, Any]:
    """Convert a shape to plain values, from which ``shape_from_dict`` rebuilds it."""
    if isinstance(shape, Repeated):
        return {"kind": shape.kind, "shape": shape_to_dict(shape.shape), **asdict(shape.periodicity)}
    return {"kind": shape.kind, **asdict(shape)}  # type: ignore[call-overload]


def shape_from_dict(values: dict[str, Any]) -> Shape:
    """Rebuild a shape from plain values.

    Raises:
        ValueError: the kind or a key is unknown (the message names it), or the shape refuses a value.
    """
    values = dict(values)
    kind = values.pop("kind", None)
    if kind not in SHAPES:
        raise ValueError(f"unknown shape kind {kind!r}; known: {', '.join(SHAPES)}")

    def tuples(value: Any) -> Any:
        return tuple(tuples(v) for v in value) if isinstance(value, (list, tuple)) else value

    try:
        if kind == Repeated.kind:
            inner = values.pop("shape", None)
            if not isinstance(inner, dict) or inner.get("kind") in (Repeated.kind, Wall.kind):
                raise ValueError("shape 'repeated': its 'shape' must be an obstacle")
            return Repeated(shape_from_dict(inner), Periodicity(**{key: tuples(value) for key, value in values.items()}))
        return SHAPES[kind](**{key: tuples(value) for key, value in values.items()})
    except TypeError as error:
        raise ValueError(f"shape {kind!r}: {error}") from None


def shapes_fault(shapes: Sequence[Shape], space: Periodicity) -> str | None:
    """Describe the first shape that breaks a rule; None if all are valid. Every reader of files calls it, because a file can contain anything.

    The rules: numbers are finite, vectors have one component per axis of ``space``, friction is at least 0, restitution lies between 0 and 1, radii are
    positive, boxes and walls have positive widths, normals of walls are unit vectors along one axis, and repeated shapes have the periodicity ``space``. Shapes
    of other classes are not checked.
    """
    for k, shape in enumerate(shapes):
        if isinstance(shape, Repeated) and shape.periodicity != space:
            return f"shape {k} repeats along {shape.periodicity}, the domain along {space}"
        if wrong := shape_fault(shape, len(space.bounds)):
            return f"shape {k} ({shape.shape.kind if isinstance(shape, Repeated) else shape.kind}): {wrong}"
    return None


_SCALARS = {"friction", "restitution", "radius", "offset", "spacing"}


def shape_fault(shape: Shape, dim: int) -> str | None:
    """Describe the first rule of ``shapes_fault`` that a shape in ``dim`` dimensions breaks; None if it breaks none, or is of another class."""
    if isinstance(shape, Repeated):
        return shape_fault(shape.shape, dim)
    if type(shape) not in SHAPES.values():
        return None
    values: dict[str, np.ndarray] = {}
    for key in (f.name for f in fields(shape) if f.name != "encoded"):  # type: ignore[arg-type]
        try:
            values[key] = np.asarray(getattr(shape, key))
        except ValueError:  # lists of different lengths
            return f"{key} must be numbers"
        if values[key].dtype.kind not in "fiu":
            return f"{key} must be numbers"
        if not (np.abs(values[key]) <= LARGEST).all():
            return f"not finite: {key}"
        size = () if key in _SCALARS else (dim,)
        if values[key].shape[key == "vertices" :] != size:
            return f"{key} must have {dim} components" if size else f"{key} must be one number"
    if values["friction"] < 0:
        return f"friction is {shape.friction:g}, must be at least 0"
    if not 0 <= values["restitution"] <= 1:
        return f"restitution is {shape.restitution:g}, must lie between 0 and 1"
    if "radius" in values and values["radius"] <= 0:
        return f"radius is {values['radius']:g} m, must be positive"
    if "low" in values and (values["low"] >= values["high"]).any():
        return "low must be below high along every axis"
    if "normal" in values and np.sort(np.abs(values["normal"])).tolist() != [0.0] * (dim - 1) + [1.0]:
        return "normal must be a unit vector along one axis"
    return None


def moved(shape: Shape, by: np.ndarray) -> Shape:
    """Return the shape displaced by ``by`` [dim] in m."""
    if isinstance(shape, Repeated):
        bounds = tuple((low + x, high + x) for (low, high), x in zip(shape.periodicity.bounds, by.tolist(), strict=True))
        return Repeated(moved(shape.shape, by), replace(shape.periodicity, bounds=bounds))
    values = shape_to_dict(shape)
    values |= {name: (values[name] + by).tolist() for name in ("center", "low", "high", "vertices", "origin") if name in values}
    if isinstance(shape, Wall):
        values["offset"] += float(np.dot(shape.normal, by))
    return shape_from_dict(values)
