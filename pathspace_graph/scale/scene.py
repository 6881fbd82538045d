"""The scale of a scene, from the width of its road and the gaps of its rows where the drive begins."""

from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

WIDTH: Final = 3.5
"""Distance of a cone from the nearest one of the other side on a track of Formula Student, m, median."""
GAP: Final = 3.2
"""Distance of a cone from the nearest one of its row there, m, median."""
SCALES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)
"""A scale is one of these: what is within a factor of 1.7 of one is mapped as well with it."""
NEAREST: Final = 5
"""This number of cones of each side, the nearest ones, tell the scale."""
FEWEST: Final = 3
"""A cycle tells it where it has this number of cones of each side."""
SAME: Final = 3.0
"""Two detections nearer to each other than this number of sigmas are of one cone."""
FARTHEST: Final = 1e4
"""No cone is farther away (m), in a scene of any scale."""
MOVED: Final = 0.1
"""A cycle counts once the vehicle has moved by this share of a gap."""
JUDGED: Final = (1, 5, 20)
"""The scale is judged after these numbers of cycles that count, and is final after the last."""
PATIENCE: Final = 200
"""It is final in any case after this number of cycles."""


class SceneScale:
    """Finds the scale of a scene, cycle by cycle, as soon as both sides of the road and a row are seen.

    It is the smaller one of what width and gaps say, and 1 where they disagree: a wide road isn't a large
    scene. A record in wrong units, out of the range of `SCALES`, has the scale 1.
    """

    def __init__(self, scale: float | None = None) -> None:
        """Begin with a scale that is given, or to be found."""
        self.value = 1.0 if scale is None else scale
        """Scale as far as it is known."""
        self.is_final = scale is not None
        """Whether the value changes no more."""
        self._widths: list[float] = []
        self._gaps: list[float] = []
        self._driven = np.inf  # since the last cycle that counted
        self._cycles = self._counted = 0

    def see(self, odometry: Odometry, detections: Detections) -> None:
        """Take a cycle into account."""
        if self.is_final:
            return
        self._cycles += 1
        held = np.diff(np.append(odometry.t, max(detections.t, *odometry.t[-1:], -np.inf)))
        self._driven += float(np.hypot(*odometry.twist[:, :2].T) @ held) if len(held) else 0.0
        width, gap = width_and_gap(detections)
        if not np.isnan(gap) and self._driven >= MOVED * gap:
            self._driven = 0.0
            self._counted += 1
            self._gaps.append(gap)
            self._widths.append(width)
            if self._counted in JUDGED:
                self.value = _nearest(self._widths, self._gaps)
        self.is_final = self._counted >= JUDGED[-1] or self._cycles >= PATIENCE


def scale_of(log: Log) -> float:
    """Return the scale of a log's scene, which the first metres of its drive tell."""
    scene, since = SceneScale(), float(log.odometry.t[0])
    for detections in log.cycles:
        scene.see(log.odometry.between(since, detections.t), detections)
        since = detections.t
        if scene.is_final:
            break
    return scene.value


def width_and_gap(detections: Detections) -> tuple[float, float]:
    """Return the width of the road and the gap of its rows (m) in a cycle; NaN where they aren't seen.

    Without labels, what is to the left of the vehicle is the left side.
    """
    usable = (np.abs(detections.points_vehicle) < FARTHEST).all(axis=1)  # the gate drops the others
    points, labels = detections.points_vehicle[usable], detections.labels[usable]
    sides = labels if (labels != UNKNOWN).any() else np.where(points[:, 1] > 0.0, LEFT, RIGHT)
    covariances = detections.covariances[usable]
    rows = [_nearest_cones(points[sides == s], covariances[sides == s]) for s in (LEFT, RIGHT)]
    if min(map(len, rows)) < FEWEST:
        return np.nan, np.nan
    nearest = [np.asarray(KDTree(row).query(row, k=2)[0])[:, 1] for row in rows]
    left, right = rows
    across = np.append(KDTree(right).query(left)[0], KDTree(left).query(right)[0])
    return float(np.median(across)), float(np.mean([np.median(gaps) for gaps in nearest]))


def _nearest_cones(points: Array, covariances: Array) -> Array:
    """Return the nearest of points (m, 2), vehicle frame, one for each cone."""
    chosen: list[int] = []
    for k in np.argsort(np.hypot(*points.T)).tolist():
        apart = ((points[chosen] - points[k]) ** 2).sum(axis=1)
        variance = 0.5 * np.trace(covariances[chosen] + covariances[k], axis1=1, axis2=2)
        if (apart > SAME**2 * variance).all():
            chosen.append(k)
        if len(chosen) == NEAREST:
            break
    return np.asarray(points[chosen])


def _nearest(widths: list[float], gaps: list[float]) -> float:
    """Return the scale that is nearest to what widths and gaps (m) say, by ratio."""
    if not widths or not gaps:
        return 1.0
    ratios = np.log10([np.median(widths) / WIDTH, np.median(gaps) / GAP])
    if ratios[0] * ratios[1] <= 0.0:
        return 1.0
    away = 2.0 * ratios[np.abs(ratios).argmin()]
    place = round(float(away)) + SCALES.index(1.0)
    return SCALES[place] if 0 <= place < len(SCALES) else 1.0
