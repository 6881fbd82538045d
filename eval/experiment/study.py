"""Studies: drives, estimators and settings to compare, from a TOML file or in Python."""

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from html import escape
from itertools import product
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, PathspaceError, SettingsError, check_name
from pathspace_graph.eval.figures.notebook import table
from pathspace_graph.eval.metrics.measures import METRICS
from pathspace_graph.io.files import is_temporary
from pathspace_graph.io.log import FILES, LOG_FILE, Log
from pathspace_graph.io.parsing import MAX_HEADER_BYTES, parse_toml, read_text, shown
from pathspace_graph.plausibility.judge import Hint, read_plausible_log
from pathspace_graph.settings.checked import Overrides, apart, flatten, override
from pathspace_graph.settings.mapper import LimitSettings, MapperSettings
from pathspace_graph.sim.simulate import PLAIN, PRESETS, SimulationSettings, preset, simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import generate_track

SHIPPED: Final = Path(__file__).parents[1] / "studies"
DEFAULT: Final = "default"  # variant that overrides nothing, part of every study
PRESET: Final = "preset"  # entry of a noise that names a preset, as in `sensor.preset = "camera"`
ALL: Final = "all"  # name that stands for all known estimators
RECORDED: Final = "recorded"  # noise of a drive that was not simulated
TRACK_SUFFIXES: Final = (".yaml", ".yml", ".csv")
MAX_VARIANTS: Final = 10_000  # of the grid of a study
_LISTS: Final = ("tracks", "seeds", "estimators", "metrics")
_latest: dict[str, tuple[Log, Sequence[Hint]]] = {}  # the log that was asked for last, by its drive


# --- drives ------------------------------------------------------------------------------------------------


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class StudyDrive:
    """A log that is simulated or recorded, as a study names it."""

    track: str
    seed: int
    """Number of the drive on its track."""
    noise: str
    source: str
    """Seed with which `simulate` makes the same log, or the name of the recorded one."""
    id: str
    """Identity of everything that the log depends on, except the code."""
    read: Callable[[], tuple[Log, Sequence[Hint]]]
    simulation: SimulationSettings | None = None

    def load(self) -> tuple[Log, Sequence[Hint]]:
        """Return the log and its likely mistakes; the latest one is kept, for cells in order of drives."""
        if self.id not in _latest:
            _latest.clear()
            _latest[self.id] = self.read()
        return _latest[self.id]


def simulated_drive(track: Track, seed: int, noise: str, simulation: SimulationSettings) -> StudyDrive:
    """Return a drive whose seed depends on the track: those of several tracks are independent samples."""
    digest = track_digest(track)
    own = int(identity(track=digest, seed=seed)[:8], 16)
    meaning = identity(track=digest, seed=own, simulation=asdict(simulation))
    read = partial(_simulated, track, simulation, own)
    return StudyDrive(track.name, seed, noise, str(own), meaning, read, simulation)


def _simulated(track: Track, simulation: SimulationSettings, seed: int) -> tuple[Log, Sequence[Hint]]:
    return simulate(track, simulation, seed), ()


def recorded_drive(track: str, number: int, folder: Path, limits: LimitSettings) -> StudyDrive:
    """Return the drive of a log's folder, one of those that were driven on a track."""
    digest = hashlib.sha256()
    for file in (folder / name for name in FILES):
        digest.update(file.name.encode() + (file.read_bytes() if file.exists() else b""))
    read = partial(read_plausible_log, folder, limits)
    return StudyDrive(track, number, RECORDED, folder.resolve().name, digest.hexdigest()[:20], read)


def track_digest(track: Track) -> str:
    """Return the identity of a track's geometry to the millimetre, wherever it came from.

    The last digits of a generated track depend on the processor; the seeds of its drives do not.
    """
    parts = (track.left, track.right, track.other, track.start, track.cone_labels)
    # the shift keeps coordinates of few decimals off the edges of millimetres
    rounded = (np.floor(np.asarray(part) / 1e-3 + 1.0 / np.pi).astype("<i8") for part in parts)
    cones = b"|".join(part.tobytes() for part in rounded)
    return hashlib.sha256(cones + str(track.closed).encode()).hexdigest()[:20]


