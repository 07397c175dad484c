"""Worker processes, which end with the process that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from gpe_pl.errors import GpeError


class WorkerError(GpeError, RuntimeError):
    """Raised when a worker process died."""


def _prepare() -> None:
    """Prepare a worker: it ends when its parent is killed, and ignores Ctrl-C, which reaches all processes and is handled by the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def pool(num_workers: int) -> Iterator[Executor | None]:
    """Start worker processes for ``results``; yields None for one worker, whose work this process does itself.

    If the block ends with an error, the workers are terminated.
    """
    if num_workers == 1:
        yield None
        return
    before = os.environ.get("NUMBA_NUM_THREADS")
    os.environ["NUMBA_NUM_THREADS"] = "1"  # inherited by the workers: one process per core, one thread per process
    executor = ProcessPoolExecutor(num_workers, multiprocessing.get_context("spawn"), _prepare)
    try:
        yield executor
    except BaseException:
        for process in list((executor._processes or {}).values()):
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)
        if before is None:
            del os.environ["NUMBA_NUM_THREADS"]
        else:
            os.environ["NUMBA_NUM_THREADS"] = before


def results(executor: Executor | None, function: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield the results of ``function`` as they complete.

    Args:
        executor: from ``pool``; None calls the function in this process.
        function: picklable function.
        arguments: positional arguments of each call.

    Raises:
        WorkerError: a worker process died.
    """
    if executor is None:
        for values in arguments:
            yield function(*values)
        return
    try:
        with _uninterrupted():
            futures: list[Future[Any]] = [executor.submit(function, *values) for values in arguments]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool:
        raise WorkerError(
            "a worker process died (killed, or out of memory); run the same command again to resume, with fewer workers"
        ) from None


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C inside the block. Processes started in it never receive one, even before they can ignore it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
