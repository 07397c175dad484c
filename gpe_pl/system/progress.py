"""Progress bars in the terminal and in notebooks."""

from __future__ import annotations

import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

from gpe_pl.errors.printable import one_line

Progress = Callable[[int, int], Any]  # arguments: amount done, total amount
Bars = Callable[[str], AbstractContextManager[Progress]]
"""Makes the bar of a phase from its label: ``progress_bar`` or ``no_bar``."""

WINDOW = 30.0
"""Time over which the rate is measured [s]."""
APART = 0.1
"""Updates that follow each other faster than this count as one [s]."""
FEWEST = 5
"""Number of updates over which the rate is measured if fewer came within ``WINDOW``."""


class Pace:
    """Rate of some work and its remaining time, from the last updates. The first update is the start, so work done before it does not count."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._updates = clock, deque[tuple[float, int]]()

    def update(self, done: int) -> None:
        """Count work as done up to ``done``."""
        now = self._clock()
        if len(self._updates) > 2 and now - self._updates[-2][0] < APART:
            self._updates.pop()
        self._updates.append((now, done))
        while len(self._updates) > FEWEST + 1 and self._updates[1][0] < now - WINDOW:
            self._updates.popleft()

    @property
    def per_second(self) -> float:
        """Amount per second; 0 before the second update."""
        if not self._updates:
            return 0.0
        (first, low), (last, high) = self._updates[0], self._updates[-1]
        return (high - low) / (last - first) if last > first else 0.0

    def rate(self) -> str:
        """Return the rate as text, as the time of one where that is longer than a second."""
        rate = self.per_second
        if rate <= 0:
            return ""
        return f"{rate:.3g}/s" if rate >= 1 else f"{1 / rate:.{0 if rate < 0.01 else 1}f} s each"

    def remaining(self, total: int) -> str:
        """Return the time until ``total`` is done, which goes on falling between two updates."""
        if not self.per_second:
            return "-:--:--"
        last, done = self._updates[-1]
        seconds = math.ceil(max(0.0, (total - done) / self.per_second - (self._clock() - last)))
        return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


@contextlib.contextmanager
def progress_bar(description: str, note: Callable[[], str] | None = None) -> Iterator[Progress]:
    """Show a progress bar with rate and remaining time; yields the callback ``on_progress(done, total)`` that long work takes.

    Args:
        description: name of the work.
        note: called whenever the bar is drawn, returns a further text, such as a loss.
    """
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar
    from rich.text import Text

    pace = Pace()

    class PaceColumn(ProgressColumn):
        """Rate, remaining time and note."""

        def render(self, task: Task) -> Text:
            left = "" if task.total is None or task.finished else f"{pace.remaining(int(task.total))} left"
            return Text("  ".join(part for part in (pace.rate(), left, note() if note else "") if part), style="progress.remaining")

    def update(done: int, total: int) -> None:
        pace.update(done)
        bar.update(task, completed=done, total=total)

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), PaceColumn())
    with Bar(*columns, refresh_per_second=2) as bar:  # drawn by the process that also does the work
        task = bar.add_task(escape(one_line(description)), total=None)
        yield update


@contextlib.contextmanager
def no_bar(description: str) -> Iterator[Progress]:
    """Show nothing; yields a callback like that of ``progress_bar``."""
    yield lambda done, total: None
