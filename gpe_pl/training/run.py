"""One training run in a folder: settings, start or resume, and reuse of a finished run."""

from __future__ import annotations

import logging
import os
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import lightning as L
import torch
from lightning.fabric.plugins.environments import ClusterEnvironment, LightningEnvironment, SLURMEnvironment
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from pydantic import Field

from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import PushForward, Sampling
from gpe_pl.errors import GpeError
from gpe_pl.errors.origin import came_through
from gpe_pl.errors.printable import one_line
from gpe_pl.files.atomic import replacing
from gpe_pl.files.run_folder import CONFIG, RunError, config_in, differences
from gpe_pl.learned.checkpoint_file import reason
from gpe_pl.system.machine import keep_freed_memory
from gpe_pl.training.callbacks import RolloutValidation, StepProgress, WarmAverage
from gpe_pl.training.checkpoints import AtomicCheckpoints, Checkpoints
from gpe_pl.training.interruption import Interruption
from gpe_pl.training.loss_terms import Loss, StressLoss
from gpe_pl.training.module import Compile, CudaGraph, Schedule, TrainingError, TrainingModule
from gpe_pl.training.parallel import SummedGradients

KNOWN_WARNINGS = (
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",  # concerns Lightning and PyTorch
    r"Checkpoint directory .* exists and is not empty",  # normal when resuming
    r"You have overridden `transfer_batch_to_device` in `LightningModule`",  # meant so
)
"""Warnings that training does not show."""

log = logging.getLogger(__name__)

Targets = Literal["trajectory", "solver"]
"""Targets of noisy and unrolled states: ``trajectory`` leads back to the true trajectory, ``solver`` follows the solver from these states."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the optimisation. ``TrainingModule``, ``TrajectoryDataModule``, ``data.noise`` and ``data.sampling`` describe those not listed here.

    Attributes:
        num_steps: number of optimiser steps; 0 keeps the model of ``start_from`` as it is.
        budget_minutes: training time on one core or GPU [min]; replaces ``num_steps`` (see ``training.budget``).
        gradient_clip: largest norm of the gradient; None switches clipping off.
        ema_decay: decay of the moving average of the weights; None switches averaging off.
        unroll_steps: number of steps in a row whose errors are in the loss, with gradients through the states between them; None for one.
        push_fraction: fraction of the steps, at the end of training, that use push-forward.
        push_steps: maximum number of steps of an unroll.
        push_correction: fraction of the velocity's deviation after an unroll that the target removes within one step, with ``targets=trajectory``.
        mirror, rotate, quarter_turns, boost_speed: images of training windows, see ``data.augmentation``.
        targets: targets of noisy and unrolled states, see ``Targets`` and ``data.solver_targets``.
        early_layers: train only the weights that ``start_from`` did not give, the embeddings of materials, the encoders, and this number of the first
            message-passing steps; None trains all weights.
        least_distance: quantile of the distances of nearest liquid nodes in the training data. Rollouts of the model keep these nodes that far apart (see
            ``learned.least_distance``); None keeps no distance.
        val_containment: put particles that cross a wall back on its surface in the validation rollouts, which choose the best checkpoint.
    """

    num_steps: Annotated[int, Field(ge=0)]
    budget_minutes: Annotated[float, Field(gt=0)] | None = None
    batch_size: Annotated[int, Field(ge=1)] = 2
    learning_rate: Annotated[float, Field(gt=0)] = 1e-3
    final_learning_rate: Annotated[float, Field(gt=0)] = 1e-5
    schedule: Schedule = "cosine"
    warmup_steps: Annotated[int, Field(ge=0)] = 100
    gradient_clip: Annotated[float, Field(gt=0)] | None = 1.0
    ema_decay: Annotated[float, Field(ge=0, lt=1)] | None = 0.999
    position_noise_of_domain: Annotated[float, Field(ge=0, le=1)] = 0.0
    velocity_noise_of_change: Annotated[float, Field(ge=0, le=100)] = 0.3
    noise_correction: Annotated[float, Field(ge=0, le=1)] = 0.0
    targets: Targets = "trajectory"
    mirror: bool = False
    rotate: bool = False
    quarter_turns: bool = False
    boost_speed: Annotated[float, Field(ge=0, le=100)] = 0.0
    sampling: Sampling = "uniform"
    push_fraction: Annotated[float, Field(ge=0, le=1)] = 0.0
    push_steps: Annotated[int, Field(ge=1)] = 20
    push_correction: Annotated[float, Field(ge=0, le=1)] = 1.0
    loss: Loss = "square"
    stress_loss: StressLoss = "square"
    stress_weight: Annotated[float, Field(gt=0)] = 1.0
    unroll_steps: Annotated[int, Field(ge=1, le=100)] | None = None
    neighbor_weight: Annotated[float, Field(gt=0, le=10)] | None = None
    early_layers: Annotated[int, Field(ge=0)] | None = None
    compile: Compile = "auto"
    cuda_graph: CudaGraph = "auto"
    val_interval: Annotated[int, Field(ge=1)] = 1000
    num_val_rollouts: Annotated[int, Field(ge=1)] = 4
    val_rollout_steps: Annotated[int, Field(ge=1)] = 100
    least_distance: Annotated[float, Field(gt=0, le=1)] | None = None
    val_containment: bool = True

    def __post_init__(self) -> None:
        if self.num_steps > self.val_interval and self.num_steps % self.val_interval:
            raise ValueError(
                f"val_interval={self.val_interval} must divide num_steps={self.num_steps}: the last steps would be neither validated nor saved"
            )
        if self.final_learning_rate > self.learning_rate:
            raise ValueError(
                f"final_learning_rate={self.final_learning_rate:g} must be at most learning_rate={self.learning_rate:g}, from which the schedule falls"
            )
        if self.augmentation.is_beyond_mirror and self.targets != "trajectory":
            raise ValueError(
                f"rotate, quarter_turns and boost_speed: not together with targets={self.targets}, whose walls stay; set targets=trajectory"
            )
        if (self.unroll_steps or 1) > 1:
            if self.push_fraction:
                raise ValueError(
                    f"unroll_steps={self.unroll_steps}: not together with push_fraction={self.push_fraction:g}; set push_fraction=0"
                )
            if self.targets != "trajectory":
                raise ValueError(f"unroll_steps={self.unroll_steps}: not together with targets={self.targets}; set targets=trajectory")

    @property
    def augmentation(self) -> Augmentation:
        """Images of training windows."""
        return Augmentation(self.mirror, self.rotate, self.quarter_turns, self.boost_speed)

    @property
    def noise(self) -> Noise:
        """Noise on the inputs."""
        return Noise(self.position_noise_of_domain, self.velocity_noise_of_change, self.noise_correction)

    @property
    def push_forward(self) -> PushForward | None:
        """Push-forward settings; None without push-forward."""
        return (
            PushForward(round((1 - self.push_fraction) * self.num_steps), self.push_steps, self.push_correction)
            if self.push_fraction
            else None
        )


