"""Progress bars in the terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from gpe_pl.errors.printable import one_line

Progress = Callable[[int, int], Any]  # arguments: amount done, total amount


@contextlib.contextmanager
def progress_bar(description: str) -> Iterator[Progress]:
    """Show a progress bar with the remaining time; yields the callback ``on_progress(done, total)`` that long work takes.

    The remaining time is estimated from the updates in the last 30 s. The first update does not count, so that work done before a resumed command began does
    not distort the estimate.
    """
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Bar(*columns, refresh_per_second=2) as bar:  # drawn by the process that also does the work
        task = bar.add_task(escape(one_line(description)), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
