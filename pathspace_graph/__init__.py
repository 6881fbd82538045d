"""B-spline SLAM of race tracks on GTSAM factor graphs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .errors import InputError, OutputError, PathspaceError, SettingsError
    from .fixed_lag import FixedLagMapper
    from .log import Detections, Log, Odometry, read_log, write_log
    from .map import Map, PointBoundary, SplineBoundary, read_map
    from .result_folder import write_result
    from .run import CycleRecord, RunResult, run_online
    from .settings import MapperSettings
    from .spline import BSpline

__all__ = [
    "BSpline",
    "CycleRecord",
    "Detections",
    "FixedLagMapper",
    "InputError",
    "Log",
    "Map",
    "MapperSettings",
    "Odometry",
    "OutputError",
    "PathspaceError",
    "PointBoundary",
    "RunResult",
    "SettingsError",
    "SplineBoundary",
    "read_log",
    "read_map",
    "run_online",
    "write_log",
    "write_result",
]

# imported when first asked for: the command line's help, and sim, need no estimator
_HOMES = {
    "errors": ("InputError", "OutputError", "PathspaceError", "SettingsError"),
    "fixed_lag": ("FixedLagMapper",),
    "log": ("Detections", "Log", "Odometry", "read_log", "write_log"),
    "map": ("Map", "PointBoundary", "SplineBoundary", "read_map"),
    "result_folder": ("write_result",),
    "run": ("CycleRecord", "RunResult", "run_online"),
    "settings": ("MapperSettings",),
    "spline": ("BSpline",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
