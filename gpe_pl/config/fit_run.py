"""The stages of a run of ``fit``: data, number of steps, folder, training, evaluation."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gpe_pl.config.datasets import (
    IMPORTED,
    check_material_controls,
    check_same_frames,
    check_splits,
    dataset_spec,
    ensure_data,
    evaluated_config,
    material_controls,
    scene_metadata,
    stride_of,
    training_parts,
)
from gpe_pl.config.entry_point import ConfigError, bind, construct
from gpe_pl.data.checksum import split_checksum
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.dataset import every, open_split, window_counts
from gpe_pl.data.frame_velocities import warn_of_means
from gpe_pl.data.sampling import BatchSize
from gpe_pl.evaluation.metric_rows import LEARNED, read_rows
from gpe_pl.evaluation.rollouts import evaluate
from gpe_pl.evaluation.settings import EvaluationSettings
from gpe_pl.files.run_folder import DATA_CHECKSUMS, RunError, claim, without_tables
from gpe_pl.graphs.builder import GraphBuilder
from gpe_pl.graphs.features import GraphConfig
from gpe_pl.learned.least_distance import distance_in
from gpe_pl.learned.pretrained import fingerprint
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.learned.transfer import check_model, keep_rollout_settings, keep_trained_ranges
from gpe_pl.models.lookup import model_class
from gpe_pl.reports.finished_runs import Run, rollout_errors, table_of
from gpe_pl.reports.outcome import means
from gpe_pl.rollout.loop import Restartable
from gpe_pl.system.progress import no_bar, progress_bar
from gpe_pl.training.budget import PauseForMeasurements, mean_step_time, step_time_key, within_budget
from gpe_pl.training.loss_terms import mean_num_neighbors
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.optimizer import train_only
from gpe_pl.training.parallel import be_the_only_process, end_later_processes, started_processes
from gpe_pl.training.run import TrainerSettings, TrainingSettings, adopt, seed, set_up, train
from gpe_pl.training.tracking import LoggerSettings, publish
from gpe_pl.trajectory.store import iter_trajectories

log = logging.getLogger(__name__)

OPTIMISATION = (
    *("num_steps", "learning_rate", "final_learning_rate", "schedule", "warmup_steps"),
    *("loss", "stress_loss", "stress_weight", "neighbor_weight", "compile", "cuda_graph"),
)
"""Fields of ``TrainingSettings`` that are arguments of ``TrainingModule``."""


class FitRun:
    """One run of ``fit``. The constructor checks settings and loads the model of ``start_from``. The methods are called in the order of their definition.

    Args:
        cfg: composed configuration.
        folder: folder of the results.

    Raises:
        ConfigError: a setting has the wrong type or value, or does not fit the others.
    """

    def __init__(self, cfg: DictConfig, folder: Path) -> None:
        if type(cfg.seed) is not int or cfg.seed < 0:
            raise ConfigError(f"seed={cfg.seed!r}: must be an integer of at least 0")
        if not (cfg.start_from is None or isinstance(cfg.start_from, str)):
            raise ConfigError(f"start_from={cfg.start_from!r}: must be null, the folder of a run, a checkpoint or a shipped model")
        self.cfg, self.folder, self.runs = cfg, folder, Path(cfg.paths.runs)
        self.training = construct(TrainingSettings, cfg.training, "training")
        if cfg.start_from is None and self.training.num_steps == 0:
            raise ConfigError("training.num_steps=0: there is nothing to evaluate; needs start_from, or at least 1 step")
        if cfg.start_from is None and self.training.early_layers is not None:
            raise ConfigError(f"training.early_layers={self.training.early_layers}: the other layers stay as they are; needs start_from")
        self.trainer = construct(TrainerSettings, cfg.trainer, "trainer")
        self._check_processes()
        self.evaluation = construct(EvaluationSettings, {k: v for k, v in cfg.evaluation.items() if k != "data"}, "evaluation")
        check_splits(evaluated_config(cfg), self.evaluation.splits, "evaluation.splits")
        check_material_controls(cfg, self.evaluation)
        self.graph = construct(GraphConfig, cfg.graph, "graph")
        self.parts = training_parts(cfg)
        self.stride, self.evaluated_stride = stride_of(self.parts[0]), stride_of(evaluated_config(cfg))
        self.logger = construct(LoggerSettings, cfg.logger, "logger")
        settings = {key: value for key, value in cfg.model.items() if key != "_target_"}
        self.new_model = bind(model_class(cfg.model._target_), settings, "model", "spec")
        self.batch_size = construct(BatchSize, cfg.batching, "batching", num_graphs=self.training.batch_size)
        if self.evaluation.static_friction and not self.graph.islands:
            raise ConfigError(
                f"evaluation.static_friction={self.evaluation.static_friction:g}: needs graph.islands=true, which model=gpe_tuned has"
            )
        if self.evaluation.static_friction and not self.graph.boundary_condition:
            raise ConfigError(f"evaluation.static_friction={self.evaluation.static_friction:g}: needs graph.boundary_condition=true")
        self.start = None if cfg.start_from is None else LearnedSimulator.from_checkpoint(cfg.start_from)
        self.callbacks: list[PauseForMeasurements] = []

    def _check_processes(self) -> None:
        count, started = self.trainer.num_processes, started_processes()
        if count == 1:
            be_the_only_process()
        elif started not in (None, count):
            raise ConfigError(
                f"trainer.devices={self.trainer.devices}, trainer.num_nodes={self.trainer.num_nodes}: are {count} processes, and torchrun or Slurm started "
                f"{started}; choose equal numbers, or leave torchrun out and unset SLURM_NTASKS, so that this command starts the others"
            )

    def prepare_data(self) -> None:
        """Generate missing data and controls, after checking that model, noise and evaluation fit the scenes, and ``start_from`` the model. Choose the device.

        Raises:
            GpeError: the model refuses its settings for the materials of the scenes.
            NoiseError: the noise is too large for the spacing of the scenes.
            CheckpointError: the model of ``start_from`` has other settings.
            StartError: ``evaluation.start_time`` leaves too little history, or is between frames.
            ControlError: the model of ``start_from`` is not trained here, and its training had other material parameters than these data.
            ConfigError: evaluated data have frames of another length, or windows of the elastic law are to be turned by any angle.
        """
        scenes, evaluated = scene_metadata(self.parts[0], "train"), evaluated_config(self.cfg)
        self.training.noise.check(scenes)
        builder = GraphBuilder(self.graph, scenes)
        untrained = LearnedSimulator(self.new_model(spec=builder.spec), builder, self.stride)
        if self.training.rotate and untrained.model.settings.get("elastic"):
            raise ConfigError(
                "training.rotate=true: the elastic law reads the shapes of walls, which turn by whole quarters only; choose training.quarter_turns=true"
            )
        if self.start is not None:
            check_model(untrained, self.start)
            stride = self.start.stride_on(scene_metadata(self.cfg, "train", strided=False))
            if stride and stride != self.stride:
                log.warning("start_from: data.stride=%d has frames as long as those of the trained model", stride)
        rolled_out = scene_metadata(evaluated, self.evaluation.splits[0])
        self.first_frame = self.evaluation.first_frame(self.graph.history, rolled_out.frame_dt)
        if self.cfg.evaluation.data and self.graph.scales == "one":
            check_same_frames(scenes, rolled_out)
        self.solver = self._solver_of_targets()
        self.root, *others = (ensure_data(part) for part in self.parts)
        warn_of_means(untrained, self.root, "train")
        self.others = list(zip(others, map(stride_of, self.parts[1:]), strict=True))
        is_same = not self.cfg.evaluation.data and len(self.parts) == 1
        self.evaluated_root = self.root if is_same else ensure_data(evaluated)
        untouched = self.start if self.training.num_steps == 0 else None  # later trained on these data
        self.controls = material_controls(self.cfg, self.evaluation, self.evaluated_root, self.first_frame, untouched)
        if self.controls is not None and self.start is not None:
            self.controls.warn_of_start(self.start)
        self.device = set_up(self.trainer)

    def choose_num_steps(self) -> None:
        """Replace a time budget by the number of steps that it allows. A run of 0 steps trains nothing, so it has no use for a budget."""
        if self.training.num_steps == 0:
            self.training = replace(self.training, budget_minutes=None)
        if self.training.budget_minutes is None:
            return
        checksum = self._checksums["train"] if self._settings["data"]["size"] == IMPORTED else None
        key = step_time_key(self._settings, self._as_timed(self.training), self.trainer, checksum)
        times = self.runs / (self.cfg.reuse or self.cfg.name) / "step_times.json"
        self.callbacks.append(PauseForMeasurements(times))
        self.training = within_budget(self.training, times, key, self._step_time, self.device)

    def claim_folder(self) -> None:
        """Assign the folder to this run; raises ``RunError`` if it belongs to a run with another configuration."""
        try:
            claim(self.folder, self._config)
        except RunError as error:
            if self.cfg.training.budget_minutes is None or "training.num_steps" not in str(error):
                raise
            raise RunError(
                f"{error}. training.num_steps follows from training.budget_minutes and the measured time of a step, which trainer.accelerator and "
                "trainer.matmul_precision change"
            ) from None

    @property
    def is_evaluated(self) -> bool:
        """Whether the run was finished by an earlier start, with all files that this one asks for."""
        wanted = [self.folder / f"quantities_{split}.csv" for split in self.evaluation.splits if self.evaluation.quantities]
        return self._metrics.exists() and all(path.exists() for path in wanted)

    def check_evaluation(self) -> None:
        """Check before training that the evaluated splits have trajectories that are long enough."""
        for split in self.evaluation.splits:
            window_counts(every(open_split(self.evaluated_root, split, cache_bytes=0), self.evaluated_stride), self.first_frame)

    def finished_model(self) -> Path | None:
        """Copy the best checkpoint of a finished run with the same training from the sweep that ``reuse`` names. Return the copy, or None."""
        best = None if self.cfg.reuse is None else adopt(self.runs / self.cfg.reuse, self._trained, self.folder)
        if self.cfg.reuse is not None and best is None:
            log.info("reuse=%s: no finished run there has the same training; this run is trained", self.cfg.reuse)
        if best is not None:
            end_later_processes()
        return best

    def train(self) -> Path:
        """Train to the last step, starting from the last checkpoint if there is one, and return the best checkpoint."""
        if self.training.num_steps == 0:
            end_later_processes()
            best = self.folder / "checkpoints" / "best.ckpt"
            best.parent.mkdir(parents=True, exist_ok=True)
            simulator = self._new_module(self.training).simulator
            chosen = simulator.least_distance
            if self.start is not None:
                keep_rollout_settings(simulator, self.start)
                keep_trained_ranges(simulator, self.start)
            if self.training.least_distance is not None:
                simulator.least_distance = chosen
            simulator.save(best)
            return best
        module, is_trained = self._new_module(self.training), self.start is not None
        best = train(module, self._data, self.training, self.trainer, self._loggers, self.folder, self.callbacks, is_trained)
        end_later_processes()
        return best

    def evaluate(self, checkpoint: Path) -> None:
        """Roll the model out on the evaluated splits, and log the mean errors."""
        simulator = LearnedSimulator.from_checkpoint(checkpoint, self.device)
        bars = progress_bar if self.trainer.progress else no_bar
        rows = evaluate(
            simulator, self.evaluated_root, self.evaluation, self.folder, controls=self.controls, stride=self.evaluated_stride, bars=bars
        )
        publish(self._loggers, self.folder, means(Run(self.folder, {}, table_of(rows))))

    def error(self) -> float:
        """Return the mean full-length rollout MSE [m²] on the first evaluated split. Failed rollouts count as in ``finished_runs.rollout_errors``.

        Raises:
            RunError: the metrics of this run have no such error.
        """
        split = self.evaluation.splits[0]
        run = Run(self.folder, {}, table_of(read_rows(self._metrics)))
        values = [value for errors in rollout_errors([run], split, "full") for value in errors.values()]
        if not values:
            raise RunError(f"{self._metrics}: has no rollout_mse of {LEARNED} on {split}; delete the file to evaluate again")
        return sum(values) / len(values)

    @property
    def _metrics(self) -> Path:
        return self.folder / "metrics.csv"

    @cached_property
    def _settings(self) -> dict[str, Any]:
        resolved: Any = OmegaConf.to_container(self.cfg, resolve=True)
        return without_tables(resolved)

    @cached_property
    def _checksums(self) -> dict[str, str]:
        own = {split: split_checksum(self.root, split) for split in ("train", "val")}
        further = {f"{split} {k}": split_checksum(root, split) for k, (root, _) in enumerate(self.others, 1) for split in own}
        return own | further

    @property
    def _trained(self) -> dict[str, Any]:
        """Everything that the trained model depends on."""
        own = {key: self._settings[key] for key in ("seed", "size", "data", "graph", "batching", "model")}
        start = {} if self.cfg.start_from is None else {"start_from": fingerprint(self.cfg.start_from)}
        return own | start | {"training": asdict(self.training), DATA_CHECKSUMS: self._checksums} | self.trainer.identity

    @cached_property
    def _config(self) -> dict[str, Any]:
        """Everything that the results depend on."""
        checksums = {split: split_checksum(self.evaluated_root, split) for split in self.evaluation.splits}
        settings = {key: value for key, value in self._settings["evaluation"].items() if key != "quantities"}  # changes no metric
        return self._trained | {"evaluation": settings | {DATA_CHECKSUMS: checksums}}

    @cached_property
    def _loggers(self) -> list[Any]:
        return self.logger.loggers(self.folder, self.cfg.name, self._config)

    @cached_property
    def _data(self) -> TrajectoryDataModule:
        return TrajectoryDataModule(
            self.root,
            self.graph,
            self.training.noise,
            self.batch_size,
            self.cfg.seed,
            self.trainer.num_workers,
            stress=bool(self.cfg.model.get("stress", False)),
            sampling=self.training.sampling,
            solver=self.solver,
            augmentation=self.training.augmentation,
            stride=self.stride,
            unroll_steps=self.training.unroll_steps or 1,
            others=self.others,
            reads_relief=bool(self.cfg.model.get("wall_layer", 0)),
        )

    def _solver_of_targets(self) -> Restartable | None:
        """Solver that gives training targets, with frames as long as the model's; None if ``training.targets`` is ``trajectory``."""
        if self.training.targets == "trajectory":
            return None
        if self.cfg.data.size == IMPORTED:
            raise ConfigError("training.targets=solver: imported data have no solver; choose training.targets=trajectory")
        solver = dataset_spec(self.cfg).solver
        if not (isinstance(solver, Restartable) and solver.can_restart):
            raise ConfigError(
                f"training.targets=solver: the solver {solver.name} cannot continue {', '.join(solver.materials)} from positions; "
                "choose training.targets=trajectory"
            )
        longer: Any = solver
        return replace(longer, frame_dt=self.stride * solver.frame_dt)  # type: ignore[no-any-return]

    def _new_module(self, training: TrainingSettings) -> TrainingModule:
        seed(self.cfg.seed)
        data = self._data
        simulator = LearnedSimulator(self.new_model(spec=data.builder.spec), data.builder, data.stride)
        sample = data.statistics_sample()
        simulator.fit_statistics(sample, data.parameter_ranges(), data.trained_scene(), data.trained_scales())
        if training.least_distance is not None:
            simulator.least_distance = distance_in(iter_trajectories(self.root, "train"), training.least_distance)
        neighbors = mean_num_neighbors(sample, data.builder.spec.materials) if training.neighbor_weight is not None else 1.0
        if self.start is not None:
            new = simulator.start_from(self.start).new
            if training.early_layers is not None:
                train_only(simulator.model, [*simulator.model.early_layers(training.early_layers)], new.values())
        return TrainingModule(simulator, mean_neighbors=neighbors, **{name: getattr(training, name) for name in OPTIMISATION})

    def _as_timed(self, training: TrainingSettings) -> TrainingSettings:
        """Return settings for a measurement in this process, before other processes start: several processes train without CUDA graphs."""
        return training if self.trainer.num_processes == 1 else replace(training, cuda_graph="off")

    def _step_time(self, training: TrainingSettings) -> float:
        timed = self._as_timed(training)
        return mean_step_time(self._new_module(timed).to(self.device), self._data.train_set, self.batch_size, timed)
