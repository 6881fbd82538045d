"""Progress: a line now and then where there is no terminal, with the time that remains."""

from __future__ import annotations

import os

import pytest

from pathspace_graph.console import progress, say, time_remaining


def test_the_time_that_remains_is_that_of_the_mean_step() -> None:
    assert time_remaining(30.0, 0, 4) == "time left unknown"
    assert time_remaining(30.0, 1, 4) == "0:01:30 left"
    assert time_remaining(30.0, 4, 4) == "0:00:00 left"


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