@dataclass(frozen=True)
class TrainerSettings:
    """Where and how the training runs: one process per device, each with a part of every batch (see ``training.parallel``).

    Attributes:
        accelerator: kind of the devices; ``auto`` takes a GPU if there is one.
        devices: number of devices on each of the ``num_nodes`` machines.
        num_threads: PyTorch's threads in each process; None leaves PyTorch's choice.
        num_workers: number of processes that build graphs; 0 builds them in the training process.
        matmul_precision: PyTorch's precision of matrix products in float32. ``high`` and ``medium`` may use TensorFloat-32 or bfloat16 inside where the
            processor or GPU is faster with them.
        checkpoint_minutes: time between checkpoints, apart from those of validations [min].
        progress: show a progress bar.
    """

    accelerator: Literal["cpu", "gpu", "auto"] = "cpu"
    devices: Annotated[int, Field(ge=1)] = 1
    num_nodes: Annotated[int, Field(ge=1)] = 1
    num_threads: Annotated[int, Field(ge=1, le=1024)] | None = None
    num_workers: Annotated[int, Field(ge=0)] = 0
    matmul_precision: Literal["highest", "high", "medium"] = "highest"
    checkpoint_minutes: Annotated[float, Field(gt=0)] = 5.0
    progress: bool = True

    @property
    def identity(self) -> dict[str, Any]:
        """The settings that change weights and metrics, as a part of a run's configuration. Defaults are left out, as in folders of earlier versions."""
        return {} if self.matmul_precision == "highest" else {"trainer": {"matmul_precision": self.matmul_precision}}

    @property
    def device(self) -> str:
        """Type of the device of all tensors: ``cpu`` or ``cuda``."""
        return "cuda" if self.accelerator == "gpu" or (self.accelerator == "auto" and torch.cuda.is_available()) else "cpu"

    @property
    def num_processes(self) -> int:
        return self.devices * self.num_nodes


