"""The origin to which an import moved positions, for files in the coordinates of the source."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np

from gpe_pl.trajectory.trajectory import Metadata

KEY = "origin"
"""Name of the origin in the settings of an import, which are ``Metadata.config``."""


def origin_of(metadata: Metadata) -> np.ndarray | None:
    """Return the origin of stored positions in the coordinates of their source [dim] in m; None if they are in these coordinates."""
    stated = _settings(metadata).get(KEY)
    if not isinstance(stated, list) or len(stated) != metadata.dim or not all(isinstance(x, int | float) for x in stated):
        return None
    origin = np.array(stated, np.float64)
    return origin if origin.any() and np.isfinite(origin).all() else None


def without_origin(metadata: Metadata) -> Metadata:
    """Return the metadata for a scene that has coordinates of its own, such as one that was drawn up for a model of imported data."""
    settings = _settings(metadata)
    if KEY not in settings:
        return metadata
    kept = {name: value for name, value in settings.items() if name != KEY}
    return replace(metadata, config=json.dumps(kept, sort_keys=True))


def _settings(metadata: Metadata) -> dict[str, Any]:
    """Return the settings with which data were made; none if the text is no JSON of settings."""
    try:
        settings = json.loads(metadata.config)
    except ValueError:
        return {}
    return settings if isinstance(settings, dict) else {}
