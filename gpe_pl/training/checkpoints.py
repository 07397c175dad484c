"""Checkpoints of a run: decides when to save, keeps the best score, and writes each file whole or not at all."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from gpe_pl.errors import GpeError
from gpe_pl.files.atomic import replace_bytes
from gpe_pl.learned.checkpoint_file import CheckpointError, load_checkpoint, reason
from gpe_pl.system import ranks
from gpe_pl.training.interruption import Interruption

SCORE = "val/rollout_mse"
"""Metric of a validation; the model with its lowest value becomes the best checkpoint."""


class Checkpoints(Checkpoint):
    """Saves ``last.ckpt`` regularly, and ``best.ckpt`` after each validation with the best score so far.

    ``last.ckpt`` is saved after every validation, every ``seconds`` between validations, and when training is interrupted. A checkpoint stores the best score
    and its step but no path, so a run's folder can be moved. All ranks save and stop together.

    Args:
        folder: folder of the two files.
        seconds: time from one ``last.ckpt`` to the next between validations [s].
        interruption: notes signals from the first step on. After one, ``last.ckpt`` is saved and training ends with ``KeyboardInterrupt``.

    Attributes:
        best_score: validation score of ``best.ckpt`` [m²]; None if there is none.
        best_step: training step of ``best.ckpt``; None if there is none.
        saved_step: training step of ``last.ckpt``; None if this process has neither loaded nor saved it.
        has_begun: whether a training step has begun. By then, all of ``last.ckpt`` has been restored.
    """

    def __init__(self, folder: Path, seconds: float = math.inf, interruption: Interruption | None = None) -> None:
        self.best, self.last = folder / "best.ckpt", folder / "last.ckpt"
        self.seconds, self.interruption = seconds, interruption or Interruption()
        self.best_score: float | None = None
        self.best_step: int | None = None
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
        score = float(trainer.callback_metrics[SCORE])
        if self.best_score is None or score < self.best_score:
            self.best_score, self.best_step = score if math.isfinite(score) else math.inf, trainer.global_step
            trainer.save_checkpoint(self.best, weights_only=False)
        self._save_last(trainer)
        if self._agreed(pl_module, self.interruption.requested)[0]:
            raise KeyboardInterrupt

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
        """Raise ``CheckpointError`` if Lightning fails to restore ``last.ckpt`` inside this context. Errors of later training steps are not converted."""
        try:
            yield
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            if self.has_begun or not self.last.exists() or isinstance(error, GpeError | torch.OutOfMemoryError):
                raise
            raise CheckpointError(
                f"{self.last}: training cannot resume from it ({reason(error)}); delete the file, and the same command trains from the start"
            ) from None

    # --- what is remembered ---------------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        return {"best_score": self.best_score, "best_step": self.best_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the best score and its step from the result of ``state_dict``, unless ``best.ckpt`` is missing.

        Raises:
            CheckpointError: ``state_dict`` holds something else.
        """
        score, step = (state_dict.get(key) for key in ("best_score", "best_step"))
        if (score, step) != (None, None) and not (type(score) is float and type(step) is int):
            raise CheckpointError(f"{self.last}: does not hold the score and step of the best checkpoint; delete the file")
        if self.best.exists():  # else the next validation is the best so far
            self.best_score, self.best_step = score, step

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
