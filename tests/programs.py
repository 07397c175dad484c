"""Export of programs in tests."""

from __future__ import annotations

from pathlib import Path

import jaxtyping

from gpe_pl.export.program import export_model
from gpe_pl.learned.simulator import LearnedSimulator


def exported(learned: LearnedSimulator, path: Path) -> Path:
    """Export a program. Lengths are symbols during export, which the tests' type checks do not accept as numbers."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        export_model(learned, path)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    return path
