"""Settings of rollouts that can be changed after training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypedDict

from gpe_pl.learned.least_distance import checked
from gpe_pl.rollout.skips import Skips


class RolloutSettings(TypedDict, total=False):
    """Attributes of a ``LearnedSimulator`` that ``LearnedSimulator.configured`` changes; None keeps one."""

    skips: Skips | None
    clamps_parameters: bool | None
    static_friction: float | None
    mirror_average: bool | None
    least_distance: float | None


def to_store(static_friction: float, mirror_average: bool, least_distance: float) -> dict[str, Any]:
    """Return the settings that ``stored`` reads, of a simulator at the spacing of its reference."""
    return {"static_friction": static_friction, "mirror_average": mirror_average, "least_distance": least_distance}


def stored(values: Mapping[str, Any]) -> RolloutSettings:
    """Return the settings in the description of a simulator. Older descriptions lack some, which are then off.

    Raises:
        ValueError: a value is impossible.
    """
    if type(average := values.get("mirror_average", False)) is not bool:
        raise ValueError(f"mirror_average={average!r}: must be true or false")
    return {
        "static_friction": values.get("static_friction", 0.0),
        "mirror_average": average,
        "least_distance": checked(values.get("least_distance", 0.0)),
    }
