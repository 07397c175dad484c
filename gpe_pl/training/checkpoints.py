"""How a run's checkpoints reach the disk: whole or not at all, and only sound ones come back."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io import TorchCheckpointIO

from gpe_pl.atomic import replacing
from gpe_pl.learned_simulator import CheckpointError, load_checkpoint


class AtomicCheckpoints(TorchCheckpointIO):
    """Checkpoints are written beside their place and renamed.

    Lightning writes them into the system's temporary folder, from where they are copied if that is another disk: a run that is killed meanwhile loses
    both the old checkpoint and the new one.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        with replacing(Path(path)) as part:
            part.write_bytes(content.getbuffer())

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = True) -> dict[str, Any]:
        """Only tensors and plain values are unpickled, whatever the caller asks for.

        Raises:
            CheckpointError: not a readable checkpoint, or damaged.
        """
        try:
            return load_checkpoint(path, map_location)
        except CheckpointError as error:
            raise CheckpointError(f"{error}; delete the file, and the same command trains from the start") from None
