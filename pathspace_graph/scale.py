"""Scale of a scene: inside an estimator, every scene has the size of a Formula Student track.

An estimator has one scale. Its input is divided by it (`front_end.gate`, `solved`), and its results are
multiplied by it. If the settings have no scale, it is determined beforehand from the width of the road and
the gaps of its rows in the first metres of the log.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.settings.mapper import MapperSettings

from .errors import check_type, solving
from .labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from .lengths import scaled
from .run import split_odometry

R = TypeVar("R")

SCENE_WIDTH: Final = 3.5  # median distance from a cone to the other side in Formula Student (m)
SCENE_GAP: Final = 3.2  # median distance from a cone to the nearest one of its row there (m)
SCALES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)  # maps are equally good within a factor of 1.7
SCENE_NEAREST: Final = 5  # number of nearest cones of each side in use
SCENE_FEWEST: Final = 3  # least number of cones of each side in a cycle
SCENE_SAME: Final = 3.0  # largest distance (sigmas) of two detections of one cone
SCENE_FARTHEST: Final = 1e4  # largest distance of a cone (m), in a scene of any scale
SCENE_MOVED: Final = 0.1  # least motion between used cycles, as a share of the gap
SCENE_ENOUGH: Final = 20  # number of used cycles after which the scale is final
SCENE_PATIENCE: Final = 200  # number of cycles after which it is final in any case


class SceneScale:
    """Online estimate of a scene's scale from cycles with both sides of the road in view.

    The scale is the less extreme one by width and by gaps. It is 1 if they disagree, since a wide road is not
    a large scene, and outside the range of `SCALES`.
    """

    def __init__(self) -> None:
        self._widths: list[float] = []
        self._gaps: list[float] = []
        self._driven = np.inf  # path since the last used cycle (m)
        self._cycles = 0

    def see(self, odometry: Odometry, detections: Detections) -> None:
        if self.is_final:
            return
        self._cycles += 1
        held = np.diff(np.append(odometry.t, max(detections.t, *odometry.t[-1:], -np.inf)))
        self._driven += float(np.hypot(*odometry.twist[:, :2].T) @ held) if len(held) else 0.0
        width, gap = width_and_gap(detections)
        if not np.isnan(gap) and self._driven >= SCENE_MOVED * gap:
            self._driven = 0.0
            self._gaps.append(gap)
            self._widths.append(width)

    @property
    def value(self) -> float:
        """Return the present estimate of the scale."""
        return _nearest(self._widths, self._gaps) if self._gaps else 1.0

    @property
    def is_final(self) -> bool:
        """Whether the value is final."""
        return len(self._gaps) >= SCENE_ENOUGH or self._cycles >= SCENE_PATIENCE


@lru_cache(maxsize=1)  # several ask about the log that was read last
def scale_of(log: Log) -> float:
    """Return the scale of a log's scene, by the first metres of its drive."""
    scene = SceneScale()
    for cycle in split_odometry(log):
        scene.see(*cycle)
        if scene.is_final:
            break
    return scene.value


def chosen_scale(settings: MapperSettings, log: Log) -> float:
    """Return the scale of the settings or, if they have none, of the log's scene."""
    check_type("log", log, Log)
    return scale_of(log) if settings.scale is None else settings.scale


def solved(solve: Callable[[Log, float], R], log: Log, settings: MapperSettings) -> R:
    """Solve a batch at scale 1 and rescale its result; `solve` gets the log at scale 1, and the scale.

    BLAS runs on one thread, and a numerical failure raises a SolveError.
    """
    scale = chosen_scale(settings, log)
    with threadpool_limits(limits=1), solving("the batch"):
        return scaled(solve(scaled(log, 1.0 / scale), scale), scale)


def width_and_gap(detections: Detections) -> tuple[float, float]:
    """Return the width of the road and the gap of its rows (m) in a cycle; NaN if they are not in view."""
    usable = (np.abs(detections.points_vehicle) < SCENE_FARTHEST).all(axis=1)  # the gate drops the others
    near = detections.where(np.asarray(usable))
    points, covariances, sides = near.points_vehicle, near.covariances, side_of(near)
    own = [np.flatnonzero(sides == label) for label in BOUNDARIES]
    rows = [points[rows[nearest_cones(points[rows], covariances[rows], SCENE_NEAREST)]] for rows in own]
    if min(map(len, rows)) < SCENE_FEWEST:
        return np.nan, np.nan
    nearest = [np.asarray(KDTree(row).query(row, k=2)[0])[:, 1] for row in rows]
    left, right = rows
    across = np.append(KDTree(right).query(left)[0], KDTree(left).query(right)[0])
    return float(np.median(across)), float(np.mean([np.median(gaps) for gaps in nearest]))


def side_of(detections: Detections) -> IntArray:
    """Return the boundary (m,) of each detection: its label or, if no one has a label, the vehicle's side."""
    labels = detections.labels
    if (labels != UNKNOWN).any():
        return labels
    return np.where(detections.points_vehicle[:, 1] > 0.0, LEFT, RIGHT)


def nearest_cones(points: Array, covariances: Array, most: int) -> list[int]:
    """Return the indices of the nearest detections, one per cone, nearest first."""
    chosen: list[int] = []
    for k in np.argsort(np.hypot(*points.T)).tolist():
        apart = ((points[chosen] - points[k]) ** 2).sum(axis=1)
        variance = 0.5 * np.trace(covariances[chosen] + covariances[k], axis1=1, axis2=2)
        if (apart > SCENE_SAME**2 * variance).all():
            chosen.append(k)
        if len(chosen) == most:
            break
    return chosen


def _nearest(widths: list[float], gaps: list[float]) -> float:
    ratios = np.log10([np.median(widths) / SCENE_WIDTH, np.median(gaps) / SCENE_GAP])
    if ratios[0] * ratios[1] <= 0.0:
        return 1.0
    away = 2.0 * ratios[np.abs(ratios).argmin()]
    place = round(float(away)) + SCALES.index(1.0)
    return SCALES[place] if 0 <= place < len(SCALES) else 1.0
