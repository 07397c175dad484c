"""Times of the steps of Lightning's training loop, without loggers, checkpoints and validation."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
from torch.utils.data import DataLoader

from gpe_pl.data.dataset import WindowDataset, collated
from gpe_pl.data.sampling import NUM_LANES, BatchSampler, BatchSize, PushForward
from gpe_pl.learned.simulator import LearnedSimulator
from gpe_pl.training.callbacks import WarmAverage
from gpe_pl.training.module import TrainingModule
from gpe_pl.training.run import TrainingSettings

WARM_UP_STEPS, STEPS_PER_ROUND = 2 * NUM_LANES, NUM_LANES
"""Steps before the first round, and in each round. A round takes every lane of push-forward once."""
LEARNING_RATE = 1e-9
"""Learning rate of the timed steps. It is so small that the weights stay almost the same."""


class _Rounds(L.Callback):
    """Processor time per step [s] of each round."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._start = 0.0

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        done = trainer.global_step - WARM_UP_STEPS
        if done >= 0 and done % STEPS_PER_ROUND == 0:
            now = time.process_time()
            if done:
                self.seconds.append((now - self._start) / STEPS_PER_ROUND)
            self._start = now


def loop_times(
    simulator: LearnedSimulator,
    data: WindowDataset,
    size: BatchSize,
    settings: TrainingSettings,
    push_forward: PushForward | None,
    num_rounds: int,
) -> list[float]:
    """Return the processor time per step [s] of each of several rounds of steps, which train ``simulator``.

    Args:
        simulator: simulator with its statistics set.
        data: training windows.
        size: size of the batches.
        settings: settings of the optimisation.
        push_forward: settings of push-forward in all steps; None for steps without it.
        num_rounds: number of rounds.
    """
    rounds, num_steps = _Rounds(), WARM_UP_STEPS + num_rounds * STEPS_PER_ROUND
    trainer = L.Trainer(
        accelerator="cpu",
        max_steps=num_steps,
        max_epochs=-1,
        gradient_clip_val=settings.gradient_clip,
        callbacks=[*([] if settings.ema_decay is None else [WarmAverage(settings.ema_decay)]), rounds],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    batches = BatchSampler(data, size, 0, lambda: trainer.global_step, push_forward)
    module = TrainingModule(simulator.train(), num_steps, LEARNING_RATE, LEARNING_RATE, stress_weight=settings.stress_weight, compile="off")
    trainer.fit(module, DataLoader(data, batch_sampler=batches, collate_fn=collated))
    return rounds.seconds
