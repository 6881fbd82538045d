"""The reach of a map: how far ahead of the vehicle it can be trusted, cycle by cycle (FORMATS, Reach)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.factors.se2 import to_map, to_vehicle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.run import ObservedCycle

from .table1 import boundary_distances

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

MOST: Final = 35.0
"""A reach is at most this long (m)."""
ON_CURVE: Final = 0.5
"""The reach ends at the first true cone that is farther than this (m) from the mapped boundary."""
SHORT: Final = 4.0
"""A reach of less than this (m) is too short for any planner."""
STARTING: Final = 0.03
"""On this first share of lap 1 the map has only begun, and cycles don't count."""
NOT_COUNTED: Final = (np.nan, 0.0, 0.0)
"""A cycle that doesn't count has this in place of `CycleReach`."""


# --- the true road ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrueRoad:
    """Holds the true drive by its length, and the true cones in the order in which the drive passes them."""

    t: Array
    """These are the stamps (N,) in s of the true poses."""
    drive: Array
    """Each row is [station, x, y, theta] (N, 4) in m and rad: the length driven so far, and the true pose,
    whose heading isn't wrapped."""
    stations: Array
    """The drive passes a true cone at each of these lengths (P,) in m, ascending; every lap passes every
    cone."""
    cones: Array
    """Each row is the cone (P, 2) in m, map frame, that is passed there."""
    labels: NDArray[np.int_]
    """Each cone (P,) that is passed is of this boundary."""
    counted: tuple[float, float]
    """Cycles between these stations (m) count."""

    def at(self, t: float) -> tuple[float, Array]:
        """Returns the station (m) and the true pose (3,) at a stamp (s)."""
        station, *pose = (float(np.interp(t, self.t, column)) for column in self.drive.T)
        return station, np.array(pose)

    def counts(self, t: float, station: float) -> bool:
        """Returns whether the cycle at a stamp (s), whose true station (m) is known, counts."""
        return bool(self.t[0] <= t <= self.t[-1]) and self.counted[0] <= station <= self.counted[1]

    def ahead(self, station: float) -> slice:
        """Returns which of the cones are passed within the next `MOST` metres."""
        first, stop = np.searchsorted(self.stations, [station, station + MOST])
        return slice(int(first), int(stop))


def true_road(truth: Truth) -> TrueRoad:
    """Returns the road of a truth that has poses and cones.

    The last lap's cones are passed once more, one lap later, so that the road goes on behind the drive's end.
    Without a complete lap it doesn't. Then the cones beside the drive's two ends are left out, and cycles
    less than `MOST` metres before its end don't count.
    """
    steps = np.linalg.norm(np.diff(truth.poses[:, :2], axis=0), axis=1)
    driven = np.append(0.0, np.cumsum(steps))
    own = np.isin(truth.cone_labels, BOUNDARIES)
    cones, ends = truth.cones[own], driven[lap_end_indices(truth.poses)]
    stations, cone = _passes(truth.poses[:, :2], driven, cones, ends)
    order = np.argsort(stations, kind="stable")
    lap = float(ends[0]) if len(ends) else float(driven[-1])
    heading = np.unwrap(truth.poses[:, 2])
    return TrueRoad(
        t=truth.pose_t,
        drive=np.column_stack([driven, truth.poses[:, :2], heading]),
        stations=stations[order],
        cones=cones[cone[order]],
        labels=truth.cone_labels[own][cone[order]],
        counted=(STARTING * lap, np.inf if len(ends) else float(driven[-1]) - MOST),
    )


