"""Drives: logs that are simulated on a track, recorded, or given, each with its identity."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.io.files import is_temporary
from pathspace_graph.io.log import FILES, LOG_FILE, Log
from pathspace_graph.plausibility.hint import Hint
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.online import LimitSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

TRACK_SUFFIXES: Final = (".yaml", ".yml", ".csv")
RECORDED: Final = "recorded"  # noise of a drive that was not simulated
RESOLUTION: Final = 1e-3  # length (m) and angle (rad) to which the geometry of a track identifies it
ROUNDING: Final = 1.0 / np.pi  # shift that keeps coordinates of few decimals off the edges of millimetres
_latest: dict[str, tuple[Log, Sequence[Hint]]] = {}  # the log that was asked for last, by its drive


def track_digest(track: Track) -> str:
    """Return the identity of a track's geometry to the millimetre, wherever it came from.

    The last digits of a generated track depend on the processor; the seeds of its drives do not.
    """
    parts = (track.left, track.right, track.other, track.start, track.cone_labels)
    rounded = (np.floor(np.asarray(part) / RESOLUTION + ROUNDING).astype("<i8") for part in parts)
    cones = b"|".join(part.tobytes() for part in rounded)
    return hashlib.sha256(cones + str(track.closed).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class Drive:
    """One lap or more on a track."""

    track: Track
    seed: int  # number of the drive on its track
    noise: str
    simulation: SimulationSettings

    @property
    def names(self) -> dict[str, Any]:
        return {"track": self.track.name, "seed": self.seed, "noise": self.noise}

    @property
    def source(self) -> str:
        """Seed with which `simulate` makes the same log of this track and noise."""
        return str(self.own_seed)

    @cached_property
    def own_seed(self) -> int:
        """Seed of the simulation: drives of one seed on several tracks are independent samples."""
        return int(identity(track=track_digest(self.track), seed=self.seed)[:8], 16)

    @cached_property
    def id(self) -> str:
        """Identity of everything that the log depends on, except the code."""
        simulation = asdict(self.simulation)
        return identity(track=track_digest(self.track), seed=self.own_seed, simulation=simulation)

    def load(self) -> tuple[Log, Sequence[Hint]]:
        """Return the log, and its likely mistakes, of which it has none."""
        return _kept(self.id, lambda: (simulate(self.track, self.simulation, self.own_seed), ()))


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A log in a folder, one of those that were driven on a track."""

    track: str
    seed: int  # number of the log on its track
    folder: Path
    limits: LimitSettings  # of what is read

    @property
    def names(self) -> dict[str, Any]:
        return {"track": self.track, "seed": self.seed, "noise": RECORDED}

    @property
    def source(self) -> str:
        """Name of the log."""
        return self.folder.resolve().name

    @property
    def simulation(self) -> None:
        return None

    @cached_property
    def id(self) -> str:
        """Identity of what is in the files of the log."""
        digest = hashlib.sha256()
        for name in FILES:
            file = self.folder / name
            digest.update(name.encode() + (file.read_bytes() if file.exists() else b""))
        return digest.hexdigest()[:20]

    def load(self) -> tuple[Log, Sequence[Hint]]:
        """Return the log, and the mistakes that are likely in it."""
        return _kept(self.id, lambda: read_plausible_log(self.folder, self.limits))


AnyDrive = Drive | RecordedDrive


def _kept(drive: str, load: Callable[[], tuple[Log, Sequence[Hint]]]) -> tuple[Log, Sequence[Hint]]:
    """Return what `load` does, once for cells in the order of their drives."""
    if drive not in _latest:
        _latest.clear()
        _latest[drive] = load()
    return _latest[drive]


def log_folders(folder: Path) -> dict[str, Path]:
    """Return a log's folder by its name, or those in a folder of logs; InputError if there is none."""
    folders = {folder.resolve().name: folder}
    if not (folder / LOG_FILE).exists():
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        folders = {e.name: e for e in entries if not is_temporary(e.name) and (e / LOG_FILE).is_file()}
    if not folders:
        raise InputError(folder, f"expected a log ({LOG_FILE}) or folders that are logs, found neither")
    return folders


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]


def load_tracks(tracks: Iterable[Path | int]) -> list[Track]:
    """Read or generate tracks, with the names that they have in the results.

    A folder stands for every track file in it, a number is the seed of a generated track, and the name of an
    event stands for its track. InputError where a file is no track or a folder has none.
    """
    every = list[Path | int]()
    for entry in tracks:
        if not isinstance(entry, Path) or not entry.is_dir():
            every.append(entry)
        elif files := sorted(file for file in entry.iterdir() if file.suffix in TRACK_SUFFIXES):
            every += files
        else:
            raise InputError(entry, f"expected track files ({', '.join(TRACK_SUFFIXES)}), found none")
    stems = [track.stem for track in every if isinstance(track, Path)]
    return [_load(track, stems) for track in every]


def _load(track: Path | int, stems: list[str]) -> Track:
    if isinstance(track, int):
        return replace(generate_track(np.random.default_rng(track)), name=f"generated {track}")
    if track.name in EVENTS and not track.exists():
        return EVENTS[track.name]()
    if not track.exists() and track.parent.is_dir():
        beside = sorted(entry.name for entry in track.parent.iterdir() if entry.suffix == track.suffix)
        try:
            check_name(track.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(track, str(error)) from error
    folder = f"{track.resolve().parent.name}/" if stems.count(track.stem) > 1 else ""
    return replace(read_track(track), name=f"{folder}{track.stem}")
