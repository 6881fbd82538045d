"""Drives: tracks by name, the logs that are simulated on them, and the files that keep those exactly."""

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import InputError, SettingsError, check_name
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo, Truth
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
_TRUTH: Final = {
    name: name for name in ("pose_t", "poses", "cones", "cone_labels", "associations", "calibration")
} | {"sensor": "true_sensor", "noise": "true_noise"}
_SENSOR: Final = ("range_max", "fov", "rate")
_DIGEST_BYTES: Final = hashlib.sha256().digest_size
_ERRORS: Final = (OSError, ValueError, LookupError, TypeError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""Archives of something else, and arrays that do not fit each other, raise these."""


@dataclass(frozen=True, eq=False)
class NamedTrack:
    """A track with the name that it has in the results."""

    name: str
    """Name of the track."""
    track: Track
    """Cones of the track."""

    @cached_property
    def digest(self) -> str:
        """Identity of the geometry, wherever it came from."""
        track = self.track
        parts = (track.left, track.right, track.other, track.start, track.cone_labels)
        cones = b"|".join(np.ascontiguousarray(part, dtype=float).tobytes() for part in parts)
        return hashlib.sha256(cones + str(self.track.closed).encode()).hexdigest()[:_IDENTITY_DIGITS]


@dataclass(frozen=True, eq=False)
class Drive:
    """One lap or more on a track, simulated once; its log serves every run on it."""

    track: NamedTrack
    """Track of the drive."""
    seed: int
    """Number of the drive on its track."""
    noise: str
    """Name of the noise."""
    simulation: SimulationSettings
    """Settings of the simulation."""

    @property
    def names(self) -> dict[str, Any]:
        """Names that distinguish the drive from others in the results."""
        return {"track": self.track.name, "seed": self.seed, "noise": self.noise}

    @cached_property
    def own_seed(self) -> int:
        """Seed of the simulation: drives of one seed on several tracks are independent samples."""
        return int(identity(track=self.track.digest, seed=self.seed)[:_SEED_DIGITS], 16)

    @cached_property
    def id(self) -> str:
        """Identity of everything that the log depends on, except the code."""
        return identity(track=self.track.digest, seed=self.own_seed, simulation=asdict(self.simulation))

    def simulate(self) -> Log:
        """Simulate the log."""
        return simulate(self.track.track, self.simulation, self.own_seed)


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:_IDENTITY_DIGITS]


def try_drive(drive: Drive) -> Log | Exception:
    """Return the drive's log, or the error of its simulation: other drives go on."""
    try:
        return drive.simulate()
    except Exception as error:
        return error


def load_tracks(tracks: Iterable[Path | int]) -> list[NamedTrack]:
    """Read or generate tracks and name each of them; a folder stands for every track file in it.

    A number is the seed of a generated track, and the name of an event its track. InputError where a file is
    no track or a folder has none.
    """
    every = [track for entry in tracks for track in _expanded(entry)]
    stems = [track.stem for track in every if isinstance(track, Path)]
    return [_load(track, stems) for track in every]


def _expanded(entry: Path | int) -> list[Path | int]:
    """Return the entry itself, or the track files of a folder in the order of their names."""
    if isinstance(entry, int) or not entry.is_dir():
        return [entry]
    files = sorted(file for file in entry.iterdir() if file.suffix in TRACK_SUFFIXES)
    if not files:
        raise InputError(entry, f"expected track files ({', '.join(TRACK_SUFFIXES)}), found none")
    return [*files]


def _load(track: Path | int, stems: list[str]) -> NamedTrack:
    """Name a file by its stem, and by its folder too where several files have that stem.

    A path that is no file but ends with the name of an event is that event's track.
    """
    if isinstance(track, int):
        return NamedTrack(f"generated {track}", generate_track(np.random.default_rng(track)))
    if track.name in EVENTS and not track.exists():
        return NamedTrack(track.name, EVENTS[track.name]())
    _check_file(track)
    unique = stems.count(track.stem) == 1
    return NamedTrack(
        track.stem if unique else f"{track.resolve().parent.name}/{track.stem}", read_track(track)
    )


def _check_file(file: Path) -> None:
    """Raise InputError with the nearest name in the folder where there is no such file."""
    if not file.exists() and file.parent.is_dir():
        beside = sorted(entry.name for entry in file.parent.iterdir() if entry.suffix == file.suffix)
        try:
            check_name(file.name, beside, "expected a track file")
        except SettingsError as error:
            raise InputError(file, str(error)) from error


# --- files -----------------------------------------------------------------------------------------------


def write_log_file(file: Path, log: Log) -> None:
    """Write the log as a numpy archive behind its SHA-256."""
    cycles, sensor = log.cycles, [getattr(log.sensor, name) for name in _SENSOR]
    arrays: dict[str, Any] = {
        "odometry_t": log.odometry.t,
        "odometry_twist": log.odometry.twist,
        "odometry_sigma": log.odometry_sigma,
        "cycle_t": np.array([cycle.t for cycle in cycles]),
        "cycle_size": np.array([len(cycle.labels) for cycle in cycles], dtype=int),
        "points": np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in cycles)]),
        "covariances": np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in cycles)]),
        "labels": np.concatenate([np.zeros(0, dtype=int), *(cycle.labels for cycle in cycles)]),
        "sensor": np.array([np.nan if value is None else value for value in sensor]),
        "source": np.array(json.dumps(dict(log.source))),
    }
    if log.truth is not None:
        known = {array: getattr(log.truth, name) for name, array in _TRUTH.items()}
        arrays |= {name: value for name, value in known.items() if value is not None}
    archive = io.BytesIO()
    np.savez(archive, **arrays)
    content = archive.getvalue()
    file.write_bytes(hashlib.sha256(content).digest() + content)


def read_log_file(file: Path) -> Log:
    """Return the log of an archive; an InputError says that it is none, or damaged."""
    try:
        data = file.read_bytes()
        digest, content = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
        if digest != hashlib.sha256(content).digest():
            raise ValueError("it is not as it was written")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return _log(arrays)
    except (*_ERRORS, EOFError) as error:
        raise InputError(file, f"expected the log of a study: {error}") from error


def _log(arrays: dict[str, NDArray[Any]]) -> Log:
    at = np.cumsum(arrays["cycle_size"])[:-1]
    points, covariances, labels = (np.split(arrays[name], at) for name in ("points", "covariances", "labels"))
    cycles = zip(arrays["cycle_t"].tolist(), points, covariances, labels, strict=bool(len(arrays["cycle_t"])))
    sensor = [None if np.isnan(value) else value for value in arrays["sensor"].tolist()]
    truth = {name: arrays[array] for name, array in _TRUTH.items() if array in arrays}
    return Log(
        Odometry(arrays["odometry_t"], arrays["odometry_twist"]),
        tuple(Detections(*cycle) for cycle in cycles),
        arrays["odometry_sigma"],
        SensorInfo(*sensor),
        json.loads(str(arrays["source"])),
        truth=Truth(**truth) if truth else None,
    )
