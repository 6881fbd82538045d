"""What a command prints: results on standard output, hints and the progress of long work on the other."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import timedelta
from importlib.util import find_spec
from typing import Final, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn

# How much is printed; hints and errors always are. QUIET is no results and no progress, VERBOSE is progress
# in lines where there is no terminal, and the traceback of an error.
VERBOSITY: Final = ContextVar("verbosity", default="NORMAL")
FILE_WIDTH: Final = 160  # width of tables where the output is no terminal (characters)
LINES: Final = 20  # about the number of lines of progress, where they are printed


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Leave a closed pipe to the command line; rich would exit with 1."""
        raise  # noqa: PLE0704


@contextmanager
def verbosity(level: Literal["QUIET", "NORMAL", "VERBOSE"]) -> Iterator[None]:
    before = VERBOSITY.set(level)
    try:
        yield
    finally:
        VERBOSITY.reset(before)


def output(wide: bool = False) -> Console:
    """Console for results; tables are `FILE_WIDTH` wide in a file if `wide`."""
    quiet = VERBOSITY.get() == "QUIET"
    console = _Output(quiet=quiet)
    return _Output(quiet=quiet, width=FILE_WIDTH) if wide and not console.is_terminal else console


def note(*lines: str) -> None:
    say(*lines, console=Console(stderr=True))


def say(*lines: str, console: Console | None = None) -> None:
    console = console or output()
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True, markup=False, emoji=False)


@contextmanager
def progress(description: str, total: int | None = None, lines: int = 0) -> Iterator[Callable[..., None]]:
    """Show a bar on a terminal, or a spinner without a total, and yield the function that counts a step.

    With arguments that function sets how many steps of how many are done. It tells the time that remains by
    the mean of the steps.

    A notebook shows the same bar with ipywidgets, and lines without. Elsewhere nothing is shown, unless
    `lines` asks for about that many lines.
    """
    level, console = VERBOSITY.get(), Console(stderr=True, highlight=False)
    lines = {"QUIET": 0, "VERBOSE": LINES}.get(level, lines)
    has_bar = console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)
    if console.is_jupyter and not has_bar and level != "QUIET":
        lines = lines or LINES
    text, remaining = (
        TextColumn(f"{{task.{name}}}", markup=False) for name in ("description", "fields[remaining]")
    )
    columns = (SpinnerColumn(), text, BarColumn(), MofNCompleteColumn(), remaining)
    shown = columns if total is not None or lines else columns[:2]
    hidden = level == "QUIET" or not has_bar
    with Progress(*shown, console=console, transient=True, disable=hidden) as display:
        begin, steps = time.monotonic(), 0
        task = display.add_task(description, total=total, remaining="")

        def step(done: int | None = None, of: int | None = None) -> None:
            nonlocal steps, total
            steps, total = steps + 1 if done is None else done, total if of is None else of
            remaining = ""
            if total is not None:
                remaining = "time left unknown"
                if steps:
                    mean = (time.monotonic() - begin) / steps
                    remaining = f"{timedelta(seconds=round(mean * (total - steps)))} left"
            display.update(task, completed=steps, total=total, remaining=remaining)
            is_due = lines and total and (steps % -(-total // lines) == 0 or steps == total)
            if is_due and not console.is_terminal:
                console.print(f"{description}: {steps} of {total}, {remaining}", markup=False)

        yield step
