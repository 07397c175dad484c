"""One training run in a folder: start, resume, or recognise that it is finished."""

from __future__ import annotations

import logging
import os
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import lightning as L
import torch
from lightning.fabric.plugins.environments import SLURMEnvironment
from lightning.pytorch.callbacks import Callback, LearningRateMonitor
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from pydantic import Field

from gpe_pl.data.datamodule import TrajectoryDataModule
from gpe_pl.data.noise import Noise
from gpe_pl.data.sampling import PushForward, Sampling
from gpe_pl.files.atomic import replacing
from gpe_pl.files.run_folder import CONFIG, RunError, config_in, differences
from gpe_pl.system.machine import keep_freed_memory
from gpe_pl.training.callbacks import RolloutValidation, StepProgress, WarmAverage
from gpe_pl.training.checkpoints import AtomicCheckpoints, Checkpoints
from gpe_pl.training.interruption import Interruption
from gpe_pl.training.module import Compile, Schedule, TrainingError, TrainingModule
from gpe_pl.training.parallel import SummedGradients

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingSettings:
    """Everything about the optimisation; see ``TrainingModule``, ``TrajectoryDataModule``, ``data.noise`` and ``data.sampling`` for the meaning of each value.

    ``budget_minutes``, of one core or GPU, replaces ``num_steps`` (see ``training.budget``). The last ``push_share`` of the steps start where the model
    has come to in up to ``push_steps`` steps of its own; ``push_correction`` of the way that its velocity has gone astray is to be taken back within a step.
    ``gradient_clip`` and ``ema_decay`` are switched off by None. ``val_containment`` puts particles that cross a wall back in the rollouts of the validation,
    which choose the best checkpoint.
    """

    num_steps: Annotated[int, Field(ge=1)]
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
    sampling: Sampling = "uniform"
    push_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    push_steps: Annotated[int, Field(ge=1)] = 20
    push_correction: Annotated[float, Field(ge=0, le=1)] = 1.0
    stress_weight: Annotated[float, Field(gt=0)] = 1.0
    compile: Compile = "auto"
    val_interval: Annotated[int, Field(ge=1)] = 1000
    num_val_rollouts: Annotated[int, Field(ge=1)] = 4
    val_rollout_steps: Annotated[int, Field(ge=1)] = 100
    val_containment: bool = True

    def __post_init__(self) -> None:
        if self.num_steps > self.val_interval and self.num_steps % self.val_interval:
            raise ValueError(
                f"val_interval={self.val_interval} must divide num_steps={self.num_steps}: the last steps would be neither validated nor saved"
            )

    @property
    def noise(self) -> Noise:
        """On the inputs."""
        return Noise(self.position_noise_of_domain, self.velocity_noise_of_change, self.noise_correction)

    @property
    def push_forward(self) -> PushForward | None:
        """When samples begin with own steps of the model."""
        return (
            PushForward(round((1 - self.push_share) * self.num_steps), self.push_steps, self.push_correction) if self.push_share else None
        )


@dataclass(frozen=True)
class TrainerSettings:
    """Where the training runs: in one process per device, each of which takes a part of every batch (see ``training.parallel``).

    ``devices`` are those of one of ``num_nodes`` machines. ``matmul_precision`` is PyTorch's for products of single precision: ``high`` and ``medium`` may use
    TensorFloat-32 or bfloat16 inside, where the processor or GPU is faster with them. Between validations a checkpoint is saved every ``checkpoint_minutes``.
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
    def device(self) -> str:
        """Where tensors go."""
        return "cuda" if self.accelerator == "gpu" or (self.accelerator == "auto" and torch.cuda.is_available()) else "cpu"

    @property
    def num_processes(self) -> int:
        return self.devices * self.num_nodes


def adopt(folder: Path, config: dict[str, Any], run_dir: Path) -> Path | None:
    """Copy the checkpoint of a finished run below ``folder`` that was trained with the configuration ``config``; None if there is no such run.

    Of several processes the first copies.
    """
    for path in sorted(folder.rglob(CONFIG)):
        trained = path.parent / "checkpoints" / "best.ckpt"
        if (path.parent / "metrics.csv").exists() and trained.exists():
            there = config_in(path)
            if not differences({key: value for key, value in there.items() if key != "evaluation"}, config):
                own = run_dir / "checkpoints" / "best.ckpt"
                if rank_zero_only.rank == 0:  # type: ignore[attr-defined]
                    log.info("taking the model that was trained in %s", path.parent)
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
) -> Path:
    """Train to ``num_steps``, resuming from ``checkpoints/last.ckpt`` if there is one; returns the checkpoint with the best validation rollout.

    Several processes return; ``end_later_processes`` leaves the first. Unless ``torchrun`` or Slurm starts them, each runs the same command.
    """
    datamodule.push_forward = training.push_forward  # known only now, as a budget of time has become a number of steps
    interruption = Interruption()
    checkpoints = Checkpoints(run_dir / "checkpoints", 60 * trainer_settings.checkpoint_minutes, interruption)
    steps = min(training.val_rollout_steps, datamodule.val_trajectories(1)[0].num_frames - datamodule.builder.config.history - 1)
    averages = [] if training.ema_decay is None else [WarmAverage(training.ema_decay)]
    own: list[Callback] = [
        RolloutValidation(datamodule.val_trajectories(training.num_val_rollouts), steps, training.val_containment),
        *averages,
        LearningRateMonitor(),
        checkpoints,
    ]
    if trainer_settings.progress:
        own.append(StepProgress())
    is_parallel = trainer_settings.num_processes > 1
    if is_parallel:
        os.environ.setdefault("OMP_NUM_THREADS", str(torch.get_num_threads()))  # else Lightning shares out all cores
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    try:
        trainer = L.Trainer(
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
            callbacks=[*own, *callbacks],
            logger=loggers,
            log_every_n_steps=min(50, training.num_steps),
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=run_dir,
            plugins=[AtomicCheckpoints(), *([SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else [])],
        )
    except MisconfigurationException as error:
        raise RunError(f"trainer.accelerator={trainer_settings.accelerator}, trainer.devices={trainer_settings.devices}: {error}") from None
    last = checkpoints.last if checkpoints.last.exists() else None
    if last is not None:
        log.info("resuming from %s", last)
    for known in (r"`isinstance\(treespec, LeafSpec\)` is deprecated", r"Checkpoint directory .* exists and is not empty"):
        warnings.filterwarnings("ignore", known)  # the first is between Lightning and PyTorch, the second what resuming is
    try:
        with interruption, checkpoints.taken_up():
            trainer.fit(module, datamodule, ckpt_path=last, weights_only=True)
    except SystemExit:  # Lightning's answer to an interruption
        if trainer.global_rank > 0:
            raise
        saved = checkpoints.where_saved()
        advice = (
            "nothing was saved yet, the same command starts again"
            if saved is None
            else f"run the same command again to resume from {saved}"
        )
        raise RunError(f"interrupted; {advice}") from None
    except TrainingError as error:
        saved = checkpoints.where_saved()
        raise TrainingError(
            f"{error}; {'no checkpoint was saved yet' if saved is None else f'the last good checkpoint is kept: {saved}'}"
        ) from None
    return checkpoints.best


def seed(number: int) -> None:
    """Seed the random numbers of Python, NumPy and PyTorch."""
    L.seed_everything(number, verbose=False)


def set_up(settings: TrainerSettings) -> str:
    """Threads, memory and precision of PyTorch in this process; the device to compute on.

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
