"""The speed profile of a line: as fast as friction and curvature allow, and the time that it takes."""

from dataclasses import dataclass
from math import inf, sqrt
from typing import Protocol

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.settings.output import SpeedSettings


class SampledLine(Protocol):
    """A line that is sampled at n points, such as `CentreLine` and `TrackAhead`."""

    @property
    def curvature(self) -> Array:
        """Return the curvature (n,) in 1/m."""

    @property
    def arc_length(self) -> Array:
        """Return the length (n,) of the line from its first point, in m."""

    @property
    def length(self) -> float:
        """Return the whole length in m, with the way back to the first point where the line is closed."""

    @property
    def closed(self) -> bool:
        """Return whether the line is a loop."""


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Speed at the n points of a line."""

    speed: Array
    """Speed (n,) in m/s."""
    acceleration: Array
    """Acceleration along the line (n,) from each point to the next one, in m/s^2; 0 at the last point of an
    open line."""
    time: Array
    """Time (n,) since the first point, in s."""
    duration: float
    """Time for the whole line (s): the lap time of a closed one."""


def speed_profile(
    line: SampledLine,
    settings: SpeedSettings | None = None,
    begin: float | None = None,
    end: float | None = None,
) -> SpeedProfile:
    """Return the largest speeds with v <= v_top that obey the friction ellipse,

        (v^2 k / a_lateral)^2 + (a / a_long)^2 <= 1,

    with the curvature k and the acceleration a, which is constant from each point to the next one; each such
    step obeys it at its slower end. a_long is `forward` or `braking`. At first v^2 = a_lateral / |k|; then a
    forward and a backward pass bound v_next^2 by v^2 + 2 a ds (Kapania et al., J. Dyn. Syst. Meas. Control
    138, 2016). A closed line begins and ends at the same speed. An open one may begin and end at given speeds
    (m/s), by default as fast as its curvature allows. SettingsError is raised where a line has fewer
    than two points, a speed is not a number from 0 on, or one is given for a closed line.
    """
    settings = settings or SpeedSettings()
    count = len(line.curvature)
    if count < 2:
        raise SettingsError(f"a speed profile: expected a line of at least 2 points, found {count}")
    if line.closed and (begin is not None or end is not None):
        raise SettingsError(
            "a speed profile: expected an open line for a first or a last speed, found a loop"
        )
    bend = np.abs(line.curvature) / settings.lateral
    squares = np.minimum(1.0 / np.maximum(bend, np.finfo(float).tiny), settings.top**2)
    steps = np.diff(line.arc_length)
    if line.closed:  # from the slowest point once round, back to it
        first = int(squares.argmin())
        around = np.arange(first, first + count + 1) % count
        steps = np.append(steps, line.length - line.arc_length[-1])[around[:-1]]
        squares, bend = squares[around], bend[around]
    else:
        squares[0], squares[-1] = min(squares[0], _square(begin)), min(squares[-1], _square(end))
    squares = _accelerated(squares, steps, bend, settings.forward)
    squares = _accelerated(squares[::-1], steps[::-1], bend[::-1], settings.braking)[::-1]
    acceleration, speed = 0.5 * np.diff(squares) / steps, np.sqrt(squares)
    sums = speed[:-1] + speed[1:]
    seconds = np.divide(2.0 * steps, sums, out=np.full(len(steps), np.inf), where=sums > 0.0)
    if line.closed:
        speed, acceleration, seconds = (
            np.roll(values, first) for values in (speed[:-1], acceleration, seconds)
        )
    else:
        acceleration = np.append(acceleration, 0.0)
    time = np.append(0.0, np.cumsum(seconds))
    return SpeedProfile(speed, acceleration, time[:count], float(time[-1]))


def _accelerated(squares: Array, steps: Array, bend: Array, most: float) -> Array:
    """Return the squares (n,) of the speeds that the acceleration `most` (m/s^2) can reach, going along."""
    reached, now = squares.tolist(), float(squares[0])
    for i, (step, turn) in enumerate(zip(steps.tolist(), bend[:-1].tolist(), strict=True), 1):
        share = sqrt(max(1.0 - (now * turn) ** 2, 0.0))
        now = reached[i] = min(reached[i], now + 2.0 * most * share * step)
    return np.array(reached)


def _square(speed: float | None) -> float:
    """Return the square of a speed (m/s), which is unbounded where none is given."""
    if speed is None:
        return inf
    if not 0.0 <= speed < inf:
        raise SettingsError(f"a speed profile: expected a speed (m/s) from 0 on, found {speed:g}")
    return speed**2