def log_folders(folder: Path) -> dict[str, Path]:
    """Return a log's folder by its name, or those in a folder of logs; InputError if there is none."""
    folders = {folder.resolve().name: folder}
    if not (folder / LOG_FILE).exists():
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        folders = {e.name: e for e in entries if not is_temporary(e.name) and (e / LOG_FILE).is_file()}
    if not folders:
        raise InputError(folder, f"expected a log ({LOG_FILE}) or folders that are logs, found neither")
    return folders


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
    stems, found = [track.stem for track in every if isinstance(track, Path)], list[Track]()
    for track in every:
        if isinstance(track, int):
            generated = generate_track(np.random.default_rng(track))
            found.append(replace(generated, name=f"generated {track}"))
        elif track.name in EVENTS and not track.exists():
            found.append(EVENTS[track.name]())
        else:
            if not track.exists() and track.parent.is_dir():
                beside = sorted(one.name for one in track.parent.iterdir() if one.suffix == track.suffix)
                try:
                    check_name(track.name, beside, "expected a track file")
                except SettingsError as error:
                    raise InputError(track, str(error)) from error
            folder = f"{track.resolve().parent.name}/" if stems.count(track.stem) > 1 else ""
            found.append(replace(read_track(track), name=f"{folder}{track.stem}"))
    return found


# --- studies -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variant:
    """What one variant runs: the settings, and the own parameters of the estimators that have any."""

    settings: MapperSettings
    parameters: tuple[tuple[str, Any], ...] = ()  # pairs of an estimator and its frozen dataclass


@dataclass(frozen=True)
class Baseline:
    """Combination that every other one is compared with, on the same track, seed and noise."""

    variant: str = DEFAULT
    estimator: str | None = None
    """Estimator of the baseline; without one, each estimator is compared with itself."""


