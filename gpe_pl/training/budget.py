"""Time budgets. ``budget_minutes`` becomes a number of training steps, so that all models train for the same time.

The time of one step is measured once and stored in a file, which all seeds of a sweep share. Runs count steps only, so a resumed run ends at the same step as
an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import lightning as L
from pydantic import Field, TypeAdapter, ValidationError

from gpe_pl.data.augmentation import Augmentation
from gpe_pl.data.dataset import WindowDataset, collated
from gpe_pl.data.sampling import NUM_LANES, BatchSampler, BatchSize, PushForward
from gpe_pl.errors import GpeError
from gpe_pl.files import sealed
from gpe_pl.system.locks import alone
from gpe_pl.system.machine import gemm_rate, work_clock
from gpe_pl.training.module import COMPILE_PAYS_AFTER, TrainingModule
from gpe_pl.training.optimizer import OnePassAdam, clip
from gpe_pl.training.run import TrainerSettings, TrainingSettings

log = logging.getLogger(__name__)

WARM_UP_STEPS = NUM_LANES
MEASURED_STEPS = 25
ROUNDS = 5
FRACTION_TO_MEASURE = 0.5
"""Fraction of the budget after which no further round of measurements begins."""
TIMES = TypeAdapter(dict[str, Annotated[float, Field(gt=0, strict=True)]])
RATE = "FLOP/s in products"
"""Key in a file of step times: the rate of matrix products [FLOP/s] on the machine that measured the first step time."""
PRODUCTS = (4096, 128)
"""Rows and channels of the matrix products that are timed for ``RATE``."""
SAME_MACHINE = 1.4
"""If two measured rates differ by more than this factor, the machines differ, or one of them was busy. A warning is logged then."""


def step_time_key(config: dict[str, Any], training: TrainingSettings, trainer: TrainerSettings, data: str | None = None) -> str:
    """Return the key of a step time: a text that differs between runs whose step times can differ.

    Args:
        config: resolved configuration of the run without its lookup tables of data and sizes (``run_folder.without_tables``). Entries for other data must not
            change the key.
        training, trainer: the same settings as objects.
        data: checksum of imported data, which the configuration gives by name only. None for generated data, which the configuration describes in full.
    """
    parts = {key: config[key] for key in ("graph", "model", "data", "batching")} | {
        "batch_size": training.batch_size,
        "compile": training.compile,
        "push_forward": [training.push_fraction, training.push_steps] if training.push_fraction else None,
        "device": trainer.device,
        "matmul_precision": trainer.matmul_precision,
        "data_sha256": data,
    }
    if trainer.device != "cpu":
        parts["cuda_graph"] = training.cuda_graph
    if training.unroll_steps is not None:
        parts["unroll_steps"] = training.unroll_steps
    if training.targets != "trajectory":  # the solver runs for states that deviate
        parts["targets"] = [training.targets, training.noise.is_any]
    if training.augmentation != Augmentation():
        parts["augmentation"] = asdict(training.augmentation)
    parts |= {name: value for name in ("early_layers", "neighbor_weight") if (value := getattr(training, name)) is not None}
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]
    return f"{config['data']['name']} {config['size']['name']} {config['model']['_target_'].rpartition('.')[2]} {digest}"


class BudgetError(GpeError, ValueError):
    """Raised when the file of measured step times cannot be used; the message names the file and says what to do."""


def mean_step_time(module: TrainingModule, data: WindowDataset, size: BatchSize, settings: TrainingSettings) -> float:
    """Return the mean time per optimiser step [s] over a whole run, weighted by the fraction of steps with push-forward (``settings.push_fraction``).

    Args:
        module: module whose steps are measured. The learning rate is 0, so its weights do not change.
        data: training windows.
        size: size of the batches.
        settings: settings of the training.
    """
    limit = math.inf if settings.budget_minutes is None else FRACTION_TO_MEASURE * 60 * settings.budget_minutes
    if not settings.push_fraction:
        return step_time(module, data, size, settings.gradient_clip, limit=limit)
    plain = step_time(module, data, size, settings.gradient_clip, limit=limit / 2)
    late = step_time(module, data, size, settings.gradient_clip, PushForward(0, settings.push_steps), limit=limit / 2)
    return (1 - settings.push_fraction) * plain + settings.push_fraction * late


def step_time(
    module: TrainingModule,
    data: WindowDataset,
    size: BatchSize,
    gradient_clip: float | None,
    push_forward: PushForward | None = None,
    limit: float = math.inf,
) -> float:
    """Return the time per optimiser step [s] in the fastest of several rounds. It includes the building of graphs.

    The time is processor time on a CPU and wall time on a GPU. The fastest round is taken because other processes can only slow a step down; even processor
    time grows when they use the same caches and memory. The first round always runs.

    Args:
        module, data, size: as in ``mean_step_time``.
        gradient_clip: largest norm of the gradient; None switches clipping off.
        push_forward: settings of push-forward in all steps; None for steps without it.
        limit: time after which no further round begins [s].
    """
    clock = work_clock(next(module.parameters()).is_cuda)
    optimizer = OnePassAdam(module.parameters(), learning_rate=0.0)
    numbers = BatchSampler(data, size, 0, lambda: 0, push_forward)
    batches = (module.transfer_batch_to_device(collated([data[key] for key in keys]), module.device, 0) for keys in numbers)

    def steps(count: int) -> float:
        start = clock()
        for _ in range(count):
            optimizer.zero_grad()
            module.loss(next(batches)).backward()
            clip(module.parameters(), gradient_clip)
            optimizer.step()
        return clock() - start

    with module.compiled():
        steps(WARM_UP_STEPS)
        rounds = [steps(MEASURED_STEPS)]
        while len(rounds) < ROUNDS and sum(rounds) < limit:
            rounds.append(steps(MEASURED_STEPS))
        return min(rounds) / MEASURED_STEPS


def within_budget(
    settings: TrainingSettings, path: Path, key: str, measure: Callable[[TrainingSettings], float], device: str = "cpu"
) -> TrainingSettings:
    """Return settings with the number of steps that fits into ``settings.budget_minutes``. The number of validations does not change.

    The budget does not include the time of compilation.

    Args:
        settings: settings with a budget.
        path: JSON file of step times [s]. The runs of a sweep share it, and their trainings pause during a measurement (``PauseForMeasurements``).
        key: key of the step time in that file (``step_time_key``).
        measure: measures the step time [s] under given settings; called if the file does not have it yet.
        device: device to compute on. A warning is logged if it is faster or slower than the device on which the first time in the file was measured.

    Raises:
        BudgetError: the file is damaged.
    """
    assert settings.budget_minutes is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    with alone(_lock(path)):
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
    """Return the step time [s] with or without compilation, as in the run itself. With ``compile: auto``, the number of steps decides."""
    assert settings.budget_minutes is not None
    if settings.compile != "auto":
        return measure(settings)
    plain = measure(replace(settings, compile="off"))
    num_steps = int(60 * settings.budget_minutes / plain)
    return measure(replace(settings, num_steps=num_steps, val_interval=num_steps)) if num_steps >= COMPILE_PAYS_AFTER else plain


def _check_machine(times: dict[str, float], path: Path, key: str, device: str) -> None:
    """Warn if the stored times come from another machine, because equal budgets are then not equal work. If ``times`` is empty, add this machine's rate."""
    rate = gemm_rate(*PRODUCTS, device)
    before = times.get(RATE, rate) if times else times.setdefault(RATE, rate)
    if not 1 / SAME_MACHINE < rate / before < SAME_MACHINE:
        log.warning(
            "%s: its step times were measured where products ran at %.0f GFLOP/s, and here it is %.0f; %s gets a number of steps that does not compare "
            "with those of the other runs. To compare, delete the file and measure all here, on an idle machine",
            *(path, 1e-9 * before, 1e-9 * rate, key),
        )


class PauseForMeasurements(L.Callback):
    """Pauses a training while another run of its sweep measures a step time, because the training would slow the measured steps down.

    Args:
        path: the sweep's file of step times.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def on_train_batch_start(self, *_: Any) -> None:
        if _announcement(self.path).exists():
            with alone(_lock(self.path)):  # free once the measurement, or its process, has ended
                _announcement(self.path).unlink(missing_ok=True)


@contextmanager
def _announced(path: Path) -> Iterator[None]:
    """Make other trainings of the sweep pause before their next step, for as long as the context lasts."""
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
    """Return step times [s] by key, and the machine's rate under ``RATE``; empty if there is no file.

    Raises:
        BudgetError: the file is damaged.
    """
    if not path.exists():
        return {}
    try:
        return TIMES.validate_python(sealed.read(path, "delete it to measure again"))
    except ValidationError:
        raise BudgetError(f"{path}: not a file of step times, which are positive numbers; delete it to measure again") from None
    except sealed.SealError as error:
        raise BudgetError(str(error)) from None
