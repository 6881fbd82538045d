"""Scan matching: the detections of a cycle are laid on those of the cycles just before.

Cones stand still, so that the detections tell how the vehicle has moved, in every direction. No cone needs an
identity: each detection is drawn to the weighted mean of the earlier ones beside it, and the weights sharpen
from iteration to iteration (EM-ICP; Granger and Pennec 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.se2 import rotation, to_map
from pathspace_graph.settings.front_end import MotionSettings

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_REACHES = 3.0
"""Remembered detections farther than this many reaches have no weight."""
_LEAST_SHARE = 1e-6
"""The pose is held where the determinant of its information, by the product of its diagonal, is larger."""
MOST_MISFIT = 9.0
"""A whitened square distance counts at most this much in a misfit that is compared with another."""
_TINY = float(np.finfo(float).tiny)


class RecentDetections:
    """Holds the detections of the newest cycles in one frame.

    They are corrected by what is known now of the errors of the sensor, so that a cone stays where it is when
    more is learned of them.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.settings = settings
        self.points: Array = np.zeros((0, 2))
        """(n, 2) Each detection is at this point in m."""
        # a row is [stamp | point as measured | place of the vehicle | derivatives of x | derivatives of y]
        self._table: Array = np.zeros((0, 5 + 2 * len(settings.sigmas_errors)))

    def add(self, t: float, measured: Array, columns: Array, pose: Array) -> None:
        """Adds the detections of a cycle at t (s), measured at (m, 2) in the frame of the pose (3,).

        Their derivatives by e errors of the sensor are the columns (m, 2, e), in the same frame.
        """
        new = np.empty((len(measured), self._table.shape[1]))
        new[:, 0], new[:, 1:3], new[:, 3:5] = t, to_map(measured, pose[None]), pose[:2]
        new[:, 5:] = (rotation(pose[2]) @ columns).reshape(len(measured), new.shape[1] - 5)
        self._table = np.concatenate([self._table, new])[-self.settings.max_remembered :]
        self.points = self._table[:, 1:3]

    def correct(self, errors: Array) -> None:
        """Puts the detections where they are if the sensor has these errors (e,)."""
        columns = self._table[:, 5:].reshape(len(self._table), 2, len(errors))
        self.points = self._table[:, 1:3] + columns @ errors

    def forget(self, t: float) -> None:
        """Drops the detections that are too old at t (s)."""
        first = int(self._table[:, 0].searchsorted(t - self.settings.memory, side="right"))
        self._table = self._table[first:]
        self.points = self._table[:, 1:3]

    @property
    def seen_from(self) -> Array:
        """Returns the mean place (2,) from which the detections were seen."""
        return np.asarray(self._table[:, 3:5].sum(axis=0) / len(self._table))

    def has(self, points: Array) -> BoolArray:
        """Returns whether each point (m, 2) lies where an earlier detection does."""
        _, weights = _means(points, self.points, self.settings.reach_last)
        return np.asarray(weights > self.settings.min_weight)


@dataclass(frozen=True, eq=False)
class Match:
    """Holds the pose that lays detections on earlier ones."""

    pose: Array
    """(3,) This is the pose in the frame of the earlier detections, in m, m and rad."""
    information: Array
    """(3, 3) This is the information about the pose, in the same frame, from the matched detections."""
    is_matched: BoolArray
    """(m,) The flag is set when a detection lies on earlier ones."""
    misfit: float
    """This is the mean square of the matched detections' whitened distances."""

    @property
    def matched(self) -> int:
        """Returns the number of detections that lie on earlier ones."""
        return int(self.is_matched.sum())

    @property
    def is_certain(self) -> bool:
        """Returns whether the detections hold the pose in every direction."""
        share = np.linalg.det(self.information) / max(float(self.information.diagonal().prod()), _TINY)
        return bool(share > _LEAST_SHARE)


def match(
    recent: RecentDetections,
    points_vehicle: Array,
    variances: Array,
    start: Array,
    settings: MotionSettings,
    reaches: Sequence[float],
) -> Match:
    """Lays detections (m, 2), vehicle frame, on the recent ones by Gauss-Newton steps from a pose (3,).

    Each step minimizes `sum_i |R z_i + t - m_i|^2 / sigma_i^2` with m_i the weighted mean of the recent
    detections beside the point, and `sigma_i^2 = variance_i (1 + 1/n_i) + sigma_cone^2` with n_i the sum of
    the weights. There is a step for each of the reaches (m). The variances (m,) are those of one coordinate
    (m^2).
    """
    pose = start.copy()
    for reach in reaches:
        points = to_map(points_vehicle, pose[None])
        means, weights = _means(points, recent.points, reach)
        matched = weights > settings.min_weight
        off, arm = (points - means)[matched], (points - pose[:2])[matched]
        precision = 1.0 / (variances[matched] * (1.0 + 1.0 / weights[matched]) + settings.sigma_cone**2)
        square = (off * off).sum(axis=1)
        precision *= huber_weights(np.sqrt(square * precision), settings.huber)
        information, gradient = _normal_equations(off, arm, precision)
        if matched.sum() < settings.min_matched:
            break
        regular = information + np.diag(_LEAST_SHARE * information.diagonal())
        pose = pose - np.linalg.solve(regular, gradient)
    count = int(matched.sum())
    return Match(pose, information, matched, float(square @ precision) / max(count, 1))


def misfit_at(
    recent: RecentDetections, points_vehicle: Array, variances: Array, pose: Array, settings: MotionSettings
) -> float:
    """Return the mean square of the whitened distances as `match` has them, at a pose (3,) that is given.

    Each counts at most `MOST_MISFIT`, and as much where nothing was detected before.
    """
    points = to_map(points_vehicle, pose[None])
    means, weights = _means(points, recent.points, settings.reach_last)
    matched = weights > settings.min_weight
    variance = variances * (1.0 + 1.0 / np.where(matched, weights, 1.0)) + settings.sigma_cone**2
    square = np.where(matched, ((points - means) ** 2).sum(axis=1) / variance, MOST_MISFIT)
    return float(np.minimum(square, MOST_MISFIT).mean()) if len(square) else 0.0


def _means(points: Array, recent: Array, reach: float) -> tuple[Array, Array]:
    """Returns the weighted means (m, 2) of recent points (n, 2) beside points (m, 2), and sums of weights."""
    dx = points[:, 0, None] - recent[:, 0]
    dy = points[:, 1, None] - recent[:, 1]
    square = (dx * dx + dy * dy) / reach**2
    weights = np.where(square < _REACHES**2, np.exp(-0.5 * square), 0.0)
    total = weights.sum(axis=1)
    return (weights @ recent) / np.maximum(total, np.finfo(float).tiny)[:, None], total


def _normal_equations(off: Array, arm: Array, precision: Array) -> tuple[Array, Array]:
    """Returns the information (3, 3) and the gradient (3,) of offsets (m, 2) by (x, y, theta)."""
    ax, ay = arm.T
    ex, ey = off.T
    w, wx, wy = precision.sum(), -(precision @ ay), precision @ ax
    turning = precision @ (ax * ax + ay * ay)
    information = np.array([[w, 0.0, wx], [0.0, w, wy], [wx, wy, turning]])
    gradient = np.array([precision @ ex, precision @ ey, precision @ (ax * ey - ay * ex)])
    return information, gradient
