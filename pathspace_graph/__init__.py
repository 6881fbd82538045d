"""B-spline SLAM of race tracks on GTSAM factor graphs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathspace_graph.baselines.filters import CkfMapper, LandmarkCkf
    from pathspace_graph.baselines.landmark_graph import LandmarkBatch, LandmarkFixedLag
    from pathspace_graph.batch.mapper import BatchMapper
    from pathspace_graph.io.log import Detections, Log, Odometry
    from pathspace_graph.io.log_files import read_log, write_log
    from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary, read_map
    from pathspace_graph.io.results import CycleRecord, RunResult, write_result
    from pathspace_graph.online.fixed_lag import FixedLagMapper
    from pathspace_graph.plausibility.judge import Hint, hints
    from pathspace_graph.settings.mapper import MapperSettings
    from pathspace_graph.spline.bspline import BSpline

    from .errors import InputError, OutputError, PathspaceError, ReadingError, SettingsError, SolveError
    from .estimators import make_batch, make_online
    from .frames import read_cycles, read_study
    from .labels import LEFT, RIGHT
    from .run import run_online, split_odometry

__all__ = [
    "LEFT", "RIGHT", "BSpline", "BatchMapper", "CkfMapper",
    "CycleRecord", "Detections", "FixedLagMapper", "Hint", "InputError", "LandmarkBatch", "LandmarkCkf",
    "LandmarkFixedLag", "Log", "Map", "MapperSettings", "Odometry", "OutputError", "PathspaceError",
    "PointBoundary", "ReadingError", "RunResult", "SettingsError", "SolveError", "SplineBoundary", "hints",
    "make_batch", "make_online", "read_cycles", "read_log", "read_map", "read_study", "run_online",
    "split_odometry", "write_log", "write_result",
]  # fmt: skip

# imported at first access: help of the command line and sim need no estimator
_HOMES = {
    "batch.mapper": ("BatchMapper",),
    "baselines.filters": ("CkfMapper", "LandmarkCkf"),
    "errors": ("InputError", "OutputError", "PathspaceError", "ReadingError", "SettingsError", "SolveError"),
    "estimators": ("make_batch", "make_online"),
    "frames": ("read_cycles", "read_study"),
    "io.log": ("Detections", "Log", "Odometry"),
    "io.log_files": ("read_log", "write_log"),
    "io.map": ("Map", "PointBoundary", "SplineBoundary", "read_map"),
    "io.results": ("CycleRecord", "RunResult", "write_result"),
    "labels": ("LEFT", "RIGHT"),
    "baselines.landmark_graph": ("LandmarkBatch", "LandmarkFixedLag"),
    "online.fixed_lag": ("FixedLagMapper",),
    "plausibility.judge": ("Hint", "hints"),
    "run": ("run_online", "split_odometry"),
    "settings.mapper": ("MapperSettings",),
    "spline.bspline": ("BSpline",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return __all__
