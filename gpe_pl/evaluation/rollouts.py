"""Evaluation: rolls a learned simulator and the trivial baselines out over whole splits. Writes a table of metrics, figures and animations."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from itertools import takewhile
from pathlib import Path

import numpy as np
import torch

from gpe_pl.data.dataset import WindowDataset, every, long_enough, open_split, usable
from gpe_pl.evaluation.horizons import labels
from gpe_pl.evaluation.material_controls import MaterialControls
from gpe_pl.evaluation.metric_rows import LEARNED, About, Row, write_rows
from gpe_pl.evaluation.predictions import SCENES_AT_ONCE, PredictedScene, Predictor
from gpe_pl.evaluation.rollout_cost import write_cost
from gpe_pl.evaluation.scene_files import MODELS, check_formats, check_scene, write_models
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.evaluation.split_files import SplitFiles
from gpe_pl.export.play_page import SolverFilm
from gpe_pl.graphs.batching import batched
from gpe_pl.learned.ensemble import LearnedEnsemble, configured, members_of
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import OneStepNMSE, rollout_metrics
from gpe_pl.nn.stores import predicted_rows
from gpe_pl.schema import param_names
from gpe_pl.system.progress import Bars, no_bar
from gpe_pl.trajectory.trajectory import Metadata, Trajectory

log = logging.getLogger(__name__)

ONE_STEP_WINDOWS = 256
See = Callable[[PredictedScene, About], Iterable[Row]]


def evaluate(
    simulator: LearnedSimulator | LearnedEnsemble,
    root: Path,
    settings: EvaluationSettings,
    run_dir: Path,
    label: str = LEARNED,
    controls: MaterialControls | None = None,
    stride: int = 1,
    see: See | None = None,
    bars: Bars = no_bar,
) -> list[Row]:
    """Roll out every trajectory of the splits, and write metrics and pictures to ``run_dir``.

    All rollouts start at ``settings.first_frame`` and run to the end of the ground truth. The files are ``metrics.csv`` with its digest, ``rollout_cost.json``
    (see ``rollout_cost``) and, unless ``settings.num_pictures`` is 0, ``error_curve_*.png``. The first ``settings.num_pictures`` trajectories of each split
    also get ``rollout_*.png``, ``rollout_*.gif``, ``rollout_*.html`` (a viewer), ``stress_*.png`` if the model decodes a stress, and the files of
    ``settings.export``. ``settings.quantities`` adds ``quantities_*.png``, ``quantities_*.csv`` and ``parity_*.png``. With ``controls``, those of
    ``test_unseen`` also get ``parameters_*.png``: the solver and the model at three values of the material parameters.

    These metrics are computed here, beside those of ``metrics.rollout_metrics``:

    - ``one_step_nmse``: one value for each split (see ``one_step_nmse``).
    - ``num_good_frames``: number of frames that the rollout reached.
    - ``edges_per_node``: edges within the radius, one per pair of nodes, per dynamic node, in the graph of the middle frame of the ground truth.
    - ``fraction_outside_at_end``: fraction of particles inside a wall or obstacle in the last frame.
    - ``fraction_corrected``: fraction of particle-steps that containment corrects.
    - ``fraction_outside_uncontained``: fraction of particle-frames inside a wall or obstacle with containment off, for the first ``settings.num_uncontained``
      rollouts of a split. This metric and the two before it are left out if the boundary consists of nodes only.
    - ``skipping_mse`` [m²]: position MSE between the rollouts with and without the approximate levels of ``simulator.skips``, over the frames of both.
    - ``fraction_asleep``: fraction of particle-steps that the approximate levels did not compute.
    - ``lost_impulse`` [kg m/s]: momentum that was lost when nodes fell asleep. This metric and the two before it are reported if approximate levels are on. The
      rollout without these levels is then evaluated, too.

    Args:
        simulator: trained simulator, or several as an ensemble.
        root: folder of the data set.
        settings: what to evaluate.
        run_dir: folder for the files.
        label: name of the model in the rows.
        controls: prepared controls of scenes with unseen parameters.
        stride: number of stored frames in a frame of the simulator.
        see: called for each scene after its rollouts, with its split, number, parameter group and parameter. The rows that it returns are added.
        bars: makes the progress bar of a split.

    Returns:
        The rows of ``metrics.csv``.

    Raises:
        StartError: ``settings.start_time`` leaves too little history, or is between frames.
        SceneError: the data do not fit the simulator.
        ExportError, OnnxError, PageError: a format in ``settings.export`` cannot be written. Nothing was rolled out before.
        RigidBodyError: a scene has rigid bodies, which a format in ``settings.export`` would ignore.
    """
    if members_of(simulator)[0].builder.config.scales != "one":
        simulator = simulator.on(_scene_in(root, settings.splits[0], stride))
    first = members_of(simulator)[0]
    frame_dt = first.builder.metadata.frame_dt
    start_frame = settings.first_frame(first.builder.config.history, frame_dt)
    simulator = as_evaluated(simulator, settings)
    check_formats(settings, simulator)
    run_dir.mkdir(parents=True, exist_ok=True)
    if MODELS & {*settings.export}:  # before the rollouts, which would be lost with a model that cannot be written
        write_models(run_dir, members_of(simulator)[0], label, [*_films(root, settings, first, start_frame, stride)], settings.export)
    predictor = Predictor(simulator, settings, label, controls, stride, start_frame, seconds=[], bars=bars)
    rows, files = list[Row](), {split: SplitFiles(run_dir, split, label, settings) for split in settings.splits}
    for split, of_split in files.items():
        rows.append(Row(label, split, -1, "", float("nan"), "one_step_nmse", "1", one_step_nmse(simulator, root, split, stride=stride)))
        for scene in predictor.scenes(root, split):
            about = (split, scene.number, scene.truth.metadata.parameter_group, _parameter(scene.trajectory))
            rows += _rows(scene, about, label, labels(settings.horizons, frame_dt))
            rows += see(scene, about) if see else []
            of_split.add(scene, about)
        of_split.write_quantities()
    write_cost(run_dir, predictor.seconds, frame_dt, first.acceleration_std.is_cuda)
    write_rows(run_dir / "metrics.csv", rows)  # after all other results, as a run with metrics is finished; figures that fail lose none
    for of_split in files.values():
        of_split.draw()
    return rows


def _films(root: Path, settings: EvaluationSettings, simulator: LearnedSimulator, start_frame: int, stride: int) -> Iterator[SolverFilm]:
    """Check all scenes that are evaluated, and yield those that get pictures."""
    wanted = math.inf if settings.num_trajectories is None else settings.num_trajectories
    for split in settings.splits:
        for number, trajectory in takewhile(lambda scene: scene[0] < wanted, long_enough(root, split, start_frame, stride)):
            check_scene(settings, trajectory, simulator.builder.metadata)
            if number < settings.num_pictures:
                yield SolverFilm(f"{split} {number}", trajectory)


def _scene_in(root: Path, split: str, stride: int) -> Metadata:
    """Return the metadata of a split at a stride."""
    return open_split(root, split, cache_bytes=0)[0].window(0, 1).metadata.every(stride)


def as_evaluated(simulator: LearnedSimulator | LearnedEnsemble, settings: EvaluationSettings) -> LearnedSimulator | LearnedEnsemble:
    """Return the simulator with the settings of an evaluation."""
    return configured(
        simulator,
        clamps_parameters=settings.clamp_parameters,
        static_friction=settings.static_friction,
        mirror_average=settings.mirror_average,
    )


def _rows(scene: PredictedScene, about: About, label: str, horizons: dict[int, str]) -> Iterator[Row]:
    """Yield the metrics of a scene, and warn if its rollout stopped. ``horizons`` has labels by the number of frames."""
    stop = scene.predictions[label].termination
    if stop is not None:
        log.warning("%s %d stopped: %s, %s", *about[:2], stop.reason, stop.message)
    compared = {model: (prediction, scene.truth) for model, prediction in scene.predictions.items()} | scene.solver_runs
    for model, (prediction, reference) in compared.items():
        for record in rollout_metrics(prediction, reference, [*horizons, "full"]):
            horizon = "full" if record.horizon == "full" else horizons[record.horizon]
            yield Row(model, *about, record.metric, horizon, record.value)
    for metric, value in scene.counts.items():
        yield Row(label, *about, metric, "full", value)


def _parameter(trajectory: Trajectory) -> float:
    """Return the first material parameter of a scene; NaN if its nodes have several values or none."""
    metadata = trajectory.metadata
    first = [metadata.param_names.index(name) for name in param_names(metadata.materials)]
    values = np.unique(np.asarray(trajectory.material_params, dtype=np.float64)[:, first])
    values = values[np.isfinite(values)]
    return float(values[0]) if len(values) == 1 else float("nan")


def one_step_nmse(
    simulator: LearnedSimulator | LearnedEnsemble, root: Path, split: str, num_windows: int = ONE_STEP_WINDOWS, stride: int = 1
) -> float:
    """Return the normalised one-step error without noise (``metrics.OneStepNMSE``), over windows spread evenly over a split. Predicting free fall gives 1.

    The prediction of an ensemble is the mean over its members.

    Raises:
        SceneError: every ``stride``-th frame of the data does not fit the simulator.
    """
    views = every(usable(open_split(root, split), stride), stride)
    members = members_of(simulator.on(views[0].window(0, 1).metadata))
    datasets = [WindowDataset(views, member.builder) for member in members]
    windows = np.unique(np.linspace(0, len(datasets[0]) - 1, min(len(datasets[0]), num_windows)).round().astype(int))
    metric = OneStepNMSE().to(members[0].acceleration_std.device)
    with torch.inference_mode():
        for chosen in np.array_split(windows, -(-len(windows) // SCENES_AT_ONCE)):
            batches = [batched([dataset[int(window)] for window in chosen]).to(members[0].acceleration_std.device) for dataset in datasets]
            predicted = [member(data).acceleration for member, data in zip(members, batches, strict=True)]
            unit = members[0].acceleration_std.float()
            for material in predicted[0]:
                values = [own[material] * (member.acceleration_std.float() / unit) for own, member in zip(predicted, members, strict=True)]
                store, mean = batches[0][material], torch.stack(values).mean(dim=0)
                metric.update(predicted_rows(store, mean), predicted_rows(store, store.target / unit))
    return float(metric.compute())
