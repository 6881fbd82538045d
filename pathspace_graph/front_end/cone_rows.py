"""Rows of cones: both boundaries of the road ahead, followed from cone to cone.

The rows are extended in turn, so that the width of the track decides where the colours do not.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.mapping.path import along_and_across, crosses

ROW_GAP: Final = 11.0  # largest distance of neighbours (m): two regular gaps, since one cone may be missed
ROW_TURN: Final = 2.0  # largest turn from one cone to the next, at distance 0 (rad)
ROW_TURN_RATE: Final = 0.1  # decrease of the largest turn with the distance (rad/m)
ROW_WIDTH: Final = 1.5  # least distance from the other row (m)
WIDTH_RATIO: Final = 1.8  # largest growth of the distance from the other row between successive cones
WIDTH_SLACK: Final = 1.0  # additional growth allowed (m)


@dataclass(eq=False)
class ConeRow:
    """The known part of a boundary, and the cones that may continue it."""

    side: float  # side of the other row on which it lies: 1 left, -1 right
    line: Array  # (n, 2) points of the row in driving order (m)
    direction: Array  # (2,) unit vector along the row at its last point
    candidates: Array  # (k, 2) cones that may continue the row (m)
    chosen: list[int] = field(default_factory=list)  # indices of the candidates in the row, in order
    ended: bool = False  # whether no candidate can continue the row

    @property
    def cones(self) -> Array:
        """Return the candidates (c, 2) in the row."""
        return self.candidates[self.chosen]

    @property
    def lengths(self) -> Array:
        """Return the lengths (c,) in m along the row from the known end to each chosen candidate."""
        return path_lengths(self.line[-len(self.chosen) - 1 :])[1:]

    def choose(self, index: int) -> None:
        """Continue the row through a candidate."""
        step = self.candidates[index] - self.line[-1]
        self.direction = step / np.hypot(*step)
        self.line = np.concatenate([self.line, self.candidates[index, None]])
        self.chosen.append(index)

    def choose_next(self, other: "ConeRow", driven: Array, threshold: float) -> bool:
        """Continue the row by the rules of `extend_rows`; return whether there is a candidate.

        The next cone has the least `distance (1 + turn^2)`. A row without any candidate within the limits has
        `ended`.
        """
        step, (cos, sin) = self.candidates - self.line[-1], self.direction
        distance = np.hypot(step[:, 0], step[:, 1])
        turn = np.abs(np.arctan2(cos * step[:, 1] - sin * step[:, 0], step @ self.direction))
        cost = distance * (1.0 + turn**2)
        possible = (distance > threshold) & (distance < ROW_GAP)
        possible &= turn < ROW_TURN - ROW_TURN_RATE * distance
        possible[self.chosen] = False
        indices = np.flatnonzero(possible)
        indices = indices[np.argsort(cost[indices])]
        self.ended = len(indices) == 0
        if self.ended:
            return False
        points = self.candidates[indices]
        fits = _has_width(self, other, points)
        fits &= ~crosses(self.line[-1], points, driven) & ~crosses(self.line[-1], points, other.line)
        if fits.any():
            self.choose(int(indices[fits.argmax()]))
        return bool(fits.any())


def extend_rows(left: ConeRow, right: ConeRow, driven: Array, threshold: float) -> None:
    """Continue both rows through their candidates, always the row that lags behind.

    A row stays on its side of the other one, at about the width of the track, and does not cross the driven
    path (n, 2). Cones within `threshold` (m) of a row's end are skipped.
    """
    waiting = [left, right]
    while waiting:
        ahead = left.direction + right.direction
        row = min(waiting, key=lambda row: float(row.line[-1] @ ahead))
        if row.choose_next(right if row is left else left, driven, threshold):
            waiting = [other for other in (left, right) if not other.ended]
        else:
            waiting = [other for other in waiting if other is not row]


def _has_width(row: ConeRow, other: ConeRow, points: Array) -> BoolArray:
    """Whether points (k, 2) are about as far from the other row as the end of their own row."""
    stations = path_lengths(other.line)
    station, width = along_and_across(np.concatenate([row.line[-1:], points]), other.line, stations)
    width, beyond = row.side * width, station[1:] > stations[-1]
    widest = WIDTH_RATIO * abs(width[0]) + WIDTH_SLACK
    return np.asarray((width[1:] > ROW_WIDTH) & (beyond | (width[1:] < widest)))
