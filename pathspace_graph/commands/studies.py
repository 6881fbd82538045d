"""What the commands that run a study share: its own tracks, seeds and laps replaced, and what failed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import pandas as pd
from rich.console import Console

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.study.study import Study

CELLS_FAILED: Final = 3
"""This is the exit code of a study that is written, but some of whose cells failed."""
LINES: Final = 20
"""A whole study writes about this many lines of progress where there is no terminal."""


def with_drives(study: Study, tracks: tuple[str, ...], seeds: tuple[int, ...], laps: int | None) -> Study:
    """Returns the study with other tracks, seeds and laps, where any are given.

    A track is a file, or the seed of a generated track.
    """
    if laps is not None and laps < 1:
        raise SettingsError(f"--laps: expected at least 1, found {laps}")
    own: dict[str, object] = {"seeds": seeds} if seeds else {}
    own |= {"laps": laps} if laps else {}
    own |= {"tracks": tuple(int(t) if t.isdecimal() else Path(t) for t in tracks)} if tracks else {}
    return replace(study, **own)  # type: ignore[arg-type]


def report_failures(frame: pd.DataFrame, cells: int) -> None:
    """Says on standard error how many cells failed, and exits with code 3 where any did."""
    failures = frame[frame["failure"] != ""]
    if len(failures):
        line = f"{len(failures)} of {cells} cells failed, the first of {failures.iloc[0]['failure']}"
        Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(line)
        raise SystemExit(CELLS_FAILED)
