"""Data sets of a configuration: specification, folder, and generation of missing parts."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from gpe_pl.config.entry_point import LARGEST_INTEGER, ConfigError, compose, construct, construct_target
from gpe_pl.config.typed_keys import TABLES
from gpe_pl.files.names import data_name, spacing_suffix
from gpe_pl.schema import SPLITS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from omegaconf import DictConfig

    from gpe_pl.data.ground_truth import DatasetSpec
    from gpe_pl.evaluation.material_controls import MaterialControls
    from gpe_pl.evaluation.settings import EvaluationSettings
    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.trajectory.trajectory import Metadata

IMPORTED = "imported"
"""Value of ``data.size`` for imported data. Generated data have the name of their size."""

AUTOMATIC_BYTES = 2**30
"""``fit`` and ``evaluate`` generate data sets up to this size [bytes]. Generate larger ones with ``simulate``."""

STRIDE = "stride"
"""Key of ``data`` with the number of stored frames in a frame of a model. It selects frames when data are read; stored data do not depend on it."""
SPACING, SCALES = "spacing_factor", "scales"
"""Keys of ``data`` with the factor on the spacing of nodes, which other keys contain, and with the scales of a training (``ScaleGrid``)."""
SPACED_SCENE = "gpe_pl.solvers.scenes.BodyScene"
"""Class of the scenes whose spacing has the factor ``spacing_factor``."""


@dataclass(frozen=True)
class ScaleGrid:
    """Spacings and frame intervals of a training. The training data have all pairs of them.

    Attributes:
        spacing_factors: values of ``data.spacing_factor``.
        strides: values of ``data.stride``.
    """

    spacing_factors: Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1)]
    strides: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]


def stride_of(cfg: DictConfig) -> int:
    """Return ``data.stride``; raise ``ConfigError`` if it is not an integer of at least 1."""
    stride = cfg.data.get(STRIDE, 1)
    if type(stride) is not int or not 1 <= stride <= LARGEST_INTEGER:
        raise ConfigError(f"data.stride={stride!r}: must be an integer of at least 1, the number of stored frames in a frame of the model")
    return stride


def check_without_stride(cfg: DictConfig) -> None:
    """Raise ``ConfigError`` if ``data.stride`` is set for a command that works with stored frames."""
    if stride_of(cfg) != 1:
        raise ConfigError(
            f"data.stride={stride_of(cfg)}: solvers store every frame; leave it out here, and train or evaluate with it on the same data"
        )


def dataset_spec(cfg: DictConfig) -> DatasetSpec:
    """Return the specification of a config's data set.

    Raises:
        ConfigError: the data set does not have the size, or a setting of the data, the scene or the solver is not allowed. The message names key and value.
    """
    from gpe_pl.data.chosen_scenes import read

    spec = _spec(cfg)
    chosen = tuple(number for choice in read(dataset_folder(cfg)) for number in choice.scenes)
    if chosen and len(chosen) != spec.num_train:
        raise ConfigError(
            f"data.num_train={spec.num_train}: models chose {len(chosen)} training scenes of {dataset_folder(cfg)}; set data.num_train={len(chosen)}, "
            "or choose more with `python -m gpe_pl.simulate` and active.models"
        )
    return replace(spec, train_scenes=chosen) if chosen else spec


def dataset_folder(cfg: DictConfig) -> Path:
    """Return the folder of a generated data set, which need not exist."""
    return Path(cfg.paths.data) / str(cfg.data.name) / str(cfg.size.name)


def _spec(cfg: DictConfig) -> DatasetSpec:
    from omegaconf import OmegaConf

    from gpe_pl.data.ground_truth import DatasetSpec

    if cfg.data.get(SPACING, 1) != 1 or cfg.data.get(SCALES) is not None:
        _check_spacing(cfg)
    if cfg.size.name not in cfg.data.sizes:
        raise ConfigError(f"size={cfg.size.name}: data={cfg.data.name} has the sizes {', '.join(cfg.data.sizes)}")
    values: dict[str, Any] = OmegaConf.to_container(cfg.data, resolve=True)  # type: ignore[assignment]
    for key in (*TABLES, STRIDE, SPACING, SCALES):
        values.pop(key, None)
    scene = construct_target(values.pop("scene"), "data.scene", "gpe_pl.solvers.")
    solver = construct_target(values.pop("solver"), "data.solver", "gpe_pl.solvers.")
    return construct(DatasetSpec, values, "data", scene=scene, solver=solver)


def candidate_spec(cfg: DictConfig, num_candidates: int) -> DatasetSpec:
    """Return the data set with all candidates for a choice as its training scenes. Errors are those of ``dataset_spec``."""
    return replace(_spec(cfg), num_train=num_candidates)


def dataset(*overrides: str) -> DatasetSpec:
    """Return the specification of a data set from overrides of the command line, such as ``dataset("data=sand", "size=tiny")``.

    Raises:
        ConfigError: an override is not valid, or as in ``dataset_spec``.
    """
    cfg = compose("simulate", overrides)
    check_without_stride(cfg)
    return dataset_spec(cfg)


def imported_data(cfg: DictConfig) -> Path:
    """Return the folder of an imported data set; raises ``ConfigError`` if it does not exist."""
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
    """Return the folder of the config's data set. Missing parts of a small data set are generated.

    Raises:
        ConfigError: the data set is missing and larger than ``AUTOMATIC_BYTES``, or imported data do not exist.
    """
    from gpe_pl.data.generation import dataset_bytes, generate
    from gpe_pl.system.progress import progress_bar

    if cfg.data.size == IMPORTED:  # imported data are complete
        return imported_data(cfg)
    spec = dataset_spec(cfg)
    folder = Path(cfg.paths.data) / spec.name / spec.size
    if dataset_bytes(spec) > AUTOMATIC_BYTES and not (folder / "statistics.json").exists():
        same = "the data, parameters, scene, dimension and size of this command"
        raise ConfigError(f"{folder}: no data; generate it first with `python -m gpe_pl.simulate` and {same}")
    with progress_bar(f"{spec.name} {spec.size}") as on_progress:
        return generate(cfg.paths.data, spec, os.cpu_count() or 1, on_progress)


def scene_metadata(cfg: DictConfig, split: str, strided: bool = True) -> Metadata:
    """Return the metadata of the first scene of a split. Imported data must exist. Generated data need not, because their configuration determines them.

    Args:
        cfg: configuration of a command.
        split: split of the data set.
        strided: describe frames of the model, each of which has ``data.stride`` stored frames; False describes the stored frames.
    """
    from gpe_pl.data.ground_truth import trajectory_metadata
    from gpe_pl.trajectory.store import iter_trajectories

    if cfg.data.size == IMPORTED:
        stored = next(iter_trajectories(imported_data(cfg), split)).metadata
    else:
        stored = trajectory_metadata(dataset_spec(cfg), split, 0)
    return stored.every(stride_of(cfg)) if strided else stored


def ensure_split(cfg: DictConfig, split: str) -> Path:
    """Return the folder of a data set that contains a split. Missing data are generated.

    If the config's data set exists, it is completed. If not, only this split and one training trajectory are generated, as a data set named
    ``{name}_{split}``. Errors are those of ``ensure_data``.
    """
    from omegaconf import OmegaConf

    from gpe_pl.data.chosen_scenes import SPEC_FILE

    if (
        cfg.data.size != IMPORTED
        and not (Path(cfg.paths.data) / data_name(cfg.data.name, "data.name") / cfg.size.name / SPEC_FILE).exists()
    ):
        counts = {f"num_{s}": cfg.data[f"num_{s}"] if s == split else int(s == "train") for s in SPLITS}
        only: Any = OmegaConf.merge(cfg, {"data": {"name": f"{cfg.data.name}_{split}", **counts}})
        return ensure_data(only)
    return ensure_data(cfg)


def evaluated_config(cfg: DictConfig) -> DictConfig:
    """Return the config with ``data`` as the evaluation needs it: that of the training, with the keys of ``evaluation.data`` replaced."""
    from omegaconf import OmegaConf

    given: Any = cfg.evaluation.data or {}
    merged: Any = OmegaConf.merge(cfg, _spaced(cfg, given[SPACING]) if SPACING in given else {}, {"data": given})
    return merged


def _spaced(cfg: DictConfig, factor: float | int) -> dict[str, Any]:
    """Return what a resolved config replaces for another ``data.spacing_factor``: the settings in ``conf`` that contain it.

    Raises:
        ConfigError: the data have no such factor.
    """
    _check_spacing(cfg)
    before = cfg.data[SPACING]
    if factor == before:
        return {}
    grid = {"grid_spacing": factor * (cfg.data.scene.grid_spacing / before)}
    name = cfg.data.name.removesuffix(spacing_suffix(before)) + spacing_suffix(factor)
    return {"data": {SPACING: factor, "name": name, "scene": grid, "solver": grid}}


def _check_spacing(cfg: DictConfig) -> None:
    """Raise ``ConfigError`` if the spacing of the data has no factor. A factor would then change nothing but the configuration."""
    kind = (cfg.data.get("scene") or {}).get("_target_", "")
    if kind != SPACED_SCENE:
        scenes = f"scenes of {kind.rpartition('.')[2]}" if kind else "imported scenes"
        raise ConfigError(
            f"data.spacing_factor, data.scales: the spacing of {scenes} has no factor; choose data of bodies of particles, such as data=sand"
        )


def training_parts(cfg: DictConfig) -> list[DictConfig]:
    """Return the config of each pair of spacing and stride in ``data.scales``; without it, the config itself.

    Raises:
        ConfigError: ``data.scales`` is not valid, or other settings allow one scale only.
    """
    from omegaconf import OmegaConf

    if (given := cfg.data.get(SCALES)) is None:
        return [cfg]
    scales = construct(ScaleGrid, given, "data.scales")
    if cfg.graph.scales == "one":
        raise ConfigError("data.scales: the model has to take several scales; set graph.scales=dimensionless")
    if (cfg.training.unroll_steps or 1) > 1 or cfg.training.targets != "trajectory":
        raise ConfigError("data.scales: works with training.targets=trajectory and training.unroll_steps=null only")
    spaced = [OmegaConf.merge(cfg, _spaced(cfg, factor)) for factor in scales.spacing_factors]
    return [OmegaConf.merge(own, {"data": {STRIDE: stride, SCALES: None}}) for own in spaced for stride in scales.strides]  # type: ignore[misc]


def check_same_frames(trained: Metadata, evaluated: Metadata) -> None:
    """Raise ``ConfigError`` if evaluated data have frames of another length than those of the training."""
    if abs(evaluated.frame_dt / trained.frame_dt - 1) > 1e-6:
        raise ConfigError(
            f"evaluation.data: frames of {evaluated.frame_dt:g} s, those of the training have {trained.frame_dt:g} s; "
            "choose another evaluation.data.stride or evaluation.data.solver.frame_dt"
        )


def check_splits(cfg: DictConfig, splits: Sequence[str], key: str) -> None:
    """Raise ``ConfigError`` before any work is done if generated data will have no trajectory in one of these splits, which ``key`` named."""
    if cfg.data.size == IMPORTED:
        return
    counts = dataset_spec(cfg).counts
    for split in splits:
        if not counts[split]:
            there = ", ".join(name for name, count in counts.items() if count)
            raise ConfigError(
                f"{key}={split}: data={cfg.data.name} with size={cfg.size.name} has no such trajectories, only {there}; or set data.num_{split}"
            )


def check_material_controls(cfg: DictConfig, settings: EvaluationSettings) -> None:
    """Raise ``ConfigError`` if an evaluation asks for rollouts with other material parameters (``evaluation.material_controls``) that its data cannot have."""
    from gpe_pl.evaluation.material_controls import UNSEEN

    if settings.material_controls and UNSEEN not in settings.splits:
        raise ConfigError(f"evaluation.material_controls=true: needs the split {UNSEEN}, evaluated are {', '.join(settings.splits)}")
    if settings.material_controls and cfg.data.size == IMPORTED:
        raise ConfigError(f"evaluation.material_controls=true: needs data that this package simulates; data={IMPORTED} has no solver")


def material_controls(
    cfg: DictConfig, settings: EvaluationSettings, root: Path, start_frame: int, simulator: LearnedSimulator | None = None
) -> MaterialControls | None:
    """Return the rollouts with other material parameters that an evaluation on the data in ``root`` compares with, or None if the settings want none.

    Missing runs of the solver are computed, after a check that the trained values are those of ``simulator``, if it is given. ``start_frame`` counts frames of
    the model, each of which has ``data.stride`` stored frames. Errors are those of ``MaterialControls.prepare`` and ``check_trained``.
    """
    from gpe_pl.evaluation.material_controls import MaterialControls
    from gpe_pl.system.progress import progress_bar

    if not settings.material_controls:
        return None
    evaluated = evaluated_config(cfg)
    spec = dataset_spec(evaluated)
    controls = MaterialControls(root, spec, dataset_spec(cfg), start_frame, settings.num_trajectories, stride_of(evaluated))
    if simulator is not None:
        controls.check_trained(simulator)
    with progress_bar(f"{spec.name} {spec.size} controls") as on_progress:
        controls.prepare(os.cpu_count() or 1, on_progress)
    return controls
