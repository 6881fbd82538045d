"""Scenes of any size: inside of an estimator, every scene has the size of a Formula Student track.

An estimator is made for one scale. Lengths are divided by it on the way in (`front_end.gate`, `solved`) and
those of results multiplied by it on the way out. Where the settings leave it open, it is found beforehand,
from the width of the road and the gaps of its rows in the first metres of the log.
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

SCENE_WIDTH: Final = 3.5  # m from a cone to the nearest one of the other side in Formula Student, median
SCENE_GAP: Final = 3.2  # distance of a cone from the nearest one of its row there, m, median
SCALES: Final = (0.1, 0.3, 1.0, 3.0, 10.0)  # within a factor of 1.7 of one, maps are as good
SCENE_NEAREST: Final = 5  # number of the nearest cones of each side that tell the scale
SCENE_FEWEST: Final = 3  # number of cones of each side that a cycle needs
SCENE_SAME: Final = 3.0  # largest distance (sigmas) of two detections of one cone
SCENE_FARTHEST: Final = 1e4  # largest distance of a cone (m), in a scene of any scale
SCENE_MOVED: Final = 0.1  # share of a gap by which the vehicle moves until the next cycle counts
SCENE_ENOUGH: Final = 20  # number of cycles that count after which the scale is final
SCENE_PATIENCE: Final = 200  # number of cycles after which it is final in any case


class SceneScale:
    """Finder of a scene's scale, cycle by cycle, where both sides of the road and a row are seen.

    It is the less extreme one of what width and gaps say, and 1 where they disagree, since a wide road isn't
    a large scene, or where they are out of the range of `SCALES`.
    """

    def __init__(self) -> None:
        self._widths: list[float] = []
        self._gaps: list[float] = []
        self._driven = np.inf  # since the last cycle that counted
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
        """Return the scale as far as it is known."""
        return _nearest(self._widths, self._gaps) if self._gaps else 1.0

    @property
    def is_final(self) -> bool:
        """Return whether the value changes no more."""
        return len(self._gaps) >= SCENE_ENOUGH or self._cycles >= SCENE_PATIENCE


@lru_cache(maxsize=1)  # several ask about the log that was read last
def scale_of(log: Log) -> float:
    """Return the scale of a log's scene, which the first metres of its drive tell."""
    scene = SceneScale()
    for cycle in split_odometry(log):
        scene.see(*cycle)
        if scene.is_final:
            break
    return scene.value


def chosen_scale(settings: MapperSettings, log: Log) -> float:
    """Return the scale of the settings, or that of a log's scene where they leave it open."""
    check_type("log", log, Log)
    return scale_of(log) if settings.scale is None else settings.scale


def solved(solve: Callable[[Log, float], R], log: Log, settings: MapperSettings) -> R:
    """Return the result of a batch in metres of the log; `solve` takes the log at scale 1, and its scale.

    BLAS has one thread, and whatever numerics raise is a SolveError.
    """
    scale = chosen_scale(settings, log)
    with threadpool_limits(limits=1), solving("the batch"):
        return scaled(solve(scaled(log, 1.0 / scale), scale), scale)


def width_and_gap(detections: Detections) -> tuple[float, float]:
    """Return the width of the road and the gap of its rows (m) in a cycle; NaN where they aren't seen."""
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
    """Return the boundary (m,) of each detection: its label, or the side of the vehicle if none has any."""
    labels = detections.labels
    if (labels != UNKNOWN).any():
        return labels
    return np.where(detections.points_vehicle[:, 1] > 0.0, LEFT, RIGHT)


def nearest_cones(points: Array, covariances: Array, most: int) -> list[int]:
    """Return the nearest detections of cones, each cone once, by index, the nearest first."""
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
