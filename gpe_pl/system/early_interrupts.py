"""Ctrl-C while a command imports what it needs, before it can catch anything itself, and where Python ignores exceptions."""

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
"""Exit status after Ctrl-C, as shells have it."""
COMMANDS = ("fit", "simulate", "evaluate", "benchmark", "convert")


def begin() -> None:
    """End the process with one line on Ctrl-C from now on, if it is a command that begins: ``python -m gpe_pl.COMMAND``."""
    is_command = sys.argv[:1] == ["-m"] and any(f"gpe_pl.{name}" in sys.orig_argv for name in COMMANDS)
    if is_command:
        catch()


def catch() -> None:
    """The same in any process, unless Ctrl-C is ignored or somebody else catches it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end_process)


def end() -> None:
    """Ctrl-C raises ``KeyboardInterrupt`` again, and a moment later once more where that is ignored, as in destructors and callbacks of weak references."""
    sys.unraisablehook = _interrupt_again
    if signal.getsignal(signal.SIGINT) is _end_process:
        signal.signal(signal.SIGINT, signal.default_int_handler)


SECONDS_LATER = 0.02


def _interrupt_again(ignored: UnraisableHookArgs) -> None:
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        again = threading.Timer(SECONDS_LATER, _thread.interrupt_main)  # the exception would be ignored here too
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(ignored)


def _end_process(number: int, frame: FrameType | None) -> None:
    """At once: nothing has been written, and libraries may take an exception in their imports for another one."""
    os.write(2, f"{NOTICE}\n".encode())
    os._exit(STATUS)
