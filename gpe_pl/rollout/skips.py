"""Levels of skipping: computations that a rollout can leave out. Each level is a switch, so that rollouts with and without it can be compared.

Exact levels are on by default and change a rollout by rounding at most. Approximate levels (``learned.approximate``) are off by default. Evaluation reports the
error that they cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field


@dataclass(frozen=True)
class Skips:
    """Levels of skipping in a learned rollout.

    Attributes:
        absent_types: exact. Skip the code of node types and relations that the scene does not have.
        static_boundary: exact. Build the search tree of the boundary once, not in every step.
        isolated_nodes: exact. Leave nodes without an edge out of message passing.
        edges_at_once: exact. Number of edges for which features and messages are computed at a time. This limits the memory; None takes all edges at once.
        sorted_from: exact. Graphs with at least this number of nodes are sorted so that neighbours are near each other in memory. None never sorts.
        stress: exact for the motion. Leave out the prediction of the stress.
        sleep_after: approximate. Number of frames at rest after which an island sleeps: it stands still until something moves near it. None switches this off.
            A body that is thrown upward is slow at the top of its flight; choose more frames than it is slow.
        rest_step_spacings: a node is at rest only if it moves less than this distance in a frame [rest spacings]. Where the ground truth is at rest, learned
            models move nodes by 0.01 to 0.03 spacings.
        rest_step_change_spacings: a node is at rest only if its displacement in a frame differs from that in the frame before by less than this distance [rest
            spacings].
        repeat_frames: approximate. Number of frames for which one prediction is repeated. An impact is repeated, too, so the energy can grow.
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
    repeat_frames: Annotated[int, Field(ge=1)] = 1

    @property
    def is_exact(self) -> bool:
        """Whether a rollout with these levels equals a rollout without them, up to rounding."""
        return not self.approximations

    @property
    def approximations(self) -> dict[str, int | float]:
        """Settings of the approximate levels that are on, by name."""
        names = ["sleep_after", "rest_step_spacings", "rest_step_change_spacings"] if self.sleep_after is not None else []
        names += ["repeat_frames"] if self.repeat_frames > 1 else []
        return {name: getattr(self, name) for name in names}
