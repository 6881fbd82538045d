"""The folder that a run leaves: its map, trajectory, cycles and summary (FORMATS)."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .files import atomic_folder
from .json_file import write_json
from .map import MAP_FILE, Map, map_to_json

_CYCLE_COLUMNS = ("cycle", "t", "seconds", "size_left", "size_right", "readings", "lap")


def write_result(folder: Path | str, result: RunResult, summary: Mapping[str, Any]) -> None:
    """Writes map.json, trajectory.tum, cycles.csv and summary.json: all of them, or on failure nothing.

    An earlier result in `folder` is kept as a numbered backup; OutputError where anything else stands there.
    """
    with atomic_folder(Path(folder), marker=MAP_FILE) as temporary:
        write_json(temporary / MAP_FILE, map_to_json(result.map), indent=None)
        write_trajectory(temporary / "trajectory.tum", result.trajectory_t, result.trajectory)
        _write_cycles(temporary / "cycles.csv", result.cycles)
        write_json(temporary / "summary.json", summary)


def write_trajectory(file: Path, t: ArrayLike, poses: ArrayLike) -> None:
    """TUM trajectory format, `t tx ty tz qx qy qz qw`; t: (n,) s, poses: (n, 3) [x, y, theta] map frame."""
    rows = np.column_stack([np.asarray(t, dtype=float), np.asarray(poses, dtype=float).reshape(-1, 3)])
    with file.open("w", encoding="utf-8", newline="\n") as out:
        for stamp, x, y, theta in rows.tolist():
            qz, qw = float(np.sin(theta / 2)), float(np.cos(theta / 2))
            out.write(f"{stamp!r} {x!r} {y!r} 0.0 0.0 0.0 {qz!r} {qw!r}\n")


def _write_cycles(file: Path, cycles: Iterable[CycleRecord]) -> None:
    with file.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(_CYCLE_COLUMNS)
        writer.writerows(_cycle_row(record) for record in cycles)


def _cycle_row(record: CycleRecord) -> list[float | int]:
    values = (getattr(record, column) for column in _CYCLE_COLUMNS)
    return [value.item() if isinstance(value, np.generic) else value for value in values]


Array = NDArray[np.float64]


@dataclass(frozen=True)
class CycleRecord:
    """One row of `cycles.csv` (FORMATS)."""

    cycle: int
    """Number of the perception cycle, from 0."""
    t: float
    """Stamp, s."""
    seconds: float
    """Wall time of the whole update, s."""
    size_left: int
    """Control points or landmarks of the left boundary."""
    size_right: int
    """The same of the right boundary."""
    readings: int
    """How many of the cycle's readings were used."""
    lap: int
    """The lap being driven, from 1, by the estimated trajectory."""
    stages: Mapping[str, float] = field(default_factory=dict)
    """Time (s) that each stage of the update took, by its name."""


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run of an estimator over a log gives."""

    estimator: str
    """Name of the estimator (FORMATS)."""
    settings: dict[str, Any]
    """Its settings in full, as plain values."""
    map: Map
    """The map at the end of the log."""
    trajectory_t: Array
    """Stamps of the perception cycles (n,), s."""
    trajectory: Array
    """Poses [x, y, theta] (n, 3), map frame; of an online estimator as they stood at that cycle."""
    cycles: tuple[CycleRecord, ...]
    """A record of each perception cycle."""
    laps: int
    """Complete laps by the estimated trajectory, one that ends just short of the line included."""
    lap_maps: tuple[tuple[int, Map], ...] = ()
    """(lap, map as it stood at its end) of each complete lap by the estimated trajectory."""
    snapshots: tuple[Map, ...] = ()
    """The map as it stood at each of the times that were asked for."""


@dataclass(frozen=True, eq=False)
class BatchRun(RunResult):
    """What a batch estimator gives; its maps of the laps are all the same one, that of the whole log."""

    converged: bool = True
    """Whether it ended at an optimum."""
