"""Signals that end a training. They are noted at once; the training ends at the next step at which it can be saved."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any

SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
"""Signals of Ctrl-C (``SIGINT``), of ``kill`` (``SIGTERM``) and of clusters before a job's time is over (``SIGUSR1``, ``SIGUSR2``)."""

NOTICE = (
    "interrupted: training saves a checkpoint after this step, or after the validation that is running; interrupt again to stop at once\n"
)


class Interruption:
    """Notes whether this process was asked to end. A second signal raises ``KeyboardInterrupt`` at once.

    Use it as a context manager: on exit it restores the previous signal handlers.

    Attributes:
        requested: whether a signal has arrived since ``listen`` was called.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # Python lets no other thread set handlers
            numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
            self._before = {number: signal.getsignal(number) for number in numbers}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            if handler is not None:  # None: not set from Python, so Python cannot restore it
                signal.signal(number, handler)

    def listen(self) -> None:
        """Note signals from now on, except those that are ignored, as in background jobs of a shell."""
        for number, handler in self._before.items():
            if handler is not None and handler is not signal.SIG_IGN:
                signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, NOTICE.encode())  # the signal may have interrupted print
