"""Captions of pictures: names of trajectories, their materials and parameter values."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpe_pl.schema import BOUNDARY, MATERIALS, MaterialParameter, node_code, parameters_by_name
from gpe_pl.trajectory.trajectory import Trajectory

UNITS = {"1": "", "deg": "°", "m^2/s": " m²/s"}
PREFIXES = (("G", 1e9), ("M", 1e6), ("k", 1e3))
"""Prefixes of pascals and their factors."""


SHOWN_OUTSIDE = 0.5
"""Distance outside the domain up to which pictures show a node [rest spacings]."""


def heading(trajectory: Trajectory) -> str:
    """Return the words ``prediction`` or ``ground truth`` for a trajectory."""
    return "prediction" if trajectory.is_prediction else "ground truth"


def with_heading(first: Trajectory, others: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Return all trajectories by name. The first one is called ``ground truth`` or ``prediction``, see ``heading``.

    Raises:
        ValueError: another trajectory has the name of the first, frames of another length, or another time in its first frame.
    """
    name = heading(first)
    if name in others:
        raise ValueError(f"{name!r} is the name of the first trajectory; give the other trajectory another name")
    for label, other in others.items():
        if not math.isclose(other.metadata.frame_dt, first.metadata.frame_dt, rel_tol=1e-6):
            raise ValueError(
                f"{label!r} has frames of {other.metadata.frame_dt:g} s and the {name} of {first.metadata.frame_dt:g} s; take every so many frames of one "
                "(Trajectory.every)"
            )
        if abs(other.start_time - first.start_time) > 0.5 * first.metadata.frame_dt:
            raise ValueError(
                f"{label!r} begins at {other.start_time:g} s and the {name} at {first.start_time:g} s; cut one of them (Trajectory.frames)"
            )
    return {name: first, **others}


def pictured(first: Trajectory, others: Mapping[str, Trajectory]) -> dict[str, Trajectory]:
    """Return ``with_heading`` with moving boundary nodes as nodes, and NaN as the position of nodes that are not in an open scene."""
    named = with_heading(first, others)
    return {name: t.with_nodes_of(first).with_moving_boundary().with_absent_hidden() for name, t in named.items()}


def as_written(text: str) -> str:
    """Return a text that Matplotlib shows as it is: not as mathematics between dollar signs, and in legends also if it begins with an underscore."""
    escaped = text.replace("$", r"\$")
    return f"\u200b{escaped}" if escaped.startswith("_") else escaped  # a space without width


def hidden_nodes(trajectory: Trajectory, frame: int) -> list[str]:
    """Return how many nodes a picture of a frame does not show: ``20 of 48 nodes are outside``, ``3 of 48 nodes are missing``; empty if it shows all.

    A node is outside if it is farther outside the domain than ``SHOWN_OUTSIDE``, and missing if its position is not finite. Moving walls do not count, nor do
    nodes that are not in an open scene in this frame.
    """
    metadata = trajectory.metadata
    counted = trajectory.node_type != node_code(BOUNDARY)
    if trajectory.alive is not None:
        counted &= trajectory.alive[frame]
    pos = metadata.periodicity.wrapped(trajectory.pos[frame, counted].astype(np.float64))
    low, high = np.asarray(metadata.bounds, float).T
    missing = ~np.isfinite(pos).all(axis=1)
    margin = SHOWN_OUTSIDE * metadata.spacing
    outside = ((pos < low - margin) | (pos > high + margin)).any(axis=1) & ~missing
    return [f"{mask.sum()} of {len(pos)} nodes are {what}" for mask, what in ((outside, "outside"), (missing, "missing")) if mask.any()]


def time_decimals(frame_dt: float) -> int:
    """Return the number of decimals that times of frames need: those of the time between frames [s], of which up to three significant digits count."""
    digits, exponent = f"{frame_dt:.2e}".split("e")
    return max(0, len(digits.rstrip("0").partition(".")[2]) - int(exponent))


def frame_time(frame: int, trajectory: Trajectory) -> str:
    """Return the time of a frame since the start of the scene, with as many decimals as the time between frames: ``0.096 s``."""
    frame_dt = trajectory.metadata.frame_dt
    return f"{trajectory.start_time + frame * frame_dt:.{time_decimals(frame_dt)}f} s"


def parameter_name(parameter: MaterialParameter) -> str:
    """Return the name of a material parameter in words."""
    return parameter.name.replace("_", " ").replace("youngs", "Young’s").replace("poisson", "Poisson’s")


def parameter_value(parameter: MaterialParameter, low: float, high: float | None = None) -> str:
    """Return the value of a material parameter, or its range, with the unit: ``27.5°``, ``0.6 … 1 MPa``."""
    high, unit = low if high is None else high, parameter.unit
    prefix, scale = next(((p, s) for p, s in PREFIXES if unit == "Pa" and high >= s), ("", 1.0))
    numbers = [f"{value / scale:.4g}" for value in (low, high)]
    return " … ".join(dict.fromkeys(numbers)) + (f" {prefix}Pa" if unit == "Pa" else UNITS[unit])


def materials_of(trajectory: Trajectory) -> list[str]:
    """Return the materials that occur."""
    return [material for material in trajectory.metadata.materials if (trajectory.node_type == node_code(material)).any()]


def describe(trajectory: Trajectory) -> str:
    """Return the materials that occur with their parameter values: ``sand, friction angle 27.5°``."""
    parts = []
    for material in materials_of(trajectory):
        metadata, of_material = trajectory.metadata, trajectory.node_type == node_code(material)
        part = material
        for parameter, column in zip(metadata.parameters_of(material), metadata.columns_of(material), strict=True):
            values = trajectory.material_params[of_material, column].astype(np.float64)
            known = values[np.isfinite(values)]
            part += f", {parameter_name(parameter)} {parameter_value(parameter, known.min(), known.max())}" if len(known) else ""
        parts.append(part)
    return "; ".join(parts)


def in_common(trajectories: Sequence[Trajectory]) -> str:
    """Return ``describe`` if it is the same for all trajectories, else the materials that occur."""
    texts = list(dict.fromkeys(describe(trajectory) for trajectory in trajectories))
    return texts[0] if len(texts) == 1 else ", ".join(dict.fromkeys(m for t in trajectories for m in materials_of(t)))


def row_label(values: Mapping[str, Any]) -> str:
    """Return parameter values by material as the label of a row; values without a name are those of the first parameters."""
    lines = []
    for material, value in values.items():
        named = parameters_by_name(material, value)
        own = [(p, named[p.name]) for p in MATERIALS[material] if p.name in named]
        if len(values) > 1:
            lines.append(f"{material} {', '.join(parameter_value(p, number) for p, number in own)}")
        else:
            lines += [f"{parameter_name(p)}\n{parameter_value(p, number)}" for p, number in own]
    return "\n".join(lines)
