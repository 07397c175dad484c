"""Evaluate a checkpoint: ``python -m gpe_pl.evaluate checkpoint=… split=test_unseen``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gpe_pl.config import ConfigError, construct, construct_target, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.learned_simulator import LearnedSimulator


def evaluate_checkpoint(cfg: DictConfig) -> None:
    """Roll a trained model out on one split of a data set, and in the scene's showcase if it has one; numbers and pictures go to ``{paths.runs}/{name}``."""
    from gpe_pl.evaluation import EvaluationSettings, evaluate
    from gpe_pl.learned_simulator import LearnedSimulator
    from gpe_pl.pretrained import names
    from gpe_pl.report import summary
    from gpe_pl.simulate import ensure_split, evaluated_config
    from gpe_pl.skips import Skips
    from gpe_pl.training.run import TrainerSettings, set_up

    if not isinstance(cfg.checkpoint, str):
        shipped = f", or a shipped model: {', '.join(names())}" if names() else ""
        raise ConfigError(f"checkpoint={cfg.checkpoint!r}: name a checkpoint of a run, such as runs/sand/checkpoints/best.ckpt{shipped}")
    settings = construct(
        EvaluationSettings, {**{k: v for k, v in cfg.evaluation.items() if k != "data"}, "splits": [cfg.split]}, "evaluation"
    )
    device = set_up(construct(TrainerSettings, cfg.trainer, "trainer"))
    simulator = LearnedSimulator.from_checkpoint(cfg.checkpoint, device)
    simulator.skips = construct(Skips, cfg.rollout, "rollout")
    root = ensure_split(evaluated_config(cfg), cfg.split)
    folder = Path(cfg.paths.runs) / cfg.name
    rows = evaluate(simulator, root, settings, folder)
    print(summary(rows))
    if cfg.data.get("showcase") is not None:
        _show(cfg, simulator, folder)
    print(folder)


def _show(cfg: DictConfig, simulator: LearnedSimulator, folder: Path) -> None:
    from gpe_pl import showcase
    from gpe_pl.generation import progress_bar

    settings = construct(showcase.ShowcaseSettings, {k: v for k, v in cfg.data.showcase.items() if k != "scene"}, "data.showcase")
    scene = construct_target(cfg.data.showcase.scene, "data.showcase.scene", "gpe_pl.solvers.")
    with progress_bar("showcase") as on_progress:
        records = showcase.run(simulator, scene, settings, folder, on_progress)
    print(showcase.summary(records))


main = entry_point("evaluate")(evaluate_checkpoint)

if __name__ == "__main__":
    main()
