"""Stretches: the part of its own curve where each row's foot point is searched for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .bspline import Floats, Ints
from .spans import Spans

Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Holds each row's stretch, on the axis of `Spans`."""

    periodic: bool
    """If true, the curves are closed."""
    begin: Floats
    """The domain of each row's curve begins here (m,)."""
    end: Floats
    """The domain of each row's curve ends here (m,)."""
    low: Floats
    """Each stretch begins here (m,)."""
    high: Floats
    """Each stretch ends here (m,)."""
    floor: Floats
    """The iteration does not go below this limit (m,), which is -inf where a stretch is a whole period."""
    ceiling: Floats
    """The iteration does not go above this limit (m,), which is inf where a stretch is a whole period."""
    interval: Floats
    """This is the mean knot interval (m,) of each row's curve."""

    @property
    def length(self) -> Floats:
        """Returns the length (m,) of the domain of each row's curve."""
        return self.end - self.begin

    def within(self, v: Floats) -> Floats:
        """Returns v (m,) clipped to the limits of the iteration."""
        return np.minimum(np.maximum(v, self.floor), self.ceiling)

    def moved_into(self, v: Floats) -> Floats:
        """Returns v (m,) moved into its stretch by whole periods, or to the nearest limit."""
        low, high = self.low, self.high
        if not self.periodic:
            return np.minimum(np.maximum(v, low), high)
        period = self.length
        inside = low + np.mod(v - low, period)
        nearest = np.where(inside - high < low + period - inside, high, low)
        return np.where(inside <= high, inside, nearest)

    def in_domain(self, v: Floats) -> Floats:
        """Returns v (m,) wrapped into the domain of a periodic curve, or clipped to that of an open one."""
        if self.periodic:
            v = v - self.length * np.floor((v - self.begin) / self.length)
        return np.minimum(np.maximum(v, self.begin), self.end)

    def where(self, rows: Bools) -> Stretch:
        """Returns the stretches of some rows."""
        names = ("begin", "end", "low", "high", "floor", "ceiling", "interval")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def stretch_of(spans: Spans, curve: Ints, u_low: Floats, u_high: Floats) -> Stretch:
    """Returns the stretches of rows on curves `curve` (m,) between the parameters u_low and u_high (m,).

    A stretch lies inside the domain of an open curve and begins inside that of a periodic one. Reversed
    limits give a stretch of length zero.
    """
    begin, end, shift = spans.low.take(curve), spans.high.take(curve), spans.shift.take(curve)
    interval = spans.interval.take(curve)
    low, high = u_low + shift, u_high + shift
    if not spans.periodic:
        low = np.minimum(np.maximum(low, begin), end)
        high = np.maximum(low, np.minimum(high, end))
        return Stretch(False, begin, end, low, high, low, high, interval)
    period = end - begin
    whole = ~(high - low < period)
    if whole.any():
        low, high = np.where(whole, begin, low), np.where(whole, end, high)
    turns = period * np.floor((low - begin) / period)
    low, high = low - turns, np.maximum(low, high) - turns
    if not whole.any():
        return Stretch(True, begin, end, low, high, low, high, interval)
    floor, ceiling = np.where(whole, -np.inf, low), np.where(whole, np.inf, high)
    return Stretch(True, begin, end, low, high, floor, ceiling, interval)
