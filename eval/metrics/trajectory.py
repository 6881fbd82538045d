"""Errors of a trajectory, and the reach: how far ahead of the vehicle the map is right."""

from itertools import pairwise
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths, relative, to_map, to_vehicle, wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.run import ObservedCycle
from pathspace_graph.sim.track import arc_lengths

from .accuracy import boundary_distances, root_mean_square, true_lap_ends

MOST: Final = 35.0  # greatest length of a reach (m)


def interpolate_poses(pose_t: Array, poses: Array, t: Array) -> Array:
    """Return poses (n, 3) at t (n,), linear between poses (N, 3) at pose_t (N,), by the shorter turn."""
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    x, y, theta = (np.interp(t, pose_t, column) for column in columns)
    return np.stack([x, y, wrap_angle(theta)], axis=1)


def trajectory_errors(t: Array, poses: Array, truth: Truth) -> Array:
    """Return [along, across, heading] (k, 3) in m, m, rad: the error of each pose in the true pose's frame.

    t is (n,), poses is (n, 3). Nothing is aligned. Stamps outside those of the true path are left out.
    """
    inside = (t >= truth.pose_t[0]) & (t <= truth.pose_t[-1])
    expected = interpolate_poses(truth.pose_t, truth.poses, t[inside])
    errors = relative(expected, poses[inside])
    return np.column_stack([errors[:, :2], wrap_angle(errors[:, 2])])


def end_of_trajectory(t: Array, poses: Array, truth: Truth) -> dict[str, float]:
    """Return the largest position error (m), and whether its rms in the last second is over 5 m: lost."""
    errors = trajectory_errors(t, poses, truth)
    if len(errors) == 0:
        return {}
    known = t[(t >= truth.pose_t[0]) & (t <= truth.pose_t[-1])]
    largest = float(np.linalg.norm(errors[:, :2], axis=1).max())
    end = position_rms(errors[known >= known[-1] - 1.0])
    return {"error_max": largest, "lost_at_end": end > 5.0}


def longest_divergence(t: Array, poses: Array, truth: Truth, since: float) -> dict[str, float]:
    """Return the longest time (s) and way (m) for which the estimate had diverged, from a stamp on (s).

    Counted from the first cycle that is wrong by more than a metre to the next one that is right, or the end.
    """
    after = (t >= max(since, truth.pose_t[0])) & (t <= truth.pose_t[-1])
    if not after.any():
        return {}
    stamps, errors = t[after], np.linalg.norm(trajectory_errors(t[after], poses[after], truth)[:, :2], axis=1)
    driven = np.interp(stamps, truth.pose_t, path_lengths(truth.poses))
    diverged = np.append(errors > 1.0, False).astype(int)
    begins = np.flatnonzero(np.diff(diverged, prepend=0) == 1)
    ends = np.minimum(np.flatnonzero(np.diff(diverged, prepend=0) == -1), len(stamps) - 1)
    time, way = (float((of[ends] - of[begins]).max(initial=0.0)) for of in (stamps, driven))
    return {"divergence_time": time, "divergence_distance": way}


def vehicle_errors(state: VehicleState, t: float, truth: Truth) -> dict[str, float]:
    """Return the calibration at the end, its truth, and errors by their claimed sigmas, as `KEY_by_sigma`.

    The heading is that at a stamp (s). What the truth doesn't know is absent.
    """
    scale, bias = state.calibration.tolist()
    values, errors = {"scale": scale, "bias": bias}, {}
    if truth.calibration is not None:
        values["scale_true"], values["bias_true"] = truth.calibration.tolist()
        errors = {"scale": scale - values["scale_true"], "bias": bias - values["bias_true"]}
    if len(truth.poses) and truth.pose_t[0] <= t <= truth.pose_t[-1]:
        ((_, _, heading),) = trajectory_errors(np.array([t]), state.pose[None], truth)
        errors["heading"] = float(heading)
    sigmas = dict(zip(("heading", "scale", "bias"), state.sigmas.tolist()[2:], strict=True))
    return values | {f"{key}_by_sigma": error / sigmas[key] for key, error in errors.items()}


def position_rms(errors: Array) -> float:
    """Return sqrt(mean |p - p_true|^2), m, of pose errors (k, 3): the absolute trajectory error (ATE)."""
    return root_mean_square(np.linalg.norm(errors[:, :2], axis=1))


