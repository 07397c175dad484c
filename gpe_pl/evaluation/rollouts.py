"""Evaluation: rolls a learned simulator and the trivial baselines out over whole splits. Writes a table of metrics, figures and animations."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import io
import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from pydantic import Field

from gpe_pl.data.dataset import WindowDataset, every, long_enough, open_split, usable
from gpe_pl.errors import GpeError
from gpe_pl.evaluation.horizons import labels, time_of
from gpe_pl.evaluation.material_controls import UNSEEN, AtValue, MaterialControls, label_of
from gpe_pl.evaluation.rollout_cost import Timed, write_cost
from gpe_pl.export.program import export_model
from gpe_pl.files import regular_files
from gpe_pl.files.atomic import replace_text, replacing
from gpe_pl.geometry.shapes import surface_tolerance
from gpe_pl.graphs.batching import batched
from gpe_pl.learned.approximate import approximate
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.metrics import OneStepNMSE, per_frame_mse, rollout_metrics
from gpe_pl.rollout.baselines import BASELINES
from gpe_pl.rollout.containment import Contained
from gpe_pl.rollout.guard import Guard
from gpe_pl.rollout.loop import Simulator, Start, fraction_outside, rollout, rollouts
from gpe_pl.schema import RADIUS, SPLITS, ParameterGroup, Split, param_names
from gpe_pl.trajectory.state import State
from gpe_pl.trajectory.trajectory import Trajectory
from gpe_pl.viz.saving import save_figure

log = logging.getLogger(__name__)

LEARNED = "learned"
EXACT = "learned, exact"
"""Label of the same model without the approximate levels of ``Skips``; used if the rollout has any."""
Export = Literal["vtk", "npz", "mp4", "model"]
MAX_SPEED_FACTOR = 20.0
"""A learned rollout has exploded if a particle's speed exceeds this factor times a reference speed. The reference is the speed of the fastest particle of the
ground truth, or the speed that crosses the domain within the trajectory if that is larger."""
ONE_STEP_WINDOWS = 256
VIEWER_BYTES = 2**26
"""Maximum size of a viewer's arrays before compression [bytes]; the viewer of a longer rollout skips frames."""
SCENES_AT_ONCE = 16
"""Number of scenes, or windows, in one pass of the model."""


class StartError(GpeError, ValueError):
    """Raised when rollouts cannot start: the start frame has too few frames before it, or gravity leaves no mirror image of the scene."""


@dataclass(frozen=True)
class EvaluationSettings:
    """Settings of an evaluation.

    Attributes:
        splits: splits of the data set.
        horizons: horizons [s], each at the nearest frame (see ``horizons``); the full length is always added.
        num_trajectories: number of trajectories per split, from its start; None takes all.
        start_time: time at which rollouts start [s]. Set it to compare models with different histories or frames from the same instant. None takes the first
            frame with enough history.
        containment: put particles that cross a wall back on its surface.
        num_uncontained: number of trajectories per split that are also rolled out without containment, which shows what it corrects; None takes all.
        clamp_parameters: clamp material parameters outside the trained range to the nearest trained value.
        static_friction: nodes that walls support stay in place if they are slower than this fraction of the speed that gravity gives in one frame (see
            ``nn.static_friction``); None takes the model's own value.
        material_controls: roll scenes with unseen parameters out with other parameters, too (see ``material_controls``).
        num_pictures: number of trajectories per split that get a figure, an animation and a viewer.
        export: what to write for other programs: the trajectories with pictures as ``vtk`` series, ``npz`` and ``mp4``, and the ``model`` (see
            ``export.program``).
    """

    splits: Annotated[list[Split], Field(min_length=1)] = field(default_factory=lambda: ["test", "test_unseen"])
    horizons: list[Annotated[float, Field(gt=0)]] = field(default_factory=lambda: [0.025, 0.1, 0.25, 0.5])
    num_trajectories: Annotated[int, Field(ge=1)] | None = None
    start_time: Annotated[float, Field(gt=0)] | None = None
    containment: bool = True
    num_uncontained: Annotated[int, Field(ge=0)] | None = None
    clamp_parameters: bool = True
    static_friction: Annotated[float, Field(ge=0, lt=1)] | None = None
    material_controls: bool = False
    num_pictures: Annotated[int, Field(ge=0)] = 2
    export: list[Export] = field(default_factory=list)

    def first_frame(self, history: int, frame_dt: float) -> int:
        """Return the frame at which rollouts of a model with this history [frames] start.

        Raises:
            StartError: ``start_time`` leaves too little history, or is between frames.
        """
        if self.start_time is None:
            return history
        frame, key = round(self.start_time / frame_dt), f"evaluation.start_time={self.start_time:g}"
        if frame < history:
            raise StartError(
                f"{key}: graph.history={history} needs as many frames of {frame_dt:g} s before it; choose at least {history * frame_dt:g}"
            )
        if abs(frame * frame_dt - self.start_time) > 1e-6 * frame_dt:
            raise StartError(f"{key}: is between two frames of {frame_dt:g} s; choose {frame * frame_dt:g}")
        return frame


