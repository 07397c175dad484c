"""Wall times of alternatives, measured in turns so that whatever else the machine does hits all of them alike."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

log = logging.getLogger(__name__)


def paired_times(
    alternatives: Mapping[str, Callable[[], Any]], num_rounds: int = 20, num_warmups: int = 2, what: str = ""
) -> dict[str, np.ndarray]:
    """Seconds [round] of each alternative; every round runs all of them once, in an order that rotates. Rounds of ``what`` are logged, if it is given."""
    names = list(alternatives)
    for _ in range(num_warmups):
        for name in names:
            alternatives[name]()
    times: dict[str, list[float]] = {name: [] for name in names}
    for k in range(num_rounds):
        shift = k % len(names)
        for name in names[shift:] + names[:shift]:
            start = time.perf_counter()
            alternatives[name]()
            times[name].append(time.perf_counter() - start)
        if what:
            log.info("%s: round %d of %d", what, k + 1, num_rounds)
    return {name: np.array(t) for name, t in times.items()}


def paired_ratio(times: Mapping[str, np.ndarray], name: str, reference: str) -> float:
    """Median over rounds of the time of ``name`` divided by that of ``reference`` in the same round."""
    return float(np.median(times[name] / times[reference]))
