"""Progress of long work, shown in the terminal."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from gpe_pl.printable import one_line

Progress = Callable[[int, int], Any]  # called with how much is done, and the total


@contextlib.contextmanager
def progress_bar(description: str) -> Iterator[Progress]:
    """A bar with the remaining time in the terminal; yields what long work takes as ``on_progress``.

    The remaining time follows from the work since the bar appeared, so that resumed work does not count what was done before.
    """
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Bar(*columns, refresh_per_second=2) as bar:  # drawn from within the process whose work it shows
        task = bar.add_task(escape(one_line(description)), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
