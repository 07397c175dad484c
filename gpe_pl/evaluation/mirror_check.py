"""Checks whether a model treats a scene and its mirror image alike, by a rollout of both. The scene needs no symmetry."""

from __future__ import annotations

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.predictions import start_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics.mirror import equivariance_error
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.loop import rollouts
from gpe_pl.rollout.mirrored import Mirrored
from gpe_pl.trajectory.reflection import level_axes
from gpe_pl.trajectory.trajectory import Trajectory


class MirrorError(GpeError, ValueError):
    """Raised for a scene whose mirror images all fall another way, because gravity acts along every axis."""


def mirror_equivariance_error(simulator: LearnedSimulator, trajectory: Trajectory, start_frame: int | None = None) -> float:
    """Return ‖x − y‖ / ‖x − x(0)‖, with x the rollout of a scene and y that of its mirror image, mirrored back.

    The mirror is the plane in the middle of the domain, normal to the first level axis (``trajectory.reflection.level_axes``). For a model that treats left and
    right alike, the error is due to rounding, which grows where the motion is chaotic. Compare it with the error of the rollout against the ground truth
    (``displacement_error``).

    Args:
        simulator: trained simulator.
        trajectory: the scene, from which the model starts.
        start_frame: frame at which the rollouts start; None takes the first with enough history.

    Raises:
        MirrorError: gravity acts along every axis, or there is none and all walls face one way along every axis.
        FrameError: there are too few frames before ``start_frame``.
        SceneError: the scene does not fit the simulator.
    """
    metadata, history = trajectory.metadata, simulator.builder.config.history
    level = level_axes(metadata.gravity, trajectory.boundary.normal)
    if not level:
        raise MirrorError(
            f"gravity {metadata.gravity} m/s² or walls act one way along every axis, so no mirror image of the scene moves the same way"
        )
    first = history if start_frame is None else start_frame
    start = start_of(simulator, first, trajectory, trajectory.frames(first))
    mirrored = Mirrored(simulator, level[0], sum(metadata.bounds[level[0]]) / 2)
    one, other = (rollouts(Contained(inner, metadata.frame_dt), [start])[0] for inner in (simulator, mirrored))
    return equivariance_error(one, other)
