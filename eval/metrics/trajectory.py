"""Errors of a trajectory, and the reach: how far ahead of the vehicle the map is right."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.batch.association import path_lengths
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import to_map, to_vehicle, wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, MapBoundary, SplineBoundary
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.laps import lap_end_indices
from pathspace_graph.run import ObservedCycle
from pathspace_graph.sim.curves import arc_lengths

from .accuracy import boundary_distances, root_mean_square

LOST, ASTRAY = 5.0, 1.0
"""Position errors beyond which a vehicle is lost, or astray (m)."""
MOST: Final = 35.0
"""Greatest length of a reach (m)."""
ON_CURVE: Final = 0.5
"""Distance of a true cone from the mapped boundary at which the reach ends (m)."""
SHORT: Final = 4.0
"""Reach below which no planner can work (m)."""
STARTING: Final = 0.03
"""Share of lap 1 on which the map has only begun, and cycles don't count."""


def interpolate_poses(pose_t: Array, poses: Array, t: Array) -> Array:
    """Return poses (n, 3) [x, y, theta] at the stamps t (n,), linear between poses (N, 3) at pose_t (N,).

    Headings turn the shorter way.
    """
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    x, y, theta = (np.interp(t, pose_t, column) for column in columns)
    return np.stack([x, y, wrap_angle(theta)], axis=1)


def pose_errors(t: Array, poses: Array, reference_t: Array, reference: Array) -> Array:
    """Return [along, across, heading] (k, 3) in m, m, rad: the error of each pose in its reference's frame.

    t is (n,), poses is (n, 3). Nothing is aligned. Stamps outside those of the reference are left out (k <=
    n).
    """
    inside = (t >= reference_t[0]) & (t <= reference_t[-1])
    expected = interpolate_poses(reference_t, reference, t[inside])
    dx, dy, turn = (poses[inside] - expected).T
    c, s = np.cos(expected[:, 2]), np.sin(expected[:, 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(turn)], axis=1)


def trajectory_errors(t: Array, poses: Array, truth: Truth) -> Array:
    """Return `pose_errors` by the true path."""
    return pose_errors(t, poses, truth.pose_t, truth.poses)


def ate(t: Array, poses: Array, truth: Truth) -> float:
    """Return the absolute trajectory error sqrt(mean |p - p_true|^2) in m, without alignment."""
    return position_rms(trajectory_errors(t, poses, truth))


def end_of_trajectory(t: Array, poses: Array, truth: Truth) -> dict[str, float]:
    """Return the largest position error (m), its rms in the last second (m), and whether that is lost."""
    errors = trajectory_errors(t, poses, truth)
    if len(errors) == 0:
        return {}
    known = t[(t >= truth.pose_t[0]) & (t <= truth.pose_t[-1])]
    error_end = position_rms(errors[known >= known[-1] - 1.0])
    return {
        "error_max": float(np.linalg.norm(errors[:, :2], axis=1).max()),
        "error_end": error_end,
        "lost_at_end": bool(error_end > LOST),
    }


def longest_astray(t: Array, poses: Array, truth: Truth, since: float) -> dict[str, float]:
    """Return the longest time (s) and way (m) for which a vehicle was astray, from a stamp (s) on.

    Counted from the first cycle that is wrong by more than a metre to the next one that is right, or the end.
    """
    after = (t >= max(since, truth.pose_t[0])) & (t <= truth.pose_t[-1])
    if not after.any():
        return {}
    stamps, errors = t[after], np.linalg.norm(trajectory_errors(t[after], poses[after], truth)[:, :2], axis=1)
    driven = np.interp(stamps, truth.pose_t, path_lengths(truth.poses))
    astray = np.append(errors > ASTRAY, False).astype(int)
    begins = np.flatnonzero(np.diff(astray, prepend=0) == 1)
    ends = np.minimum(np.flatnonzero(np.diff(astray, prepend=0) == -1), len(stamps) - 1)
    return {
        "astray_time": float((stamps[ends] - stamps[begins]).max(initial=0.0)),
        "astray_way": float((driven[ends] - driven[begins]).max(initial=0.0)),
    }