def adopt(folder: Path, config: dict[str, Any], run_dir: Path) -> Path | None:
    """Copy the best checkpoint of a finished run that was trained with the same configuration. With several processes, the first one copies.

    Args:
        folder: folder to search for runs.
        config: configuration of the training, without the key ``evaluation``.
        run_dir: folder of the new run.

    Returns:
        Path of the copy; None if there is no such run.
    """
    for path in sorted(folder.rglob(CONFIG)):
        trained = path.parent / "checkpoints" / "best.ckpt"
        if (path.parent / "metrics.csv").exists() and trained.exists():
            try:
                there = config_in(path)
            except RunError as error:
                log.warning("%s; looking for a trained model in the other runs", error)
                continue
            if not differences({key: value for key, value in there.items() if key != "evaluation"}, config):
                own = run_dir / "checkpoints" / "best.ckpt"
                if rank_zero_only.rank == 0:  # type: ignore[attr-defined]
                    log.info("using the model that was trained in %s", path.parent)
                    with replacing(own) as part:
                        shutil.copy(trained, part)
                return own
    return None


def train(
    module: TrainingModule,
    datamodule: TrajectoryDataModule,
    training: TrainingSettings,
    trainer_settings: TrainerSettings,
    loggers: list[Logger],
    run_dir: Path,
    callbacks: Sequence[Callback] = (),
    starts_trained: bool = False,
) -> Path:
    """Train up to step ``num_steps``, from ``checkpoints/last.ckpt`` if there is one, else from the start.

    With several processes, each of them returns; call ``end_later_processes`` to continue with the first alone. Unless ``torchrun`` or Slurm starts the
    processes, each runs the same command.

    Args:
        module: module to train.
        datamodule: training and validation windows.
        training: settings of the optimisation.
        trainer_settings: where and how the training runs.
        loggers: loggers of losses and metrics.
        run_dir: folder of the run.
        callbacks: callbacks of Lightning beyond those of every run.
        starts_trained: whether the model has been trained before. It is validated before the first step, too, and stays the best one unless a later one is.

    Returns:
        Path of the best checkpoint; see ``Checkpoints``.

    Raises:
        RunError: the accelerator or devices are not available, training was interrupted, or another process of it has ended; the message says how to
            resume. Or this process has already trained together with processes that it started.
        TrainingError: losses are not finite; the message names the last checkpoint.
        CheckpointError: training cannot resume from ``last.ckpt``.
    """
    datamodule.push_forward = training.push_forward  # known only now, as it depends on the number of steps within a time budget
    interruption = Interruption()
    averages = [] if training.ema_decay is None else [WarmAverage(training.ema_decay)]
    validation = _validation(datamodule, training)
    checkpoints = Checkpoints(run_dir / "checkpoints", 60 * trainer_settings.checkpoint_minutes, interruption, validation, starts_trained)
    own: list[Callback] = [
        validation,
        *averages,
        LearningRateMonitor(),
        checkpoints,
    ]
    if trainer_settings.progress:
        own.append(StepProgress())
    trainer = _trainer(training, trainer_settings, loggers, run_dir, [*own, *callbacks])
    _warn_of_warmup(training)
    last = checkpoints.last if checkpoints.last.exists() else None
    if last is not None:
        log.info("resuming from %s", last)
    for known in KNOWN_WARNINGS:
        warnings.filterwarnings("ignore", known)
    with _said_how_to_continue(checkpoints, trainer), interruption, checkpoints.taken_up():
        trainer.fit(module, datamodule, ckpt_path=last, weights_only=True)
    if checkpoints.best_step == 0:
        log.warning(
            "start_from: every validation was clearly worse than the model at the start, so %s has its weights; those of the training are in %s. "
            "Try a lower training.learning_rate or more trajectories",
            checkpoints.best,
            checkpoints.last,
        )
    return checkpoints.best


@contextmanager
def _said_how_to_continue(checkpoints: Checkpoints, trainer: L.Trainer) -> Iterator[None]:
    """Name the last checkpoint in errors that end a training: an interruption, numbers that are not finite, or the end of another process."""
    try:
        yield
    except SystemExit:  # Lightning's answer to an interruption
        if trainer.global_rank > 0:
            raise
        raise RunError(f"interrupted; {_how_to_continue(checkpoints)}") from None
    except GpeError as error:
        if not isinstance(error, TrainingError):
            raise _from_worker(error) from None
        saved = checkpoints.where_saved()
        raise TrainingError(
            f"{error}; {'no checkpoint was saved yet' if saved is None else f'the last good checkpoint is kept: {saved}'}"
        ) from None
    except RuntimeError as error:
        if "DataLoader worker" in str(error) and came_through(error, "torch.utils.data.dataloader"):
            raise RunError(
                f"a process of trainer.num_workers has ended ({reason(error)}); if memory is short, lower trainer.num_workers; "
                f"{_how_to_continue(checkpoints)}"
            ) from None
        if not came_through(error, "torch.distributed"):
            raise
        raise RunError(
            f"the connection to the other processes of the training failed ({reason(error)}). If one of them has ended, its message is above; "
            f"{_how_to_continue(checkpoints)}"
        ) from None


