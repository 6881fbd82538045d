"""Result of a run (FORMATS): map, trajectory in the TUM format, cycles, summary, and what made it."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.metadata import version
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_info

from pathspace_graph.brief import Brief, Shown
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.odometry import CALIBRATION, CALIBRATION_SIZE
from pathspace_graph.factors.se2 import compose
from pathspace_graph.factors.sensor import SENSOR
from pathspace_graph.lengths import POSE_LENGTHS, scaled

from .files import atomic_folder, write_json, write_table
from .map import MAP_FILE, Map, map_to_json

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from .log import Truth


TRAJECTORY_FILE: Final = "trajectory.tum"
SMOOTHED_FILE: Final = "smoothed.tum"
NoiseSource = Literal["stated", "measured", "assumed"]  # by the log, by the drive, by default


def write_trajectory(file: Path, t: ArrayLike, poses: ArrayLike) -> None:
    """Write stamps (n,) in s and poses [x, y, theta] (n, 3), map frame; every number to full precision."""
    x, y, theta = np.asarray(poses, dtype=float).reshape(-1, 3).T
    zero = np.zeros((len(x), 3))
    write_table(
        file, (), np.asarray(t, dtype=float), x, y, zero, np.sin(theta / 2), np.cos(theta / 2), delimiter=" "
    )


CYCLES_FILE: Final = "cycles.csv"
CYCLE_COLUMNS: Final = {  # columns of `cycles.csv` with their types; any further one is text
    **{"cycle": "int64", "t": "float64", "seconds": "float64"},
    **dict.fromkeys(("size_left", "size_right", "readings", "lap", "offered"), "int64"),
    **{"health": "str", "reason": "str", "dropped": "int64"},
}


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One row of `cycles.csv` (FORMATS)."""

    LENGTHS: ClassVar = {"jump": POSE_LENGTHS}

    cycle: int
    """Number of the perception cycle, from 0."""
    t: float
    """Stamp of the cycle, s."""
    seconds: float
    """Wall time of the whole update, s."""
    size_left: int
    size_right: int
    """Number of control points or landmarks of the right boundary, as of the left one."""
    readings: int
    """Number of the cycle's detections that were used."""
    lap: int
    """Lap of the estimated trajectory, from 1."""
    stages: Mapping[str, float] = field(default_factory=dict)
    """Time of each stage of the update, s, by its name."""
    closed: bool = False
    """Whether the loop has closed by the end of the cycle."""
    jump: tuple[float, float, float] | None = None
    """Jump of the newest pose [m, m, rad], map frame, where the map was replaced in this cycle."""
    notice: str = ""
    """Notice for the user about the cycle, if any."""
    offered: int = 0
    """Number of the cycle's detections."""
    health: str = ""
    """Good, degraded or lost; empty where the estimator does not report it."""
    reason: str = ""
    """Why the estimate is not good."""
    dropped: int = 0
    """Number of the cycle's detections that were dropped as impossible."""
    refused: int = 0
    """Number of cycles that were refused just before this one."""
    processor: float = nan
    """Processor time of this thread in the update, s."""


