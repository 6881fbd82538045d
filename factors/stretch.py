"""Where a foot point is looked for: a stretch of each row's own curve."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .bspline import Floats, Ints
from .spans import Spans

Bools = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Each row's stretch on the axis of `Spans`."""

    periodic: bool
    """Whether the curves are closed."""
    begin: Floats
    """Domain (m,) of the row's curve, from ..."""
    end: Floats
    """... to."""
    low: Floats
    """Stretch (m,), from ..."""
    high: Floats
    """... to."""
    floor: Floats
    """Limits (m,) that the iteration must keep, from ..."""
    ceiling: Floats
    """... to: none for a stretch that is a whole period."""
    interval: Floats
    """Mean knot interval (m,) of the row's curve."""

    @property
    def length(self) -> Floats:
        """Length (m,) of the row's curve."""
        return self.end - self.begin

    def within(self, v: Floats) -> Floats:
        """v (m,) clipped to the limits that the iteration must keep."""
        return np.minimum(np.maximum(v, self.floor), self.ceiling)

    def moved_into(self, v: Floats) -> Floats:
        """v (m,) moved into the stretch: by whole periods where periodic, else to the nearest limit."""
        low, high = self.low, self.high
        if not self.periodic:
            return np.minimum(np.maximum(v, low), high)
        period = self.length
        inside = low + np.mod(v - low, period)
        nearest = np.where(inside - high < low + period - inside, high, low)
        return np.where(inside <= high, inside, nearest)

    def in_domain(self, v: Floats) -> Floats:
        """v (m,) wrapped into the curve's domain where periodic, else clipped to it."""
        if self.periodic:
            v = v - self.length * np.floor((v - self.begin) / self.length)
        return np.minimum(np.maximum(v, self.begin), self.end)

    def where(self, rows: Bools) -> Stretch:
        """Of some rows."""
        names = ("begin", "end", "low", "high", "floor", "ceiling", "interval")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def stretch_of(spans: Spans, curve: Ints, u_low: Floats, u_high: Floats) -> Stretch:
    """Stretches (m,) inside an open domain, or begun in a periodic one; never reversed."""
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
