"""Evidence against an optimum: against closing a loop on it, and against the map as a whole."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.se2 import path_lengths, to_map
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.spline.boundary import boundaries_cross, sampled
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.crossing import crossed_boundaries, crossings_told

from .start import aligned_odometry
from .system import BatchSystem, Evaluation

LEAST_USED: Final = 2.0 / 3.0  # least share of coloured detections on the curves of a closed result
DRIVE_RATIO: Final = 2.5  # largest distance of a boundary from the drive, relative to the drive's from it
DRIVE_PERCENTILE: Final = 95.0  # percentile of the poses' distances: the drive may begin or end off the track
BENT_SIGMAS: Final = 4.0  # largest distance of an optimum's poses from odometry and revisits (sigmas)
MISS_STRETCH: Final = 25.0  # length of the stretches of the drive by which a miss is located (m)
MISS_DETECTIONS: Final = 20  # least number of detections of such a stretch
MISS_NEAR: Final = (
    2.5  # largest distance of near detections from the drive, relative to the used ones' median
)
SAME_CONE: Final = 0.5  # distance of two detections of one cone, as the optimum places them (m)
SEEN_AGAIN: Final = 0.25  # least number of detections of a cone, relative to the median of the used ones
MISS_SHARE: Final = 1.0 / 3.0  # least share of near detections on no boundary that is a miss
MISS_SHOWN: Final = 3  # largest number of reported stretches


def are_of_cones(detections: DetectionTable, points: Array) -> BoolArray:
    """Whether each detection at points (m, 2), map frame, has others beside it about as used ones have.

    False detections are scattered. They are evidence neither for a map nor against it.
    """
    if not detections.used.any():
        return np.ones(len(points), bool)
    count = np.asarray(KDTree(points).query_ball_point(points, SAME_CONE, return_length=True))
    return np.asarray(count >= SEEN_AGAIN * np.median(count[detections.used]))


def share_used(at: Evaluation, detections: DetectionTable) -> float:
    """Share of the coloured detections of cones of the first lap that lie on the curves of an optimum."""
    state = at.state
    coloured = np.isin(detections.label, list(state.boundaries))
    coloured &= are_of_cones(detections, detections.points_map(slice(None), state.variables))
    again = np.ones(len(state.poses), bool)  # beside a previously driven stretch of every boundary
    for label, boundary in state.boundaries.items():
        again &= state.pose_u[label] - state.pose_u[label][0] >= boundary.length
    first = coloured & ~again[detections.cycle]
    return float(detections.used[first].mean()) if first.any() else 0.0


def objection(splines: Mapping[int, BSpline], poses: Array, used: float) -> str:
    """Describe the evidence against a map of closed curves around the poses (P, 3) of a lap; empty if none.

    Both boundaries must be closed, and cross only at level crossings. The vehicle must cross neither, and
    drive beside all of both. A large share of the detections must be `used`. Beside a gap between two cycles
    the boundaries are not tested if a point beside its middle would be too far from both poses.
    """
    if set(splines) != set(BOUNDARIES) or not all(spline.periodic for spline in splines.values()):
        return "not both of its boundaries are closed"
    driven, by_drive = poses[:, :2], KDTree(poses[:, :2])
    if boundaries_cross(splines, SAMPLE, driven):
        return "its boundaries cross"
    if crossed := crossed_boundaries(splines, driven):
        return crossings_told(crossed)
    for curve in (sampled(spline, SAMPLE) for spline in splines.values()):
        distance, beside = map(np.asarray, KDTree(curve).query(driven))
        aside = float(np.percentile(distance, DRIVE_PERCENTILE))
        missing = np.flatnonzero(np.hypot(*np.diff(driven, axis=0).T) > 2.0 * DRIVE_RATIO * aside)
        known = np.ones(len(curve), bool)
        for first, last in zip(beside[missing], beside[missing + 1], strict=True):
            known[np.arange(first, last if last >= first else last + len(curve)) % len(curve)] = False
        wider = float(np.max(by_drive.query(curve[known])[0])) / aside
        if wider > DRIVE_RATIO:
            return f"a boundary has a stretch {wider:.1f} times as far from the drive as one driven along"
    if used < LEAST_USED:
        return f"only {used:.0%} of the detections lie on its boundaries".replace("%", " %")
    return ""


def evidence_against(
    system: BatchSystem, at: Evaluation, splines: Mapping[int, BSpline], detections: DetectionTable
) -> str:
    """Describe the evidence against closed curves at an optimum, with their detections; empty if none."""
    poses, calibration = at.state.poses, at.state.variables.calibration
    used = share_used(at, detections)
    return disagreement(system, poses, calibration) or objection(splines, poses, used)


def disagreement(system: BatchSystem, poses: Array, calibration: Array) -> str:
    """Describe how the poses (P, 3) of an optimum contradict odometry and revisits; empty if they agree.

    Both are estimates of one drive, so they differ by some standard deviations of the less certain one. A
    wrong optimum bends the drive by much more, to fit the map. The odometry is corrected by the calibration
    (2,) of the optimum: what contradicts its prior widens that, and does not bend the drive.
    """
    if not system.revisits:
        return ""
    calibrated = replace(system.chain, calibration_mean=calibration)
    sigmas = aligned_odometry(calibrated, system.revisits).disagreement(poses)
    return f"the poses are {sigmas:.1f} sigmas from the odometry" if sigmas > BENT_SIGMAS else ""


def unmapped(detections: DetectionTable, poses: Array) -> str:
    """Describe where a third of the detections near a drive lie on no boundary; empty if they do not.

    Detections far from the drive may be of another road, or false.
    """
    if len(detections.cycle) == 0:
        return ""
    driven, used = path_lengths(poses), detections.used
    points = to_map(detections.measured, poses[detections.cycle])
    distance = np.asarray(KDTree(poses[:, :2]).query(points)[0])
    near = distance < MISS_NEAR * np.median(distance[used] if used.any() else distance)
    near &= are_of_cones(detections, points)
    missed = near & ~used
    if missed.sum() < MISS_SHARE * near.sum():
        return ""
    stretch = (driven[detections.cycle] // MISS_STRETCH).astype(np.intp)
    count = np.bincount(stretch, near)
    poor = (count >= MISS_DETECTIONS) & (np.bincount(stretch, missed, len(count)) >= MISS_SHARE * count)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], poor, [False]])))
    ends = np.minimum(MISS_STRETCH * edges.reshape(-1, 2), driven[-1]).tolist()[:MISS_SHOWN]
    told = ", ".join(f"{a:.3g} to {b:.3g} m" for a, b in ends)
    where = f" ({told} of the drive)" if told else ""
    share = 100.0 * missed.sum() / near.sum()
    return f"{share:.0f} % of the detections near the drive lie on no boundary{where}"