class ExportError(GpeError):
    """Raised when a requested export cannot be written; the message says what is missing."""


@dataclass(frozen=True)
class Row:
    """One number of ``metrics.csv``. A metric of a whole split has the trajectory -1, no parameter group and the parameter NaN."""

    model: str
    split: str
    trajectory: int
    parameter_group: str
    parameter: float
    metric: str
    horizon: str
    value: float


def evaluate(
    simulator: LearnedSimulator,
    root: Path,
    settings: EvaluationSettings,
    run_dir: Path,
    label: str = LEARNED,
    controls: MaterialControls | None = None,
    stride: int = 1,
) -> list[Row]:
    """Roll out every trajectory of the splits, and write metrics and pictures to ``run_dir``.

    All rollouts start at ``settings.first_frame`` and run to the end of the ground truth. The files are ``metrics.csv`` with its digest, ``rollout_cost.json``
    (see ``rollout_cost``) and ``error_curve_*.png``. The first ``settings.num_pictures`` trajectories of each split also get ``rollout_*.png``,
    ``rollout_*.gif``, ``rollout_*.html`` (a viewer), ``stress_*.png`` if the model decodes a stress, and the files of ``settings.export``. With ``controls``,
    those of ``test_unseen`` also get ``parameters_*.png``: the solver and the model at three values of the material parameters.

    These metrics are computed here, beside those of ``metrics.rollout_metrics``:

    - ``one_step_nmse``: one value for each split (see ``one_step_nmse``).
    - ``num_good_frames``: number of frames that the rollout reached.
    - ``edges_per_node``: number of edges within the radius over that of dynamic nodes, in the graph of the middle frame of the ground truth. Each pair of
      nodes has one edge.
    - ``fraction_outside_at_end``: fraction of particles inside a wall or obstacle in the last frame.
    - ``fraction_corrected``: fraction of particle-steps that containment corrects.
    - ``fraction_outside_uncontained``: fraction of particle-frames inside a wall or obstacle with containment off, for the first ``settings.num_uncontained``
      rollouts of a split. These three are not reported for a boundary that consists of nodes only.
    - ``skipping_mse`` [m²]: position MSE between the rollouts with and without the approximate levels of ``simulator.skips``, over the frames of both.
    - ``fraction_asleep``: fraction of particle-steps that the approximate levels did not compute.
    - ``lost_impulse`` [kg m/s]: momentum that was lost when nodes fell asleep. The last three are reported if approximate levels are on. The rollout without
      these levels is then evaluated, too.

    Args:
        simulator: trained simulator.
        root: folder of the data set.
        settings: what to evaluate.
        run_dir: folder for the files.
        label: name of the model in the rows.
        controls: prepared controls of scenes with unseen parameters.
        stride: number of stored frames in a frame of the simulator.

    Returns:
        The rows of ``metrics.csv``.

    Raises:
        StartError: ``settings.start_time`` leaves too little history, or is between frames.
        SceneError: the data do not fit the simulator.
        ExportError: a format in ``settings.export`` needs a package that is not installed.
    """
    frame_dt = simulator.builder.metadata.frame_dt
    start_frame = settings.first_frame(simulator.builder.config.history, frame_dt)
    steps = labels(settings.horizons, frame_dt)
    if "mp4" in settings.export and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ExportError(
            "evaluation.export: mp4 needs imageio-ffmpeg: `pip install imageio-ffmpeg`, or leave it out (a GIF is always written)"
        )
    simulator = simulator.configured(clamps_parameters=settings.clamp_parameters, static_friction=settings.static_friction)
    run_dir.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    seconds: list[float] = []
    for split in settings.splits:
        curves: dict[str, list[np.ndarray]] = {}
        rows += [Row(label, split, -1, "", float("nan"), "one_step_nmse", "1", one_step_nmse(simulator, root, split, stride=stride))]
        trajectories = islice(long_enough(root, split, start_frame, stride), settings.num_trajectories)
        number, truth = 0, None
        while batch := list(islice(trajectories, SCENES_AT_ONCE)):
            left = len(batch) if settings.num_uncontained is None else max(0, settings.num_uncontained - number)
            controlled = controls if split == UNSEEN else None
            pictured = 0 if controlled is None else max(0, settings.num_pictures - number)
            for trajectory, (predictions, extra, at_values) in zip(
                batch,
                _predict(simulator, batch, start_frame, settings.containment, left, label, controlled, number, pictured, seconds),
                strict=True,
            ):
                truth = trajectory.frames(start_frame)
                stop = predictions[label].termination
                if stop is not None:
                    log.warning("%s %d stopped: %s, %s", split, number, stop.reason, stop.message)
                about = (split, number, truth.metadata.parameter_group, _parameter(trajectory))
                compared = {model: (prediction, truth) for model, prediction in predictions.items()}
                if controlled is not None:
                    compared |= controlled.solver_runs(number, truth)
                for model, (prediction, reference) in compared.items():
                    if model in BASELINES or model in (label, EXACT):
                        curves.setdefault(model, []).append(per_frame_mse(prediction, reference))
                    for record in rollout_metrics(prediction, reference, [*steps, "full"]):
                        horizon = "full" if record.horizon == "full" else steps[record.horizon]
                        rows.append(Row(model, *about, record.metric, horizon, record.value))
                rows += [Row(label, *about, metric, "full", value) for metric, value in extra.items()]
                if number < settings.num_pictures:
                    _pictures(run_dir, split, number, truth, {label: predictions[label]})
                    _exports(run_dir, split, number, truth, predictions[label], settings.export)
                    if at_values:
                        _parameter_picture(run_dir / f"parameters_{split}_{number:02d}.png", at_values)
                number += 1
        if truth is not None:
            _error_curve(run_dir / f"error_curve_{split}.png", curves, truth.metadata.frame_dt)
    if "model" in settings.export:
        export_model(simulator, run_dir / "model.pt2")
    write_cost(run_dir, seconds, frame_dt)
    write_rows(run_dir / "metrics.csv", rows)
    return rows


