"""Wall times of alternatives, measured in turns so that whatever else the machine does hits all of them alike."""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Of glibc's ``mallopt``."""


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


@contextmanager
def apart(factories: Mapping[str, Callable[[], Callable[[], Any]]]) -> Iterator[dict[str, Callable[[], None]]]:
    """The functions that the factories make, each in a process of its own: a call waits until the function has run there, and returns nothing.

    In one process functions with large arrays find what the others left in the allocator's heap, which can cost them a third of their time; so can pages that
    the system takes back and returns. Here each has a heap of its own, which keeps what it has (with glibc).

    Args:
        factories: picklable, called in the new processes.

    Raises:
        RuntimeError: a process ended; its error is on the standard error.
    """
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        connections = {}
        for name, factory in factories.items():
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there, factory))
            process.start()
            there.close()
            stack.callback(process.join)
            stack.callback(here.close)  # comes first, and ends the process
            connections[name] = here
        for name, connection in connections.items():
            _wait(name, connection)
        yield {name: partial(_call, name, connection) for name, connection in connections.items()}


def _serve(connection: Connection, factory: Callable[[], Callable[[], Any]]) -> None:
    """Runs the function whenever it is asked to, until there is nobody left to ask."""
    _keep_memory()
    function = factory()
    connection.send(None)
    while True:
        try:
            connection.recv()
        except EOFError:
            return
        function()
        connection.send(None)


def _keep_memory() -> None:
    """Nothing that is freed goes back to the system, so that what is allocated next finds its pages there."""
    if hasattr(os, "confstr_names") and "CS_GNU_LIBC_VERSION" in os.confstr_names:
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_MAX, 0)
        libc.mallopt(M_TRIM_THRESHOLD, -1)


def _call(name: str, connection: Connection) -> None:
    try:
        connection.send(None)
    except OSError:
        raise RuntimeError(f"{name}: its process has ended") from None
    _wait(name, connection)


def _wait(name: str, connection: Connection) -> None:
    try:
        connection.recv()
    except (EOFError, OSError):
        raise RuntimeError(f"{name}: its process ended; its error stands above") from None
