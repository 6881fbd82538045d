"""Progress: a line now and then where there is no terminal, with the time that remains."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from pathspace_graph.console import progress, say


def test_the_time_that_remains_is_that_of_the_mean_step(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter((0.0, 30.0, 30.0, 30.0))
    monkeypatch.setattr("pathspace_graph.console.time", SimpleNamespace(monotonic=lambda: next(clock)))
    with progress("cells", 4, lines=4) as advance:
        for done in (0, 1, 4):
            advance(done)
    told = [line.split(", ")[1] for line in capsys.readouterr().err.splitlines()]
    assert told == ["time left unknown", "0:01:30 left", "0:00:00 left"]


def test_without_a_terminal_only_the_lines_that_were_asked_for_are_written(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with progress("mapping", 3) as advance:
        advance()
    assert capsys.readouterr().err == ""
    with progress("cells", lines=2) as advance:
        for done in range(1, 6):
            advance(done, 5)
    assert [line.split(",")[0] for line in capsys.readouterr().err.splitlines()] == [
        "cells: 3 of 5",
        "cells: 5 of 5",
    ]


def test_a_closed_pipe_is_left_to_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with pytest.raises(BrokenPipeError), os.fdopen(write, "w", buffering=1) as pipe:
        monkeypatch.setattr("sys.stdout", pipe)
        say("nobody reads this")
