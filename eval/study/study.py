"""A study says which tracks, seeds, noise, estimators and settings are compared, and with which baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, Final

from pathspace_graph import estimators as registry
from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.harness.attempts import known_estimators
from pathspace_graph.eval.metrics.measures import METRICS
from pathspace_graph.io.limits import MAX_VARIANTS, shown
from pathspace_graph.overrides import Overrides, override
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.presets import PLAIN, PRESETS, preset
from pathspace_graph.sim.simulate import SimulationSettings

from .column import column_of

DEFAULT: Final = "default"
"""This variant overrides nothing, and it is part of every study."""
PRESET: Final = "preset"
"""A noise names the preset of a group in this entry of it, as in `sensor.preset = "camera"`."""
ALL: Final = "all"
"""This name stands for all known estimators."""


@dataclass(frozen=True)
class Baseline:
    """Names the combination that every other one is compared with, on the same track, seed and noise."""

    variant: str = DEFAULT
    """The baseline has the settings of this variant."""
    estimator: str | None = None
    """The baseline has this estimator; without one, each estimator is compared with itself."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study is a grid of tracks x seeds x noise x estimators x settings, which is checked when it is
    made."""

    tracks: tuple[Path | int, ...]
    """The vehicle drives on these track files, and on tracks that are generated from these seeds."""
    seeds: tuple[int, ...] = (0,)
    """Each of these seeds decides a drive and its noise."""
    laps: int = 5
    """The vehicle drives this number of laps."""
    name: str = "study"
    """The study has this name."""
    question: str = ""
    """The study answers this question."""
    estimators: tuple[str, ...] = (registry.DEFAULT,)
    """These estimators run, online and batch ones; `all` stands for every one."""
    noise: Mapping[str, Overrides] = field(default_factory=lambda: {"nominal": {}})
    """Each noise has a name, and overrides dotted fields of the simulation."""
    variants: Mapping[str, Overrides] = field(default_factory=dict)
    """Each variant has a name, and overrides dotted fields of the settings; `default` is always there."""
    grids: tuple[Mapping[str, Sequence[Any]], ...] = ()
    """Each grid has values by dotted field; every combination is a variant with a name such as `lag=1,
    steps=2`."""
    baseline: Baseline = field(default_factory=Baseline)
    """The other combinations are compared with this one."""
    metrics: tuple[str, ...] = ("rmse", "missed", "size", "ms_mean")
    """The summary compares these metrics with the baseline."""
    columns: tuple[str, ...] = ()
    """The summary has a table by track of these: `rmse` is the last lap's, `rmse@1` that of lap 1, and
    `slope(bias, bias_true)` says how much of the truth an estimate has found."""
    yardsticks: bool = False
    """The limit of every run is computed, which takes a landmark batch with oracle associations."""

    def __post_init__(self) -> None:
        """Raises SettingsError if anything is unknown, empty, named twice or out of its range."""
        self._normalize()
        for name in ("tracks", "seeds", "estimators", "noise", "metrics"):
            _check_list(name, getattr(self, name))
        _check_integers("seeds", self.seeds)
        _check_integers("tracks", [track for track in self.tracks if not isinstance(track, Path)])
        for name in self.estimators:
            check_name(name, known_estimators(), "estimators: expected a known estimator")
        for name in self.metrics:
            check_name(name, METRICS, "metrics: expected a known metric")
        for column in self.columns:
            column_of(column)
        if not isinstance(self.yardsticks, bool):
            raise SettingsError(f"yardsticks: expected true or false, found {shown(self.yardsticks)}")
        self._check_settings()
        self._check_baseline()

    def _normalize(self) -> None:
        """Turns lists into tuples, and texts among the tracks into files."""
        for name in ("tracks", "seeds", "estimators", "metrics", "columns", "grids"):
            value = getattr(self, name)
            object.__setattr__(self, name, (value,) if isinstance(value, str) else tuple(value))
        tracks = tuple(Path(track) if isinstance(track, str) else track for track in self.tracks)
        object.__setattr__(self, "tracks", tracks)
        if self.estimators == (ALL,):
            object.__setattr__(self, "estimators", tuple(known_estimators()))

    def _check_settings(self) -> None:
        if isinstance(self.laps, bool) or not isinstance(self.laps, int):
            raise SettingsError(f"laps: expected a whole number, found {shown(self.laps)}")
        if DEFAULT in self.variants:
            raise SettingsError(f"variants.{DEFAULT}: that name is kept for the settings as they are")
        for name in self.noise:
            self.simulation(name)
        points = self._named()
        if len(points) != 1 + len(self.variants) + sum(len(_grid(grid)) for grid in self.grids):
            raise SettingsError("variants: expected every name once, found one of a grid among them")

    def _check_baseline(self) -> None:
        check_name(self.baseline.variant, self._named(), "baseline.variant: expected a variant")
        if self.baseline.estimator is not None:
            expected = "baseline.estimator: expected one of the study's estimators"
            check_name(self.baseline.estimator, self.estimators, expected)

    def simulation(self, noise: str) -> SimulationSettings:
        """Returns the settings of the drives under a named noise."""
        overrides = dict(self.noise[noise])
        if "laps" in overrides:
            raise SettingsError(f"noise.{noise}.laps: expected laps as a key of the study itself")
        chosen = {group: overrides.pop(f"{group}.{PRESET}", PLAIN) for group in PRESETS}
        return replace(override(preset(chosen), overrides, f"noise.{noise}"), laps=self.laps)

    @property
    def points(self) -> dict[str, MapperSettings]:
        """Returns the settings to run by name; of variants with equal settings the first."""
        distinct: dict[str, MapperSettings] = {}
        for name, settings in self._named().items():
            if settings not in distinct.values():
                distinct[name] = settings
        return distinct

    @property
    def baseline_variant(self) -> str:
        """Returns the baseline's name among `points`."""
        wanted = self._named()[self.baseline.variant]
        return next(name for name, settings in self.points.items() if settings == wanted)

    @property
    def varied(self) -> tuple[str, ...]:
        """Returns the dotted settings that any variant overrides."""
        names = [name for overrides in self.variants.values() for name in overrides]
        return tuple(dict.fromkeys([*names, *(name for grid in self.grids for name in grid)]))

    @property
    def varied_noise(self) -> tuple[str, ...]:
        """Returns the dotted settings of the simulation that any noise overrides, without presets."""
        names = dict.fromkeys(name for overrides in self.noise.values() for name in overrides)
        return tuple(name for name in names if not name.endswith(f".{PRESET}"))

    def _named(self) -> dict[str, MapperSettings]:
        points = {DEFAULT: MapperSettings()}
        for name, overrides in self.variants.items():
            points[name] = override(MapperSettings(), overrides, f"variants.{name}")
        for grid in self.grids:
            for name, overrides in _grid(grid).items():
                points[name] = override(MapperSettings(), overrides, "grid")
        return points


def _grid(grid: Mapping[str, Sequence[Any]]) -> dict[str, Overrides]:
    """Returns every combination of the values by its name."""
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


def _check_list(name: str, values: Any) -> None:
    if len(values) == 0 or len({repr(value) for value in values}) != len(values):
        raise SettingsError(f"{name}: expected at least one, and none twice, found {shown(list(values))}")


def _check_integers(name: str, values: Sequence[Any]) -> None:
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise SettingsError(f"{name}: expected whole numbers from 0 on, found {shown(value)}")
