"""Standstill by cones: the vehicle stands although its odometry moves.

The filter of an inertial system may creep for seconds after a stop, too slowly for a single cycle to show. So
all cycles of the last second are compared under two hypotheses: standstill, and motion by odometry. If both
fit equally well, as between walls, the odometry is trusted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, move_points, relative

from .scan_matching import MOST_MISFIT, SIGMA_CONE

COMPARED: Final = 1.0  # largest age of a compared cycle (s)
CREEP: Final = 3.0  # largest speed of creep (m/s); a single cycle contradicts spinning wheels
HYPOTHESES: Final = (0.0, 0.25, 0.5, 1.0)
"""Hypotheses, as shares of the odometry's motion: standstill, slip, and the odometry itself."""
CHANCE: Final = 4.5  # least gain (sigmas of its scatter): points of a line fit by chance below
NOWHERE: Final = np.full((1, 2), 1e6)  # point far from all others, so that no cycle is empty


@dataclass(frozen=True, eq=False)
class _Cycle:
    t: float  # stamp (s)
    points: Array  # (n, 2) corrected detections, vehicle frame, and `NOWHERE`
    farthest: float  # largest range of a detection (m)
    by_odometry: Array  # (3,) pose by odometry alone
    pose: Array  # (3,) accepted pose
    gains: Array  # (5, k) cumulative sums of `_gains` over the k previous cycles


class Standstill(Copyable):
    """Detection of a standstill by the cones of the last second."""

    def __init__(self) -> None:
        self._cycles: tuple[_Cycle, ...] = ()  # newest first

    def add(self, t: float, points: Array, covariances: Array, delta: Array) -> None:
        """Add corrected detections (n, 2), vehicle frame, at t (s) after the motion (3,) by odometry."""
        cycles = self._cycles
        by_odometry = compose(cycles[0].by_odometry, delta) if cycles else np.zeros(3)
        if cycles and np.hypot(delta[0], delta[1]) > CREEP * (t - cycles[0].t):
            cycles = ()
        cycles = tuple(one for one in cycles if one.t >= t - COMPARED)
        gains = _gains(cycles, points, covariances, by_odometry)
        farthest = np.sqrt((points**2).sum(axis=1).max(initial=0.0))
        points = np.concatenate([points, NOWHERE])
        newest = _Cycle(t, points, farthest, by_odometry, by_odometry, gains.cumsum(axis=1))
        self._cycles = (newest, *cycles)

    def believe(self, pose: Array) -> None:
        """Set the accepted pose (3,) of the newest cycle."""
        self._place(1, pose)

    def place(self, limit: float) -> Array | None:
        """Return the pose (3,) at which the vehicle stands, or None if it may move.

        Twice the log-likelihood of n cycles is `2 / n` times the sum of the gains of their pairs. The vehicle
        stands if, for some number of newest cycles, twice the log-likelihood ratio of standstill to odometry
        exceeds `limit^2`, standstill is likelier than slip, and the gain exceeds its scatter. All of these
        cycles then get the pose of the first one.
        """
        if not self._cycles:
            return None
        earlier = len(self._cycles) - 1
        sums = np.zeros((len(HYPOTHESES) + 1, earlier))
        for k, one in enumerate(self._cycles):
            sums[:, k:] += one.gains[:, : earlier - k]
        rest, *slip, odometry, squares = sums
        likelier = (rest - odometry) * 2.0 / (2.0 + np.arange(earlier))
        possible = (rest >= np.max(slip, axis=0)) & (rest - odometry > CHANCE * np.sqrt(squares))
        likelier = np.where(possible, likelier, 0.0)
        if not likelier.max(initial=0.0) > limit**2:
            return None
        first = 1 + int(likelier.argmax())
        pose = self._cycles[first].pose
        self._place(first, pose)
        return pose

    def _place(self, count: int, pose: Array) -> None:
        """Set the pose (3,) of the `count` newest cycles."""
        placed = (replace(one, pose=pose) for one in self._cycles[:count])
        self._cycles = (*placed, *self._cycles[count:])


def _gains(cycles: Sequence[_Cycle], points: Array, covariances: Array, by_odometry: Array) -> Array:
    """Return the gains (5, k) of the newest cycle with k others, a row for each hypothesis.

    The gain of a detection is `max(0, MOST_MISFIT - d^2)` with its whitened distance d from the nearest one
    of the other cycle. Detections outside the other cycle's view, by odometry, have no gain: the view moves
    with the vehicle, and its border matches only at standstill. The last row sums (standstill - odometry)^2.
    """
    if not cycles:
        return np.zeros((len(HYPOTHESES) + 1, 0))
    ways = np.array([relative(by_odometry, one.by_odometry) for one in cycles])
    begins = np.cumsum([0, *(len(one.points) for one in cycles)])[:-1]
    resting = np.concatenate([one.points for one in cycles])
    moved = np.concatenate([move_points(way, one.points) for way, one in zip(ways, cycles, strict=True)])
    view = np.array([one.farthest for one in cycles]) - np.hypot(ways[:, 0], ways[:, 1])
    seen = np.hypot(points[:, 0], points[:, 1])[:, None] <= view
    precisions = np.linalg.inv(2.0 * covariances + SIGMA_CONE**2 * np.eye(2))
    (xx, xy), (_, yy) = precisions.transpose(1, 2, 0)[..., None]
    gains = []
    for share in HYPOTHESES:
        x, y = (points[:, None] - resting - share * (moved - resting)).transpose(2, 0, 1)
        square = np.minimum.reduceat(xx * x * x + 2.0 * xy * x * y + yy * y * y, begins, axis=1)
        gains.append(seen * np.maximum(MOST_MISFIT - square, 0.0))
    return np.array([one.sum(axis=0) for one in (*gains, (gains[0] - gains[-1]) ** 2)])
