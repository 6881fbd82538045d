"""Progress of a study with the time left, on standard error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

LINES: Final = 20
"""Lines that a whole study leaves where there is no terminal to draw a bar on."""


@contextmanager
def study_progress() -> Iterator[Callable[[int, int], None]]:
    """Yield what is to be told `(done, total)`: a bar on a terminal, elsewhere a line now and then.

    The time left is that of the cells done so far, by the mean: a cell takes longer than a bar's own memory.
    """
    console = Console(stderr=True, highlight=False)
    begin = time.monotonic()
    columns = [
        SpinnerColumn(),
        TextColumn("cells"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
    ]
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as display:
        task = display.add_task("", total=None, left="simulating")

        def told(done: int, total: int) -> None:
            left = time_left(time.monotonic() - begin, done, total)
            display.update(task, completed=done, total=total, left=left)
            step = -(-total // LINES)
            if not console.is_terminal and (done % step == 0 or done == total):
                console.print(f"{done} of {total} cells, {left}")

        yield told


def time_left(elapsed: float, done: int, total: int) -> str:
    """In words: `elapsed (total - done) / done` seconds."""
    if not done:
        return "time left unknown"
    return f"{timedelta(seconds=round(elapsed * (total - done) / done))} left"