class Published(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of a publication, beside which a study shows its own."""

    source: str = ""
    laps: dict[str, dict[str, list[float]]] = {}
    """Values after each lap, in the units of the tables, by estimator and metric."""
    notes: dict[str, str] = {}
    """How far a metric can be compared, by metric."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Study:
    """Grid of tracks x seeds x noise x estimators x settings, checked when it is made."""

    tracks: tuple[Path | int, ...] = ()
    """Track files, and seeds of generated tracks."""
    logs: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)
    """Recorded logs by the name of their track, which are driven beside or instead of simulated ones."""
    seeds: tuple[int, ...] = (0,)
    laps: int = 5
    name: str = "study"
    question: str = ""
    estimators: tuple[str, ...] = (registry.DEFAULT_ONLINE,)
    """Estimators to run, online and batch ones; `all` stands for every one."""
    settings: MapperSettings = field(default_factory=MapperSettings)
    """Settings of every estimator, which variants override."""
    own: Overrides = field(default_factory=dict)
    """Own parameters of estimators, `NAME.field`, which variants override."""
    noise: Mapping[str, Overrides] = field(default_factory=lambda: {"nominal": {}})
    """Overrides of the simulation by the name of a noise."""
    variants: Mapping[str, Overrides] = field(default_factory=dict)
    """Overrides of the settings by the name of a variant; `default` is always there. `NAME.field` is of the
    own parameters of an estimator."""
    grids: tuple[Mapping[str, Sequence[Any]], ...] = ()
    """Values by dotted field; every combination is a variant with a name such as `lag=1, steps=2`."""
    baseline: Baseline = field(default_factory=Baseline)
    """Combination that the others are compared with."""
    metrics: tuple[str, ...] = ("rmse", "missed", "size", "ms_mean")
    """Metrics that the summary compares with the baseline."""
    published: Published = field(default_factory=Published)

    def __post_init__(self) -> None:
        """Raise SettingsError if anything is unknown, empty, named twice or out of its range."""
        for name in (*_LISTS, "grids"):
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
        tracks = tuple(Path(track) if isinstance(track, str) else track for track in self.tracks)
        object.__setattr__(self, "tracks", tracks)
        logs = {track: tuple(map(Path, folders)) for track, folders in self.logs.items()}
        object.__setattr__(self, "logs", logs)
        if self.estimators == (ALL,):
            object.__setattr__(self, "estimators", tuple(registry.known_estimators()))
        self._check_lists()
        if DEFAULT in self.variants:
            raise SettingsError(f"variants.{DEFAULT}: that name is kept for the settings as they are")
        for name in self.noise:
            self.simulation(name)
        if len(self._named()) != 1 + len(self.variants) + sum(len(_grid(grid)) for grid in self.grids):
            raise SettingsError("variants: expected every name once, found one of a grid among them")
        check_name(self.baseline.variant, self._named(), "baseline.variant: expected a variant")
        if self.baseline.estimator is not None:
            expected = "baseline.estimator: expected one of the study's estimators"
            check_name(self.baseline.estimator, self.estimators, expected)

    def __repr__(self) -> str:
        tracks = [*self.tracks, *self.logs]
        sizes = {"tracks": len(tracks), "seeds": len(self.seeds), "noises": len(self.noises)}
        sizes |= {"estimators": len(self.estimators), "variants": len(self.points)}
        return f"Study({self.name}: {' x '.join(f'{n} {name}' for name, n in sizes.items())})"

    def _repr_html_(self) -> str:
        values = ((entry.name, getattr(self, entry.name)) for entry in fields(self))
        return f"<h4>{escape(repr(self))}</h4>{table(pair for pair in values if pair[1])}"

    def _check_lists(self) -> None:
        if not self.tracks and not self.logs:
            expected = "track files, or seeds of generated tracks"
            raise SettingsError(f"tracks: expected at least one of {expected}, or drives.logs, found none")
        for name in (*_LISTS, "noise"):
            values = [*getattr(self, name)]
            if (not values and name != "tracks") or len({*map(repr, values)}) < len(values):
                expected = "expected at least one, and none twice"
                raise SettingsError(f"{name}: {expected}, found {shown(values)}")
        for name, numbers in {"seeds": self.seeds, "tracks": self.tracks}.items():
            for value in numbers:
                if not isinstance(value, Path) and (type(value) is not int or value < 0):
                    raise SettingsError(f"{name}: expected whole numbers from 0 on, found {shown(value)}")
        if type(self.laps) is not int:
            raise SettingsError(f"laps: expected a whole number, found {shown(self.laps)}")
        for name in self.estimators:
            check_name(name, registry.known_estimators(), "estimators: expected a known estimator")
        for name in self.metrics:
            check_name(name, METRICS, "metrics: expected a known metric")
        for name, of_laps in self.published.laps.items():
            check_name(name, self.estimators, "published.laps: expected one of the study's estimators")
            for metric in of_laps:
                check_name(metric, METRICS, f"published.laps.{name}: expected a known metric")

    def simulation(self, noise: str) -> SimulationSettings:
        overrides = dict(self.noise[noise])
        if "laps" in overrides:
            raise SettingsError(f"noise.{noise}.laps: expected laps as a key of the study itself")
        chosen = {group: overrides.pop(f"{group}.{PRESET}", PLAIN) for group in PRESETS}
        return replace(override(preset(chosen), overrides, f"noise.{noise}"), laps=self.laps)

    def against(self, baseline: str) -> "Study":
        """Return the study with a variant or an estimator as the baseline; SettingsError if it has none."""
        if baseline in self.estimators:
            return replace(self, baseline=Baseline(estimator=baseline))
        check_name(
            baseline, [*self._named(), *self.estimators], "--baseline: expected a variant or an estimator"
        )
        return replace(self, baseline=Baseline(baseline))

    @property
    def points(self) -> dict[str, Variant]:
        """Variants to run by name; of those that are equal the first."""
        named = [*self._named().items()]
        first = {variant: name for name, variant in reversed(named)}
        return {name: variant for name, variant in named if first[variant] == name}

    @property
    def noises(self) -> list[str]:
        """Names of the noises of all drives."""
        return [*(self.noise if self.tracks else ()), *([RECORDED] if self.logs else [])]

    @property
    def baseline_variant(self) -> str:
        """Name of the baseline among `points`."""
        wanted = self._named()[self.baseline.variant]
        return next(name for name, variant in self.points.items() if variant == wanted)

    @property
    def varied(self) -> tuple[str, ...]:
        """Dotted settings that any variant overrides."""
        groups = (*self.variants.values(), *self.grids)
        return tuple(dict.fromkeys(name for group in groups for name in group))

    @property
    def varied_noise(self) -> tuple[str, ...]:
        """Dotted settings of the simulation that any noise overrides, without presets."""
        names = dict.fromkeys(name for overrides in self.noise.values() for name in overrides)
        return tuple(name for name in names if not name.endswith(f".{PRESET}"))

    def _named(self) -> dict[str, Variant]:
        points = {DEFAULT: self._variant({}, "")}
        for name, overrides in self.variants.items():
            points[name] = self._variant(overrides, f"variants.{name}")
        for grid in self.grids:
            for name, overrides in _grid(grid).items():
                points[name] = self._variant(overrides, "grid")
        return points

    def _variant(self, overrides: Overrides, where: str) -> Variant:
        """Return settings and parameters with overrides; those of `NAME.field` are of an estimator's own."""
        parameters, rest = list[tuple[str, Any]](), {**self.own, **overrides}
        for name in self.estimators:
            own, rest = registry.with_parameters(name, rest, where)
            parameters += [] if own is None else [(name, own)]
        return Variant(override(self.settings, rest, where), tuple(parameters))