def _predict(
    simulator: LearnedSimulator,
    trajectories: list[Trajectory],
    start_frame: int,
    containment: bool,
    num_uncontained: int,
    label: str,
    controls: MaterialControls | None,
    first: int,
    num_pictured: int,
    seconds: list[float],
) -> Iterator[tuple[dict[str, Trajectory], dict[str, float], list[AtValue]]]:
    """Yield for each trajectory the predictions by model, further metrics of the learned model by name, and the scene at three parameter values.

    ``first`` is the number of the first trajectory. Only the first ``num_pictured`` trajectories have scenes at three values, for pictures. Processor times
    of steps [s] are added to ``seconds``.
    """
    truths = [trajectory.frames(start_frame) for trajectory in trajectories]
    starts = [start_of(simulator, start_frame, *pair) for pair in zip(trajectories, truths, strict=True)]
    totals = [{"num_corrected": 0.0, "num_asleep": 0.0, "lost_impulse": 0.0} for _ in starts]

    def count(scene: int, _: int, state: State) -> None:
        for name in totals[scene]:
            totals[scene][name] += getattr(state, name)

    runner = approximate(simulator)

    def within_walls(inner: Simulator) -> Simulator:
        return Contained(inner, truths[0].metadata.frame_dt) if containment else inner

    predicted = rollouts(Timed(within_walls(runner), seconds), starts, count)
    free = rollouts(runner, starts[:num_uncontained]) if containment else predicted
    exact = None if runner is simulator else rollouts(within_walls(simulator), starts)
    others = None if controls is None else controls.predictions(within_walls(runner), starts, first)
    for scene, (trajectory, truth) in enumerate(zip(trajectories, truths, strict=True)):
        dt, steps, spacing = truth.metadata.frame_dt, truth.num_frames - 1, truth.metadata.spacing
        prediction = predicted[scene]
        predictions = {label: prediction} if exact is None else {label: prediction, EXACT: exact[scene]}
        for name, baseline in BASELINES.items():
            predictions[name] = rollout(baseline(dt), trajectory.state(start_frame, start_frame), steps, truth.metadata)
        if others is not None:
            predictions |= {label_of(label, control): other for control, other in others[scene].items()}
        num_steps = truth.num_nodes * max(1, prediction.num_frames - 1)
        extra = {"num_good_frames": float(prediction.num_frames - 1), "edges_per_node": _edges_per_node(simulator, trajectory)}
        if truth.boundary.shapes:  # a boundary of nodes alone has no inside
            extra["fraction_outside_at_end"] = _fraction_outside(
                prediction, steps, steps, tolerance=surface_tolerance(truth.boundary.shapes)
            )
            extra["fraction_corrected"] = totals[scene]["num_corrected"] / num_steps
            if scene < len(free):
                extra["fraction_outside_uncontained"] = _fraction_outside(free[scene], 1, steps, tolerance=1e-3 * spacing)
        if exact is not None:
            shared = prediction.frames(0, min(prediction.num_frames, exact[scene].num_frames))
            extra["skipping_mse"] = float(per_frame_mse(shared, exact[scene])[1:].mean())
            extra["fraction_asleep"], extra["lost_impulse"] = totals[scene]["num_asleep"] / num_steps, totals[scene]["lost_impulse"]
        at_values: list[AtValue] = []
        if controls is not None and scene < num_pictured:
            at_values = controls.at_three_values(within_walls(runner), starts[scene], first + scene, truth, prediction)
        yield predictions, extra, at_values