def _from_worker(error: GpeError) -> GpeError:
    """Return an error without the report that PyTorch puts around it if a process of ``trainer.num_workers`` raised it."""
    if not str(error).startswith(f"Caught {type(error).__name__} in DataLoader worker"):
        return error
    kind = type(error)
    return kind(str(error).rpartition(f"{kind.__module__}.{kind.__qualname__}: ")[2])


def _how_to_continue(checkpoints: Checkpoints) -> str:
    saved = checkpoints.where_saved()
    return "nothing was saved yet, the same command starts again" if saved is None else f"run the same command again to resume from {saved}"


def _validation(datamodule: TrajectoryDataModule, training: TrainingSettings) -> RolloutValidation:
    """Return the validation by rollouts. Each has the length of its scene, if that is shorter than ``val_rollout_steps``."""
    validated = datamodule.val_trajectories(training.num_val_rollouts)
    lengths = [min(training.val_rollout_steps, t.num_frames - datamodule.builder.config.history - 1) for t in validated]
    if min(lengths) < max(lengths):
        unlike = "strides" if len({t.metadata.frame_dt for t in validated}) > 1 else "lengths"
        log.warning(
            "validation rollouts have %d to %d frames, because scenes of the split val have unlike %s", min(lengths), max(lengths), unlike
        )
    return RolloutValidation(validated, max(lengths), training.val_containment)


def _warn_of_warmup(training: TrainingSettings) -> None:
    if training.schedule == "cosine" and 0 < training.num_steps < training.warmup_steps:
        log.warning(
            "training.warmup_steps=%d: training ends at step %d, before the learning rate has reached training.learning_rate=%g",
            training.warmup_steps,
            training.num_steps,
            training.learning_rate,
        )


def _trainer(
    training: TrainingSettings, trainer_settings: TrainerSettings, loggers: list[Logger], run_dir: Path, callbacks: list[Callback]
) -> L.Trainer:
    """Return Lightning's trainer.

    Raises:
        RunError: the accelerator or devices are not available, or this process has already trained together with processes that it started.
    """
    is_parallel = trainer_settings.num_processes > 1
    if is_parallel and SummedGradients.has_started_processes:
        raise RunError(
            f"trainer.devices={trainer_settings.devices}: this Python process has already trained on several devices; start each such training as a "
            "command or script of its own"
        )
    if is_parallel:
        os.environ.setdefault("OMP_NUM_THREADS", str(torch.get_num_threads()))  # else Lightning divides all cores between the processes
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    try:
        return L.Trainer(
            accelerator=trainer_settings.accelerator,
            devices=trainer_settings.devices,
            num_nodes=trainer_settings.num_nodes,
            strategy=SummedGradients() if is_parallel else "auto",
            use_distributed_sampler=False,  # the data module's samplers know the ranks
            max_steps=training.num_steps,
            max_epochs=-1,
            val_check_interval=min(training.val_interval, training.num_steps),
            check_val_every_n_epoch=None,
            gradient_clip_val=training.gradient_clip,
            num_sanity_val_steps=0,
            callbacks=callbacks,
            logger=loggers,
            log_every_n_steps=min(50, training.num_steps),
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=run_dir,
            plugins=[AtomicCheckpoints(), *_environment(is_parallel)],
        )
    except (MisconfigurationException, RuntimeError, ValueError) as error:  # Lightning raises all three for what a launcher did otherwise
        raise RunError(
            f"trainer.accelerator={trainer_settings.accelerator}, trainer.devices={trainer_settings.devices}: {one_line(str(error))}"
        ) from None


def _environment(is_parallel: bool) -> list[ClusterEnvironment]:
    """Return how Lightning learns of other processes, if it is not by itself. A single process has none, also in a job of Slurm with several tasks."""
    if not is_parallel:
        return [LightningEnvironment()]
    return [SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else []


def seed(number: int) -> None:
    """Seed the random number generators of Python, NumPy and PyTorch."""
    L.seed_everything(number, verbose=False)


def set_up(settings: TrainerSettings) -> str:
    """Set PyTorch's threads, memory use and precision in this process.

    Returns:
        The device to compute on.

    Raises:
        RunError: there is no such device.
    """
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise RunError(f"trainer.accelerator={settings.accelerator}: PyTorch finds no GPU here; choose trainer=cpu")
    if settings.num_threads is not None:
        torch.set_num_threads(settings.num_threads)
    keep_freed_memory()
    torch.set_float32_matmul_precision(settings.matmul_precision)
    return settings.device
