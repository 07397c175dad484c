"""Rollouts of a state by a model and by the solver that made its training data, with containment and a guard."""

from __future__ import annotations

import contextlib
import json
import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from gpe_pl.data.ground_truth import solver_settings
from gpe_pl.geometry.thin_parts import thickness
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.training_ranges import stored_ranges
from gpe_pl.learned.unlike import UnlikeScenes, Watch, trained_limits
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import rollout
from gpe_pl.system.caches import has_compiled
from gpe_pl.system.compiled import unfused
from gpe_pl.system.progress import progress_bar
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

log = logging.getLogger(__name__)

FEWEST_CELLS = 2
"""Thickness of an obstacle [grid cells] from which on the material point method feels both its faces."""

QUICK = 200_000
"""Node-frames up to which a rollout takes seconds without compiled passes. Compiling them takes longer, once for each version of the package."""

FEW = 2_000
"""Number of nodes up to which PyTorch runs on one thread. Threads that share such small operations mostly wait for each other."""


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run PyTorch's operations on one thread inside this block."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def middle_values(simulator: LearnedSimulator) -> dict[str, dict[str, float]]:
    """Return the middle of the trained range of each parameter, by material and name. For parameters that span decades this is the geometric mean."""
    own = simulator.builder.metadata
    return {
        material: {spec.name: math.sqrt(low * high) if spec.scale == "log" else (low + high) / 2 for spec, _, (low, high) in found}
        for material, trained in simulator.trained_ranges()
        for found in [[(spec, column, ends.tolist()) for spec, column, ends in stored_ranges(own, material, trained)]]
    }


def guard_of(metadata: Metadata) -> Guard:
    """Return the limits of a rollout: nodes may leave the domain by its size, as they do in a solver that has no walls."""
    return Guard(bounds=metadata.bounds, margin=metadata.longest_side, spacing=metadata.spacing)


def predicted(simulator: LearnedSimulator, state: State, metadata: Metadata, num_frames: int, label: str) -> Trajectory:
    """Roll a model out from a state without earlier frames; a progress bar shows rate and remaining time.

    A warning is logged for speeds and accelerations far beyond those of the training.

    Args:
        simulator: the model.
        state: state of the scene, as NumPy arrays.
        metadata: metadata of the scene.
        num_frames: number of frames after the start.
        label: text beside the bar.

    Raises:
        SceneError: the scene does not fit the model.
    """
    start = simulator.standing(state, metadata)
    watch = Watch(simulator, num_frames)
    watch.see(0, start)
    is_quick = num_frames * state.num_nodes <= QUICK and not has_compiled("nn/network_program_kernels.py")
    on_threads = one_thread() if state.num_nodes <= FEW else contextlib.nullcontext()
    with unfused() if is_quick else contextlib.nullcontext(), on_threads, progress_bar(label) as on_progress:

        def see(frame: int, now: State) -> None:
            watch.see(frame, now)
            on_progress(frame, num_frames)

        found = rollout(Contained(approximate(simulator), metadata.frame_dt), start, num_frames, metadata, guard_of(metadata), see)
    unlike = UnlikeScenes(trained_limits(simulator), "training", is_complete=False)
    unlike.add(watch.found)
    unlike.warn("this rollout")
    return found


def solved(solver: Any, state: State, metadata: Metadata, num_frames: int, label: str) -> Trajectory:
    """Roll a solver out from a state. Its frames may be shorter than those of ``metadata`` by a whole number; the result has those of ``metadata``.

    A warning is logged for obstacles that the material point method does not resolve.
    """
    _warn_of_thin_obstacles(solver, state)
    stride = max(1, round(metadata.frame_dt / solver.frame_dt))
    config = json.dumps({**json.loads(metadata.config), "solver": solver_settings(solver)}, sort_keys=True)
    about = {"solver": solver.name, "solver_version": solver.version, "solver_dt": solver.solver_dt, "config": config}
    stored = replace(metadata, frame_dt=solver.frame_dt, **about)
    steps = math.ceil(num_frames * stride)
    with progress_bar(label) as on_progress:
        found = rollout(solver, state, steps, stored, guard_of(metadata), lambda frame, _: on_progress(frame, steps))
    return found.every(stride) if stride > 1 else found


def _warn_of_thin_obstacles(solver: Any, state: State) -> None:
    spacing = getattr(solver, "grid_spacing", None) if solver.name == "mpm" else None
    if spacing is None:
        return
    for shape in state.boundary.shapes:
        if (cells := thickness(shape) / spacing) < FEWEST_CELLS * (1 - 1e-6):
            log.warning(
                "solver mpm: an obstacle (%s) is %.2g cells of the grid thick; with fewer than %d, what touches it depends on its place in the grid",
                shape.kind,
                cells,
                FEWEST_CELLS,
            )
