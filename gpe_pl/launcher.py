"""A Hydra launcher that runs the jobs of a sweep side by side, each as the plain command that would run it alone, with a log file in its own folder.

Chosen by ``hydra/launcher: processes``; any other launcher (Ray, Slurm through submitit, Hydra's own ``basic``) takes its place on the command line.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict
from rich.console import Console

from gpe_pl.errors import GpeError

LOG = "output.log"
RESULT = "GPE_PL_RESULT"
"""Environment variable: the file in which a command leaves the value that it returns."""
USAGE_ERROR = 64
"""Exit status of a run whose configuration is wrong: the rest of the sweep is not started."""
PLUGINS = "hydra_plugins"
"""Hydra takes plugins only from this namespace package, which exists where another plugin is installed."""


class SweepError(GpeError, RuntimeError):
    """Runs of a sweep failed; names them, their errors and their logs."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep: what the command line gets, and where its results go."""

    overrides: list[str]
    sweep_folder: Path
    name: str

    @property
    def folder(self) -> Path:
        return self.sweep_folder / self.name

    def run(self, module: str) -> JobReturn:
        """Run ``python -m module`` for this job and wait for its end."""
        self.folder.mkdir(parents=True, exist_ok=True)
        result = self.folder / ".result"
        here = [f"hydra.run.dir={json.dumps(str(self.folder))}", "hydra.mode=RUN", "~hydra.callbacks.report"]
        with open(self.folder / LOG, "ab") as log:
            command = [sys.executable, "-m", module, *self.overrides, *here]
            environment = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"} | {RESULT: str(result)}
            with subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.PIPE, env=environment) as process:
                code = process.wait()
        if code == USAGE_ERROR:
            raise SweepError(self._last_words(code))
        if code:
            return JobReturn(self.overrides, status=JobStatus.FAILED, _return_value=SweepError(self._last_words(code)))
        value = json.loads(result.read_text())
        result.unlink()
        return JobReturn(self.overrides, status=JobStatus.COMPLETED, _return_value=value)

    def _last_words(self, code: int) -> str:
        lines = (self.folder / LOG).read_text(errors="replace").splitlines()
        last = next((line for line in reversed(lines) if line.strip()), f"ended with code {code}")
        return f"{last.removeprefix('error: ')} (see {self.folder / LOG})"


def end_with_sweep() -> None:
    """End this run when the sweep that started it is gone, however it ended: the pipe that is its standard input then closes.

    Otherwise the same command, given again, would meet the run in its folder.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class ProcessLauncher(Launcher):
    """Runs jobs side by side.

    Args:
        num_processes: jobs at once; None: as many as there are cores, at ``trainer.num_threads`` each (one job if that is None).

    Raises:
        SweepError: a run's configuration is wrong; or some runs failed, and all others have been run.
    """

    def __init__(self, num_processes: int | None = None) -> None:
        if num_processes is not None and not (type(num_processes) is int and num_processes >= 1):
            raise ValueError(f"hydra.launcher.num_processes={num_processes!r}: must be null or an integer of at least 1")
        self.num_processes = num_processes

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.config = hydra_context, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        setup_globals()
        jobs = [self._job(initial_job_idx + k, overrides) for k, overrides in enumerate(job_overrides)]
        module = sys.modules["__main__"].__spec__
        assert module is not None, "a sweep is started by python -m"
        number = min(len(jobs), self.num_processes or default_processes(OmegaConf.select(self.config, "trainer.num_threads")))
        console = Console(highlight=False, soft_wrap=True)
        console.print(f"{len(jobs)} runs, {number} at a time; each has its {LOG} below {self.config.hydra.sweep.dir}")
        returns: dict[int, JobReturn] = {}
        pool = ThreadPoolExecutor(number)
        try:
            waiting = {pool.submit(job.run, module.name): k for k, job in enumerate(jobs)}
            for future in as_completed(waiting):
                k = waiting[future]
                returns[k] = future.result()
                failed = returns[k].status is JobStatus.FAILED
                console.print(f"{len(returns)}/{len(jobs)} {'failed' if failed else 'done'}: {jobs[k].name}")
        finally:
            pool.shutdown(wait=True, cancel_futures=True)  # a Ctrl-C reaches the runs too: they save, nothing new starts
        errors = [f"{jobs[k].name}: {r._return_value}" for k, r in sorted(returns.items()) if r.status is JobStatus.FAILED]
        if errors:
            raise SweepError(f"{len(errors)} of {len(jobs)} runs failed; the same command runs only those again. {'; '.join(errors[:3])}")
        return [returns[k] for k in sorted(returns)]

    def _job(self, number: int, overrides: Sequence[str]) -> Job:
        config: Any = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        HydraConfig.instance().set_config(config)  # the folder's name is resolved against it
        return Job(list(overrides), Path(str(config.hydra.sweep.dir)), str(config.hydra.sweep.subdir))


def default_processes(num_threads: int | None) -> int:
    """Jobs that this machine has cores for."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // (num_threads or cores))


@dataclass
class ProcessLauncherConfig:
    """Configuration node of ``hydra/launcher=processes``."""

    _target_: str = f"{PLUGINS}.gpe_pl.{ProcessLauncher.__name__}"
    num_processes: int | None = None


def register() -> None:
    """Make ``hydra/launcher=processes`` known to Hydra."""
    ConfigStore.instance().store(group="hydra/launcher", name="processes", node=ProcessLauncherConfig, provider="gpe_pl")
    try:
        package = importlib.import_module(PLUGINS)
    except ImportError:
        package = sys.modules[PLUGINS] = ModuleType(PLUGINS)
        package.__path__ = []
    package.__dict__["gpe_pl"] = sys.modules[f"{PLUGINS}.gpe_pl"] = sys.modules[__name__]
    ProcessLauncher.__module__ = f"{PLUGINS}.gpe_pl"
    Plugins.instance().register(ProcessLauncher)
