"""Rows of cones: both boundaries of the road ahead, followed from cone to cone.

`extend_rows` extends rows of known colours in turn. `deal_out` assigns cones without a colour to both rows
until the next cone is ambiguous.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.mapping.path import along_and_across, crosses


@dataclass(frozen=True)
class RowLimits:
    """Limits of a step from one cone of a row to the next; its cost is `distance (1 + turn_cost turn^2)`."""

    gap: float  # largest distance of neighbours (m)
    turn: float  # largest turn at distance 0 (rad)
    turn_rate: float  # decrease of the largest turn with distance (rad/m)
    turn_cost: float  # cost of a turn (rad^-2)
    width: float  # least distance from the other row (m)


EXTENDED: Final = RowLimits(gap=11.0, turn=2.0, turn_rate=0.1, turn_cost=1.0, width=1.5)
"""Limits of rows of known colours: two regular gaps, since one cone may be missed."""
DEALT_OUT: Final = RowLimits(gap=8.0, turn=1.3, turn_rate=0.0, turn_cost=2.0, width=1.8)
WIDTH_RATIO: Final = 1.8  # largest growth of the distance from the other row between successive cones
WIDTH_SLACK: Final = 1.0  # additional growth allowed (m)
CLEAR: Final = 1.3  # least ratio of a cone's cost in the other row to its cost in its own


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
    def end(self) -> Array:
        return np.asarray(self.line[-1])

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
        step = self.candidates[index] - self.end
        self.direction = step / np.hypot(*step)
        self.line = np.concatenate([self.line, self.candidates[index, None]])
        self.chosen.append(index)

    def costs(self, indices: IntArray, limits: RowLimits) -> tuple[Array, Array]:
        """Return distances (k,) in m and costs (k,) of candidates, infinite beyond the largest turn."""
        step = self.candidates[indices] - self.end
        distance, (cos, sin) = np.hypot(step[:, 0], step[:, 1]), self.direction
        turn = np.abs(np.arctan2(cos * step[:, 1] - sin * step[:, 0], step @ self.direction))
        cost = distance * (1.0 + limits.turn_cost * turn**2)
        return distance, np.where(turn < limits.turn - limits.turn_rate * distance, cost, np.inf)

    def choose_next(self, other: "ConeRow", driven: Array, threshold: float) -> bool:
        """Continue the row by the rules of `extend_rows`; return whether there is a candidate.

        A row without any candidate within the limits has `ended`.
        """
        distance, cost = self.costs(np.arange(len(self.candidates)), EXTENDED)
        possible = (distance > threshold) & (distance < EXTENDED.gap) & np.isfinite(cost)
        possible[self.chosen] = False
        indices = np.flatnonzero(possible)
        indices = indices[np.argsort(cost[indices])]
        self.ended = len(indices) == 0
        if self.ended:
            return False
        points = self.candidates[indices]
        fits = _has_width(self, other, points)
        fits &= ~crosses(self.end, points, driven) & ~crosses(self.end, points, other.line)
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
        row = min(waiting, key=lambda row: float(row.end @ ahead))
        if row.choose_next(right if row is left else left, driven, threshold):
            waiting = [other for other in (left, right) if not other.ended]
        else:
            waiting = [other for other in waiting if other is not row]


def _has_width(row: ConeRow, other: ConeRow, points: Array) -> BoolArray:
    """Whether points (k, 2) are about as far from the other row as the end of their own row."""
    stations = path_lengths(other.line)
    station, width = along_and_across(np.concatenate([row.end[None], points]), other.line, stations)
    width, beyond = row.side * width, station[1:] > stations[-1]
    widest = WIDTH_RATIO * abs(width[0]) + WIDTH_SLACK
    return np.asarray((width[1:] > EXTENDED.width) & (beyond | (width[1:] < widest)))


def deal_out(rows: Sequence[ConeRow], free: IntArray, may_be: BoolArray) -> None:
    """Continue two rows through free cones (k,), given by index, until the next cone is ambiguous.

    The next cone has the least cost of all that `may_be` (2, k) allows a row, and a cost `CLEAR` times as
    large in the other row. Both rows have the same candidates.
    """
    while len(free):
        ways = [row.costs(free, DEALT_OUT) for row in rows]
        apart = np.array([_distances(row.candidates[free], other.cones) for row, other in (rows, rows[::-1])])
        costs = np.where(may_be & (apart > DEALT_OUT.width), [cost for _, cost in ways], np.inf)
        within = np.where([distance < DEALT_OUT.gap for distance, _ in ways], costs, np.inf)
        own, best = divmod(int(within.argmin()), len(free))
        if np.isinf(within[own, best]) or costs[1 - own, best] < CLEAR * within[own, best]:
            return
        rows[own].choose(int(free[best]))
        free, may_be = np.delete(free, best), np.delete(may_be, best, axis=1)


def _distances(points: Array, cones: Array) -> Array:
    """Return the distance (k,) of each point (k, 2) from the nearest cone (n, 2), infinite without any."""
    off = points[:, None] - cones[None]
    return np.asarray(np.hypot(off[..., 0], off[..., 1]).min(axis=1, initial=np.inf))
