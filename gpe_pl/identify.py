"""Command ``python -m gpe_pl.identify checkpoint=… trajectory=…``: find material parameters from observed motion."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from gpe_pl.config.entry_point import ConfigError, construct, entry_point

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.evaluation.identification.results import Task
    from gpe_pl.trajectory.trajectory import Trajectory


@dataclass(frozen=True, config={"extra": "forbid"})
class Settings:
    """Settings of the command that do not belong to a part of it; ``conf/identify.yaml`` describes them."""

    checkpoint: str
    trajectory: str
    num_scenes: Annotated[int, Field(ge=1)] | None = None
    unknowns: list[str] | None = None
    per_body: bool = False
    bounds: dict[str, tuple[float, float]] | None = None
    simulator: Literal["model", "solver", "both"] = "both"
    calibration: str | None = None
    level: Annotated[float, Field(gt=0, lt=1)] = 0.9


PARTS = ("paths", "trainer", "name", "observations", "shooting", "search")


def identify_scenes(cfg: DictConfig) -> None:
    """Identify the unknowns of each scene that has no answer yet, and write a table of all. Results go to ``{paths.runs}/{name}``."""
    from gpe_pl.evaluation.identification.observations import ObservationSettings
    from gpe_pl.evaluation.identification.results import Task, write_table
    from gpe_pl.evaluation.identification.search import SearchSettings
    from gpe_pl.evaluation.identification.shooting import ShootingSettings
    from gpe_pl.files.names import run_name
    from gpe_pl.files.run_folder import claim, without_orphans
    from gpe_pl.learned.pretrained import names
    from gpe_pl.learned.simulator import LearnedSimulator
    from gpe_pl.system.locks import locked
    from gpe_pl.system.provenance import recorded
    from gpe_pl.training.run import TrainerSettings, set_up

    if not isinstance(cfg.checkpoint, str):
        raise ConfigError(
            f"checkpoint={cfg.checkpoint!r}: name the folder of a run, a checkpoint, or a shipped model: {', '.join(names())}"
        )
    if not isinstance(cfg.trajectory, str):
        raise ConfigError(
            f"trajectory={cfg.trajectory!r}: name a file of trajectories, such as data/sand/tiny/test/shard-00000.h5, or a folder"
        )
    settings = construct(Settings, {key: value for key, value in _plain(cfg).items() if key not in PARTS}, "")
    observations = construct(ObservationSettings, cfg.observations, "observations")
    shooting, search = construct(ShootingSettings, cfg.shooting, "shooting"), construct(SearchSettings, cfg.search, "search")
    simulator = LearnedSimulator.from_checkpoint(cfg.checkpoint, set_up(construct(TrainerSettings, cfg.trainer, "trainer")))
    folder = Path(cfg.paths.runs) / run_name(cfg.name)
    calibrations, calibrated_on = _calibrations(cfg, settings)
    task = Task(
        simulator,
        settings.unknowns,
        settings.per_body,
        settings.bounds or {},
        ("model", "solver") if settings.simulator == "both" else (settings.simulator,),
        observations,
        shooting,
        search,
        calibrations,
        calibrated_on,
    )
    with locked(folder), recorded(folder, "identify", sys.argv[1:], cfg.paths.runs):
        claim(folder, _identity(cfg, calibrated_on), results=["scenes/*"])
        with without_orphans(folder):
            left_out = identify_all(task, scenes(Path(settings.trajectory), settings.num_scenes), folder)
            print(write_table(folder))
            if left_out:
                print(f"scenes that were left out: {len(left_out)}; the first is {left_out[0]}")
    print(folder)


def identify_all(task: Task, named: Iterable[tuple[str, Trajectory]], folder: Path) -> list[str]:
    """Identify scenes, write and print their answers, and return the names of scenes whose motion cannot be used, with the reasons.

    Raises:
        ConfigError: no scene can be used.
    """
    from gpe_pl.evaluation.identification.observations import ObservationError
    from gpe_pl.evaluation.identification.shooting import ShootingError

    left_out, num_answered = list[str](), 0
    for name, trajectory in named:
        try:
            for line in task.run(name, trajectory, folder):
                print(f"{name}: {line}", flush=True)
            num_answered += 1
        except (ObservationError, ShootingError) as error:  # other scenes may have a longer or more complete motion
            left_out.append(f"{name}: {error}")
            print(f"{name}: left out: {error}", flush=True)
    if left_out and not num_answered:
        raise ConfigError(f"no scene can be identified; {left_out[0]}")
    return left_out


def scenes(path: Path, number: int | None) -> Iterator[tuple[str, Trajectory]]:
    """Yield name and trajectory of each scene in a file, or in the files of a folder.

    Raises:
        ConfigError: there is no such file, or the folder has none.
    """
    from itertools import islice

    from gpe_pl.trajectory.store import read_trajectory, trajectory_names

    files = sorted(path.glob("*.h5")) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise ConfigError(f"trajectory={path}: no file *.h5 there; name a file of stored trajectories, or the folder of a split")
    named = ((file, name) for file in files for name in trajectory_names(file))
    for file, name in islice(named, number):
        yield f"{file.stem}_{name}", read_trajectory(file, name)


def _calibrations(cfg: DictConfig, settings: Settings) -> tuple[dict[str, dict[str, Any]], set[str]]:
    """Return the calibration of each simulator and unknown from an earlier results folder, and the digests of its motions; both empty without one.

    Raises:
        ConfigError: there are no answers, too few with a stored value, or answers of another model or with other settings.
    """
    from gpe_pl.evaluation.identification.answer import MODEL, SOLVER, known_of, read_answers
    from gpe_pl.evaluation.identification.calibration import FewScenesError, calibrated
    from gpe_pl.files.run_folder import CONFIG, config_in
    from gpe_pl.metrics.conformal import fewest_scenes

    if settings.calibration is None:
        if settings.level != Settings.level:
            raise ConfigError(f"level={settings.level:g}: intervals of another level need calibration=FOLDER")
        return {}, set()
    folder, key = Path(settings.calibration), f"calibration={settings.calibration}"
    kinds = (MODEL, SOLVER) if settings.simulator == "both" else (settings.simulator,)
    answers = {kind: read_answers(folder, kind) for kind in kinds}
    if not any(answers.values()) or not (folder / CONFIG).is_file():
        raise ConfigError(f"{key}: has no answers; name the results folder of an earlier run of this command")
    stored, own = config_in(folder / CONFIG), _identity(cfg)
    compared = (
        "unknowns",
        "bounds",
        "per_body",
        "observations",
        "shooting",
        "search",
        "checkpoint",
    )  # the checkpoint also gives bounds of the solver
    if different := [name for name in compared if stored.get(name) != own[name]]:
        shown = "; ".join(f"{name}: {stored.get(name)} there, {own[name]} now" for name in different)
        raise ConfigError(f"{key}: was made with other settings ({shown}); identify its scenes again with these")
    found: dict[str, dict[str, Any]] = {}
    for kind, seen in answers.items():
        if not (by_name := known_of(seen)):
            other = "" if len(kinds) == 1 else f", or choose simulator={next(each for each in kinds if each != kind)}"
            raise ConfigError(
                f"{key}: simulator={kind}: none of {len(seen)} calibration scenes has a stored value to compare with; intervals of "
                f"{100 * settings.level:g} % need at least {fewest_scenes(settings.level)} that do: identify scenes with known values{other}"
            )
        for name, known in by_name.items():
            try:
                found.setdefault(kind, {})[name] = calibrated(known, settings.level)
            except FewScenesError as error:
                raise ConfigError(f"{key}: {name} by simulator={kind}: {error}") from None
            if not math.isfinite(found[kind][name].threshold):
                raise ConfigError(
                    f"{key}: {name} by simulator={kind}: too many calibration scenes have true values beyond the bounds of the search, so no interval of "
                    f"{100 * settings.level:g} % has an end; calibrate on scenes within the bounds, or with wider bounds"
                )
    return found, {answer.observed for own in answers.values() for answer in own}


def _plain(cfg: DictConfig) -> dict[str, Any]:
    from omegaconf import OmegaConf

    values: Any = OmegaConf.to_container(cfg, resolve=True)
    return values


def _identity(cfg: DictConfig, calibrated_on: Collection[str] = ()) -> dict[str, Any]:
    """Return what answers depend on. If something differs, the run needs another folder.

    Args:
        cfg: configuration of the command.
        calibrated_on: digests of the motions of the calibration, whose folder can gain scenes.
    """
    from gpe_pl.learned.pretrained import fingerprint

    values = _plain(cfg)
    kept = ("unknowns", "per_body", "bounds", "calibration", "level", "observations", "shooting", "search", "trajectory")
    calibration = {"calibrated_on": sorted(calibrated_on)} if calibrated_on else {}
    return {"checkpoint": fingerprint(cfg.checkpoint), **{key: values[key] for key in kept}, **calibration}


main = entry_point("identify")(identify_scenes)

if __name__ == "__main__":
    main()