def _grid(grid: Mapping[str, Sequence[Any]]) -> dict[str, Overrides]:
    for name, values in grid.items():
        if not isinstance(values, list | tuple) or not values:
            raise SettingsError(f"grid.{name}: expected a list of values, found {shown(values)}")
    combinations = math.prod(map(len, grid.values()))
    if combinations > MAX_VARIANTS:
        raise SettingsError(f"grid: expected at most {MAX_VARIANTS} combinations, found {combinations}")
    points = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    named = dict[str, Overrides]()
    for point in points:
        texts = []
        for name, value in point.items():
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            is_short = is_number and float(f"{value:g}") == value
            texts.append(f"{name}={value:g}" if is_short else f"{name}={value}")
        named[", ".join(texts)] = point
    return named


def shipped_studies() -> list[str]:
    return sorted(file.stem for file in SHIPPED.glob("*.toml"))


def find_study(name: Path) -> Path:
    """Return the file itself, or that of the shipped study of this name."""
    if name.is_file():
        return name
    if name.suffix == "" and name.stem in shipped_studies():
        return SHIPPED / f"{name.stem}.toml"
    check_name(str(name), shipped_studies(), "expected a study's file, or one that is known by name")
    raise InputError(name, "expected a study's file")


def read_study_file(file: Path | str) -> Study:
    """Return the study of a TOML file, with track files relative to it; InputError says what is wrong."""
    file = Path(file)
    content = parse_toml(read_text(file, "a study", MAX_HEADER_BYTES), file)
    try:
        return study_from(content, file.parent, file.stem)
    except PathspaceError as error:
        raise InputError(file, str(error)) from error


_KINDS: Final[Mapping[str, type]] = {  # types of the keys of a study's file
    **dict.fromkeys(("name", "question"), str),
    **dict.fromkeys(_LISTS, list),
    **dict.fromkeys(("drives", "settings", "noise", "variants", "baseline", "published"), Mapping),
    **dict.fromkeys(("laps", "grid"), object),
}


def study_from(content: Mapping[str, Any], folder: Path = Path(), name: str = "study") -> Study:
    """Return the study of a file's content; SettingsError names the key that is wrong."""
    values: dict[str, Any] = {"name": name}
    for key, given in content.items():
        check_name(key, _KINDS, "expected a known key")
        values[key] = _typed(key, [ALL] if given == ALL and key in _LISTS else given, _KINDS[key])
    values["tracks"] = [folder / t if isinstance(t, str) else t for t in values.get("tracks", ())]
    drives = values.pop("drives", {})
    for key in drives:
        check_name(key, ("logs",), "drives: expected a known key")
    given = drives.get("logs", [])
    several = given if isinstance(given, Mapping) else {"": given}
    values["logs"] = {}  # from a list each is of a track of its own, from a table of that of its list
    for track, paths in several.items():
        key = f"drives.logs.{track}".rstrip(".")
        own = [folder / _typed(key, path, str) for path in _typed(key, paths, list)]
        logs = tuple(log for path in own for log in log_folders(path).values())
        values["logs"] |= {track: logs} if isinstance(given, Mapping) else {log.name: (log,) for log in logs}
    given = flatten(values.get("settings", {}))
    overrides, values["own"] = apart(given, registry.known_estimators(), MapperSettings())
    values["settings"] = override(MapperSettings(), overrides, "settings")
    for key in {"noise", "variants"} & set(values):
        tables = values[key].items()
        values[key] = {k: flatten(_typed(f"{key}.{k}", table, Mapping)) for k, table in tables}
    grids = values.pop("grid", [])
    grids = grids if isinstance(grids, list) else [grids]
    values["grids"] = [flatten(_typed("grid", grid, Mapping)) for grid in grids]
    baseline = values.get("baseline", {})
    for key, value in baseline.items():
        check_name(key, ("variant", "estimator"), "baseline: expected a known key")
        _typed(f"baseline.{key}", value, str)
    try:
        values["published"] = msgspec.convert(values.get("published", {}), Published)
    except msgspec.ValidationError as error:
        raise SettingsError(f"published: {error}") from error
    return Study(**values | {"baseline": Baseline(**baseline)})


def _typed(key: str, value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        expected = "a list" if kind is list else "text" if kind is str else "a table"
        raise SettingsError(f"{key}: expected {expected}, found {shown(value)}")
    return value
