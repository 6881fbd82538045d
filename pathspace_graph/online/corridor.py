"""Rows of tentative tracks that lead on, cone by cone, between the two boundaries of the track."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.mapping.path import along_and_across
from pathspace_graph.settings.growth import TentativeSettings

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(eq=False)
class Row:
    """Holds one boundary as far as it is known, and the tracks that may continue it."""

    side: float
    """The row lies where the signed distance from the other row (left positive) has this sign."""
    line: Array
    """(n, 2) These are at least two points of the row in driving order (m, map frame)."""
    direction: Array
    """(2,) The row leads on from its last point in the direction of this unit vector."""
    candidates: Array
    """(k, 2) These tracks may continue the row (m, map frame)."""
    chosen: list[int] = field(default_factory=list)
    """The row continues through the candidates with these indices, in driving order."""
    ended: bool = False
    """No candidate continues the row, wherever the other one leads."""

    @property
    def end(self) -> Array:
        """Returns the last point (2,) of the row."""
        end: Array = self.line[-1]
        return end

    def choose(self, index: int) -> None:
        """Continues the row through a candidate."""
        step = self.candidates[index] - self.end
        self.direction = step / np.hypot(*step)
        self.line = np.concatenate([self.line, self.candidates[index, None]])
        self.chosen.append(index)


def lead_on(left: Row, right: Row, driven: Array, threshold: float, settings: TentativeSettings) -> None:
    """Continues both rows through their candidates, each time the one that lags behind.

    Each row bounds where the other may lead: it stays on its own side, at about the width that the track has.
    No row crosses the driven path (n, 2). A track nearer to a row's end than `threshold` (m) is passed over.
    """
    waiting = [left, right]
    while waiting:
        ahead = left.direction + right.direction
        row = min(waiting, key=lambda row: float(row.end @ ahead))
        index = _next(row, right if row is left else left, driven, threshold, settings)
        if index is None:
            waiting = [other for other in waiting if other is not row]
        else:
            row.choose(index)
            waiting = [other for other in (left, right) if not other.ended]


def _next(row: Row, other: Row, driven: Array, threshold: float, settings: TentativeSettings) -> int | None:
    """Returns the index of the candidate that continues a row, or None."""
    step = row.candidates - row.end
    distance = np.hypot(step[:, 0], step[:, 1])
    near = (distance > threshold) & (distance < settings.gap)
    near[row.chosen] = False
    indices = np.flatnonzero(near)
    if len(indices) == 0:
        row.ended = True
        return None
    (cos, sin), step, distance = row.direction, step[indices], distance[indices]
    turn = np.abs(np.arctan2(cos * step[:, 1] - sin * step[:, 0], step @ row.direction))
    allowed = turn < settings.turn - settings.turn_rate * distance
    cost = distance * (1.0 + settings.turn_cost * turn**2)
    indices = indices[allowed][np.argsort(cost[allowed])]
    if len(indices) == 0:
        row.ended = True
        return None
    points = row.candidates[indices]
    possible = _has_width(row, other, points, settings)
    possible &= ~crosses(row.end, points, driven) & ~crosses(row.end, points, other.line)
    return int(indices[possible.argmax()]) if possible.any() else None


def _has_width(row: Row, other: Row, points: Array, settings: TentativeSettings) -> BoolArray:
    """Returns whether points (k, 2) are about as far from the other row as the end of their own row."""
    stations = np.append(0.0, np.cumsum(np.hypot(*np.diff(other.line, axis=0).T)))
    station, width = along_and_across(np.concatenate([row.end[None], points]), other.line, stations)
    width, beyond = row.side * width, station[1:] > stations[-1]
    widest = settings.width_ratio * abs(width[0]) + settings.width_slack
    return np.asarray((width[1:] > settings.min_width) & (beyond | (width[1:] < widest)))


def crosses(begin: Array, ends: Array, line: Array) -> BoolArray:
    """Returns whether each segment from `begin` (2,) to one of `ends` (k, 2) crosses a polyline (n, 2)."""
    step, relative = ends - begin, line - begin
    beside = step[:, :1] * relative[:, 1] - step[:, 1:] * relative[:, 0]
    edge = np.diff(line, axis=0)
    at_begin = edge[:, 1] * relative[:-1, 0] - edge[:, 0] * relative[:-1, 1]
    at_end = at_begin + edge[:, 0] * step[:, 1:] - edge[:, 1] * step[:, :1]
    parts = (beside[:, :-1] * beside[:, 1:] < 0.0) & (at_begin * at_end < 0.0)
    return np.asarray(parts.any(axis=1))
