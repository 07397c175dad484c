"""Pictures, animations, viewers and exports of an evaluated scene."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gpe_pl.errors import GpeError
from gpe_pl.evaluation.material_controls import AtValue
from gpe_pl.evaluation.metric_rows import LEARNED
from gpe_pl.evaluation.settings import EvaluationSettings, Export
from gpe_pl.export.onnx_network import check_network, export_network
from gpe_pl.export.play_model import check
from gpe_pl.export.play_page import SolverFilm, check_film, write_page
from gpe_pl.export.program import check_exportable, export_model, refuse_rigid_bodies
from gpe_pl.learned.ensemble import LearnedEnsemble
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.trajectory.trajectory import Metadata, Trajectory
from gpe_pl.viz.saving import save_figure

log = logging.getLogger(__name__)

VIEWER_BYTES = 2**26
"""Maximum size of a viewer's arrays before compression [bytes]; the viewer of a longer rollout skips frames."""


VECTOR: tuple[Export, ...] = ("svg", "pdf")
"""Formats in which figures are written beside PNG."""
MODELS: set[Export] = {"model", "onnx", "page"}
"""Formats that hold a model."""


class ExportError(GpeError):
    """Raised when a requested export cannot be written; the message says what is missing."""


def check_formats(settings: EvaluationSettings, simulator: LearnedSimulator | LearnedEnsemble) -> None:
    """Check, before any rollout, that the formats of ``settings.export`` can be written.

    Raises:
        ExportError: a format needs a package that is not installed, needs scenes with pictures, or takes a single model and the simulator is an ensemble.
        PageError: a page cannot compute the simulator.
        OnnxError: the model is no GPE.
    """
    formats = settings.export
    single = [kind for kind in formats if kind in MODELS]
    if isinstance(simulator, LearnedEnsemble):
        if single:
            raise ExportError(f"evaluation.export: {single[0]} takes a single checkpoint; leave it out, or evaluate one checkpoint")
    else:
        if "page" in formats:
            check(simulator)
        if "model" in formats:
            try:
                check_exportable(simulator)
            except GpeError as error:
                raise ExportError(f"evaluation.export: {error}; or leave model out") from None
        if "onnx" in formats:
            check_network(simulator)
    if "onnx" in formats and not all(importlib.util.find_spec(name) for name in ("onnx", "onnxruntime", "onnxscript")):
        raise ExportError("evaluation.export: onnx needs onnx, onnxruntime and onnxscript: `pip install 'gpe_pl[onnx]'`, or leave it out")
    if "onnx" in formats and not settings.num_pictures:
        raise ExportError(
            "evaluation.export: onnx is compared with the model in the scenes with pictures; choose evaluation.num_pictures=1"
        )
    if "mp4" in formats and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ExportError(
            "evaluation.export: mp4 needs imageio-ffmpeg: `pip install imageio-ffmpeg`, or leave it out (a GIF is always written)"
        )


def check_scene(settings: EvaluationSettings, trajectory: Trajectory, own: Metadata) -> None:
    """Raise an error if ``settings.export`` has something that would compute this scene otherwise than a model with the metadata ``own``.

    Raises:
        RigidBodyError: a program would ignore the rigid bodies of the scene.
        PageError: a page would have another gravity, domain or boundary.
    """
    if {"model", "page"} & {*settings.export}:
        refuse_rigid_bodies(trajectory.rigid_body)
    if "page" in settings.export:
        check_film(own, trajectory)


def save(figure: Figure, path: Path, formats: Sequence[Export], **options: Any) -> None:
    """Write a figure as PNG, and beside it as SVG or PDF if the ``formats`` name these. Options are those of ``savefig``."""
    for suffix in (".png", *(f".{kind}" for kind in VECTOR if kind in formats)):
        save_figure(figure, path.with_suffix(suffix), **{"dpi": 150, **options})


