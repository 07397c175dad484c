"""Training runs of seconds: composed configs, and the smallest data set with all features."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from gpe_pl.config.datasets import dataset_spec
from gpe_pl.config.folder import CONF
from gpe_pl.data.generation import generate

DATA = [
    "size=tiny",
    *(f"++data.sizes.tiny.{key}={value}" for key, value in {
        "num_train": 2, "num_val": 1, "num_test": 1, "num_test_unseen": 2, "num_frames": 12,
        "d2.num_particles": 30, "trajectories_per_shard": 2,
    }.items()),
]  # fmt: skip
RUN = [
    *("size.num_message_passing_steps=1", "size.hidden_channels=8", "graph.history=2"),
    *("training.num_steps=2", "training.val_interval=1", "training.num_val_rollouts=1", "training.val_rollout_steps=3"),
    *("trainer.progress=false", "trainer.num_threads=1", "evaluation.num_pictures=0", "evaluation.horizons=[0.025]"),
]


def compose(name: str, *overrides: str, hydra_config: bool = False) -> DictConfig:
    """Return a config as an entry point receives it.

    Folders are set afterwards, so that configs which differ only in them are composed once (``tests.settings_files``).
    """
    folders = [] if hydra_config else [each for each in overrides if each.startswith("paths.")]
    GlobalHydra.instance().clear()
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = hydra.compose(name, [each for each in overrides if each not in folders], return_hydra_config=hydra_config)
    for key, folder in (each.split("=", 1) for each in folders):
        OmegaConf.update(cfg, key, folder)
    if not hydra_config:
        OmegaConf.resolve(cfg)
    return cfg


def tiny(data: Path, runs: Path, *overrides: str) -> DictConfig:
    """Return the config of a run of two steps on the tiny data set."""
    # Most experiments do not read these, so commands refuse them.
    unread = ("size.comparison.budget_minutes=1e-5", "++data.sizes.tiny.larger_num_particles=60")
    return compose("fit", *DATA, *RUN, *unread, f"paths.data={data}", f"paths.runs={runs}", *overrides)


def generate_tiny(folder: Path) -> Path:
    """Generate the tiny data set in this process; return ``folder``."""
    generate(folder, dataset_spec(compose("simulate", *DATA)), 1)
    return folder


def first_choices(experiment: str) -> list[str]:
    """Return the first value of every axis that an experiment sweeps over."""
    params: Any = compose("fit", f"experiment={experiment}", hydra_config=True).hydra.sweeper.params
    return [f"{key}={_first_choice(str(values))}" for key, values in (params or {}).items()]


def _first_choice(values: str) -> str:
    interval = re.search(r"interval\(([^,]+),", values)
    return interval.group(1) if interval else values.split(",")[0]