def vehicle_errors(state: VehicleState, t: float, truth: Truth) -> dict[str, float]:
    """Return the calibration and the heading at a stamp (s): estimate, truth, claimed sigma and error.

    `KEY_by_sigma` is the error by its claimed standard deviation. What the truth doesn't know is absent.
    """
    _, _, sigma_heading, sigma_scale, sigma_bias = state.sigmas.tolist()
    scale, bias = state.calibration.tolist()
    values = {"scale": scale, "bias": bias, "scale_sigma": sigma_scale, "bias_sigma": sigma_bias}
    values["heading_sigma"] = sigma_heading
    errors = {}
    if truth.calibration is not None:
        values["scale_true"], values["bias_true"] = truth.calibration.tolist()
        errors = {"scale": scale - values["scale_true"], "bias": bias - values["bias_true"]}
    if len(truth.poses) and truth.pose_t[0] <= t <= truth.pose_t[-1]:
        ((_, _, heading),) = trajectory_errors(np.array([t]), state.pose[None], truth)
        errors["heading"] = float(heading)
    for key, error in errors.items():
        values |= {f"{key}_error": error, f"{key}_by_sigma": error / values[f"{key}_sigma"]}
    return values


def position_rms(errors: Array) -> float:
    """Return the root mean square distance (m) of pose errors (k, 3)."""
    return root_mean_square(np.linalg.norm(errors[:, :2], axis=1))


# --- reach -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrueRoad:
    """True drive by its length, and the true cones in the order in which the drive passes them."""

    t: Array
    """Stamps (N,) of the true poses (s)."""
    drive: Array
    """(N, 4) Rows [station, x, y, theta] (m, rad): length driven and true pose; theta isn't wrapped."""
    stations: Array
    """(P,) Lengths at which the drive passes a true cone in m, ascending; every lap passes every cone."""
    cones: Array
    """(P, 2) Cone passed at each station in m, map frame."""
    labels: IntArray
    """(P,) Boundary of each cone that is passed."""
    counted: tuple[float, float]
    """Stations (m) between which cycles count."""

    def at(self, t: float) -> tuple[float, Array]:
        """Return the station (m) and the true pose (3,) at a stamp (s)."""
        station, *pose = (float(np.interp(t, self.t, column)) for column in self.drive.T)
        return station, np.array(pose)

    def counts(self, t: float, station: float) -> bool:
        """Return whether the cycle at a stamp (s), whose true station (m) is known, counts."""
        return bool(self.t[0] <= t <= self.t[-1]) and self.counted[0] <= station <= self.counted[1]


def true_road(truth: Truth) -> TrueRoad:
    """Return the road of a truth that has poses and cones.

    The last lap's cones are passed once more, so that the road goes on behind the drive's end. Without a
    complete lap, cones beside the drive's two ends and cycles less than `MOST` metres before its end don't
    count.
    """
    driven = arc_lengths(truth.poses[:, :2])
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
    """Return the stations (P,) in m at which a path (N, 2) passes cones (n, 2), and each one's cone (P,)."""
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


class CycleReach(NamedTuple):
    """Reach of the map in one cycle, a row of `RunResult.reach`."""

    reach: float
    squares: float
    cones: int


def cycle_reach(road: TrueRoad, station: float, pose_true: Array, pose: Array, track: Map) -> CycleReach:
    """Return the reach of a map at a true station (m), seen from the true and from the estimated pose (3,).

    The cones are placed by `map_T_vehicle * vehicle_T_cones`, with the estimated and with the true pose, so
    that only what the vehicle would see ahead of itself counts.
    """
    ahead = slice(*np.searchsorted(road.stations, [station, station + MOST]))
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
    """Return the distance (k,) in m of each point (k, 2) from a mapped boundary, on a coarser grid."""
    if isinstance(boundary, SplineBoundary):
        return np.asarray(np.linalg.norm(points - boundary.spline.foot_points(points).position, axis=1))
    return boundary_distances(boundary, points)


class ReachObserver:
    """Observer that measures the reach in every cycle of `run.run_online`."""

    def __init__(self, truth: Truth) -> None:
        self._road = true_road(truth)
        self._rows: list[CycleReach] = []

    def __call__(self, cycle: ObservedCycle) -> None:
        road, result = self._road, cycle.result
        station, pose_true = road.at(result.t)
        if road.counts(result.t, station):
            self._rows.append(cycle_reach(road, station, pose_true, result.pose, cycle.outline))
        else:
            self._rows.append(CycleReach(np.nan, 0.0, 0))

    @property
    def rows(self) -> Array:
        return np.array(self._rows, float).reshape(-1, 3)


def reach_values(rows: Array) -> dict[str, float]:
    """Return the metrics of rows (n, 3) of `RunResult.reach`; there are none where no cycle counts."""
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
