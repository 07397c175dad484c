"""Reads and checks what the metadata of a trajectory say about finer labels (``DatasetSpec.fine``)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from gpe_pl.files.json_text import parsed
from gpe_pl.solvers.finer_solver import FACTORS
from gpe_pl.trajectory.trajectory import Metadata


def factor_of(metadata: Metadata) -> Any:
    """Return the factor by which the solver divided the spacing, as the metadata name it; 1 if they name none. The value is not checked."""
    return _settings(metadata).get("fine", 1)


def faults(metadata: Metadata) -> Iterator[str]:
    """Yield a message for each fault in what the metadata say about finer labels."""
    settings = _settings(metadata)
    if settings.keys().isdisjoint(("fine", "fine_solver")):
        return
    fine, solver = settings.get("fine"), settings.get("fine_solver")
    if fine not in FACTORS[1:]:
        yield f"fine is {fine!r}, must be one of {', '.join(map(str, FACTORS[1:]))}"
    elif not isinstance(solver, dict):
        yield f"fine is {fine}, but fine_solver, the settings of the finer solver, is missing"
    else:
        for key, wanted in (("spacing", metadata.spacing / fine), ("solver_dt", metadata.solver_dt)):
            value = solver.get(key)
            if not (isinstance(value, (int, float)) and math.isclose(value, wanted, rel_tol=1e-9)):
                yield f"fine_solver.{key} is {value!r}, but fine = {fine} and the metadata say {wanted:.6g}"


def _settings(metadata: Metadata) -> dict[str, Any]:
    try:
        settings = parsed(metadata.config)
    except ValueError:
        return {}
    return settings if isinstance(settings, dict) else {}
