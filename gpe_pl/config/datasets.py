"""From a configuration to its data set: description, folder, and generation of what is missing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.config.entry_point import ConfigError, compose, construct, construct_target
from gpe_pl.files.names import data_name
from gpe_pl.schema import SPLITS

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.data.ground_truth import DatasetSpec
    from gpe_pl.trajectory.trajectory import Metadata

IMPORTED = "imported"
"""Where data that are generated have their size, those that ``convert`` made have this."""

AUTOMATIC_BYTES = 2**30
"""``fit`` generates data sets smaller than this by itself; larger ones are asked for with ``simulate``."""


def dataset_spec(cfg: DictConfig) -> DatasetSpec:
    """The data set that a config describes; raises ``ConfigError`` that names key and value."""
    from omegaconf import OmegaConf

    from gpe_pl.data.ground_truth import DatasetSpec

    if cfg.size.name not in cfg.data.sizes:
        raise ConfigError(f"size={cfg.size.name}: data={cfg.data.name} has the sizes {', '.join(cfg.data.sizes)}")
    values: dict[str, Any] = OmegaConf.to_container(cfg.data, resolve=True)  # type: ignore[assignment]
    for table in ("sizes", "dimensions", "default_dimension", "variant", "suffix", "bounds", "larger", "comparison", "showcase"):
        values.pop(table, None)
    scene = construct_target(values.pop("scene"), "data.scene", "gpe_pl.solvers.")
    solver = construct_target(values.pop("solver"), "data.solver", "gpe_pl.solvers.")
    return construct(DatasetSpec, values, "data", scene=scene, solver=solver)


def dataset(*overrides: str) -> DatasetSpec:
    """The data set that overrides of the command line describe, such as ``dataset("data=sand", "size=tiny")``."""
    return dataset_spec(compose("simulate", overrides))


def imported_data(cfg: DictConfig) -> Path:
    """Folder of an imported data set; raises ``ConfigError`` where there is none."""
    if cfg.data.name is None:
        raise ConfigError("data.name=null: name the imported data set, as `python -m gpe_pl.convert name=…` did")
    folder = Path(cfg.paths.data) / data_name(cfg.data.name, "data.name") / IMPORTED
    if not (folder / "statistics.json").is_file():
        there = ", ".join(sorted(path.parent.parent.name for path in Path(cfg.paths.data).glob(f"*/{IMPORTED}/statistics.json"))) or "none"
        raise ConfigError(
            f"data.name={cfg.data.name}: no imported data in {folder}; make them with `python -m gpe_pl.convert name={cfg.data.name} format=… source=…` "
            f"(imported are: {there})"
        )
    return folder


def ensure_data(cfg: DictConfig) -> Path:
    """Folder of the config's data set; generates what is missing if the data set is small."""
    from gpe_pl.data.generation import dataset_bytes, generate
    from gpe_pl.system.progress import progress_bar

    if cfg.data.size == IMPORTED:  # used as they are
        return imported_data(cfg)
    spec = dataset_spec(cfg)
    folder = Path(cfg.paths.data) / spec.name / spec.size
    if dataset_bytes(spec) > AUTOMATIC_BYTES and not (folder / "statistics.json").exists():
        raise ConfigError(f"{folder}: no data; generate it first with `python -m gpe_pl.simulate data={spec.name} size={spec.size}`")
    with progress_bar(f"{spec.name} {spec.size}") as on_progress:
        return generate(cfg.paths.data, spec, os.cpu_count() or 1, on_progress)


def scene_metadata(cfg: DictConfig, split: str) -> Metadata:
    """What is known of the scenes of a split before any is generated."""
    from gpe_pl.data.ground_truth import trajectory_metadata
    from gpe_pl.trajectory.store import iter_trajectories

    if cfg.data.size == IMPORTED:
        return next(iter_trajectories(imported_data(cfg), split)).metadata
    return trajectory_metadata(dataset_spec(cfg), split, 0)


def ensure_split(cfg: DictConfig, split: str) -> Path:
    """Folder of the config's data set; where it does not exist, of one that has nothing but this split and a single training trajectory."""
    from omegaconf import OmegaConf

    from gpe_pl.data.generation import SPEC_FILE

    if (
        cfg.data.size != IMPORTED
        and not (Path(cfg.paths.data) / data_name(cfg.data.name, "data.name") / cfg.size.name / SPEC_FILE).exists()
    ):
        counts = {f"num_{s}": cfg.data[f"num_{s}"] if s == split else int(s == "train") for s in SPLITS}
        only: Any = OmegaConf.merge(cfg, {"data": {"name": f"{cfg.data.name}_{split}", **counts}})
        return ensure_data(only)
    return ensure_data(cfg)


def evaluated_config(cfg: DictConfig) -> DictConfig:
    """The config with the data to evaluate on, which ``evaluation.data`` says how to get from those to train on."""
    from omegaconf import OmegaConf

    merged: Any = OmegaConf.merge(cfg, {"data": cfg.evaluation.data})
    return merged
