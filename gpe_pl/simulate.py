"""Generate ground truth: ``python -m gpe_pl.simulate data=sand size=tiny``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.config import ConfigError, construct, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.generation import DatasetSpec

AUTOMATIC_BYTES = 2**30
"""``fit`` generates data sets smaller than this by itself; larger ones are asked for with ``simulate``."""


def dataset_spec(cfg: DictConfig) -> DatasetSpec:
    """The data set that a config describes; raises ``ConfigError`` that names key and value."""
    from omegaconf import OmegaConf

    from gpe_pl.generation import DatasetSpec
    from gpe_pl.solvers.mpm import MPM
    from gpe_pl.solvers.scenes import SceneConfig

    values: dict[str, Any] = OmegaConf.to_container(cfg.data, resolve=True)  # type: ignore[assignment]
    values.pop("sizes")
    if cfg.size.name not in cfg.data.sizes:
        raise ConfigError(f"size={cfg.size.name}: data={cfg.data.name} has the sizes {', '.join(cfg.data.sizes)}")
    scene = construct(SceneConfig, values.pop("scene"), "data.scene")
    solver = construct(MPM, values.pop("solver"), "data.solver")
    return construct(DatasetSpec, values, "data", scene=scene, solver=solver)


def ensure_data(cfg: DictConfig) -> Path:
    """Folder of the config's data set; generates what is missing if the data set is small."""
    from gpe_pl.generation import dataset_bytes, generate, progress_bar

    spec = dataset_spec(cfg)
    folder = Path(cfg.paths.data) / spec.name / spec.size
    if dataset_bytes(spec) > AUTOMATIC_BYTES and not (folder / "statistics.json").exists():
        raise ConfigError(f"{folder}: no data; generate it first with `python -m gpe_pl.simulate data={spec.name} size={spec.size}`")
    with progress_bar(f"{spec.name} {spec.size}") as on_progress:
        return generate(cfg.paths.data, spec, os.cpu_count() or 1, on_progress)


def simulate(cfg: DictConfig) -> None:
    """Generate a data set, or what is missing of it."""
    from gpe_pl.generation import generate, progress_bar

    if not (cfg.num_workers is None or (isinstance(cfg.num_workers, int) and cfg.num_workers >= 1)):
        raise ConfigError(f"num_workers={cfg.num_workers!r}: must be null (one per core) or an integer of at least 1")
    spec = dataset_spec(cfg)
    with progress_bar(f"{spec.name} {spec.size}") as on_progress:
        folder = generate(cfg.paths.data, spec, cfg.num_workers or os.cpu_count() or 1, on_progress)
    print(folder)


main = entry_point("simulate")(simulate)

if __name__ == "__main__":
    main()
