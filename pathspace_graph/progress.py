"""Progress of long work, on standard error and only where that is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)


@contextmanager
def progress(description: str, total: int | None = None) -> Iterator[Callable[[], None]]:
    """Show a bar (a spinner where the total isn't known) and yield what is to be called after each step."""
    console = Console(stderr=True)
    columns = [SpinnerColumn(), TextColumn("{task.description}")]
    known = [BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()] if total is not None else []
    with Progress(
        *columns, *known, console=console, transient=True, disable=not console.is_terminal
    ) as display:
        task = display.add_task(description, total=total)
        yield lambda: display.advance(task)