class ReachObserver:
    """Observer of `run.run_online` that measures the reach in every cycle; the truth has poses and cones.

    The last lap's cones are passed once more, so that the road goes on behind the drive's end. Without a
    complete lap, cones beside the drive's two ends and cycles less than `MOST` metres before its end don't
    count.
    """

    def __init__(self, truth: Truth) -> None:
        path, heading = truth.poses[:, :2], np.unwrap(truth.poses[:, 2])
        driven, own = arc_lengths(path), np.isin(truth.cone_labels, BOUNDARIES)
        ends = driven[true_lap_ends(truth)]
        # the stations (m) at which the cones are passed, and the cone of each
        if len(ends):
            begins, laps = np.append(0.0, ends), []
            for begin, end in pairwise(begins):
                lap = np.flatnonzero((driven >= begin) & (driven <= end))
                nearest = np.asarray(KDTree(path[lap]).query(truth.cones[own])[1], np.intp)
                laps.append(driven[lap[nearest]])
            laps.append(laps[-1] + begins[-1] - begins[-2])
            stations, cone = np.concatenate(laps), np.tile(np.arange(np.count_nonzero(own)), len(laps))
        else:
            nearest = np.asarray(KDTree(path).query(truth.cones[own])[1], np.intp)
            cone = np.flatnonzero((nearest > 0) & (nearest < len(path) - 1))
            stations = driven[nearest[cone]]
        order = np.argsort(stations, kind="stable")
        self._t, self._drive = truth.pose_t, np.column_stack([driven, path, heading])
        self._stations = stations[order]
        self._cones, self._labels = truth.cones[own][cone[order]], truth.cone_labels[own][cone[order]]
        first, whole = (ends[0], np.inf) if len(ends) else (driven[-1], driven[-1] - MOST)
        # stations between which cycles count (m): on the first 3 % of lap 1 the map has only begun
        self._counted = float(0.03 * first), float(whole)
        self._rows: list[tuple[float, float, int]] = []

    def __call__(self, cycle: ObservedCycle) -> None:
        t, (first, last) = cycle.result.t, self._counted
        station, pose_true = self.at(t)
        if self._t[0] <= t <= self._t[-1] and first <= station <= last:
            self._rows.append(self.reach(station, pose_true, cycle.result.pose, cycle.outline))
        else:
            self._rows.append((np.nan, 0.0, 0))

    @property
    def rows(self) -> Array:
        """Return the rows (n, 3) of `RunResult.reach`."""
        return np.array(self._rows, float).reshape(-1, 3)

    def at(self, t: float) -> tuple[float, Array]:
        """Return the length driven (m) and the true pose (3,) at a stamp (s)."""
        station, *pose = (float(np.interp(t, self._t, column)) for column in self._drive.T)
        return station, np.array(pose)

    def reach(self, station: float, pose_true: Array, pose: Array, track: Map) -> tuple[float, float, int]:
        """Return the reach of a map at a true station (m), seen from the true and the estimated pose (3,).

        The cones are placed by `map_T_vehicle * vehicle_T_cones`, with the estimated and with the true pose,
        so that only what the vehicle would see ahead of itself counts. The reach ends at a cone that is over
        0.5 m from its mapped boundary. The sum of their squared distances
        (m^2) and their number are of the stretch in reach.
        """
        ahead = slice(*np.searchsorted(self._stations, [station, station + MOST]))
        cones, labels, away = self._cones[ahead], self._labels[ahead], self._stations[ahead] - station
        each = (len(cones), 3)
        points = to_map(to_vehicle(cones, np.broadcast_to(pose_true, each)), np.broadcast_to(pose, each))
        distances = np.full(len(points), np.inf)
        for label, boundary in track.boundaries.items():
            own = points[labels == label]
            if isinstance(boundary, SplineBoundary):  # on a coarser grid
                feet = boundary.spline.foot_points(own)
                distances[labels == label] = np.linalg.norm(own - feet.position, axis=1)
            else:
                distances[labels == label] = boundary_distances(boundary, own)
        reach = float(away[distances > 0.5].min(initial=MOST))
        on_stretch = distances[away < reach]
        return reach, float(on_stretch @ on_stretch), len(on_stretch)


def reach_values(rows: Array) -> dict[str, float]:
    """Return the metrics of rows (n, 3) of `RunResult.reach`; there are none where no cycle counts."""
    counted = rows[~np.isnan(rows[:, 0])]
    if len(counted) == 0:
        return {}
    reach, squares, cones = counted.T
    median, tenth = np.quantile(reach, [0.5, 0.1]).tolist()
    error = float(np.sqrt(squares.sum() / cones.sum())) if cones.sum() else float("nan")
    short = float(np.mean(reach < 4.0))
    return {"reach_median": median, "reach_p10": tenth, "reach_short": short, "reach_error": error}
