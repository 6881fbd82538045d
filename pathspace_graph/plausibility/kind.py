"""Whether detections are points of lines, whatever the log says of its sensor.

The nearest detections of each side are laid on those of an earlier cycle by odometry. Cones find themselves
there, within their noise. Points of a line find a neighbour: at distances that are spread evenly over half
the gap between points, whatever the gap.
"""

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.se2 import compose, move_points, relative
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.run import split_odometry

COMPARED: Final = 2  # nearest detections of a side that are compared: noise grows with the range
PARTNERS: Final = 10  # nearest detections of an earlier cycle among which each of them has its partner
MOVED: Final = 0.25  # least way between both cycles, over the gap: at rest a line is seen at the same places
LONGEST: Final = 1.5  # longest time between them (s), over which odometry hardly drifts
MOST_AWAY: Final = 1.5  # largest distance that counts, over half the gap
PATIENCE: Final = 120.0  # time (s) that is looked at
FEWEST: Final = 80  # comparisons that tell: the median of a line has a sigma of 0.08
ENOUGH: Final = 300  # comparisons that are enough: 0.1 to 0.27 was met for cones, 0.46 to 1.2 for lines
CONES: Final = 0.32  # median distance over half the gap up to which they are cones
LINE: Final = 0.4  # from which on they are points of a line; between, it cannot be told
ON_LINE: Final = 2.2  # median distance (sigmas) across the line up to which points are on it, not garbled
LEAST_SIGMA: Final = 1e-3  # least standard deviation of that distance (m)
SAME: Final = 3.0  # largest distance (sigmas) of two detections of one cone


@lru_cache(maxsize=2)
def is_line(log: Log) -> bool | None:
    """Whether the detections of the first seconds of a log are points of lines; None if that is not clear."""
    away, across = list[float](), list[float]()  # from partners, over half the gap; from their line (sigmas)
    gaps: dict[int, list[float]] = {label: [] for label in BOUNDARIES}
    past: dict[int, list[tuple[float, Array, Array]]] = {label: [] for label in BOUNDARIES}
    pose, begin = np.zeros(3), log.cycles[0].t if log.cycles else 0.0
    for odometry, detections in split_odometry(log):
        if detections.t > begin + PATIENCE or len(away) >= ENOUGH:
            break
        if len(odometry.t):
            held = np.diff(np.append(odometry.t, detections.t))
            pose = compose(pose, integrate_twists(held, odometry.twist, np.zeros(3)).delta)
        side = detections.labels  # or of the vehicle, where no detection has a label
        if (side == UNKNOWN).all():
            side = np.where(detections.points_vehicle[:, 1] > 0.0, LEFT, RIGHT)
        for label in BOUNDARIES:
            own = detections.where(side == label)
            points, sigmas = _nearest(own)
            if len(points) < 2:
                continue
            gaps[label].append(
                float(np.median(np.asarray(KDTree(points).query(points[:COMPARED], k=2)[0])[:, 1]))
            )
            gap = float(np.median(gaps[label]))
            past[label] = [one for one in past[label] if one[0] >= detections.t - LONGEST]
            for _, earlier, partners in reversed(past[label]):
                way = relative(earlier, pose)
                if np.hypot(way[0], way[1]) < MOVED * gap:
                    continue
                placed = move_points(way, points[:COMPARED])
                seen = np.hypot(*placed.T) < np.hypot(*partners[-1])
                apart = KDTree(partners).query(placed[seen])[0]
                away += np.minimum(apart / (0.5 * gap), MOST_AWAY).tolist()
                sigma = np.maximum(2.0**0.5 * sigmas[:COMPARED][seen], LEAST_SIGMA)
                across += (_from_line(placed[seen], partners) / sigma).tolist()
                break
            past[label].append((detections.t, pose, points))
    if len(away) < FEWEST:
        return None
    if np.median(away) < CONES:
        return False
    return True if np.median(away) > LINE and np.median(across) < ON_LINE else None


def _nearest(detections: Detections) -> tuple[Array, Array]:
    """Return the nearest points (k, 2), one per cone, and the standard deviation (k,) of a coordinate (m)."""
    points, covariances = detections.points_vehicle, detections.covariances
    variances, chosen = 0.5 * np.trace(covariances, axis1=1, axis2=2), list[int]()
    for k in np.argsort(np.hypot(*points.T)).tolist():
        apart = ((points[chosen] - points[k]) ** 2).sum(axis=1)
        if (apart > SAME**2 * (variances[chosen] + variances[k])).all():
            chosen.append(k)
        if len(chosen) == PARTNERS:
            break
    return points[chosen], np.sqrt(variances[chosen])


def _from_line(points: Array, corners: Array) -> Array:
    """Return the distance (m,) of each point (m, 2) from the line through corners (k, 2), at least two."""
    begin, step = corners[:-1], np.diff(corners, axis=0)
    off = points[:, None] - begin
    share = np.clip((off * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
    return np.asarray(np.hypot(*(off - share[..., None] * step).transpose(2, 0, 1)).min(axis=1))
