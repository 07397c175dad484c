"""Wall times of alternatives, measured in turns so that other load on the machine affects all of them alike."""

from __future__ import annotations

import ctypes
import logging
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Options of glibc's ``mallopt``."""


def paired_times(
    alternatives: Mapping[str, Callable[[], Any]], num_rounds: int = 20, num_warmups: int = 2, what: str = ""
) -> dict[str, np.ndarray]:
    """Return the times [round] of each alternative in s. A round runs all alternatives once, in rotating order.

    Args:
        alternatives: functions by name.
        num_rounds: number of measured rounds.
        num_warmups: number of calls of each alternative before the first round; not measured.
        what: name of the measurement. If given, each round is logged with it.
    """
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
    """Return the median over rounds of the time of ``name`` divided by the time of ``reference`` in the same round."""
    return float(np.median(times[name] / times[reference]))


@contextmanager
def apart(
    factories: Mapping[str, Callable[[], Callable[..., Any]]], modules: Sequence[str] = ()
) -> Iterator[dict[str, Callable[..., Any]]]:
    """Yield functions, by name, that run in separate processes. A call sends its arguments there, waits, and returns the result.

    Functions with large arrays that share a process also share its heap, and slow each other down by up to a third. Returning memory to the system can cost as
    much. Here each function has a process and a heap of its own, which keeps freed memory (with glibc).

    Args:
        factories: picklable functions that are called in the new processes and return the functions to run. Arguments and results must be picklable.
        modules: modules that the new processes share, if the system can start processes so. They are imported once.

    Raises:
        RuntimeError: a process ended; its error is on the standard error.
    """
    context = _context(modules)
    with ExitStack() as stack:
        connections = {}
        for name, factory in factories.items():
            here, there = context.Pipe()
            process = context.Process(target=_serve, args=(there, factory))
            process.start()
            there.close()
            stack.callback(process.join)
            stack.callback(here.close)  # runs before the join, and ends the process
            connections[name] = here
        for name, connection in connections.items():
            _wait(name, connection)
        yield {name: partial(_call, name, connection) for name, connection in connections.items()}


def _context(modules: Sequence[str]) -> Any:
    """Return a way to start processes that have nothing of this one."""
    if not modules or "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*modules])
    return context


def _serve(connection: Connection, factory: Callable[[], Callable[..., Any]]) -> None:
    """Run the function at every request, until the connection is closed."""
    _keep_memory()
    function = factory()
    connection.send(None)
    while True:
        try:
            arguments = connection.recv()
        except EOFError:
            return
        connection.send(function(*arguments))


def _keep_memory() -> None:
    """Keep freed memory in this process, so that the next allocation finds its pages there."""
    if hasattr(os, "confstr_names") and "CS_GNU_LIBC_VERSION" in os.confstr_names:
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_MAX, 0)
        libc.mallopt(M_TRIM_THRESHOLD, -1)


def _call(name: str, connection: Connection, *arguments: Any) -> Any:
    try:
        connection.send(arguments)
    except OSError:
        raise RuntimeError(f"{name}: its process has ended") from None
    return _wait(name, connection)


def _wait(name: str, connection: Connection) -> Any:
    try:
        return connection.recv()
    except (EOFError, OSError):
        raise RuntimeError(f"{name}: its process ended; its error stands above") from None
