"""A Hydra sweeper in which Optuna chooses the next trials: ``hydra/sweeper=optuna``.

A sweep is an Optuna study that minimises the value which the command returns. The study is stored in a journal in the sweep's folder, and the same command
resumes it. A resumed study first repeats the best trial so far. The folder of that trial returns the same value at once, unless settings or data have changed.
Then interrupted trials continue. Any launcher can run the trials.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobStatus
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gpe_pl.config.launcher import SweepError, UsageError
from gpe_pl.files.atomic import replace_text

log = logging.getLogger(__name__)

JOURNAL = "optuna.log"
BEST = "best.json"


class OptunaSweeper(Sweeper):
    """Sweeper that runs batches of trials proposed by a tree-structured Parzen estimator [Bergstra et al. 2011].

    Args:
        num_trials: total number of trials. Failed trials, trials without a finite result and trials of earlier starts count.
        num_at_once: number of trials that are proposed together and run in parallel.
        seed: seed of the proposals.
        params: values by key, in Hydra's syntax: ``interval(1e-4, 1e-2)``, ``tag(log, interval(1e-4, 1e-2))``, ``int(interval(1, 8))``, ``choice(a, b)`` or
            ``a,b``, ``range(1, 5)``. A key on the command line replaces the key here.

    Raises:
        SweepError: no trial returned a finite number, trials of an earlier start used other settings or data, or their journal is damaged.
    """

    def __init__(self, num_trials: int = 20, num_at_once: int = 1, seed: int = 0, params: Mapping[str, Any] | None = None) -> None:
        for name, value in (("num_trials", num_trials), ("num_at_once", num_at_once)):
            if not (type(value) is int and value >= 1):
                raise ValueError(f"hydra.sweeper.{name}={value!r}: must be an integer of at least 1")
        self.num_trials, self.num_at_once, self.seed, self.params = num_trials, num_at_once, seed, dict(params or {})

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.config = config
        self.launcher = Plugins.instance().instantiate_launcher(hydra_context=hydra_context, task_function=task_function, config=config)

    def sweep(self, arguments: list[str]) -> None:
        try:
            import optuna
            from optuna.storages import JournalStorage
            from optuna.storages.journal import JournalFileBackend
        except ImportError:
            raise UsageError("hydra/sweeper=optuna needs optuna: `pip install optuna`, or gpe_pl with its extra [optuna]") from None
        State = optuna.trial.TrialState
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        assert self.config is not None and self.launcher is not None
        fixed, space = self._split(arguments)
        folder = Path(str(self.config.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        _without_unfinished_line(folder / JOURNAL)
        try:
            storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
            study = optuna.create_study(storage=storage, study_name="sweep", load_if_exists=True)
            finished, left_over_trials = (study.get_trials(states=[state]) for state in (State.COMPLETE, State.RUNNING))
        except OSError:
            raise
        except Exception as fault:  # Optuna has no error of its own for a damaged journal
            raise SweepError(
                f"{folder / JOURNAL}: damaged ({type(fault).__name__}: {fault}); delete the file to begin the search again"
            ) from None
        if finished:
            self._require_same(study.best_trial, fixed, folder)
        for left_over in left_over_trials:  # trials of a killed sweep; their folders contain their progress
            study.enqueue_trial(left_over.params)
            study.tell(left_over.number, state=State.FAIL)
        error = "no trial has returned a finite number"
        while (left := self.num_trials - len(study.get_trials(states=[State.COMPLETE, State.PRUNED]))) > 0:
            study.sampler = optuna.samplers.TPESampler(seed=self.seed + len(study.trials))
            trials = [study.ask(space) for _ in range(min(left, self.num_at_once))]
            overrides = [_overrides(fixed, trial) for trial in trials]
            for trial, outcome in zip(trials, self.launcher.launch(overrides, initial_job_idx=trials[0].number), strict=True):
                value = outcome._return_value
                if outcome.status is JobStatus.COMPLETED and value is not None and math.isfinite(value):
                    study.tell(trial, float(value))
                    continue
                if outcome.status is JobStatus.FAILED:
                    error = str(value)
                study.tell(trial, state=State.PRUNED)  # the estimator avoids pruned trials; Optuna would repeat a trial without a number
        if not study.get_trials(states=[State.COMPLETE]):
            raise SweepError(error)
        best = study.best_trial
        replace_text(folder / BEST, json.dumps({"value": best.value, "trial": best.number, "values": best.params}, indent=1) + "\n")
        print(f"best of {self.num_trials} trials: {best.value:.6g} with {', '.join(f'{k}={_text(v)}' for k, v in best.params.items())}")

    def _require_same(self, trial: Any, fixed: list[str], folder: Path) -> None:
        """Repeat a trial, and raise ``SweepError`` if its value differs from the stored one."""
        assert self.launcher is not None
        (outcome,) = self.launcher.launch([_overrides(fixed, trial)], initial_job_idx=trial.number)
        value = outcome._return_value
        if outcome.status is JobStatus.FAILED:
            raise SweepError(
                f"{folder}: trial {trial.number} of an earlier start cannot be repeated: {value}; choose another name=… or delete the folder"
            )
        if value != trial.value:
            raise SweepError(
                f"{folder}: trial {trial.number} of an earlier start had {trial.value:.6g} and has {value} now, so settings or data have changed; "
                "choose another name=… or delete the folder"
            )

    def _split(self, arguments: list[str]) -> tuple[list[str], dict[str, Any]]:
        """Split overrides into those with one value and the distributions of the others by key."""
        given = OverridesParser.create().parse_overrides([f"{key}={value}" for key, value in self.params.items()] + arguments)
        latest = {override.get_key_element(): override for override in given}
        space = {key: _distribution(override) for key, override in latest.items() if override.is_sweep_override()}
        if not space:
            raise UsageError(
                "hydra/sweeper=optuna: no key has several values; give some, such as training.learning_rate='interval(1e-4,1e-2)'"
            )
        return [str(o.input_line) for o in latest.values() if not o.is_sweep_override()], space


def _overrides(fixed: list[str], trial: Any) -> list[str]:
    return [*fixed, *(f"{key}={_text(value)}" for key, value in trial.params.items())]


def _without_unfinished_line(journal: Path) -> None:
    """Cut off what follows the last line end of a journal: a full disk or a power cut leaves half a line, to which Optuna would append the next one."""
    if not journal.is_file():
        return
    text = journal.read_bytes()
    whole = text.rfind(b"\n") + 1
    if whole < len(text):
        log.warning("%s: its last line was not finished and is dropped", journal)
        os.truncate(journal, whole)


def _distribution(override: Override) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    value = override.value()
    if not isinstance(value, IntervalSweep):
        return CategoricalDistribution([*override.sweep_string_iterator()])
    assert value.start is not None and value.end is not None
    is_log = "log" in value.tags
    try:
        if isinstance(value.start, int) and isinstance(value.end, int):
            return IntDistribution(value.start, value.end, log=is_log)
        return FloatDistribution(float(value.start), float(value.end), log=is_log)
    except ValueError as error:
        raise UsageError(f"{override.input_line}: {error}") from None


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)  # becomes part of a folder's name


@dataclass
class OptunaSweeperConfig:
    """Settings of ``hydra/sweeper=optuna`` with their defaults; ``OptunaSweeper`` documents them."""

    num_trials: int = 20
    num_at_once: int = 1
    seed: int = 0
    params: dict[str, Any] | None = field(default_factory=dict)
