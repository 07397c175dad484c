"""Hydra launchers that run each job of a sweep as a separate command, with a log file in the job's folder.

``hydra/launcher=processes``  in parallel on this machine
``hydra/launcher=ray``        on the machines of a Ray cluster
``hydra/launcher=slurm``      as jobs of Slurm, through submitit

Each job runs the same command that you would type to run it alone, so results do not depend on the launcher. If you start a sweep again, with any launcher,
only its unfinished jobs run. All machines must have a common disk and the same environment.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from gpe_pl.config.typed_keys import axes_of, without_effect
from gpe_pl.errors import GpeError
from gpe_pl.errors.printable import one_line
from gpe_pl.files.run_folder import RunError, refuse_links

LOG = "output.log"
"""Name of the log file in the folder of a run."""
RESULT = "GPE_PL_RESULT"
"""Environment variable with the file to which a command writes its return value."""
USAGE_ERROR = 64
"""Exit status of a run with a wrong configuration. The remaining runs of the sweep are not started."""
GRACE_SECONDS = 30.0
"""Time that a run has to save its training after its sweep has ended [s]; the same as in Slurm and Kubernetes."""
REPORT = "hydra.callbacks.report"
"""Key of the callback that writes tables. The runs of a sweep drop it, because the sweep writes one table of all runs."""


class SweepError(GpeError, RuntimeError):
    """Raised when runs of a sweep failed; the message names them, their errors and their logs."""


class UsageError(SweepError):
    """Raised when the configuration of a run is wrong."""


@dataclass(frozen=True)
class Job:
    """One run of a sweep.

    Attributes:
        overrides: overrides on the command line.
        sweep_folder: folder of the sweep, relative to ``directory``.
        name: path of the run's folder in the sweep's folder.
        directory: working directory of the command.
        settings: additional command line arguments.
    """

    overrides: list[str]
    sweep_folder: Path
    name: str
    directory: Path = field(default_factory=Path.cwd)
    settings: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        return self.directory / self.sweep_folder / self.name

    def run(self, module: str) -> JobReturn:
        """Run ``python -m module`` for this job and wait for its end."""
        try:
            refuse_links(self.folder)
        except RunError as error:
            return self.failed(SweepError(str(error)))
        self.folder.mkdir(parents=True, exist_ok=True)
        result = self.folder / ".result"
        here = [f"hydra.run.dir={json.dumps(str(self.folder))}", "hydra.mode=RUN", *self.settings]
        with open(self.folder / LOG, "ab") as log:
            logged_before = log.tell()
            command = [sys.executable, "-m", module, *self.overrides, *here]
            environment = {k: v for k, v in os.environ.items() if k != "HYDRA_FULL_ERROR"} | {RESULT: str(result)}
            with subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.PIPE, env=environment, cwd=self.directory) as process:
                code = process.wait()
        if code:
            return self.failed((UsageError if code == USAGE_ERROR else SweepError)(self._last_words(code, logged_before)))
        value = json.loads(result.read_text(encoding="utf-8"))
        result.unlink()
        return JobReturn(self.overrides, status=JobStatus.COMPLETED, _return_value=value)

    def failed(self, error: Exception) -> JobReturn:
        """Return the result of a failed job, which contains the error."""
        return JobReturn(self.overrides, status=JobStatus.FAILED, _return_value=error)

    def outcome(self, get: Callable[[], JobReturn]) -> JobReturn:
        """Return the result that a cluster gives, or a failure if the cluster has lost the job."""
        try:
            return get()
        except Exception as error:  # each cluster has its own errors
            lines = str(error).strip().splitlines() or [""]
            return self.failed(SweepError(f"{type(error).__name__}: {lines[-1]} (see {self.folder / LOG})"))

    def _last_words(self, code: int, logged_before: int) -> str:
        """Return why a run failed: its last error message, else its last line, behind the first ``logged_before`` bytes of its log; or the signal."""
        logged = (self.folder / LOG).read_bytes()[logged_before:].decode("utf-8", errors="replace")
        lines = [line for line in reversed(logged.splitlines()) if line.strip()]
        last = next((line for line in lines if line.startswith("error: ")), lines[0] if lines else f"ended with code {code}")
        if code < 0:
            name = {s.value: s.name for s in signal.Signals}.get(-code, str(-code))
            last = f"ended by signal {name}" if name != "SIGKILL" else "killed (by SIGKILL, as the system does when memory is short)"
        return f"{last.removeprefix('error: ')} (see {self.folder / LOG})"


def end_with_sweep() -> None:
    """End this run when the sweep that started it has ended. The run notices this because the pipe on its standard input closes.

    Otherwise a restarted sweep would find the old run still writing to its folder. A training has ``GRACE_SECONDS`` to save a checkpoint.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class CommandLauncher(Launcher):
    """Launcher that runs jobs as commands. Subclasses decide where they run."""

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.config = hydra_context, config

    @abstractmethod
    def run(self, jobs: Sequence[Job], module: str) -> Iterator[tuple[int, JobReturn]]:
        """Yield number and result of each job as they end."""

    @abstractmethod
    def place(self, jobs: Sequence[Job]) -> str:
        """Describe where the jobs run, for the message at the start."""

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        """Run all jobs.

        Returns:
            The results of the jobs in order. A failed job has a ``SweepError`` about all failures, which is raised when its value is accessed.

        Raises:
            UsageError: two runs have the same folder, or the configuration of a run is wrong; the remaining jobs are not run. Overrides that a run refuses
                as in ``without_effect`` are found before the first run.
            SweepError: the sweep was interrupted.
        """
        from rich.console import Console

        from gpe_pl.system.progress import progress_bar

        setup_globals()
        jobs = [self._job(initial_job_idx + k, overrides) for k, overrides in enumerate(job_overrides)]
        names = [job.name for job in jobs]
        if twice := next((name for name in names if names.count(name) > 1), None):
            alike = [" ".join(job.overrides) for job in jobs if job.name == twice]
            raise UsageError(
                f"two runs would have the same folder {one_line(twice)}: {one_line(alike[0])}, and {one_line(alike[1])}; leave one of them out"
            )
        module = sys.modules["__main__"].__spec__
        assert module is not None, "a sweep is started by python -m"
        console = Console(highlight=False, soft_wrap=True, markup=False)
        console.print(f"{len(jobs)} runs, {self.place(jobs)}; each has its {LOG} below {one_line(str(self.config.hydra.sweep.dir))}")
        returns: dict[int, JobReturn] = {}
        try:
            with progress_bar("sweep") as on_progress:
                on_progress(0, len(jobs))
                for k, outcome in self.run(jobs, module.name):
                    returns[k] = outcome
                    if isinstance(outcome._return_value, UsageError):
                        raise outcome._return_value
                    failed = outcome.status is JobStatus.FAILED
                    console.print(f"{len(returns)}/{len(jobs)} {'failed' if failed else 'done'}: {one_line(jobs[k].name)}")
                    on_progress(len(returns), len(jobs))
        except KeyboardInterrupt:
            num_done = sum(r.status is JobStatus.COMPLETED for r in returns.values())
            raise SweepError(
                f"interrupted with {num_done} of {len(jobs)} runs done; run the same command again to continue, each {LOG} says from where"
            ) from None
        errors = [f"{jobs[k].name}: {r._return_value}" for k, r in sorted(returns.items()) if r.status is JobStatus.FAILED]
        if errors:
            error = SweepError(f"{len(errors)} of {len(jobs)} runs failed; the same command runs only those again. {'; '.join(errors[:3])}")
            returns = {k: jobs[k].failed(error) if r.status is JobStatus.FAILED else r for k, r in returns.items()}
        return [returns[k] for k in sorted(returns)]

    def _job(self, number: int, overrides: Sequence[str]) -> Job:
        config: Any = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = number
        HydraConfig.instance().set_config(config)  # the folder's name is resolved with it
        task: Any = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
        if refused := without_effect(task, overrides, axes_of(config.hydra)):
            raise UsageError(refused)
        settings = (f"~{REPORT}",) if OmegaConf.select(config, REPORT) is not None else ()
        return Job(list(overrides), Path(str(config.hydra.sweep.dir)), str(config.hydra.sweep.subdir), settings=settings)


