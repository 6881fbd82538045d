"""The side of each detection, by the driven path and by colours, and rows of cones ahead of the vehicle.

A detector may have no colours, and a track may be driven in reverse. A vote of the coloured cones beside the
path decides whether colours are swapped. If most detections have no colour, two rows of cones are extended
from beside the vehicle, and each cone gets the side of the row that it fits better. The rows are extended in
turn, so that the width of the track decides where the colours do not.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import path_lengths, rotated, to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.path import (
    BEGIN_LATERAL,
    LATERAL_GAP,
    MIN_LATERAL,
    ROW_BESIDE,
    SIDES,
    DrivenPath,
    PathAhead,
    along_and_across,
    crosses,
    in_front_row,
)
from pathspace_graph.mapping.tracks import Tracks
from pathspace_graph.settings.mapper import GrowthSettings, SidesSettings

# --- rows of cones ---------------------------------------------------------------------------------------

ROW_GAP: Final = 11.0  # largest distance of neighbours (m): two regular gaps, since one cone may be missed


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

    def choose_next(self, other: "ConeRow", driven: Array, threshold: float) -> bool:
        """Continue the row by the rules of `extend_rows`; return whether there is a candidate.

        The next cone has the least `distance (1 + turn^2)`, and turns less the farther it is. Up to the end
        of the other row, the track may widen to 1.8 times its width and a metre more. A row without any
        candidate within the limits has `ended`.
        """
        step, (cos, sin) = self.candidates - self.line[-1], self.direction
        distance = np.hypot(step[:, 0], step[:, 1])
        turn = np.abs(np.arctan2(cos * step[:, 1] - sin * step[:, 0], step @ self.direction))
        cost = distance * (1.0 + turn**2)
        possible = (distance > threshold) & (distance < ROW_GAP) & (turn < 2.0 - 0.1 * distance)
        possible[self.chosen] = False
        indices = np.flatnonzero(possible)
        indices = indices[np.argsort(cost[indices])]
        self.ended = len(indices) == 0
        if self.ended:
            return False
        end, points, stations = self.line[-1:], self.candidates[indices], path_lengths(other.line)
        station, width = along_and_across(np.concatenate([end, points]), other.line, stations)
        width, beyond = self.side * width, station[1:] > stations[-1]
        fits = (width[1:] > 1.5) & (beyond | (width[1:] < 1.8 * abs(width[0]) + 1.0))
        fits &= ~crosses(self.line[-1], points, driven) & ~crosses(self.line[-1], points, other.line)
        if fits.any():
            best = int(indices[fits.argmax()])
            self.direction = step[best] / np.hypot(*step[best])
            self.line = np.concatenate([self.line, self.candidates[best, None]])
            self.chosen.append(best)
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


# --- sides -----------------------------------------------------------------------------------------------

NEARBY: Final = 8.0  # distance ahead, behind and beside the path within which it tells sides (m)


class SideJudge(Copyable):
    """Estimator of the side of each detection, which is its label."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.swapped = False  # whether the colours of the log are swapped
        self.colourless = False  # whether most detections have no colour
        self._path: DrivenPath | None = None
        self._cones = Tracks(by_label=False)
        self._voted: IntArray = np.zeros(0, np.intp)  # numbers of those that have voted
        self._agreeing = self._opposing = 0  # votes of cones on the side of their colour, and on the other
        self._counts: Array = np.zeros(2)  # detections with and without a colour, with forgetting

    def update(
        self, pose: Array, twists: Array, detections: Detections, *, in_lane: bool = False
    ) -> IntArray:
        """Return the labels (m,) of the detections of a cycle, by side.

        The pose (3,) is by dead reckoning, and the twists (k, 3) lead to it. In a lane of orange cones the
        vehicle is not on the track yet, and colours get no vote. What the colours mean is final after 30
        votes.
        """
        labels = detections.labels
        unknown = int(np.count_nonzero(labels == UNKNOWN))
        self._counts = 0.98 * self._counts + [len(labels) - unknown, unknown]
        total, sides = self._counts.sum(), np.array(UNKNOWN)
        self.colourless = bool(total >= 6 and self._counts[1] > self.settings.colourless * total)
        if self.colourless or self._agreeing + self._opposing < 30:
            self._path = self._path or DrivenPath()
            self._path.update(pose)
            self._path.steer(twists)
            path = self._path.ahead(pose, NEARBY)
            points = to_map(detections.points_vehicle, pose[None])
            covariances = rotated(detections.covariances, np.full(len(points), pose[2]))
            numbers = self._cones.add(points, covariances, labels, detections.t)
            cones = self._cones.numbers.searchsorted(numbers)
            if not in_lane:
                self._judge_colours(path)
            if self.colourless:
                sides = self._sides(pose, path)[cones]
        else:
            self._path = None  # a new path begins if it is needed again
        coloured = LEFT + RIGHT - labels if self.swapped else labels
        return np.where(labels == UNKNOWN, sides, coloured) if unknown else coloured

    def _judge_colours(self, path: PathAhead) -> None:
        """Count the vote of each cone once, and swap colours by three votes and 2.5 times the others."""
        near = self._cones
        self._voted = np.intersect1d(self._voted, near.numbers)
        fresh = np.flatnonzero(near.votes[:, BOUNDARIES].any(axis=1) & ~np.isin(near.numbers, self._voted))
        if len(fresh) == 0:
            return
        stations, lateral = path.locate(near.points[fresh])
        beside = (np.abs(lateral) > MIN_LATERAL) & (np.abs(lateral) < NEARBY)
        beside &= (stations > path.driven) & (stations < path.driven + NEARBY)
        self._voted = np.append(self._voted, near.numbers[fresh[beside]])
        is_left = near.votes[fresh, LEFT] > near.votes[fresh, RIGHT]
        agree = (lateral > 0.0) == is_left
        self._agreeing += int((agree & beside).sum())
        self._opposing += int((~agree & beside).sum())
        votes = self._opposing, self._agreeing
        winning, losing = votes[::-1] if self.swapped else votes
        if winning >= 3 and winning > 2.5 * losing:
            self.swapped = not self.swapped

    def _sides(self, pose: Array, path: PathAhead) -> IntArray:
        """Return the side (n,) of each cone seen twice: by the path beside it, by the rows beyond."""
        near = self._cones
        seen = np.flatnonzero(near.counts >= 2)
        sides = np.full(len(near.points), UNKNOWN)
        if len(seen) == 0:
            return sides
        points, begins = near.points[seen], list[tuple[Array, Array]]()
        stations, lateral = path.locate(points)
        for label in BOUNDARIES:  # each up to 3 m ahead of the vehicle
            side, ahead = SIDES[label] * lateral, np.array([np.cos(pose[2]), np.sin(pose[2])])
            beside = (side > MIN_LATERAL) & (side < NEARBY)
            beside &= (stations > path.driven - NEARBY) & (stations < path.driven + 3.0)
            order = np.flatnonzero(beside)[np.argsort(stations[beside])]
            cones = order[in_front_row(stations[order], side[order], ROW_BESIDE, LATERAL_GAP)]
            sides[seen[cones]], line = label, points[cones]
            if len(cones) == 0:
                line = pose[None, :2] + SIDES[label] * BEGIN_LATERAL * np.array([[-ahead[1], ahead[0]]])
            if len(cones) > 1:
                step = line[-1] - line[-2]
                ahead = step / np.hypot(*step)
            begins.append((np.concatenate([line[:1] - NEARBY * ahead, line]), ahead))
        votes, rows = near.votes[seen][:, BOUNDARIES[::-1] if self.swapped else BOUNDARIES], list[ConeRow]()
        free = (stations > path.driven) & (sides[seen] == UNKNOWN)
        may_be = free & (votes.T[::-1] <= votes.T + 1)  # a single wrong colour excludes no cone
        for label, (line, ahead) in zip(BOUNDARIES, begins, strict=True):
            rows.append(ConeRow(SIDES[label], line, ahead, points[may_be[label]]))
        driven = path.points[path.stations <= path.driven]
        extend_rows(rows[0], rows[1], driven, GrowthSettings.threshold)
        for label, row in zip(BOUNDARIES, rows, strict=True):
            sides[seen[may_be[label]][row.chosen]] = label
        return sides
