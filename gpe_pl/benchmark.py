"""Command ``python -m gpe_pl.benchmark suite=speed``: run a benchmark suite. Results go to ``{paths.runs}/benchmark/{suite}/``."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpe_pl.config.entry_point import ConfigError, compose, construct, entry_point
from gpe_pl.config.folder import CONF
from gpe_pl.errors.printable import one_line
from gpe_pl.files.atomic import replace_text

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from gpe_pl.training.run import TrainingSettings


NAMED = 5
"""Number of failures that the final error message names."""


def without_folder(value: Any, runs: str) -> Any:
    """Return settings in which paths inside the results folder ``runs`` begin with the text ``paths.runs``. Published settings then do not name that folder."""
    if isinstance(value, dict):
        return {key: without_folder(item, runs) for key, item in value.items()}
    if isinstance(value, list):
        return [without_folder(item, runs) for item in value]
    if isinstance(value, str) and Path(value).is_relative_to(runs):
        return (Path("paths.runs") / Path(value).relative_to(runs)).as_posix()
    return value


def _suite(name: str) -> Any:
    """Import the module of a suite: ``benchmarks.{name}``, or ``benchmarks.{name}.suite`` if ``benchmarks.{name}`` is a package."""
    package = importlib.import_module(f"gpe_pl.benchmarks.{name}")
    return importlib.import_module(f"{package.__name__}.suite") if hasattr(package, "__path__") else package


def _training(*overrides: str) -> TrainingSettings:
    """Return the settings of ``python -m gpe_pl.fit model=gpe_tuned``, as shipped models are trained, with these overrides of the command line."""
    from gpe_pl.training.run import TrainingSettings

    return construct(TrainingSettings, compose("fit", ["model=gpe_tuned", *overrides]).training, "training")


def benchmark(cfg: DictConfig) -> None:
    """Run one suite and write ``results.json``, ``table.md`` and its figures. The exit status is 1 if the suite's function ``failures`` finds some."""
    import torch
    from omegaconf import OmegaConf

    from gpe_pl.config.datasets import dataset
    from gpe_pl.system.locks import locked
    from gpe_pl.system.machine import environment, keep_freed_memory
    from gpe_pl.system.provenance import recorded
    from gpe_pl.training.run import TrainerSettings
    from gpe_pl.viz.saving import save_figure

    suites = sorted(path.stem for path in (CONF / "suite").glob("*.yaml"))
    if cfg.suite.name not in suites:
        raise ConfigError(f"suite.name={cfg.suite.name!r}: must be one of {', '.join(suites)}")
    suite = _suite(cfg.suite.name)
    values: Any = OmegaConf.to_container(cfg.suite, resolve=True)
    settings = construct(suite.Settings, {k: v for k, v in values.items() if k != "name"}, "suite")
    construct(TrainerSettings, cfg.trainer, "trainer")  # checks all keys, as suites use single values only
    if cfg.trainer.accelerator == "gpu" and not hasattr(settings, "accelerator"):
        raise ConfigError(f"trainer.accelerator=gpu: suite={cfg.suite.name} computes on the CPU; leave trainer=gpu out")
    if getattr(settings, "accelerator", "cpu") == "gpu" and not torch.cuda.is_available():
        raise ConfigError("trainer.accelerator=gpu: PyTorch finds no GPU here; choose trainer=cpu")
    keep_freed_memory()  # as trainings and evaluations do
    cases = getattr(settings, "cases", None)  # data sets by name, in suites that need some
    folder = Path(cfg.paths.runs) / "benchmark" / cfg.suite.name
    with locked(folder), recorded(folder, "benchmark", sys.argv[1:], cfg.paths.runs):
        inputs: list[dict[str, Any]] = [{k: dataset(*c.overrides) for k, c in cases.items()}] if cases is not None else []
        if cases is not None and getattr(suite, "TRAINS", False):
            inputs.append({k: _training(*c.overrides) for k, c in cases.items()})
        records, table = suite.run(settings, *inputs, *([folder] if getattr(suite, "RESUMES", False) else []))
        for name, figure in getattr(suite, "figures", lambda _: {})(records).items():
            save_figure(figure, folder / f"{name}.png", dpi=150)
        about = {"environment": environment(), "settings": without_folder(asdict(settings), cfg.paths.runs)}
        lines = ",\n".join(json.dumps(record) for record in records)
        replace_text(folder / "results.json", f'{json.dumps(about)[:-1]}, "records": [\n{lines}\n]}}\n')
        replace_text(folder / "table.md", table + "\n")
    print(table)
    failures: list[str] = getattr(suite, "failures", lambda _: [])(records)
    if failures:
        sys.exit(one_line(f"error: {len(failures)} failed: {'; '.join(failures[:NAMED])}{'; …' if len(failures) > NAMED else ''}"))


main = entry_point("benchmark")(benchmark)

if __name__ == "__main__":
    main()
