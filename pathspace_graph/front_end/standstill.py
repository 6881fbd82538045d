"""Rest by cones: the vehicle stands although its odometry moves on.

The filter of an inertial system may creep for seconds after a stop, too slowly for one cycle to show. So all
cycles of the last second are laid on each other, as if the vehicle stood and as the odometry moves it. Where
nothing is seen of the motion, as between walls, both fit alike, and the odometry is believed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, move_points, relative

from .scan_matching import MOST_MISFIT, SIGMA_CONE

COMPARED: Final = 1.0  # age of the cycles that are compared, s
CREEP: Final = 3.0  # speed above which no odometry creeps, m/s; wheels that spin contradict single cycles
HYPOTHESES: Final = (0.0, 0.25, 0.5, 1.0)
"""Hypotheses as shares of the odometry's motion: rest, slip and the odometry itself."""
CHANCE: Final = 4.5  # gain from which points of a line do not fit by chance, sigmas by its own scatter
NOWHERE: Final = np.full((1, 2), 1e6)  # a point that is near none, so that no cycle is empty


@dataclass(frozen=True, eq=False)
class _Cycle:
    t: float
    points: Array  # (n, 2) corrected detections, vehicle frame, and `NOWHERE`
    farthest: float  # largest range of a detection (m)
    by_odometry: Array  # (3,) pose by the odometry alone
    pose: Array  # (3,) pose that is believed
    gains: Array  # (5, k) sums of `_gains` over the newest k cycles before


class Standstill(Copyable):
    """Judge of whether the vehicle stands by the cones of the last second."""

    def __init__(self) -> None:
        self._cycles: tuple[_Cycle, ...] = ()  # the newest first

    def add(self, t: float, points: Array, covariances: Array, delta: Array) -> None:
        """Add corrected detections (n, 2), vehicle frame, at t (s) after a motion (3,) by the odometry."""
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
        """Note the pose (3,) of the newest cycle that is believed."""
        self._place(1, pose)

    def place(self, limit: float) -> Array | None:
        """Return the pose (3,) at which the vehicle stands, or None where it may be moving.

        Twice the log-likelihood of n cycles is `2 / n` times the sum of the gains of their pairs. The vehicle
        stands if rest is more likely than the odometry by `limit^2`, and than slip, for some number of the
        newest cycles: a moving one looks so at `limit` sigmas. The gain must also exceed its scatter, which
        needs no noise. The poses since are then the first one's.
        """
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
        """Place the newest cycles at a pose (3,)."""
        placed = (replace(one, pose=pose) for one in self._cycles[:count])
        self._cycles = (*placed, *self._cycles[count:])


def _gains(cycles: Sequence[_Cycle], points: Array, covariances: Array, by_odometry: Array) -> Array:
    """Return the gains of the newest cycle with each other one by hypothesis, and squares of rest's.

    The gain of a detection is `max(0, MOST_MISFIT - d^2)`, d being its whitened distance from the nearest
    one of the other cycle. It has none beyond what the odometry says that the other cycle saw: the view
    moves with the vehicle, so what is new at its border matches only at rest.
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
