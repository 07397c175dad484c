"""Order of the training windows: endless, starting at any step, and the same for any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count, islice
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from torch.utils.data import Sampler

from gpe_pl.data.dataset import Key, Scale, StartKey, UnrollKey, WindowDataset
from gpe_pl.system import ranks
from gpe_pl.trajectory.store import StoreError

Sampling = Literal["uniform", "activity"]
"""How often windows are drawn: ``uniform`` draws all equally often, ``activity`` in proportion to their rms acceleration."""

UNIFORM_FRACTION = 0.2
"""Fraction of samples that ``activity`` sampling draws uniformly, which limits the weights to 5."""


def probabilities(activity: np.ndarray) -> np.ndarray:
    """Return the probability of each window [window] with ``activity`` sampling.

    The gradient of a squared error grows with the error, and the error grows with the acceleration to predict. Drawing in proportion to the acceleration and
    weighting by the inverse reduces the variance and does not change the expected gradient [importance sampling, Katharopoulos and Fleuret 2018,
    arXiv 1803.00942].

    Args:
        activity: rms acceleration without gravity of each window [window].
    """
    total = activity.sum()
    if not total > 0:
        return np.full(len(activity), 1 / len(activity))
    return UNIFORM_FRACTION / len(activity) + (1 - UNIFORM_FRACTION) * activity / total


NUM_LANES = 16
"""Number of unrolls that are active at a time. Consecutive optimiser steps take them in turn, so that they train on different scenes."""


@dataclass(frozen=True)
class PushForward:
    """Settings of the push-forward trick: late in training, samples are states that the model has reached by an unroll from a true state.

    Such an unroll has up to ``max_steps`` steps, without gradient [Brandstetter et al. 2022, section 3.1].

    Attributes:
        first_step: first optimiser step with unrolls.
        max_steps: maximum number of steps of an unroll. The model is trained on a batch at its true state and after each step of its unroll. Then the next
            batch takes its lane.
        correction: fraction of the velocities' deviation that the target removes within one step. The original trick has 1, which suits material that friction
            slows down anyway. For swinging bodies, 1 puts forces into the target that do not exist.
    """

    first_step: Annotated[int, Field(ge=0)]
    max_steps: Annotated[int, Field(ge=1)]
    correction: Annotated[float, Field(ge=0, le=1)] = 1.0

    def starts(self, batches: Iterator[list[tuple[int, int]]]) -> Iterator[list[StartKey]]:
        """Yield the starts of each optimiser step from ``first_step`` on.

        Lanes begin with unrolls of different lengths, so that all lengths are about equally frequent at any time.
        """
        num_visits = self.max_steps + 1
        lanes = [next(batches) for _ in range(NUM_LANES)]
        for turn in count():
            for lane in range(NUM_LANES):
                num_steps = (turn + lane * num_visits // NUM_LANES) % num_visits
                if turn and not num_steps:
                    lanes[lane] = next(batches)
                yield [StartKey(sample, window, num_steps, lane, self.correction) for sample, window in lanes[lane]]


class StepSampler(Sampler[tuple[int, int]]):
    """Endless shuffled passes over a data set as (sample number, window), starting at any sample number.

    Args:
        num_windows: number of windows in the data set.
        seed: seed of the order. Every pass has its own order.
        start: returns the number of samples already used; called when iteration begins.
        probability: probability of each window [window]; a pass then consists of ``num_windows`` independent draws. With None a pass has every window once.
    """

    def __init__(self, num_windows: int, seed: int, start: Callable[[], int] = lambda: 0, probability: np.ndarray | None = None) -> None:
        self.num_windows, self.seed, self.start, self.probability = num_windows, seed, start, probability

    def __iter__(self) -> Iterator[tuple[int, int]]:
        sample = self.start()
        while True:
            epoch, offset = divmod(sample, self.num_windows)
            rng = np.random.default_rng((self.seed, epoch))
            if self.probability is None:
                order = rng.permutation(self.num_windows)
            else:
                order = rng.choice(self.num_windows, size=self.num_windows, p=self.probability)
            for window in order[offset:]:
                yield sample, int(window)
                sample += 1


@dataclass(frozen=True)
class BatchSize:
    """Number of samples in an optimiser step over all ranks.

    Attributes:
        num_graphs: number of samples, unless ``max_nodes`` is given.
        max_nodes: maximum number of nodes (see ``WindowDataset.num_nodes``). With it, a step takes the next samples in order up to this limit, but at least one
            sample.
    """

    num_graphs: Annotated[int, Field(ge=1)]
    max_nodes: Annotated[int, Field(ge=1)] | None = None

    def batches(self, data: WindowDataset, seed: int, step: int) -> Iterator[list[tuple[int, int]]]:
        """Yield the samples of each optimiser step as (sample number, window), from ``step`` on, without end."""
        if self.max_nodes is None:
            if data.scales:
                yield from islice(self._of_one_scale(data, iter(StepSampler(len(data), seed, probability=data.probability))), step, None)
            samples = iter(StepSampler(len(data), seed, lambda: step * self.num_graphs, data.probability))
            while True:
                yield list(islice(samples, self.num_graphs))
        else:
            yield from islice(
                self._packed(data, iter(StepSampler(len(data), seed, probability=data.probability)), self.max_nodes), step, None
            )

    def once(self, data: WindowDataset, windows: list[int]) -> list[list[int]]:
        """Return batches that contain each of these windows once, in order."""
        if self.max_nodes is None:
            return [windows[k : k + self.num_graphs] for k in range(0, len(windows), self.num_graphs)]
        return [[window for _, window in batch] for batch in self._packed(data, enumerate(windows), self.max_nodes)]

    def _of_one_scale(self, data: WindowDataset, samples: Iterator[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
        """Yield batches of samples that have the same spacing and frame interval, so that they can be unrolled together."""
        waiting: dict[Scale | None, list[tuple[int, int]]] = {}
        for sample in samples:
            own = waiting.setdefault(data.scale(sample[1]), [])
            own.append(sample)
            if len(own) == self.num_graphs:
                yield waiting.pop(data.scale(sample[1]))

    @staticmethod
    def _packed(data: WindowDataset, samples: Iterator[tuple[int, int]], max_nodes: int) -> Iterator[list[tuple[int, int]]]:
        batch, total = [next(samples)], 0
        for sample in samples:
            total += data.num_nodes(batch[-1][1])
            if total + data.num_nodes(sample[1]) > max_nodes:
                yield batch
                batch, total = [], 0
            batch.append(sample)
        yield batch


class BatchSampler(Sampler[list[Key]]):
    """Samples of this rank in each optimiser step. All ranks together follow the order that a single process would follow.

    Args:
        data: training windows. If their ``unroll_steps`` is above 1, samples are unrolls with gradients.
        size: size of the batches.
        seed: seed of the order.
        step: returns the number of optimiser steps already taken; called when iteration begins.
        push_forward: settings of the push-forward trick, or None.

    Raises:
        StoreError: batches may have fewer samples than there are ranks, or have a number of nodes although the data have several scales.
    """

    def __init__(
        self, data: WindowDataset, size: BatchSize, seed: int, step: Callable[[], int], push_forward: PushForward | None = None
    ) -> None:
        self.data, self.size, self.seed, self.step, self.push_forward = data, size, seed, step, push_forward
        if data.scales and size.max_nodes is not None:
            raise StoreError(f"batching.max_nodes={size.max_nodes}: not for data of several scales; choose batching=by_number")
        largest = max(t.num_nodes for t in data.trajectories)
        fewest = size.num_graphs if size.max_nodes is None else size.max_nodes // largest
        if fewest < ranks.num_ranks() > 1:
            what = f"training.batch_size={size.num_graphs}" if size.max_nodes is None else f"batching.max_nodes={size.max_nodes}"
            nodes = "" if size.max_nodes is None else f" of up to {largest} nodes"
            raise StoreError(
                f"{what}: too small for {ranks.num_ranks()} processes, each of which takes at least one graph{nodes}; raise it, or lower trainer.devices"
            )

    def __iter__(self) -> Iterator[list[Key]]:
        first, push = self.step(), self.push_forward
        num_plain = None if push is None else max(0, push.first_step - first)
        batches = map(self._part, self.size.batches(self.data, self.seed, first if push is None else min(first, push.first_step)))
        for batch in islice(batches, num_plain):
            yield [UnrollKey(*key) for key in batch] if self.data.unroll_steps > 1 else [*batch]
        if push is not None:
            for starts in islice(push.starts(batches), max(0, first - push.first_step), None):
                yield [*starts]

    def _part(self, batch: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Select the samples of this rank. Each sample, the largest first, goes to the rank with the fewest nodes so far."""
        if ranks.num_ranks() == 1:
            return batch
        nodes = {sample: self.data.num_nodes(window) for sample, window in batch}
        load = [0] * ranks.num_ranks()
        own = set()
        for sample in sorted(nodes, key=lambda sample: -nodes[sample]):
            fewest = load.index(min(load))
            load[fewest] += nodes[sample]
            if fewest == ranks.rank():
                own.add(sample)
        return [(sample, window) for sample, window in batch if sample in own]
