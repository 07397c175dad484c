"""Signals that end a training: noted at once, obeyed at the next moment at which it can be saved."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any

SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
"""Ctrl-C, the usual end of a process, and what clusters send before a job's time is over."""

NOTICE = (
    "interrupted: training saves a checkpoint after this step, or after the validation that is running; interrupt again to stop at once\n"
)


class Interruption:
    """Whether this process was asked to end. A second signal raises ``KeyboardInterrupt`` wherever the program is.

    As a context manager it gives the signals back to whom they belonged before.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruption:
        if threading.current_thread() is threading.main_thread():  # Python lets no other thread change them
            numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
            self._before = {number: signal.getsignal(number) for number in numbers}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for number, handler in self._before.items():
            if handler is not None:  # one that was not set from Python cannot be set from it
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
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, NOTICE.encode())  # print may be what was interrupted
