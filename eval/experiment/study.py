"""Studies: the tracks, seeds, noise, estimators and settings to compare, as a TOML file or in Python."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, PathspaceError, SettingsError, check_name
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.io.overrides import Overrides, apart, flatten, override
from pathspace_graph.io.parsing import MAX_HEADER_BYTES, MAX_VARIANTS, parse_toml, read_text, shown
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import PLAIN, PRESETS, SimulationSettings, preset

from .drives import RECORDED, log_folders

SHIPPED: Final = Path(__file__).parents[1] / "studies"
DEFAULT: Final = "default"  # variant that overrides nothing, part of every study
PRESET: Final = "preset"  # entry of a noise that names a preset, as in `sensor.preset = "camera"`
ALL: Final = "all"  # name that stands for all known estimators
_LISTS: Final = ("tracks", "seeds", "estimators", "metrics")


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


@dataclass(frozen=True, kw_only=True)
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
        if type(self.laps) is not int:
            raise SettingsError(f"laps: expected a whole number, found {shown(self.laps)}")
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

    def _check_lists(self) -> None:
        if not self.tracks and not self.logs:
            expected = "track files, or seeds of generated tracks"
            raise SettingsError(f"tracks: expected at least one of {expected}, or drives.logs, found none")
        for name in ("tracks", "seeds", "estimators", "noise", "metrics"):
            values = getattr(self, name)
            if (len(values) == 0 and name != "tracks") or len({repr(value) for value in values}) != len(
                values
            ):
                expected = "expected at least one, and none twice"
                raise SettingsError(f"{name}: {expected}, found {shown(list(values))}")
        generated = [track for track in self.tracks if not isinstance(track, Path)]
        for name, values in {"seeds": self.seeds, "tracks": generated}.items():
            for value in values:
                if type(value) is not int or value < 0:
                    raise SettingsError(f"{name}: expected whole numbers from 0 on, found {shown(value)}")
        for name in self.estimators:
            check_name(name, registry.known_estimators(), "estimators: expected a known estimator")
        for name in self.metrics:
            check_name(name, METRICS, "metrics: expected a known metric")

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
    return {", ".join(f"{name}={_short(value)}" for name, value in point.items()): point for point in points}


def _short(value: Any) -> str:
    if isinstance(value, int | float) and float(f"{value:g}") == value and not isinstance(value, bool):
        return f"{value:g}"
    return str(value)


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


def study_from(content: Mapping[str, Any], folder: Path = Path(), name: str = "study") -> Study:
    renamed = {"grids": "grid", "logs": "drives"}
    known = {renamed.get(entry.name, entry.name) for entry in fields(Study)} - {"own"}
    for key in content:
        check_name(key, known, "expected a known key")
    values: dict[str, Any] = {"name": name} | dict(content)
    for key in (key for key in _LISTS if key in values):
        values[key] = (ALL,) if values[key] == ALL else tuple(_typed(key, values[key], list))
    for key in ("name", "question"):
        _typed(key, values.get(key, ""), str)
    values["tracks"] = tuple(folder / t if isinstance(t, str) else t for t in values.get("tracks", ()))
    if "drives" in values:
        values["logs"] = _logs(_typed("drives", values.pop("drives"), Mapping), folder)
    if "settings" in values:
        given = flatten(_typed("settings", values["settings"], Mapping))
        overrides, values["own"] = apart(given, registry.known_estimators(), MapperSettings())
        values["settings"] = override(MapperSettings(), overrides, "settings")
    for key in (key for key in ("noise", "variants") if key in values):
        tables = _typed(key, values[key], Mapping).items()
        values[key] = {k: flatten(_typed(f"{key}.{k}", v, Mapping)) for k, v in tables}
    if "grid" in values:
        grids = values.pop("grid")
        grids = grids if isinstance(grids, list) else [grids]
        values["grids"] = tuple(flatten(_typed("grid", grid, Mapping)) for grid in grids)
    if "baseline" in values:
        for key, value in _typed("baseline", values["baseline"], Mapping).items():
            check_name(key, ("variant", "estimator"), "baseline: expected a known key")
            _typed(f"baseline.{key}", value, str)
        values["baseline"] = Baseline(**values["baseline"])
    return Study(**values)


def _logs(drives: Mapping[str, Any], folder: Path) -> dict[str, tuple[Path, ...]]:
    """Return logs by their track: from a list, each of a track of its own, or from a table of lists."""
    for key in drives:
        check_name(key, ("logs",), "drives: expected a known key")
    logs = drives.get("logs", [])
    if isinstance(logs, Mapping):
        return {track: _paths(f"drives.logs.{track}", own, folder) for track, own in logs.items()}
    return {path.name: (path,) for path in _paths("drives.logs", logs, folder)}


def _paths(key: str, values: Any, folder: Path) -> tuple[Path, ...]:
    every = [folder / _typed(key, value, str) for value in _typed(key, values, list)]
    return tuple(path for given in every for path in log_folders(given).values())


def _typed(key: str, value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        expected = "a list" if kind is list else "text" if kind is str else "a table"
        raise SettingsError(f"{key}: expected {expected}, found {shown(value)}")
    return value
