"""Shapes as plain values, in which they are stored."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

from gpe_pl.geometry import Bowl, Box, DistanceGrid, Polygon, Shape, Sphere, Wall
from gpe_pl.periodicity import Periodicity
from gpe_pl.repeated_shapes import Repeated

SHAPES: dict[str, type] = {cls.kind: cls for cls in (Wall, Sphere, Bowl, Box, Polygon, DistanceGrid, Repeated)}


def shape_to_dict(shape: Shape) -> dict[str, Any]:
    """Plain values from which ``shape_from_dict`` rebuilds the shape."""
    if isinstance(shape, Repeated):
        return {"kind": shape.kind, "shape": shape_to_dict(shape.shape), **asdict(shape.periodicity)}
    return {"kind": shape.kind, **asdict(shape)}  # type: ignore[call-overload]


def shape_from_dict(values: dict[str, Any]) -> Shape:
    """Rebuild a shape; raises ``ValueError`` that names an unknown kind or key."""
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


def moved(shape: Shape, by: np.ndarray) -> Shape:
    """The shape displaced by ``by`` [dim] in m."""
    if isinstance(shape, Repeated):
        bounds = tuple((low + x, high + x) for (low, high), x in zip(shape.periodicity.bounds, by.tolist(), strict=True))
        return Repeated(moved(shape.shape, by), replace(shape.periodicity, bounds=bounds))
    values = shape_to_dict(shape)
    values |= {name: (values[name] + by).tolist() for name in ("center", "low", "high", "vertices", "origin") if name in values}
    if isinstance(shape, Wall):
        values["offset"] += float(np.dot(shape.normal, by))
    return shape_from_dict(values)
