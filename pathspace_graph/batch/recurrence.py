"""The length of a lap, from where the curvature of the path driven recurs: no detections are needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import POSE
from pathspace_graph.settings.batch import RecurrenceSettings
from pathspace_graph.settings.mapper import ClosingSettings, MapperSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Recurrence:
    """Holds the length of the path driven, and after which length it recurs."""

    driven: Array
    """Each entry (P,) is the path length from the first pose to a pose (m)."""
    lap: float
    """This is the path length of a lap (m). It is infinite where the path doesn't recur."""
    turn: float
    """The heading changes by this in a lap, by the odometry (rad)."""

    @property
    def recurs(self) -> bool:
        """Returns whether a lap was found."""
        return bool(np.isfinite(self.lap))

    @property
    def whole_turn(self) -> float:
        """Returns the whole turns nearest to the change of the heading in a lap (rad)."""
        return float(2.0 * np.pi * np.round(self.turn / (2.0 * np.pi)))


@dataclass(frozen=True, eq=False)
class Profile:
    """Holds the path driven, sampled at equal steps along it."""

    step: float
    """Neighbouring samples are this path length apart (m)."""
    position: Array
    """Each row (n, 2) is a position in m, in the frame of the poses."""
    heading: Array
    """Each entry (n,) is a heading in rad, not wrapped."""
    curvature: Array
    """Each entry (n,) is the curvature averaged over a stretch (1/m)."""

    def correlation(self, lag: int, settings: ClosingSettings) -> float:
        """Returns how well the curvature agrees with itself `lag` samples later, 1 where it is the same.

        The result is `1 - mean((a - b)^2) / (mean(a^2) + mean(b^2))`. It is -inf where the path isn't back at
        about the same place and heading after that lag, by the limits of a loop closure.
        """
        distance = np.hypot(*(self.position[lag:] - self.position[:-lag]).T)
        turned = self.heading[lag:] - self.heading[:-lag]
        off = np.abs(turned - 2.0 * np.pi * np.round(turned / (2.0 * np.pi)))
        radius = settings.radius + settings.drift * lag * self.step
        if np.median(distance) >= radius or np.median(off) >= settings.heading:
            return -np.inf
        first, second = self.curvature[:-lag], self.curvature[lag:]
        power = np.mean(first**2) + np.mean(second**2)
        return float(1.0 - np.mean((first - second) ** 2) / max(power, np.finfo(float).tiny))


def find_recurrence(poses: Array, settings: MapperSettings) -> Recurrence:
    """Returns the shortest path length after which the curvature of dead-reckoned poses (P, 3) recurs.

    The first lag whose correlation is a large share of the best one's is near a lap. The best lag within
    `closing.radius` after it is the lap.
    """
    own, closing = settings.batch.recurrence, settings.closing
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    profile = _profile(poses, driven, own)
    first, last = int(closing.min_path / own.profile_step), int(own.min_overlap / own.profile_step)
    lags = np.arange(first, len(profile.heading) - last)
    scores = np.array([profile.correlation(int(lag), closing) for lag in lags])
    if not scores.max(initial=-np.inf) > 0.0:
        return Recurrence(driven, np.inf, 0.0)
    begin = int(np.argmax(scores >= own.correlation_share * scores.max()))
    reach = int(closing.radius / own.profile_step)
    lag = int(lags[begin + int(np.argmax(scores[begin : begin + reach]))])
    turn = float(np.median(profile.heading[lag:] - profile.heading[:-lag]))
    return Recurrence(driven, lag * own.profile_step, turn)


def _profile(poses: Array, driven: Array, settings: RecurrenceSettings) -> Profile:
    """Returns the path through poses (P, 3) with path lengths (P,), sampled at equal steps."""
    s = np.arange(0.0, driven[-1], settings.profile_step)
    x, y, heading = (np.interp(s, driven, poses[:, k]) for k in range(POSE))
    half, number = max(int(0.5 * settings.smoothing / settings.profile_step), 1), np.arange(len(s))
    later, before = np.minimum(number + half, len(s) - 1), np.maximum(number - half, 0)
    curvature = (heading[later] - heading[before]) / settings.smoothing
    return Profile(settings.profile_step, np.column_stack([x, y]), heading, curvature)