@dataclass(frozen=True, eq=False, repr=False)
class VehicleState(Brief):
    """Estimate of the vehicle: pose, and calibration of odometry and sensor."""

    LENGTHS: ClassVar = {"pose": POSE_LENGTHS, "sensor": (0, 1, 0, 0, 1)}
    COVARIANCES: ClassVar = {"covariance": (*POSE_LENGTHS, 0, 0), "sensor_covariance": (0, 1, 0, 0, 1)}

    pose: Array
    """Pose [x, y, theta] (3,) in m and rad, map frame; theta isn't wrapped."""
    calibration: Array
    """Calibration (2,): scale error of the speeds (-), bias of the yaw rate (rad/s)."""
    covariance: Array
    """Joint covariance (5, 5) of [pose | calibration]."""
    sensor: Array = field(default_factory=lambda: np.zeros(0))
    """Calibration of the sensor (5,), `factors.sensor:SENSOR`, or (0,) where there is none."""
    sensor_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Its covariance (5, 5), or (0, 0)."""

    @property
    def by_name(self) -> dict[str, tuple[float, float]]:
        """Each calibration with its standard deviation, by its name in `CALIBRATION` and `SENSOR`."""
        values = np.append(self.calibration, self.sensor).tolist()
        of_sensor = np.sqrt(np.diag(self.sensor_covariance))
        sigmas = np.append(self.sigmas[len(self.pose) :], of_sensor).tolist()
        return dict(zip((*CALIBRATION, *SENSOR), zip(values, sigmas, strict=True), strict=False))

    @classmethod
    def split(cls, pose: Array, calibrations: Array, joint: Array) -> VehicleState:
        """Split the state of a joint covariance of [pose | calibration of odometry | of sensor]."""
        known = len(pose) + CALIBRATION_SIZE
        odometry, sensor = np.split(calibrations.copy(), [CALIBRATION_SIZE])
        return cls(pose.copy(), odometry, joint[:known, :known], sensor, joint[known:, known:])

    @property
    def sigmas(self) -> Array:
        """Standard deviations (5,) of [pose | calibration]."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class LapBatches:
    """Ends of the batches that another process solves beside an online estimator."""

    ends: tuple[int, ...]
    """Cycles in which the result of a batch was swapped in, or the batch was abandoned."""
    late: int
    """Cycles by which the slowest batch is late in a vehicle, by its wall time."""


@dataclass(frozen=True, eq=False)
class RunNoise:
    """Noise that a run has used, and what it has measured."""

    LENGTHS: ClassVar = {"measured": 0}

    odometry: NoiseSource
    detections: NoiseSource
    measured: MeasuredNoise | None = None
    """Noise that was measured in the drive, if any."""
    size: Literal["odometry", "ranges"] | None = None
    """Ranges and speeds disagree, and the size of the map is that of these; None where they agree."""


@dataclass(frozen=True, eq=False, repr=False)
class RunResult(Shown):
    """Result of an estimator's run over a log."""

    LENGTHS: ClassVar = {
        **dict.fromkeys(("map", "cycles", "lap_maps", "snapshots", "vehicle", "noise"), 0),
        **{"trajectory": POSE_LENGTHS, "smoothed": POSE_LENGTHS, "reach": (1, 2, 0), "scale": 1},
    }

    estimator: str
    """Name of the estimator (FORMATS)."""
    settings: dict[str, Any]
    """All settings of the estimator, as plain values."""
    map: Map
    """Map at the end of the log."""
    trajectory_t: Array
    """Stamps of the perception cycles (n,) in s."""
    trajectory: Array
    """Poses [x, y, theta] (n, 3), map frame; of an online estimator as they stood at that cycle."""
    cycles: tuple[CycleRecord, ...]
    laps: int
    """Complete laps of the estimated trajectory, with a last one that ends just before the line."""
    lap_maps: tuple[tuple[int, Map], ...] = ()
    """Number of each complete lap, and the map as it stood at its end."""
    snapshots: tuple[Map, ...] = ()
    """Map as it stood at each of the times that were asked for."""
    vehicle: VehicleState | None = None
    """State of the vehicle at the end of the log, where the estimator gives it."""
    reach: Array | None = None
    """Row of each cycle (n, 3), if an observer knew the truth: the reach ahead of the vehicle, m, the sum of
    squared distances of the true cones on that stretch, m^2, and their number. The reach is NaN where the
    cycle doesn't count."""
    observing: float = 0.0
    """Wall time of the observers, s, which is no part of the estimator's."""
    batches: LapBatches | None = None
    """Ends of the batches of the lap, where the estimator has such."""
    waited: float = 0.0
    """Wall time for which the run waited for batches between cycles, s."""
    noise: RunNoise | None = None
    """Noise that was used, where the estimator reports it."""
    scale: float = 1.0
    """Size of the scene by that of a Formula Student track."""
    smoothed: Array | None = None
    """Poses (n, 3) of an online estimator whose earlier ones were corrected when the loop closed."""

    def __repr__(self) -> str:
        name = f"{type(self).__name__}({self.estimator}: {len(self.cycles)} cycles, {self.laps} laps"
        return f"{name},\n    {self.map})"

    def to_frame(self) -> pd.DataFrame:
        """Convert the run to a frame: a row for each cycle, as in `cycles.csv`, with its pose x, y, theta."""
        frame: pd.DataFrame = import_module("pathspace_graph.frames").run_frame(self)
        return frame

    def metrics(self, truth: Truth) -> pd.DataFrame:
        """Measure each complete lap against the truth of its log: the columns of `ablate`, by lap."""
        metrics = import_module("pathspace_graph.eval.figures.notebook").metrics
        frame: pd.DataFrame = metrics(self, truth)
        return frame

    def plot(self, **options: Any) -> Figure:
        """Draw map and trajectory; the options are those of `Map.plot`."""
        health = [record.health for record in self.cycles]
        paths = {"trajectory": self.trajectory, "smoothed": self.smoothed}
        return self.map.plot(**paths, health=health, **options)

    def moved(self, motion: Array) -> Self:
        """Move the last map and the trajectory by a motion (3,) of their frame."""
        return replace(self, map=self.map.moved(motion), trajectory=compose(motion, self.trajectory))

    def at_scale_one(self) -> Self:
        """Rescale the result to the size of a Formula Student track."""
        return scaled(self, 1.0 / self.scale)


