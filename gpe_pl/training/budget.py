"""Equal time for every model: a budget of minutes becomes a number of steps, from a step time that is measured once and then written down.

Runs count steps only, so a resumed run ends where an uninterrupted one does; all seeds of a sweep share the measurement.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import lightning as L
import torch
from filelock import FileLock
from pydantic import Field, TypeAdapter, ValidationError

from gpe_pl.data.dataset import Samples, WindowDataset, collated
from gpe_pl.data.sampling import NUM_LANES, BatchSampler, BatchSize, PushForward
from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.system.machine import gemm_rate
from gpe_pl.training.module import COMPILE_PAYS_AFTER, TrainingModule, clipped_norm
from gpe_pl.training.run import TrainerSettings, TrainingSettings

log = logging.getLogger(__name__)

WARM_UP_STEPS = NUM_LANES
MEASURED_STEPS = 25
ROUNDS = 5
SHARE_TO_MEASURE = 0.5
"""Of a budget: no further round begins once measuring has taken as long."""
TIMES = TypeAdapter(dict[str, Annotated[float, Field(gt=0, strict=True)]])
RATE = "FLOP/s in products"
"""In a file of step times: what the machine did when the first of them was measured."""
PRODUCTS = (4096, 128)
"""Rows and channels of the products that are timed for it."""
SAME_MACHINE = 1.4
"""Rates further apart than this factor are of different machines, or of a busy one."""


def step_time_key(config: dict[str, Any], training: TrainingSettings, trainer: TrainerSettings, data: str | None = None) -> str:
    """A name for what the time of a training step depends on.

    Args:
        config: of the run, resolved, without the tables of data and sizes (``run_folder.without_tables``), as offers to others must not change the name.
        training, trainer: the same settings as objects.
        data: checksum of imported data, of which the configuration says only the name; None: it says how the data are made.
    """
    parts = {key: config[key] for key in ("graph", "model", "data", "batching")} | {
        "batch_size": training.batch_size,
        "compile": training.compile,
        "push_forward": [training.push_share, training.push_steps] if training.push_share else None,
        "device": trainer.device,
        "matmul_precision": trainer.matmul_precision,
        "data_sha256": data,
    }
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]
    return f"{config['data']['name']} {config['size']['name']} {config['model']['_target_'].rpartition('.')[2]} {digest}"


class BudgetError(GpeError, ValueError):
    """The file of measured step times cannot be used; names it and what to do."""


def mean_step_time(module: TrainingModule, data: WindowDataset, size: BatchSize, settings: TrainingSettings) -> float:
    """Seconds per optimiser step, over a run that begins without own steps of the model and may end with them."""
    limit = math.inf if settings.budget_minutes is None else SHARE_TO_MEASURE * 60 * settings.budget_minutes
    if not settings.push_share:
        return step_time(module, data, size, settings.gradient_clip, limit=limit)
    plain = step_time(module, data, size, settings.gradient_clip, limit=limit / 2)
    late = step_time(module, data, size, settings.gradient_clip, PushForward(0, settings.push_steps), limit=limit / 2)
    return (1 - settings.push_share) * plain + settings.push_share * late


def step_time(
    module: TrainingModule,
    data: WindowDataset,
    size: BatchSize,
    gradient_clip: float | None,
    push_forward: PushForward | None = None,
    limit: float = math.inf,
) -> float:
    """Seconds per optimiser step, the building of its graphs included: processor time, or on a GPU wall time, in the fastest of several rounds.

    No round but the first begins after ``limit`` seconds of them. Other processes can only lengthen a step, through shared caches and memory even where
    processor time is counted.
    """
    on_gpu = next(module.parameters()).is_cuda
    clock = time.perf_counter if on_gpu else time.process_time
    optimizer = torch.optim.Adam(module.parameters(), lr=0.0, fused=True)
    numbers = BatchSampler(data, size, 0, lambda: 0, push_forward)
    batches = (_on(module.device, collated([data[key] for key in keys])) for keys in numbers)

    def steps(count: int) -> float:
        start = clock()
        for _ in range(count):
            optimizer.zero_grad()
            module.loss(next(batches)).backward()
            torch.nn.utils.clip_grad_norm_(module.parameters(), clipped_norm(gradient_clip))
            optimizer.step()
        if on_gpu:
            torch.cuda.synchronize()
        return clock() - start

    with module.compiled():
        steps(WARM_UP_STEPS)
        rounds = [steps(MEASURED_STEPS)]
        while len(rounds) < ROUNDS and sum(rounds) < limit:
            rounds.append(steps(MEASURED_STEPS))
        return min(rounds) / MEASURED_STEPS


def _on(device: torch.device, samples: Samples) -> Samples:
    return [start.to(device) for start in samples] if isinstance(samples, list) else samples.to(device)


def within_budget(
    settings: TrainingSettings, path: Path, key: str, measure: Callable[[TrainingSettings], float], device: str = "cpu"
) -> TrainingSettings:
    """Settings with the number of steps that ``settings.budget_minutes`` allow, and as many validations as before.

    The time of compiling is not part of the budget.

    Args:
        settings: with a budget.
        path: JSON file of step times [s], shared by the runs of a sweep, whose trainings pause meanwhile (``PauseForMeasurements``).
        key: in that file, what the step time depends on.
        measure: step time [s] under given settings; called if the file does not have it yet.
        device: what is used of the machine. If it is faster or slower than where the file's first time was measured, a warning says so.

    Raises:
        BudgetError: the file is damaged.
    """
    assert settings.budget_minutes is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(_lock(path)):
        times = read_times(path)
        if key not in times:
            with _announced(path):
                _check_machine(times, path, key, device)
                times[key] = _measured(settings, measure)
            log.info("%s: %.1f ms per training step", key, 1e3 * times[key])
            sealed.write(path, times)
    validations = max(1, settings.num_steps // settings.val_interval)
    interval = max(1, int(60 * settings.budget_minutes / times[key] / validations))
    return replace(settings, num_steps=interval * validations, val_interval=interval, budget_minutes=None)


def _measured(settings: TrainingSettings, measure: Callable[[TrainingSettings], float]) -> float:
    """Step time as the run will have it: ``compile: auto`` depends on the number of steps."""
    assert settings.budget_minutes is not None
    if settings.compile != "auto":
        return measure(settings)
    plain = measure(replace(settings, compile="off"))
    num_steps = int(60 * settings.budget_minutes / plain)
    return measure(replace(settings, num_steps=num_steps, val_interval=num_steps)) if num_steps >= COMPILE_PAYS_AFTER else plain


def _check_machine(times: dict[str, float], path: Path, key: str, device: str) -> None:
    """Warn if times so far are of another machine; equal budgets on both are not equal work. In an empty file, write down what this one does."""
    rate = gemm_rate(*PRODUCTS, device)
    before = times.get(RATE, rate) if times else times.setdefault(RATE, rate)
    if not 1 / SAME_MACHINE < rate / before < SAME_MACHINE:
        log.warning(
            "%s: its step times were measured where products ran at %.0f GFLOP/s, and here it is %.0f; %s gets a number of steps that does not compare "
            "with the others'. To compare, delete the file and measure all here, on an idle machine",
            *(path, 1e-9 * before, 1e-9 * rate, key),
        )


class PauseForMeasurements(L.Callback):
    """Holds a training while another run of its sweep measures a step time, which it would lengthen.

    Args:
        path: of the sweep's step times.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_batch_start(self, *_: Any) -> None:
        if _announcement(self.path).exists():
            with FileLock(_lock(self.path)):  # free once it is measured, or its process gone
                _announcement(self.path).unlink(missing_ok=True)


@contextmanager
def _announced(path: Path) -> Iterator[None]:
    """Inside, other trainings of the sweep pause before their next step."""
    _announcement(path).touch()
    try:
        yield
    finally:
        _announcement(path).unlink(missing_ok=True)


def _lock(path: Path) -> Path:
    return path.with_suffix(".lock")


def _announcement(path: Path) -> Path:
    return path.with_suffix(".measuring")


def read_times(path: Path) -> dict[str, float]:
    """Step times [s] by what they depend on, and the machine's rate; none where there is no file. Raises ``BudgetError`` where it is damaged."""
    if not path.exists():
        return {}
    try:
        return TIMES.validate_python(sealed.read(path, "delete it to measure again"))
    except ValidationError:
        raise BudgetError(f"{path}: not a file of step times, which are positive numbers; delete it to measure again") from None
    except sealed.SealError as error:
        raise BudgetError(str(error)) from None