def _passes(path: Array, driven: Array, cones: Array, ends: Array) -> tuple[Array, IntArray]:
    """Returns the stations (P,) in m at which a path (N, 2) passes cones (n, 2), and each one's cone (P,)."""
    if len(ends) == 0:
        nearest = np.asarray(KDTree(path).query(cones)[1], np.intp)
        beside = np.flatnonzero((nearest > 0) & (nearest < len(path) - 1))
        return driven[nearest[beside]], beside
    begins = np.append(0.0, ends)
    laps = []
    for begin, end in pairwise(begins):
        lap = np.flatnonzero((driven >= begin) & (driven <= end))
        laps.append(driven[lap[np.asarray(KDTree(path[lap]).query(cones)[1], np.intp)]])
    laps.append(laps[-1] + begins[-1] - begins[-2])
    return np.concatenate(laps), np.tile(np.arange(len(cones)), len(laps))


# --- one cycle -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CycleReach:
    """Holds how far the map reaches in one cycle."""

    reach: float
    """The road is mapped on both sides for this far ahead of the vehicle (m)."""
    squares: float
    """The squared distances of the true cones on that stretch from the mapped boundaries sum up to this
    (m^2)."""
    cones: int
    """This number of true cones is on that stretch."""


def cycle_reach(road: TrueRoad, station: float, pose_true: Array, pose: Array, track: Map) -> CycleReach:
    """Returns the reach of a map at a true station (m), seen from the true and from the estimated pose (3,).

    The cones are placed in the map by `map_T_vehicle * vehicle_T_cones`, with the estimated and with the true
    pose, so that only what the vehicle would see ahead of itself counts.
    """
    ahead = road.ahead(station)
    cones, labels, away = road.cones[ahead], road.labels[ahead], road.stations[ahead] - station
    each = (len(cones), 3)
    points = to_map(to_vehicle(cones, np.broadcast_to(pose_true, each)), np.broadcast_to(pose, each))
    distances = np.full(len(points), np.inf)
    for label, boundary in track.boundaries.items():
        distances[labels == label] = _distances(boundary, points[labels == label])
    reach = float(away[distances > ON_CURVE].min(initial=MOST))
    on_stretch = distances[away < reach]
    return CycleReach(reach, float(on_stretch @ on_stretch), len(on_stretch))


def _distances(boundary: MapBoundary, points: Array) -> Array:
    """Returns the distance (k,) in m of each point (k, 2) from a mapped boundary, on a coarser grid."""
    if isinstance(boundary, SplineBoundary):
        return np.asarray(np.linalg.norm(points - boundary.spline.foot_points(points).position, axis=1))
    return boundary_distances(boundary, points)


# --- a run -----------------------------------------------------------------------------------------------


class ReachObserver:
    """Measures the reach in every cycle of a run, which it is shown by `run.run_online`."""

    def __init__(self, truth: Truth) -> None:
        self._road = true_road(truth)
        self._rows: list[tuple[float, float, float]] = []

    def __call__(self, cycle: ObservedCycle) -> None:
        """Measures one cycle, with the map as it stands."""
        result = cycle.result
        station, pose_true = self._road.at(result.t)
        if not self._road.counts(result.t, station):
            self._rows.append(NOT_COUNTED)
            return
        found = cycle_reach(self._road, station, pose_true, result.pose, cycle.outline)
        self._rows.append((found.reach, found.squares, float(found.cones)))

    @property
    def rows(self) -> Array:
        """Returns the rows (n, 3) of `RunResult.reach`."""
        return np.array(self._rows, float).reshape(-1, 3)


def reach_values(rows: Array) -> dict[str, float]:
    """Returns the metrics of rows (n, 3) of `RunResult.reach`; there are none where no cycle counts."""
    counted = rows[~np.isnan(rows[:, 0])]
    if len(counted) == 0:
        return {}
    reach, squares, cones = counted.T
    median, tenth = np.quantile(reach, [0.5, 0.1])
    error = np.sqrt(squares.sum() / cones.sum()) if cones.sum() else np.nan
    return {
        "reach_median": float(median),
        "reach_p10": float(tenth),
        "reach_short": float(np.mean(reach < SHORT)),
        "reach_error": float(error),
    }
