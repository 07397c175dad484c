"""Switch between compiled passes for CPUs and plain operations of NumPy and PyTorch. Both give the same results; plain ones serve for comparison."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_is_wanted = ContextVar("_is_wanted", default=True)


def is_wanted() -> bool:
    """Tell whether compiled passes are wanted. They are, except inside ``unfused``."""
    return _is_wanted.get()


@contextmanager
def unfused() -> Iterator[None]:
    """Use only plain operations of NumPy, SciPy and PyTorch inside this block: in graphs, in steps, and in forward passes with their backward passes."""
    token = _is_wanted.set(False)
    try:
        yield
    finally:
        _is_wanted.reset(token)