class ProcessLauncher(CommandLauncher):
    """Launcher that runs jobs in parallel on this machine.

    Args:
        num_processes: number of parallel jobs. None uses all cores, with ``trainer.num_threads`` cores (None: all) for each of ``trainer.devices``.
    """

    def __init__(self, num_processes: int | None = None) -> None:
        if num_processes is not None and not (type(num_processes) is int and num_processes >= 1):
            raise ValueError(f"hydra.launcher.num_processes={num_processes!r}: must be null or an integer of at least 1")
        self.num_processes = num_processes

    def place(self, jobs: Sequence[Job]) -> str:
        return f"{self._number(jobs)} at a time"

    def run(self, jobs: Sequence[Job], module: str) -> Iterator[tuple[int, JobReturn]]:
        pool = ThreadPoolExecutor(self._number(jobs))
        try:
            waiting = {pool.submit(job.run, module): k for k, job in enumerate(jobs)}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)  # Ctrl-C also reaches the runs, which save; no job is started

    def _number(self, jobs: Sequence[Job]) -> int:
        num_threads, devices = (OmegaConf.select(self.config, f"trainer.{key}") for key in ("num_threads", "devices"))
        return min(len(jobs), self.num_processes or default_processes(num_threads, devices or 1))


def default_processes(num_threads: int | None, devices: int = 1) -> int:
    """Return the number of jobs that this machine has cores for, at least 1. A job has ``devices`` processes of ``num_threads`` threads (None: all cores)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // ((num_threads or cores) * devices))


class RayLauncher(CommandLauncher):
    """Launcher that runs jobs on the machines of a Ray cluster.

    Args:
        address: address of the cluster. None uses ``RAY_ADDRESS`` if it is set, else only this machine.
        num_cpus, num_gpus: numbers of CPUs and GPUs that a job needs and waits for.
    """

    def __init__(self, address: str | None = None, num_cpus: float = 1.0, num_gpus: float = 0.0) -> None:
        self.address, self.num_cpus, self.num_gpus = address, num_cpus, num_gpus

    def place(self, jobs: Sequence[Job]) -> str:
        return f"on {self.address or os.environ.get('RAY_ADDRESS', 'a Ray cluster of this machine')}"

    def run(self, jobs: Sequence[Job], module: str) -> Iterator[tuple[int, JobReturn]]:
        ray = _imported("ray", "ray")
        try:
            ray.init(address=self.address, log_to_driver=False)
        except Exception as error:  # Ray also raises bare exceptions
            raise UsageError(
                f"hydra/launcher=ray: the cluster does not start or cannot be reached ({' '.join(str(error).split())})"
            ) from None
        try:
            task = ray.remote(num_cpus=self.num_cpus, num_gpus=self.num_gpus)(Job.run)
            waiting = {task.remote(job, module): k for k, job in enumerate(jobs)}
            while waiting:
                (reference, *_), _ = ray.wait([*waiting], num_returns=1)
                k = waiting.pop(reference)
                yield k, jobs[k].outcome(partial(ray.get, reference))
        finally:
            ray.shutdown()  # ends the remaining jobs


class SlurmLauncher(CommandLauncher):
    """Launcher that submits jobs to Slurm as one array and waits for them.

    Args:
        cluster: ``slurm``, or for tests without a cluster ``local`` (processes on this machine) or ``debug`` (this process).
        parameters: arguments of ``submitit.AutoExecutor.update_parameters``, such as ``timeout_min``, ``cpus_per_task``, ``gpus_per_node``,
            ``slurm_partition``.
    """

    def __init__(self, cluster: str = "slurm", parameters: Mapping[str, Any] | None = None) -> None:
        if cluster not in ("slurm", "local", "debug"):
            raise ValueError(f"hydra.launcher.cluster={cluster!r}: must be slurm, local or debug")
        self.cluster, self.parameters = cluster, dict(parameters or {})

    def place(self, jobs: Sequence[Job]) -> str:
        return "submitted to Slurm" if self.cluster == "slurm" else f"by submitit's {self.cluster} executor"

    def run(self, jobs: Sequence[Job], module: str) -> Iterator[tuple[int, JobReturn]]:
        submitit = _imported("submitit", "slurm")
        folder = jobs[0].directory / jobs[0].sweep_folder / ".submitit"
        executor = submitit.AutoExecutor(folder=folder, cluster=self.cluster)
        try:
            executor.update_parameters(**self.parameters)
        except (NameError, TypeError) as error:
            raise UsageError(f"hydra.launcher.parameters: {' '.join(str(error).split())}") from None
        with executor.batch():
            submitted = [executor.submit(job.run, module) for job in jobs]
        numbers = {id(job): k for k, job in enumerate(submitted)}
        try:
            for job in submitit.helpers.as_completed(submitted, poll_frequency=1):
                k = numbers.pop(id(job))
                yield k, jobs[k].outcome(job.result)
        finally:
            for job in submitted:
                if id(job) in numbers:
                    job.cancel()


def _imported(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise UsageError(f"hydra/launcher={extra} needs {module}: `pip install {module}`, or gpe_pl with its extra [{extra}]") from None


@dataclass
class ProcessLauncherConfig:
    """Settings of ``hydra/launcher=processes`` with their defaults; ``ProcessLauncher`` documents them."""

    num_processes: int | None = None


@dataclass
class RayLauncherConfig:
    """Settings of ``hydra/launcher=ray`` with their defaults; ``RayLauncher`` documents them."""

    address: str | None = None
    num_cpus: float = 1.0
    num_gpus: float = 0.0


@dataclass
class SlurmLauncherConfig:
    """Settings of ``hydra/launcher=slurm`` with their defaults; ``SlurmLauncher`` documents them."""

    cluster: str = "slurm"
    parameters: dict[str, Any] = field(default_factory=lambda: {"timeout_min": 24 * 60})