def _edges_per_node(simulator: LearnedSimulator, trajectory: Trajectory) -> float:
    """Return the number of edges within the radius over that of dynamic nodes, in the graph of the middle frame of a trajectory."""
    history = simulator.builder.config.history
    graph = simulator.builder(trajectory.state(max(history, trajectory.num_frames // 2), history).to_torch())
    edges = (graph[relation].edge_index.shape[1] for relation in simulator.builder.spec.relations if relation[1] == RADIUS)
    return sum(edges) / trajectory.num_nodes


def _parameter(trajectory: Trajectory) -> float:
    """Return the first material parameter of a scene; NaN if its nodes have several values or none."""
    metadata = trajectory.metadata
    first = [metadata.param_names.index(name) for name in param_names(metadata.materials)]
    values = np.unique(np.asarray(trajectory.material_params, dtype=np.float64)[:, first])
    values = values[np.isfinite(values)]
    return float(values[0]) if len(values) == 1 else float("nan")


def start_of(simulator: LearnedSimulator, start_frame: int, trajectory: Trajectory, truth: Trajectory) -> Start:
    """Return the start of a rollout, with a guard whose limits are far beyond the ground truth."""
    bounds = truth.metadata.bounds
    size = max(high - low for low, high in bounds)
    across = size / (trajectory.num_frames * truth.metadata.frame_dt)  # the reference where everything rests
    speed = float(np.linalg.norm(trajectory.vel, axis=-1).max(initial=0.0))
    guard = Guard(max_speed=MAX_SPEED_FACTOR * max(speed, across), bounds=bounds, margin=size, spacing=truth.metadata.spacing)
    return Start(simulator.initial_state(trajectory, start_frame), truth.num_frames - 1, truth.metadata, guard)


def _fraction_outside(prediction: Trajectory, first: int, last: int, tolerance: float) -> float:
    """Return the fraction of particle-frames that are inside a wall or obstacle in frames ``first … last``.

    All particles of the frames that a stopped rollout lacks count as inside.

    Args:
        prediction: rollout; frame 0 is its start.
        first, last: frames.
        tolerance: depth [m] up to which a particle is not counted.
    """
    wanted, good = last - first + 1, prediction.frames(first, last + 1)
    return (fraction_outside(good, tolerance) * good.num_frames + wanted - good.num_frames) / wanted


def one_step_nmse(simulator: LearnedSimulator, root: Path, split: str, num_windows: int = ONE_STEP_WINDOWS, stride: int = 1) -> float:
    """Return the normalised one-step error without noise (``metrics.OneStepNMSE``), over windows spread evenly over a split. Predicting free fall gives 1.

    Raises:
        SceneError: every ``stride``-th frame of the data does not fit the simulator.
    """
    views = every(usable(open_split(root, split)), stride)
    simulator.check_scene(views[0].window(0, 1).metadata)
    dataset = WindowDataset(views, simulator.builder)
    windows = np.unique(np.linspace(0, len(dataset) - 1, min(len(dataset), num_windows)).round().astype(int))
    metric = OneStepNMSE()
    with torch.inference_mode():
        for chosen in np.array_split(windows, -(-len(windows) // SCENES_AT_ONCE)):
            data = batched([dataset[int(window)] for window in chosen])
            for material, value in simulator(data).acceleration.items():
                metric.update(value, data[material].target / simulator.acceleration_std.float())
    return float(metric.compute())


def write_rows(path: Path, rows: list[Row]) -> None:
    """Write rows as CSV, atomically, and their SHA-256 digest to ``{name}.sha256`` in the format of ``sha256sum``."""
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, fieldnames=list(Row.__dataclass_fields__))
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    content = table.getvalue().encode()
    replace_text(
        _digest_file(path), f"{hashlib.sha256(content).hexdigest()}  {path.name}\n"
    )  # first, as ``read_rows`` does not check a table without digest
    with replacing(path) as part:
        part.write_bytes(content)


GROUPS = ("", *get_args(ParameterGroup))
"""Groups of the material parameter; empty for the metrics of a whole split."""


class MetricsError(GpeError, ValueError):
    """Raised for a damaged ``metrics.csv``. The message names the file, and the line if a line cannot be read."""


def read_rows(path: Path) -> Iterator[Row]:
    """Yield the rows of a ``metrics.csv``.

    Raises:
        MetricsError: the file is not as ``write_rows`` wrote it. Without its digest, only the form of the rows is checked.
    """
    digest = _digest_file(path)
    try:
        regular_files.check(path)
        regular_files.check(digest)
    except OSError as error:
        raise MetricsError(f"{error.filename}: {error.strerror}; delete it to evaluate again") from None
    content = path.read_bytes()
    if digest.exists() and digest.read_bytes().split()[:1] != [hashlib.sha256(content).hexdigest().encode()]:
        raise MetricsError(
            f"{path}: damaged or changed (checksum mismatch); delete the file to evaluate again, or {digest.name} to use it unchecked"
        )
    reader = csv.DictReader(io.TextIOWrapper(io.BytesIO(content), "utf-8", newline=""), strict=True)
    try:
        for r in reader:
            if set(r) != set(Row.__dataclass_fields__) or None in r.values():
                raise ValueError(f"expected the columns {', '.join(Row.__dataclass_fields__)}")
            known: dict[str, Any] = {
                **r,
                "trajectory": int(r["trajectory"]),
                "parameter": float(r["parameter"]),
                "value": float(r["value"]),
            }
            if r["split"] not in SPLITS or r["parameter_group"] not in GROUPS:
                raise ValueError(f"split or parameter group is {r['split']}, {r['parameter_group']}")
            time_of(r["horizon"])
            if not (r["model"].isprintable() and r["metric"].isprintable()):
                raise ValueError("model or metric contains characters that are not printable")
            yield Row(**known)
    except (ValueError, csv.Error) as error:  # also a file that is not text
        raise MetricsError(f"{path}, line {reader.line_num}: damaged ({error}); delete the file to evaluate again") from None


def _digest_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def means(rows: list[Row], label: str = LEARNED) -> dict[str, float]:
    """Return the means of a model's metrics over trajectories, by ``split/metric@horizon``."""
    values: dict[str, list[float]] = {}
    for row in rows:
        if row.model == label:
            values.setdefault(f"{row.split}/{row.metric}@{row.horizon}", []).append(row.value)
    return {key: float(np.mean(v)) for key, v in values.items()}


def _pictures(run_dir: Path, split: str, number: int, truth: Trajectory, predictions: dict[str, Trajectory]) -> None:
    from gpe_pl.viz.figures import rollout_figure
    from gpe_pl.viz.video import write_animation
    from gpe_pl.viz.viewer import write_viewer

    stem = run_dir / f"rollout_{split}_{number:02d}"
    save_figure(rollout_figure(truth, predictions), stem.with_suffix(".png"), dpi=150, bbox_inches="tight")
    if truth.stress is not None and all(p.stress is not None for p in predictions.values()):
        figure = rollout_figure(truth, predictions, color="von_mises")
        save_figure(figure, run_dir / f"stress_{split}_{number:02d}.png", dpi=150, bbox_inches="tight")
    stride = max(1, truth.num_frames // 60)
    write_animation(stem.with_suffix(".gif"), truth, predictions, fps=20, stride=stride)
    size = (1 + len(predictions)) * (truth.pos.nbytes + truth.vel.nbytes)
    write_viewer(stem.with_suffix(".html"), truth, predictions, stride=-(-size // VIEWER_BYTES))


def _parameter_picture(path: Path, scenes: list[AtValue]) -> None:
    from gpe_pl.viz.figures import parameter_strip

    save_figure(parameter_strip(scenes), path, dpi=150, bbox_inches="tight")


def _exports(run_dir: Path, split: str, number: int, truth: Trajectory, prediction: Trajectory, formats: list[Export]) -> None:
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


def _error_curve(path: Path, curves: dict[str, list[np.ndarray]], frame_dt: float) -> None:
    from gpe_pl.viz.figures import error_curve_figure

    save_figure(error_curve_figure(curves, frame_dt), path, dpi=150)
