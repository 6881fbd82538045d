"""Cells of a study: one estimator with one set of settings on one log."""

from __future__ import annotations

import hashlib
import json
import time
import traceback
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.metrics.measures import METRICS, Row, measure
from pathspace_graph.eval.metrics.summary import lap_times, versions
from pathspace_graph.io.log import Log
from pathspace_graph.io.results import RunResult
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

from .overrides import check_name

FORMAT: Final = "pathspace-cell/1"
_ID_LENGTH: Final = 20
"""Hexadecimal digits of an identity: 80 bits."""

Record = dict[str, Any]
"""What is kept of a cell: JSON's types only."""


@dataclass(frozen=True, eq=False)
class NamedTrack:
    """A track as a study knows it."""

    name: str
    """What it is called in the results."""
    track: Track
    """Its cones."""

    @cached_property
    def digest(self) -> str:
        """Identity of its geometry, wherever it came from."""
        parts = (self.track.left, self.track.right, self.track.other, self.track.start)
        cones = b"|".join(np.ascontiguousarray(part, dtype=float).tobytes() for part in parts)
        return hashlib.sha256(cones + str(self.track.closed).encode()).hexdigest()[:_ID_LENGTH]


@dataclass(frozen=True, eq=False)
class Drive:
    """A log that is simulated once, for all the cells on it."""

    track: NamedTrack
    """Where."""
    seed: int
    """Of the drive and its noise."""
    noise: str
    """Name of the noise."""
    simulation: SimulationSettings
    """The drive."""

    @cached_property
    def id(self) -> str:
        """The same for the same log."""
        return _identity(track=self.track.digest, seed=self.seed, simulation=asdict(self.simulation))

    def simulate(self) -> Log:
        """The log."""
        return simulate(self.track.track, self.simulation, self.seed)


@dataclass(frozen=True, eq=False)
class Cell:
    """One run."""

    drive: Drive
    """Its log."""
    estimator: str
    """Name of the estimator."""
    variant: str
    """Name of its settings."""
    settings: MapperSettings
    """Everything it is told."""

    @cached_property
    def id(self) -> str:
        """The same for the same run: everything that its result depends on, but for the code."""
        return _identity(drive=self.drive.id, estimator=self.estimator, settings=asdict(self.settings))

    @property
    def names(self) -> dict[str, Any]:
        """What tells it from the others of its study."""
        drive = self.drive
        shared = {"track": drive.track.name, "seed": drive.seed, "noise": drive.noise}
        return shared | {"estimator": self.estimator, "variant": self.variant}


def _identity(**parts: Any) -> str:
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_ID_LENGTH]


def load_tracks(tracks: tuple[Path | int, ...]) -> list[NamedTrack]:
    """The tracks with a name each; InputError where a file is none."""
    files = [track for track in tracks if isinstance(track, Path)]
    stems = [file.stem for file in files]
    loaded = []
    for track in tracks:
        if isinstance(track, int):
            generated = generate_track(np.random.default_rng(track))
            loaded.append(NamedTrack(f"generated {track}", generated))
        else:
            unique = stems.count(track.stem) == 1
            name = track.stem if unique else f"{track.resolve().parent.name}/{track.stem}"
            _check_file(track)
            loaded.append(NamedTrack(name, read_track(track)))
    return loaded


def _check_file(file: Path) -> None:
    """InputError, naming the nearest file of the folder, where there is none."""
    if not file.exists() and file.parent.is_dir():
        beside = sorted(entry.name for entry in file.parent.iterdir() if entry.suffix == file.suffix)
        try:
            check_name(file.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(file, str(error)) from error


# --- runs ------------------------------------------------------------------------------------------------


def run_cell(cell: Cell, log: Log) -> Record:
    """Run the cell's estimator on its log, on one BLAS thread; a failure is a record as well."""
    try:
        with threadpool_limits(limits=1):
            begin = time.perf_counter()
            result = run_estimator(cell.estimator, cell.settings, log)
            seconds = time.perf_counter() - begin
            laps = _lap_rows(measure(log, result, seconds, marginals=True))
        return _record(cell, laps=laps)
    except Exception as error:  # whatever ends a run belongs into the results
        return failed(cell, error)


def try_drive(drive: Drive) -> Log | Exception:
    """The drive's log, or what it failed of: its cells fail then, the others' don't."""
    try:
        return drive.simulate()
    except Exception as error:
        return error


def failed(cell: Cell, error: BaseException) -> Record:
    """The record of a cell that could not be run."""
    trace = "".join(traceback.format_exception(error))
    return _record(cell, failure=f"{type(error).__name__}: {error}", traceback=trace)


def run_estimator(name: str, settings: MapperSettings, log: Log) -> RunResult:
    """An online estimator cycle by cycle, with its map at each true lap's end, or a batch one at once."""
    if name in registry.ONLINE:
        estimator = registry.make_online(name, settings, log)
        return run_online(log, estimator, name=name, snapshot_times=lap_times(log))
    return registry.make_batch(name, settings, log).solve(log)


def _lap_rows(rows: list[Row]) -> list[dict[str, Any]]:
    """Returns a row for each lap, with the metrics of the whole run beside its own.

    A run that completed no lap has one row, that of the whole run as lap 1.
    """
    *laps, whole = rows
    shared = {key: value for key, value in whole.values.items() if METRICS[key].scope == "run"}
    return [{"lap": row.lap, **row.values, **shared} for row in laps] or [{"lap": 1, **whole.values}]


def _record(cell: Cell, **what: Any) -> Record:
    shared = {"format": FORMAT, "id": cell.id, "cell": cell.names, "versions": versions()}
    return shared | {"failure": "", "traceback": "", "laps": []} | what
