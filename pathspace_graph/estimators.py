"""The estimators by their names on the command line: our own, and those of other installed packages.

A package adds one by an entry point of its name, in the group `pathspace_graph.online` or
`pathspace_graph.batch`, that refers to what makes it.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final

from pathspace_graph.batch.mapper import BatchMapper
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.kind import with_kind
from pathspace_graph.io.log import Log
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.scale import chosen_scale
from pathspace_graph.settings.mapper import MapperSettings, known_settings

from .errors import check_name, check_type
from .run import BatchEstimator, OnlineEstimator

MakeOnline = Callable[[MapperSettings, KnownNoise], OnlineEstimator]
MakeBatch = Callable[[MapperSettings, KnownNoise], BatchEstimator]

DEFAULT_ONLINE: Final = "fixed-lag"  # online estimator where none is named
DEFAULT_BATCH: Final = "spline"  # batch estimator where none is named
ONLINE_GROUP: Final = "pathspace_graph.online"  # group of entry points that add online estimators
BATCH_GROUP: Final = "pathspace_graph.batch"  # group of entry points that add batch estimators


_ENTRY_POINTS: Final = entry_points()  # looked up once, since that reads the metadata of every package


def _installed(group: str) -> dict[str, Callable[[MapperSettings, KnownNoise], Any]]:
    return {point.name: partial(_load, point) for point in _ENTRY_POINTS.select(group=group)}


def _load(point: EntryPoint, settings: MapperSettings, noise: KnownNoise) -> Any:
    """Return the estimator of an entry point, made with the sigmas (3,) of a twist (m/s, m/s, rad/s)."""
    return point.load()(settings, noise.odometry)


def _baseline(home: str, settings: MapperSettings, noise: KnownNoise) -> Any:
    """Return the estimator of a class `module:name` of the baselines, which is imported by then."""
    module, name = home.split(":")
    return getattr(import_module(f".baselines.{module}", __package__), name)(settings, noise)


ONLINE: Final[dict[str, MakeOnline]] = {  # makers, from settings and known noise
    **_installed(ONLINE_GROUP),
    DEFAULT_ONLINE: FixedLagMapper,
    "landmark-fixed-lag": partial(_baseline, "landmark_fixed_lag:LandmarkFixedLag"),
    "ckf": partial(_baseline, "filters:CkfMapper"),
    "landmark-ckf": partial(_baseline, "filters:LandmarkCkf"),
}

BATCH: Final[dict[str, MakeBatch]] = {
    **_installed(BATCH_GROUP),
    DEFAULT_BATCH: lambda settings, noise: BatchMapper(settings, noise, FixedLagMapper),
    "landmark-batch": partial(_baseline, "landmark_batch:LandmarkBatch"),
}


def check_online(name: str, option: str = "--estimator") -> None:
    """Raise a SettingsError that names the known estimators, unless the name is one of them."""
    known = ", ".join(sorted(ONLINE))
    check_name(name, ONLINE, f"{option}: expected a known online estimator ({known})")


def check_batch(name: str) -> None:
    check_name(name, BATCH, f"--estimator: expected a known batch estimator ({', '.join(sorted(BATCH))})")


def make_online(name: str, settings: MapperSettings, log: Log) -> OnlineEstimator:
    """Return an online estimator for a log, which tells the scale where the settings leave it open."""
    check_online(name)
    return ONLINE[name](settings_of(settings, log), log.noise)


def settings_of(settings: MapperSettings, log: Log) -> MapperSettings:
    """Return settings with what they leave open and a log tells: the scale, and the kind of the sensor."""
    settings = known_settings(settings)
    return with_kind(replace(settings, scale=chosen_scale(settings, log)), log)


def make_batch(name: str, settings: MapperSettings, log: Log) -> BatchEstimator:
    check_batch(name)
    check_type("log", log, Log)
    return BATCH[name](settings, log.noise)
