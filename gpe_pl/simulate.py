"""Command ``python -m gpe_pl.simulate data=sand size=tiny``: generate ground truth.

The same command resumes a killed run. It reads all existing shards and generates a shard again if its checksums do not match.
"""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from gpe_pl.config.datasets import AUTOMATIC_BYTES, candidate_spec, check_without_stride, dataset_spec
from gpe_pl.config.entry_point import ConfigError, construct, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.data.ground_truth import DatasetSpec


def simulate(cfg: DictConfig) -> None:
    """Generate the missing and damaged shards of a data set. For a large one, print first how much disk space and time it takes."""
    from gpe_pl.data.generation import CONTACT_SHEET_FILE, is_complete, written

    if not (cfg.num_workers is None or (isinstance(cfg.num_workers, int) and cfg.num_workers >= 1)):
        raise ConfigError(f"num_workers={cfg.num_workers!r}: must be null (one per core) or an integer of at least 1")
    if not (isinstance(cfg.num_parts, int) and isinstance(cfg.part, int) and 0 <= cfg.part < cfg.num_parts):
        raise ConfigError(f"part={cfg.part!r}, num_parts={cfg.num_parts!r}: must be integers with 0 <= part < num_parts")
    check_without_stride(cfg)
    _choose_scenes(cfg)
    spec, num_workers = dataset_spec(cfg), cfg.num_workers or os.cpu_count() or 1
    part = (cfg.part, cfg.num_parts)
    with nullcontext() if is_complete(cfg.paths.data, spec, part) else written(cfg.paths.data, spec, part):
        folder = _simulate(cfg.paths.data, spec, part, num_workers)
    for path in (folder / CONTACT_SHEET_FILE, folder):
        if path.exists():  # only the first part draws the sheet
            print(path)


def _choose_scenes(cfg: DictConfig) -> None:
    """Let the models of ``active.models`` choose the training scenes that the data set lacks."""
    from gpe_pl.data.generation import written
    from gpe_pl.evaluation.active import ActiveSettings, choose
    from gpe_pl.system.progress import progress_bar

    settings = construct(ActiveSettings, cfg.active, "active")
    if settings.models is None:
        return
    if cfg.num_parts > 1:
        raise ConfigError("active.models: choose scenes with num_parts=1; parts can simulate them afterwards, without active.models")
    pool = candidate_spec(cfg, settings.num_candidates)
    with written(cfg.paths.data, pool), progress_bar(f"{pool.name} {pool.size} candidates") as on_progress:
        choice = choose(cfg.paths.data, pool, cfg.data.num_train, settings, on_progress)
    if choice is None:
        print(f"{pool.name} {pool.size}: has at least {cfg.data.num_train} training scenes; nothing to choose")
        return
    print(
        f"{pool.name} {pool.size}: chose scenes {', '.join(map(str, choice.scenes))}, in which the models are {min(choice.spread):.3g} to "
        f"{max(choice.spread):.3g} spacings apart (median of all candidates: {choice.median_spread:.3g})"
    )


def _simulate(root: str, spec: DatasetSpec, part: tuple[int, int], num_workers: int) -> Path:
    from gpe_pl.data.generation import discard_damaged, generate, plan, seconds_per_trajectory
    from gpe_pl.system.progress import progress_bar

    there = sum(path.stat().st_size for path in (Path(root) / spec.name / spec.size).glob("*/shard-*.h5"))
    if there > AUTOMATIC_BYTES:
        print(f"{spec.name} {spec.size}: checking {there / 2**30:.1f} GiB of existing shards", flush=True)
    discard_damaged(root, spec, num_workers, part)
    missing = plan(root, spec, part)
    if missing.bytes_needed > AUTOMATIC_BYTES:
        print(
            f"{spec.name} {spec.size}: {missing.num_missing} trajectories to simulate, up to {missing.bytes_needed / 2**30:.1f} GiB "
            f"({missing.bytes_free / 2**30:.1f} GiB free)",
            flush=True,
        )
        if missing.fits:
            hours = missing.num_missing * seconds_per_trajectory(spec) / num_workers / 3600
            print(f"{spec.name} {spec.size}: about {hours:.1f} h on {num_workers} cores", flush=True)
    with progress_bar(f"{spec.name} {spec.size}") as on_progress:
        return generate(root, spec, num_workers, on_progress, part)


main = entry_point("simulate")(simulate)

if __name__ == "__main__":
    main()
