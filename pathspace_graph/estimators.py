"""The estimators by the names that the command line knows them by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Final

from .errors import SettingsError
from .fixed_lag import FixedLagMapper
from .log import Log
from .run import BatchEstimator, OnlineEstimator
from .settings import MapperSettings

DEFAULT: Final = "fixed-lag"
"""The online estimator that runs where none is named, ..."""
DEFAULT_BATCH: Final = "spline"
"""... and the batch one."""


def _fixed_lag(settings: MapperSettings, log: Log) -> OnlineEstimator:
    return FixedLagMapper(settings, log.odometry_sigma)


def _landmark_fixed_lag(settings: MapperSettings, log: Log) -> OnlineEstimator:
    from pathspace_graph.eval.landmark_fixed_lag import LandmarkFixedLag  # noqa: PLC0415 - eval imports us

    return LandmarkFixedLag(settings, log.odometry_sigma)


def _ckf(settings: MapperSettings, log: Log) -> OnlineEstimator:
    from .ckf import CkfMapper  # noqa: PLC0415 - only where it is asked for

    return CkfMapper(settings, log.odometry_sigma)


def _landmark_ckf(settings: MapperSettings, log: Log) -> OnlineEstimator:
    from pathspace_graph.eval.landmark_ckf import LandmarkCkf  # noqa: PLC0415 - eval imports us

    return LandmarkCkf(settings, log.odometry_sigma)


def _incremental(settings: MapperSettings, log: Log) -> OnlineEstimator:
    from .incremental import incremental_fixed_lag  # noqa: PLC0415 - only where it is asked for

    return incremental_fixed_lag(settings, log.odometry_sigma)


ONLINE: Final[Mapping[str, Callable[[MapperSettings, Log], OnlineEstimator]]] = {
    DEFAULT: _fixed_lag,
    "landmark-fixed-lag": _landmark_fixed_lag,
    "ckf": _ckf,
    "landmark-ckf": _landmark_ckf,
    "incremental-fixed-lag": _incremental,
}
"""What makes each online estimator for a log, of which it is told the sensors' noise only."""


def _spline(settings: MapperSettings, log: Log) -> BatchEstimator:
    from .batch import BatchMapper  # noqa: PLC0415 - only where it is asked for

    return BatchMapper(settings, log.odometry_sigma)


def _landmark_batch(settings: MapperSettings, log: Log) -> BatchEstimator:
    from pathspace_graph.eval.landmark_batch import LandmarkBatch  # noqa: PLC0415 - eval imports us

    return LandmarkBatch(settings, log.odometry_sigma)


BATCH: Final[Mapping[str, Callable[[MapperSettings, Log], BatchEstimator]]] = {
    DEFAULT_BATCH: _spline,
    "landmark-batch": _landmark_batch,
}
"""The same of the batch estimators."""


def check_batch(name: str) -> None:
    """SettingsError, naming the known ones, where there is no batch estimator of that name."""
    if name not in BATCH:
        known = ", ".join(sorted(BATCH))
        raise SettingsError(f"--estimator: expected a known batch estimator ({known}), found '{name}'")


def make_batch(name: str, settings: MapperSettings, log: Log) -> BatchEstimator:
    """The batch estimator of that name, for a log."""
    check_batch(name)
    return BATCH[name](settings, log)


def check_online(name: str) -> None:
    """SettingsError, naming the known ones, where there is no online estimator of that name."""
    if name not in ONLINE:
        known = ", ".join(sorted(ONLINE))
        raise SettingsError(f"--estimator: expected a known online estimator ({known}), found '{name}'")


def make_online(name: str, settings: MapperSettings, log: Log) -> OnlineEstimator:
    """The online estimator of that name, ready for the log's first cycle."""
    check_online(name)
    return ONLINE[name](settings, log)


def check_settings(settings: Any, where: str = "") -> None:
    """SettingsError unless every number of a settings dataclass, nested ones too, is finite and positive."""
    for entry in fields(settings):
        name, value = f"{where}{entry.name}", getattr(settings, entry.name)
        if is_dataclass(value):
            check_settings(value, f"{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool) and not 0 < value < float("inf"):
            raise SettingsError(f"{name}: expected a finite, positive number, found {value}")
