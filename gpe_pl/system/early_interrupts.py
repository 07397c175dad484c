"""Handling of Ctrl-C where a command cannot catch it: during its imports, and in code whose exceptions Python ignores."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

NOTICE = "interrupted"
STATUS = 130
"""Exit status after Ctrl-C, following the convention of shells."""
COMMANDS = ("fit", "simulate", "evaluate", "identify", "benchmark", "convert")


def begin() -> None:
    """Let Ctrl-C end the process with one line from now on, if the process is starting a command (``python -m gpe_pl.COMMAND``)."""
    is_command = sys.argv[:1] == ["-m"] and any(f"gpe_pl.{name}" in sys.orig_argv for name in COMMANDS)
    if is_command:
        catch()


def catch() -> None:
    """Let Ctrl-C end the process with one line from now on. Nothing changes if Ctrl-C is ignored or already has another handler."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_process)


def end() -> None:
    """Let Ctrl-C raise ``KeyboardInterrupt`` again.

    Python ignores exceptions in destructors and in callbacks of weak references. An interrupt there is repeated after ``SECONDS_LATER``.
    """
    sys.unraisablehook = _interrupt_again
    if signal.getsignal(signal.SIGINT) is _end_process:
        signal.signal(signal.SIGINT, signal.default_int_handler)


SECONDS_LATER = 0.02
"""Delay before an ignored interrupt is repeated [s]."""


def _interrupt_again(ignored: UnraisableHookArgs) -> None:
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        again = threading.Timer(SECONDS_LATER, _thread.interrupt_main)  # the exception would be ignored here too
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(ignored)


def _end_process(number: int, frame: FrameType | None) -> None:
    """End the process at once. Nothing has been written yet, and libraries may misread an exception during their imports."""
    os.write(2, f"{NOTICE}\n".encode())
    os._exit(STATUS)