def write_pictures(
    run_dir: Path, split: str, number: int, truth: Trajectory, predictions: dict[str, Trajectory], formats: Sequence[Export] = ()
) -> None:
    """Write a figure, an animation and a viewer of a scene to ``run_dir``, and a figure of the stress if all trajectories have one.

    ``split`` and ``number`` of the scene are part of the files' names. ``predictions`` are rollouts by model. ``formats`` may ask for figures as SVG or PDF.
    """
    from gpe_pl.viz.figures import rollout_figure
    from gpe_pl.viz.video import write_animation
    from gpe_pl.viz.viewer import write_viewer

    stem = run_dir / f"rollout_{split}_{number:02d}"
    save(rollout_figure(truth, predictions), stem.with_suffix(".png"), formats, bbox_inches="tight")
    if truth.stress is not None and all(p.stress is not None for p in predictions.values()):
        figure = rollout_figure(truth, predictions, color="von_mises")
        save(figure, run_dir / f"stress_{split}_{number:02d}.png", formats, bbox_inches="tight")
    stride = max(1, truth.num_frames // 60)
    write_animation(stem.with_suffix(".gif"), truth, predictions, fps=20, stride=stride)
    size = (1 + len(predictions)) * (truth.pos.nbytes + truth.vel.nbytes)
    write_viewer(stem.with_suffix(".html"), truth, predictions, stride=-(-size // VIEWER_BYTES))


def write_parameter_picture(path: Path, scenes: list[AtValue], formats: Sequence[Export] = ()) -> None:
    """Draw a scene at several values of its material parameters."""
    from gpe_pl.viz.figures import parameter_strip

    save(parameter_strip(scenes), path, formats, bbox_inches="tight")


def write_exports(run_dir: Path, split: str, number: int, truth: Trajectory, prediction: Trajectory, formats: list[Export]) -> None:
    """Write the ground truth and the rollout of a scene to ``run_dir``, in those of the ``formats`` that hold trajectories.

    ``split`` and ``number`` of the scene are part of the files' names.
    """
    from gpe_pl.export.trajectories import write_npz, write_vtk
    from gpe_pl.viz.video import write_animation

    for kind, trajectory in (("ground_truth", truth), ("rollout", prediction)):
        stem = run_dir / f"{kind}_{split}_{number:02d}"
        if "vtk" in formats:
            write_vtk(stem.with_suffix(".pvd"), trajectory, None if trajectory is truth else truth)
        if "npz" in formats:
            write_npz(stem.with_suffix(".npz"), trajectory)
    if "mp4" in formats:
        write_animation(stem.with_suffix(".mp4"), truth, {LEARNED: prediction}, fps=20, stride=max(1, truth.num_frames // 200))


def write_models(run_dir: Path, simulator: LearnedSimulator, label: str, films: list[SolverFilm], formats: list[Export]) -> None:
    """Write the simulator to ``run_dir`` in those of the ``formats`` that hold it. A page calls it ``label`` and shows the films."""
    if "model" in formats:
        export_model(simulator, run_dir / "model.pt2")
    if "onnx" in formats:
        first = simulator.builder.config.history
        frames = [(film.trajectory, frame) for film in films for frame in (first, (first + film.trajectory.num_frames - 1) // 2)]
        states = [simulator.initial_state(trajectory, frame) for trajectory, frame in frames]  # at the start bodies may touch nothing
        largest = export_network(simulator, run_dir / "network.onnx", states)
        log.info("one step of network.onnx differs from the model by at most %.2g m from %d states", largest, len(states))
    if "page" in formats:
        write_page(run_dir / "page", {label: simulator}, {label: films})


def write_error_curve(path: Path, curves: dict[str, list[np.ndarray]], frame_dt: float, formats: Sequence[Export] = ()) -> None:
    """Draw the error against time. ``curves`` has the position error of each frame [m²], for each model and scene."""
    from gpe_pl.viz.figures import error_curve_figure

    save(error_curve_figure(curves, frame_dt), path, formats)
