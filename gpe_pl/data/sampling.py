"""Which windows an optimiser step takes: an endless order that starts anywhere, and is the same whatever the number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count, islice
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from torch.utils.data import Sampler

from gpe_pl.data.dataset import Key, StartKey, WindowDataset
from gpe_pl.system import ranks
from gpe_pl.trajectory.store import StoreError

Sampling = Literal["uniform", "activity"]
"""How often each window is drawn: all alike, or the more often the more happens in it."""

UNIFORM_SHARE = 0.2
"""Of ``activity``: the share that is drawn from all windows alike, which limits their weights to five."""


def probabilities(activity: np.ndarray) -> np.ndarray:
    """Probability of each window under ``activity`` sampling.

    The gradient of a squared error grows with the error, and that with what there is to predict: to draw in proportion to it, and to weigh by the
    inverse, scatters least and leaves the expected gradient as it is [importance sampling, Katharopoulos and Fleuret 2018, arXiv 1803.00942].
    """
    total = activity.sum()
    if not total > 0:
        return np.full(len(activity), 1 / len(activity))
    return UNIFORM_SHARE / len(activity) + (1 - UNIFORM_SHARE) * activity / total


NUM_LANES = 16
"""Batches that are under way at a time. Steps of the optimiser that follow on each other take them in turn, so that they are about different scenes."""


@dataclass(frozen=True)
class PushForward:
    """Late in training samples are states that the model itself has come to from a true state, in up to ``max_steps`` steps of its own, which the gradient
    does not see [the push-forward trick of Brandstetter et al. 2022, section 3.1].

    Attributes:
        first_step: of the optimiser from which this is done.
        max_steps: own steps. A batch is trained on at its true state and after each of these steps, then the next one takes its lane.
        correction: share of what velocities have gone astray by that the target takes back within a step. The trick takes all, which suits what friction
            slows down anyway; bodies that swing would have to be stopped by forces that they do not have.
    """

    first_step: Annotated[int, Field(ge=0)]
    max_steps: Annotated[int, Field(ge=1)]
    correction: Annotated[float, Field(ge=0, le=1)] = 1.0

    def starts(self, batches: Iterator[list[tuple[int, int]]]) -> Iterator[list[StartKey]]:
        """The starts of each optimiser step from ``first_step`` on. The lanes begin with different numbers of own steps, so that all numbers are about as
        frequent at any time.
        """
        num_visits = self.max_steps + 1
        lanes = [next(batches) for _ in range(NUM_LANES)]
        for turn in count():
            for lane in range(NUM_LANES):
                own_steps = (turn + lane * num_visits // NUM_LANES) % num_visits
                if turn and not own_steps:
                    lanes[lane] = next(batches)
                yield [StartKey(sample, window, own_steps, lane, self.correction) for sample, window in lanes[lane]]


class StepSampler(Sampler[tuple[int, int]]):
    """Endless shuffled passes over a data set as (sample number, window), starting at any sample number.

    Args:
        num_windows: size of the data set.
        seed: of the order; every pass has its own.
        start: called when iteration begins; the number of samples already consumed.
        probability: of each window; a pass is then as many independent draws. None: a pass has every window once.
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
    """How many samples an optimiser step takes, all ranks together.

    Attributes:
        num_graphs: so many.
        max_nodes: if given, instead: the next ones in the order whose nodes (see ``WindowDataset.num_nodes``) are at most so many together, at least one.
    """

    num_graphs: Annotated[int, Field(ge=1)]
    max_nodes: Annotated[int, Field(ge=1)] | None = None

    def batches(self, data: WindowDataset, seed: int, step: int) -> Iterator[list[tuple[int, int]]]:
        """The samples of each optimiser step, from a step on, without end."""
        if self.max_nodes is None:
            samples = iter(StepSampler(len(data), seed, lambda: step * self.num_graphs, data.probability))
            while True:
                yield list(islice(samples, self.num_graphs))
        else:
            yield from islice(
                self._packed(data, iter(StepSampler(len(data), seed, probability=data.probability)), self.max_nodes), step, None
            )

    def once(self, data: WindowDataset, windows: list[int]) -> list[list[int]]:
        """Batches that take each of these windows once, in their order."""
        if self.max_nodes is None:
            return [windows[k : k + self.num_graphs] for k in range(0, len(windows), self.num_graphs)]
        return [[window for _, window in batch] for batch in self._packed(data, enumerate(windows), self.max_nodes)]

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
    """What this rank takes of the samples of each optimiser step. The order is one for all ranks, and the same as that of a single process.

    Args:
        data: training windows.
        size: of the batches.
        seed: of the order.
        step: called when iteration begins; the number of optimiser steps already taken.
        push_forward: from which step on samples have own steps of the model.

    Raises:
        StoreError: batches may have fewer samples than there are ranks.
    """

    def __init__(
        self, data: WindowDataset, size: BatchSize, seed: int, step: Callable[[], int], push_forward: PushForward | None = None
    ) -> None:
        self.data, self.size, self.seed, self.step, self.push_forward = data, size, seed, step, push_forward
        largest = max(t.num_nodes for t in data.trajectories)
        fewest = size.num_graphs if size.max_nodes is None else size.max_nodes // largest
        if fewest < ranks.num_ranks() > 1:
            what = f"training.batch_size={size.num_graphs}" if size.max_nodes is None else f"batching.max_nodes={size.max_nodes}"
            nodes = "" if size.max_nodes is None else f" of up to {largest} nodes"
            raise StoreError(f"{what}: too small for {ranks.num_ranks()} processes, each of which takes at least one graph{nodes}")

    def __iter__(self) -> Iterator[list[Key]]:
        first, push = self.step(), self.push_forward
        num_plain = None if push is None else max(0, push.first_step - first)
        batches = map(self._part, self.size.batches(self.data, self.seed, first if push is None else min(first, push.first_step)))
        for batch in islice(batches, num_plain):
            yield [*batch]
        if push is not None:
            for starts in islice(push.starts(batches), max(0, first - push.first_step), None):
                yield [*starts]

    def _part(self, batch: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Samples dealt by their nodes, the largest first, each to the rank that has the fewest so far."""
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
