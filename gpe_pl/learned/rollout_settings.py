"""Settings of rollouts that can be changed after training."""

from __future__ import annotations

from typing import TypedDict

from gpe_pl.rollout.skips import Skips


class RolloutSettings(TypedDict, total=False):
    """Attributes of a ``LearnedSimulator`` that ``LearnedSimulator.configured`` changes; None keeps one."""

    skips: Skips | None
    clamps_parameters: bool | None
    static_friction: float | None
    mirror_average: bool | None
