"""Loads the file of a checkpoint, or says in one line why it cannot be loaded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import did_you_mean
from gpe_pl.learned.checkpoint_archive import check_archive, check_values
from gpe_pl.learned.pretrained import names


class CheckpointError(GpeError, ValueError):
    """Raised when a checkpoint is missing, damaged, or not one of gpe_pl; the message names the file and says what to do."""


def load_checkpoint(path: Path | str, device: Any = "cpu") -> Any:
    """Return the content of a checkpoint. Only tensors and plain values are unpickled.

    The checksums of the archive are compared first, because PyTorch does not compare them.

    Raises:
        CheckpointError: the file does not exist, is damaged, or has any other content.
    """
    if not Path(path).is_file():
        shipped = f", or a shipped model: {', '.join(names())}" if names() else ""
        raise CheckpointError(
            f"{path}: no such checkpoint{did_you_mean(str(path), names())}; give the folder of a run, the path of a checkpoint{shipped}"
        )
    try:
        check_archive(Path(path))
        values = torch.load(path, map_location=device, weights_only=True)
        check_values(values)
        return values
    except Exception as error:  # zipfile and torch raise many types for damaged or unsafe files
        raise CheckpointError(
            f"{path}: not a safe, complete checkpoint ({reason(error)}); if it was copied, copy it again, or take another of the run, such as last.ckpt"
        ) from None


def reason(error: Exception) -> str:
    """Return the type and message of an error in one line of bounded length."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
