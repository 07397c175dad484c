"""Evaluate a checkpoint: ``python -m gpe_pl.evaluate checkpoint=… split=test_unseen``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gpe_pl.config import ConfigError, construct, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig


def evaluate_checkpoint(cfg: DictConfig) -> None:
    """Roll a trained model out on one split of a data set; numbers and pictures go to ``{paths.runs}/{name}``."""
    from gpe_pl.evaluation import EvaluationSettings, evaluate
    from gpe_pl.learned_simulator import LearnedSimulator
    from gpe_pl.pretrained import checkpoint_path, names
    from gpe_pl.report import summary
    from gpe_pl.simulate import ensure_data, evaluated_config

    if not isinstance(cfg.checkpoint, str):
        shipped = f", or a shipped model: {', '.join(names())}" if names() else ""
        raise ConfigError(f"checkpoint={cfg.checkpoint!r}: name a checkpoint of a run, such as runs/sand/checkpoints/best.ckpt{shipped}")
    settings = construct(
        EvaluationSettings, {**{k: v for k, v in cfg.evaluation.items() if k != "data"}, "splits": [cfg.split]}, "evaluation"
    )
    simulator = LearnedSimulator.from_checkpoint(checkpoint_path(cfg.checkpoint))
    root = ensure_data(evaluated_config(cfg))
    folder = Path(cfg.paths.runs) / cfg.name
    rows = evaluate(simulator, root, settings, folder)
    print(summary(rows))
    print(folder)


main = entry_point("evaluate")(evaluate_checkpoint)

if __name__ == "__main__":
    main()
