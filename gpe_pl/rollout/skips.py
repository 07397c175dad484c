"""What a rollout leaves out because the scene does not need it. Each level is a switch, so that it can be compared with its absence.

Exact levels are on by default and change a rollout by rounding at most. Approximate levels (``learned.approximate``) are off by default; evaluation reports
what they cost in accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field


@dataclass(frozen=True)
class Skips:
    """Levels of a learned rollout.

    Attributes:
        absent_types: exact. Node types and relations that the scene has none of run no code.
        static_boundary: exact. The boundary is sorted into a search tree once, not in every step.
        isolated_nodes: exact. Nodes without an edge take no part in message passing.
        edges_at_once: exact. Edge features and messages are computed for so many edges at a time, which bounds the memory; None: all together.
        sorted_from: exact. Graphs of so many nodes and more are computed with neighbours near each other in memory; None: none.
        stress: leaves out the stress that a model decodes beside the motion; the motion stays as it is.
        sleep_after: approximate. Groups of connected nodes that have been at rest for so many frames stand still until something moves in their
            reach; None: never.
        rest_step_spacings, rest_step_change_spacings: a node is at rest when its step within a frame is shorter than the first, and differs from the step
            before by less than the second [rest spacings]. Learned models tremble: what lies still in the ground truth makes steps of 0.01 to 0.03
            spacings. What turns in flight is as slow for some frames, and ``sleep_after`` has to be longer.
        hold: approximate. Frames for which one prediction is held.
    """

    absent_types: bool = True
    static_boundary: bool = True
    isolated_nodes: bool = True
    edges_at_once: Annotated[int, Field(ge=1)] | None = 65536
    sorted_from: Annotated[int, Field(ge=1)] | None = 5000
    stress: bool = False
    sleep_after: Annotated[int, Field(ge=1)] | None = None
    rest_step_spacings: Annotated[float, Field(gt=0)] = 0.03
    rest_step_change_spacings: Annotated[float, Field(gt=0)] = 0.06
    hold: Annotated[int, Field(ge=1)] = 1

    @property
    def is_exact(self) -> bool:
        """Whether a rollout with these levels equals one without, up to rounding."""
        return self.sleep_after is None and self.hold == 1
