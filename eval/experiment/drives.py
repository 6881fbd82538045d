"""Drives: tracks by name, and the logs that are simulated on them."""

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
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

TRACK_SUFFIXES: Final = (".yaml", ".yml", ".csv")
"""Suffixes of track files."""
_IDENTITY_DIGITS: Final = 20
"""Number of hexadecimal digits of an identity, which are 80 bits."""
_SEED_DIGITS: Final = 8
"""Number of hexadecimal digits of a seed."""
_latest: dict[str, Log] = {}
"""The log that was simulated last, by its drive."""


@dataclass(frozen=True, eq=False)
class NamedTrack:
    """A track with the name that it has in the results."""

    name: str
    track: Track

    @cached_property
    def digest(self) -> str:
        """Identity of the geometry, wherever it came from."""
        track = self.track
        parts = (track.left, track.right, track.other, track.start, track.cone_labels)
        cones = b"|".join(np.ascontiguousarray(part, dtype=float).tobytes() for part in parts)
        return hashlib.sha256(cones + str(self.track.closed).encode()).hexdigest()[:_IDENTITY_DIGITS]


@dataclass(frozen=True, eq=False)
class Drive:
    """One lap or more on a track."""

    track: NamedTrack
    seed: int
    """Number of the drive on its track."""
    noise: str
    """Name of the noise."""
    simulation: SimulationSettings

    @property
    def names(self) -> dict[str, Any]:
        return {"track": self.track.name, "seed": self.seed, "noise": self.noise}

    @cached_property
    def own_seed(self) -> int:
        """Seed of the simulation: drives of one seed on several tracks are independent samples."""
        return int(identity(track=self.track.digest, seed=self.seed)[:_SEED_DIGITS], 16)

    @cached_property
    def id(self) -> str:
        """Identity of everything that the log depends on, except the code."""
        return identity(track=self.track.digest, seed=self.own_seed, simulation=asdict(self.simulation))

    def load(self) -> Log:
        """Return the log; the last one is kept, since cells are in the order of their logs."""
        if self.id not in _latest:
            _latest.clear()
            _latest[self.id] = self.simulate()
        return _latest[self.id]

    def simulate(self) -> Log:
        return simulate(self.track.track, self.simulation, self.own_seed)


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_IDENTITY_DIGITS]


def load_tracks(tracks: Iterable[Path | int]) -> list[NamedTrack]:
    """Read or generate tracks and name each of them; a folder stands for every track file in it.

    A number is the seed of a generated track, and the name of an event its track. InputError where a file is
    no track or a folder has none.
    """
    every = [track for entry in tracks for track in _expanded(entry)]
    stems = [track.stem for track in every if isinstance(track, Path)]
    return [_load(track, stems) for track in every]


def _expanded(entry: Path | int) -> list[Path | int]:
    if isinstance(entry, int) or not entry.is_dir():
        return [entry]
    files = sorted(file for file in entry.iterdir() if file.suffix in TRACK_SUFFIXES)
    if not files:
        raise InputError(entry, f"expected track files ({', '.join(TRACK_SUFFIXES)}), found none")
    return [*files]


def _load(track: Path | int, stems: list[str]) -> NamedTrack:
    if isinstance(track, int):
        return NamedTrack(f"generated {track}", generate_track(np.random.default_rng(track)))
    if track.name in EVENTS and not track.exists():
        return NamedTrack(track.name, EVENTS[track.name]())
    _check_file(track)
    folder = f"{track.resolve().parent.name}/" if stems.count(track.stem) > 1 else ""
    return NamedTrack(f"{folder}{track.stem}", read_track(track))


def _check_file(file: Path) -> None:
    """Raise InputError with the nearest name in the folder where there is no such file."""
    if not file.exists() and file.parent.is_dir():
        beside = sorted(entry.name for entry in file.parent.iterdir() if entry.suffix == file.suffix)
        try:
            check_name(file.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(file, str(error)) from error