@dataclass(frozen=True, eq=False, repr=False)
class BatchRun(RunResult):
    """Result of a batch estimator; its maps of the laps are all the one of the whole log."""

    converged: bool = True
    """Whether the optimization ended at an optimum."""
    cost: float = nan
    """Cost at its end, half the sum of squared whitened residuals, where it is known."""


def write_result(
    folder: Path | str,
    result: RunResult,
    summary: Mapping[str, Any],
    drives: Mapping[str, RunResult] | None = None,
    *,
    force: bool = False,
) -> None:
    """Write map.json, the trajectories, cycles.csv and summary.json to a folder, as by `atomic_folder`.

    An earlier map is replaced if `force`. Where several drives were mapped at once, trajectory and cycles of
    each are in a folder of its name. The summary also says by which commit, where and when it was `made`.
    """
    with atomic_folder(folder, MAP_FILE, force=force) as temporary:
        write_json(temporary / MAP_FILE, map_to_json(result.map), indent=None)
        _write_drive(temporary, result)
        for name, drive in (drives or {}).items():
            own = temporary / "drives" / name
            own.mkdir(parents=True)
            _write_drive(own, drive)
        write_json(temporary / "summary.json", {**summary, "made": made()})


def _write_drive(folder: Path, result: RunResult) -> None:
    """Write the trajectories and the cycles of a drive."""
    write_trajectory(folder / TRAJECTORY_FILE, result.trajectory_t, result.trajectory)
    if result.smoothed is not None:
        write_trajectory(folder / SMOOTHED_FILE, result.trajectory_t, result.smoothed)
    columns = [[getattr(record, name) for record in result.cycles] for name in CYCLE_COLUMNS]
    write_table(folder / CYCLES_FILE, CYCLE_COLUMNS, *columns)


# --- where, when and by which commit a result was made --------------------------------------------------


def made() -> dict[str, str]:
    """Commit, or version outside a repository, machine and date of what this package makes now."""
    folder, named = Path(__file__).parents[1], machine()
    installed = {"site-packages", "dist-packages"} & {*folder.parts}  # a repository around it is another one
    commit = "" if installed else commit_of(folder)
    parts = (named["host"], named["processor"], named["blas"])
    commit = commit or f"version {version('pathspace-graph')}"
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"commit": commit, "machine": ", ".join(filter(None, parts)), "date": date}


@cache
def machine() -> dict[str, str]:
    """Host, processor, and the kernels that BLAS has chosen for it."""
    file, blas = Path("/proc/cpuinfo"), {pool.get("architecture") for pool in threadpool_info()}
    model = re.search(r"model name\s*: (.*)", file.read_text()) if file.exists() else None
    processor = model[1] if model else platform.processor() or platform.machine()
    return {"host": platform.node(), "processor": processor, "blas": " ".join(sorted(filter(None, blas)))}


@cache
def commit_of(folder: Path | None) -> str:
    """Short hash of the commit that is checked out, with `+` where something differs from it.

    It is empty where there is none.
    """
    git = shutil.which("git")
    if git is None or folder is None:
        return ""
    command = [git, "-C", str(folder), "describe", "--always", "--dirty=+", "--exclude=*"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
