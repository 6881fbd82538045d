"""Drives: tracks by name, and the logs that are simulated on them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

TRACK_SUFFIXES: Final = (".yaml", ".yml", ".csv")
"""Track files end in one of these."""
_IDENTITY_DIGITS: Final = 20
"""An identity has this many hexadecimal digits, which are 80 bits."""


@dataclass(frozen=True, eq=False)
class NamedTrack:
    """A track with the name that it has in the results."""

    name: str
    """This is its name."""
    track: Track
    """These are its cones."""

    @cached_property
    def digest(self) -> str:
        """Identifies the geometry, wherever it came from."""
        track = self.track
        parts = (track.left, track.right, track.other, track.start, track.cone_labels)
        cones = b"|".join(np.ascontiguousarray(part, dtype=float).tobytes() for part in parts)
        return hashlib.sha256(cones + str(self.track.closed).encode()).hexdigest()[:_IDENTITY_DIGITS]


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive is simulated once, and its log serves every run on it."""

    track: NamedTrack
    """The vehicle drives on this track."""
    seed: int
    """This seed decides the drive and its noise."""
    noise: str
    """The noise has this name."""
    simulation: SimulationSettings
    """The simulation has these settings."""

    @cached_property
    def id(self) -> str:
        """Returns an identity of everything that the log depends on, except the code."""
        return identity(track=self.track.digest, seed=self.seed, simulation=asdict(self.simulation))

    def simulate(self) -> Log:
        """Simulates the log."""
        return simulate(self.track.track, self.simulation, self.seed)


def identity(**parts: Any) -> str:
    """Returns a text that is the same for the same values, which are JSON's types only."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_IDENTITY_DIGITS]


def try_drive(drive: Drive) -> Log | Exception:
    """Returns the drive's log, or the error of its simulation: other drives go on."""
    try:
        return drive.simulate()
    except Exception as error:
        return error


def load_tracks(tracks: Iterable[Path | int]) -> list[NamedTrack]:
    """Reads or generates tracks and names each of them; a folder stands for every track file in it.

    A number is the seed of a generated track. InputError where a file is no track or a folder has none.
    """
    every = [track for entry in tracks for track in _expanded(entry)]
    stems = [track.stem for track in every if isinstance(track, Path)]
    return [_load(track, stems) for track in every]


def _expanded(entry: Path | int) -> list[Path | int]:
    """Returns the entry itself, or the track files of a folder in the order of their names."""
    if isinstance(entry, int) or not entry.is_dir():
        return [entry]
    files = sorted(file for file in entry.iterdir() if file.suffix in TRACK_SUFFIXES)
    if not files:
        raise InputError(entry, f"expected track files ({', '.join(TRACK_SUFFIXES)}), found none")
    return [*files]


def _load(track: Path | int, stems: list[str]) -> NamedTrack:
    """Names a file by its stem, and by its folder too where several files have that stem."""
    if isinstance(track, int):
        return NamedTrack(f"generated {track}", generate_track(np.random.default_rng(track)))
    _check_file(track)
    unique = stems.count(track.stem) == 1
    return NamedTrack(
        track.stem if unique else f"{track.resolve().parent.name}/{track.stem}", read_track(track)
    )


def _check_file(file: Path) -> None:
    """Raises InputError with the nearest name in the folder where there is no such file."""
    if not file.exists() and file.parent.is_dir():
        beside = sorted(entry.name for entry in file.parent.iterdir() if entry.suffix == file.suffix)
        try:
            check_name(file.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(file, str(error)) from error
