"""The runs that a table is measured over: real and generated tracks, each driven with several seeds."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol, TypeVar

import numpy as np
from joblib import Parallel, delayed, parallel_config
from rich.console import Console

from pathspace_graph.errors import InputError
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.log import Log
from pathspace_graph.progress import progress
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

FOLDERS: Final = ("pacsim", "fssim", "eufs")
"""Where the real Formula Student tracks are, in the folder that is given."""
SUFFIXES: Final = (".yaml", ".yml", ".csv")
"""Of track files."""
FILE_WIDTH: Final = 140
"""Characters in a line of a table that goes to a file."""


@dataclass(frozen=True)
class Case:
    """One run: a track, driven with one seed."""

    track: Path | int
    """Track file, or the seed of a generated track."""
    seed: int
    """Of the drive and its noise."""
    laps: int
    """Laps driven."""

    @property
    def name(self) -> str:
        """What the track is called in the table."""
        return f"generated {self.track}" if isinstance(self.track, int) else self.track.stem

    def simulated(self) -> Log:
        """Its log, with truth."""
        if isinstance(self.track, int):
            track = generate_track(np.random.default_rng(self.track))
        else:
            track = read_track(self.track)
        return simulate(track, SimulationSettings(laps=self.laps), self.seed)


class Finished(Protocol):
    """What came of a case."""

    @property
    def case(self) -> Case:
        """The run."""

    @property
    def failure(self) -> str:
        """What it failed of; empty where it finished."""


Outcome = TypeVar("Outcome", bound=Finished)


def find_tracks(folder: Path) -> list[Path]:
    """The track files of the known subfolders, in order; InputError where there are none."""
    files = [
        file for name in FOLDERS for file in sorted((folder / name).glob("*")) if file.suffix in SUFFIXES
    ]
    if not files:
        raise InputError(folder, f"expected track files in {', '.join(FOLDERS)}, found none")
    return files


def make_cases(tracks: Sequence[Path], generated: int, seeds: int, laps: int) -> list[Case]:
    """Every track, and `generated` generated ones, with every seed."""
    every = [*tracks, *range(generated)]
    return [Case(track, seed, laps) for track in every for seed in range(seeds)]


@dataclass(frozen=True, kw_only=True)
class CaseOptions:
    """What a table is measured over, and how it is printed."""

    tracks: Path | None = None
    """Folder of real tracks, with subfolders pacsim, fssim and eufs."""
    generated: int = 3
    """Number of generated tracks."""
    seeds: int = 5
    """Drives on each track."""
    laps: int = 5
    """Laps of each drive."""
    jobs: int = 2
    """Runs at a time."""
    markdown: bool = False
    """Print Markdown instead of tables for a terminal."""

    def cases(self) -> list[Case]:
        """All of them; InputError where the folder holds no tracks."""
        tracks = [] if self.tracks is None else find_tracks(self.tracks)
        return make_cases(tracks, self.generated, self.seeds, self.laps)


def measure(run: Callable[[Case], Outcome], cases: Sequence[Case], jobs: int) -> list[Outcome]:
    """What comes of every case, in their order; `jobs` at a time, each on one thread, with progress."""
    found: dict[Case, Outcome] = {}
    with (
        progress("measuring", len(cases)) as advance,
        parallel_config(backend="loky", inner_max_num_threads=1),
    ):
        tasks = (delayed(run)(case) for case in cases)
        for outcome in Parallel(n_jobs=jobs, return_as="generator_unordered")(tasks):
            found[outcome.case] = outcome
            advance()
    return [found[case] for case in cases]


def by_track(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """The outcomes of each track, in their order."""
    found: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        found.setdefault(outcome.case.name, []).append(outcome)
    return found


def show(tables: Sequence[TextTable], outcomes: Sequence[Finished], markdown: bool) -> None:
    """Print the tables, and what failed."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=FILE_WIDTH)
    for table in tables:
        if markdown:
            sys.stdout.write(f"{table.markdown()}\n")
        else:
            console.print(table.rich())
    for outcome in outcomes:
        if outcome.failure:
            sys.stderr.write(f"{outcome.case.name}, seed {outcome.case.seed}: {outcome.failure}\n")
