"""Checkpoints of a run: decides when to save and which validation counts as best, and writes each file whole or not at all."""

from __future__ import annotations

import io
import logging
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from gpe_pl.errors import GpeError
from gpe_pl.errors.origin import came_through
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.learned.checkpoint_file import CheckpointError, load_checkpoint, reason
from gpe_pl.system import ranks
from gpe_pl.training.callbacks import RolloutValidation
from gpe_pl.training.interruption import Interruption

log = logging.getLogger(__name__)

RESTORING = "lightning.pytorch.trainer.connectors.checkpoint_connector"
"""Module of Lightning that restores checkpoints."""
NUM_STANDARD_ERRORS = 2.0
"""How far above the lowest mean error a validation has to be, in standard errors, to be clearly worse."""


def clearly_worse(errors: Sequence[float], lowest: Sequence[float]) -> bool:
    """Whether a validation shows that a model is worse than another one on the same trajectories.

    The mean of the paired differences must be more than ``NUM_STANDARD_ERRORS`` of its standard errors above 0. One trajectory has no standard error, so a
    higher error is enough there. Few rollouts cannot tell apart models of nearly equal errors, and the later one was trained for longer.

    Args:
        errors: errors of the model [trajectory].
        lowest: errors of the other model [trajectory].
    """
    if not np.isfinite(errors).all() or len(errors) != len(lowest):
        return True
    difference = np.subtract(errors, lowest)
    spread = float(difference.std(ddof=1)) / math.sqrt(len(difference)) if len(difference) > 1 else 0.0
    return float(difference.mean()) > NUM_STANDARD_ERRORS * spread


class Checkpoints(Checkpoint):
    """Saves ``last.ckpt`` regularly, and ``best.ckpt`` after each validation that is not ``clearly_worse`` than the one with the lowest mean error so far.

    ``last.ckpt`` is saved after every validation, every ``seconds`` between validations, and when training is interrupted. A checkpoint stores the errors that
    the next validation is compared with but no path, so a run's folder can be moved. All ranks save and stop together.

    Args:
        folder: folder of the two files.
        seconds: time from one ``last.ckpt`` to the next between validations [s].
        interruption: notes signals from the first step on. After one, ``last.ckpt`` is saved and training ends with ``KeyboardInterrupt``.
        validation: has the errors of the last validation.
        starts_trained: whether the model has been trained before. It is then validated before the first step, too, and is ``best.ckpt`` at first.

    Attributes:
        best_step: training step of ``best.ckpt``, 0 for the model before the first step; None if there is none.
        lowest: errors [m², trajectory] of the validation with the lowest mean; None before the first one.
        saved_step: training step of ``last.ckpt``; None if this process has neither loaded nor saved it.
        has_begun: whether a training step has begun. By then, all of ``last.ckpt`` has been restored.
    """

    def __init__(
        self, folder: Path, seconds: float, interruption: Interruption, validation: RolloutValidation, starts_trained: bool = False
    ) -> None:
        self.best, self.last = folder / "best.ckpt", folder / "last.ckpt"
        self.seconds, self.interruption, self.validation, self.starts_trained = seconds, interruption, validation, starts_trained
        self.best_step: int | None = None
        self.lowest: list[float] | None = None
        self.saved_step: int | None = None
        self.has_begun = False
        self._saved_at = time.monotonic()

    def where_saved(self) -> str | None:
        """Return the path and step of ``last.ckpt``, for messages; None if there is none."""
        if not self.last.exists():
            return None
        return str(self.last) if self.saved_step is None else f"{self.last}, step {self.saved_step}"

    # --- when ----------------------------------------------------------------------------------------------------------------------------

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.has_begun, self._saved_at = True, time.monotonic()
        self.interruption.listen()
        if self.starts_trained and trainer.global_step == 0:
            simulator: Any = pl_module.simulator
            self.validation.measured(simulator)
            self._keep(trainer, self.validation.errors)
            log.info("before the first step: rollout MSE %.3g m² on validation trajectories", np.mean(self.validation.errors))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int) -> None:
        interval = trainer.val_check_batch
        assert isinstance(interval, int)
        if trainer.global_step % interval == 0:
            return  # the validation comes next and saves; a run resumed from before it would skip it
        is_due = time.monotonic() - self._saved_at >= self.seconds
        stops, saves = self._agreed(pl_module, self.interruption.requested, is_due)
        if stops or saves:
            self._save_last(trainer)
        if stops:
            raise KeyboardInterrupt

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self.lowest is None or not clearly_worse(self.validation.errors, self.lowest):
            self._keep(trainer, self.validation.errors)
        self._save_last(trainer)
        if self._agreed(pl_module, self.interruption.requested)[0]:
            raise KeyboardInterrupt

    def _keep(self, trainer: L.Trainer, errors: list[float]) -> None:
        self.best_step = trainer.global_step
        if self.lowest is None or float(np.mean(errors)) < float(np.mean(self.lowest)):
            self.lowest = errors
        trainer.save_checkpoint(self.best, weights_only=False)

    def _save_last(self, trainer: L.Trainer) -> None:
        trainer.save_checkpoint(self.last, weights_only=False)
        self.saved_step, self._saved_at = trainer.global_step, time.monotonic()

    @staticmethod
    def _agreed(module: L.LightningModule, *wishes: bool) -> list[bool]:
        """For each wish, return whether any rank has it. All ranks get the same answer."""
        if ranks.num_ranks() == 1:
            return list(wishes)
        return [bool(count) for count in ranks.summed(torch.tensor(wishes, dtype=torch.int64, device=module.device)).tolist()]

    @contextmanager
    def taken_up(self) -> Iterator[None]:
        """Raise ``CheckpointError`` if Lightning fails to restore ``last.ckpt`` inside this context. Other errors are not converted."""
        try:
            yield
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            is_restoring = came_through(error, RESTORING) and not came_through(error, "torch.distributed")
            if self.has_begun or not is_restoring or isinstance(error, GpeError | torch.OutOfMemoryError):
                raise
            raise CheckpointError(
                f"{self.last}: training cannot resume from it ({reason(error)}); delete the file, and the same command trains from the start"
            ) from None

    # --- what is remembered ---------------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        return {"best_step": self.best_step, "lowest": self.lowest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the step of the best checkpoint and the lowest errors from the result of ``state_dict``, unless ``best.ckpt`` is missing.

        Raises:
            CheckpointError: ``state_dict`` holds something else.
        """
        step, lowest = (state_dict.get(key) for key in ("best_step", "lowest"))
        if lowest is None:
            return  # saved before the first validation, or by an earlier version: the next validation is the best so far
        if not (type(step) is int and type(lowest) is list and lowest and all(type(error) is float for error in lowest)):
            raise CheckpointError(f"{self.last}: does not hold step and errors of the best checkpoint; delete the file")
        if self.best.exists():
            self.best_step, self.lowest = step, lowest

    def on_load_checkpoint(self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]) -> None:
        self.saved_step = checkpoint["global_step"]


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes a checkpoint to a temporary file in the same folder and renames it.

    Lightning's own class writes into the system's temporary folder and copies the file if that is another disk. A run that is killed during the copy loses
    both the old checkpoint and the new one.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        replace_bytes(Path(path), content.getbuffer())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = True) -> dict[str, Any]:
        """Return the content of a checkpoint. Only tensors and plain values are unpickled, whatever ``weights_only`` is.

        Raises:
            CheckpointError: the file is damaged, or not a checkpoint.
        """
        try:
            return load_checkpoint(path, map_location)
        except CheckpointError as error:
            raise CheckpointError(f"{error}; delete the file, and the same command trains from the start") from None
