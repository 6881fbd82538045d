"""The length of a lap, from where the curvature of the path driven recurs: no detections are needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, next_fast_len

from pathspace_graph.graph.keys import POSE
from pathspace_graph.mapping.registration import HEADING
from pathspace_graph.settings.batch import RecurrenceSettings
from pathspace_graph.settings.closing import ClosingSettings
from pathspace_graph.settings.mapper import MapperSettings

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Recurrence:
    """Holds the length of the path driven, and after which length it recurs."""

    driven: Array
    """Each entry (P,) is the path length from the first pose to a pose (m)."""
    lap: float
    """This is the path length of a lap (m). It is infinite where the path doesn't recur."""
    turn: float
    """The heading changes by this in a lap, by the odometry (rad)."""
    correlation: float
    """The curvature agrees with itself a lap later to this degree, 1 where it is the same."""

    @property
    def recurs(self) -> bool:
        """Returns whether a lap was found."""
        return bool(np.isfinite(self.lap))

    def denied(self) -> Recurrence:
        """Returns the same path without a lap."""
        return Recurrence(self.driven, np.inf, 0.0, 0.0)

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

    def correlations(self, lags: IntArray, settings: ClosingSettings) -> Array:
        """Returns how well the curvature agrees with itself each of the lags (l,) later, in samples.

        The result (l,) is `1 - mean((a - b)^2) / (mean(a^2) + mean(b^2))`, 1 where both are the same. It is
        -inf where the path isn't back at about the same place and heading after that lag, by the limits of a
        loop closure. All sums over the overlap come from a Fourier transform.
        """
        off = self.position - self.position.mean(axis=0)
        place, curvature = off[:, 0] + 1j * off[:, 1], self.curvature.astype(complex)
        square = _mean_square_difference(place, lags)
        along = _mean_products(np.exp(1j * self.heading), lags).real
        radius = settings.radius + settings.drift * lags * self.step
        power = np.maximum(_mean_squares(curvature, lags), np.finfo(float).tiny)
        agreement = 1.0 - _mean_square_difference(curvature, lags) / power
        back = (square < radius**2) & (along > np.cos(HEADING))
        return np.where(back, agreement, -np.inf)


def _mean_square_difference(values: ComplexArray, lags: IntArray) -> Array:
    """Returns the mean of `|v(i + lag) - v(i)|^2` for each lag (l,)."""
    return np.asarray(_mean_squares(values, lags) - 2.0 * _mean_products(values, lags).real)


def _mean_squares(values: ComplexArray, lags: IntArray) -> Array:
    """Returns the mean of `|v(i)|^2 + |v(i + lag)|^2` for each lag (l,)."""
    total = np.append(0.0, np.cumsum(np.abs(values) ** 2))
    count = len(values) - lags
    return np.asarray((total[count] + total[-1] - total[lags]) / count)


def _mean_products(values: ComplexArray, lags: IntArray) -> ComplexArray:
    """Returns the mean of `v(i + lag) conj(v(i))` for each lag (l,)."""
    transform = fft(values, next_fast_len(2 * len(values)))
    return np.asarray(ifft(np.abs(transform) ** 2)[lags] / (len(values) - lags))


def path_lengths(poses: Array) -> Array:
    """Returns the path length (P,) from the first of poses (P, 3) to each of them (m)."""
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))


def find_recurrence(poses: Array, settings: MapperSettings) -> Recurrence:
    """Returns the shortest path length after which the curvature of dead-reckoned poses (P, 3) recurs.

    From the first lag whose correlation is a large share of the best one's, the search climbs to a lag that
    is the best within `closing.radius` after it. That is the lap.
    """
    own, closing = settings.batch.recurrence, settings.closing
    driven = path_lengths(poses)
    profile = profile_of(poses, driven, own)
    first, last = int(closing.min_path / own.profile_step), int(own.min_overlap / own.profile_step)
    lags = np.arange(first, len(profile.heading) - last)
    scores = profile.correlations(lags, closing) if len(lags) else np.zeros(0)
    if not scores.max(initial=-np.inf) >= own.min_correlation:
        return Recurrence(driven, np.inf, 0.0, 0.0)
    begin = int(np.argmax(scores >= own.correlation_share * scores.max()))
    best = _climbed(scores, begin, int(closing.radius / own.profile_step))
    lag = int(lags[best])
    turn = float(np.median(profile.heading[lag:] - profile.heading[:-lag]))
    return Recurrence(driven, lag * own.profile_step, turn, float(scores[best]))


def _climbed(scores: Array, index: int, reach: int) -> int:
    """Returns the index of a score that is the best of the next `reach`, by steps from one to a better."""
    while (step := int(np.argmax(scores[index : index + reach]))) > 0:
        index += step
    return index


def profile_of(poses: Array, driven: Array, settings: RecurrenceSettings) -> Profile:
    """Returns the path through poses (P, 3) with path lengths (P,), sampled at equal steps."""
    s = np.arange(0.0, driven[-1], settings.profile_step)
    x, y, heading = (np.interp(s, driven, poses[:, k]) for k in range(POSE))
    half, number = max(int(0.5 * settings.smoothing / settings.profile_step), 1), np.arange(len(s))
    later, before = np.minimum(number + half, len(s) - 1), np.maximum(number - half, 0)
    curvature = (heading[later] - heading[before]) / settings.smoothing
    return Profile(settings.profile_step, np.column_stack([x, y]), heading, curvature)
