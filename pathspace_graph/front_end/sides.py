"""The side of each detection: what is left of the way driven is left, and colours are evidence of it.

A detector may have no colours, and a track may be driven the other way round. The coloured cones beside the
path decide together what colours mean. Where most have none, two rows of cones are followed from beside the
vehicle ahead, each cone to the row that it fits better.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import to_map, wrap_angle
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.path import SIDES, DrivenPath, PathAhead, in_front_row
from pathspace_graph.mapping.tentative import nearest_within, newest_of
from pathspace_graph.settings.online import SidesSettings

REACH: Final = 8.0  # length of the predicted path beside which coloured cones say what the colours mean, m
MIN_LATERAL: Final = 0.5
MAX_LATERAL: Final = 8.0  # distances from the path between which it tells the side of a cone, m
MAJORITY: Final = 2.5  # least ratio of cones on the other colour's side where colours are swapped
MIN_VOTES: Final = 3  # least number of cones on the other colour's side where colours are swapped
ENOUGH_VOTES: Final = 30  # number of cones that settles what the colours mean
REMEMBERED: Final = 0.98  # factor from cycle to cycle of the detections so far in the colourless share
MIN_DETECTIONS: Final = 6  # least number of detections of which the share is taken
MERGE_RADIUS: Final = 1.0  # distance within which detections are of one cone, m
FORGET_AFTER: Final = 3.0  # time without a detection after which a cone is forgotten, s
MAX_CONES: Final = 2000  # largest number of cones that are remembered, the ones that were seen last
SIGHTINGS: Final = 2  # detections from which a cone has a side
BEHIND: Final = 8.0  # length behind the vehicle at which the rows begin, m along the path
SURE: Final = 3.0  # length ahead of it up to which the path tells sides, m; beyond, the rows do
BESIDE: Final = 2.0  # distance along the path within which cones stand beside each other, m
LATERAL_GAP: Final = 0.8  # distance from a nearer cone beside it beyond which a cone is of another stretch, m
HALF_WIDTH: Final = 1.5  # distance beside the vehicle at which a row without any cone begins, m
GAP: Final = 8.0  # largest distance of neighbouring cones of a row, m
TURN: Final = 1.3  # largest turn of a row from one cone to the next, rad
TURN_COST: Final = 2.0  # the next cone of a row has the least `distance (1 + TURN_COST turn^2)` (rad^-2)
CLEAR: Final = 1.3  # least cost of the next cone of a row in the other row, by its own cost
MIN_WIDTH: Final = 1.8  # least distance of a cone of one row from each cone of the other row, m


class SideJudge:
    """Judge of the side of each detection, which gives it the label."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.swapped = False  # whether the colours of the log so far are on the other sides
        self.colourless = False  # whether most detections have no colour
        self._path: DrivenPath | None = None
        self._cones = NearCones()
        self._agreeing = self._opposing = 0  # cones on the side of their colour, and on the other one
        self._known = self._unknown = 0.0  # newest detections with and without a colour

    def copy(self) -> Self:
        """Return a copy that goes on independently."""
        other = shallow(self)
        other._path, other._cones = self._path and shallow(self._path), self._cones.copy()
        return other

    def update(
        self, pose: Array, twists: Array, detections: Detections, *, in_lane: bool = False
    ) -> Detections:
        """Return the detections of a cycle with the labels of their sides.

        The vehicle came to the pose (3,), front end's frame, with twists (k, 3). In a lane of orange cones
        it isn't on the road yet, and the colours of others prove nothing.
        """
        labels, self.colourless = detections.labels, self._is_colourless(detections.labels)
        if not self.colourless and self._agreeing + self._opposing >= ENOUGH_VOTES:
            self._path = None  # it begins anew, if it is needed again
            return self.relabelled(detections, labels) if self.swapped else detections
        self._path = self._path or DrivenPath()
        self._path.update(pose)
        self._path.steer(twists)
        path = self._path.ahead(pose, REACH)
        points = to_map(detections.points_vehicle, pose[None])
        cones = self._cones.add(detections.t, points, labels)
        if not in_lane:
            self._judge_colours(path)
        sides = self._sides(pose, path)[cones] if self.colourless else np.full(len(labels), UNKNOWN)
        return self.relabelled(detections, sides)

    def relabelled(self, detections: Detections, sides: IntArray) -> Detections:
        """Return detections with the right colours, and with sides (m,) for those that have none."""
        labels = detections.labels
        coloured = LEFT + RIGHT - labels if self.swapped else labels
        labels = np.where(labels == UNKNOWN, sides, coloured)
        return detections if (labels == detections.labels).all() else replace(detections, labels=labels)

    def _judge_colours(self, path: PathAhead) -> None:
        """Count cones once on the side of their colour or the other one, and swap colours by majority."""
        near = self._cones
        fresh = np.flatnonzero(~near.judged & near.votes.any(axis=1))
        if len(fresh) == 0:
            return
        stations, lateral = path.locate(near.points[fresh])
        beside = (np.abs(lateral) > MIN_LATERAL) & (np.abs(lateral) < MAX_LATERAL)
        beside &= (stations > path.driven) & (stations < path.driven + REACH)
        near.judge(fresh[beside])
        is_left = near.votes[fresh, LEFT] > near.votes[fresh, RIGHT]
        agree = (lateral > 0.0) == is_left
        self._agreeing += int((agree & beside).sum())
        self._opposing += int((~agree & beside).sum())
        votes = self._opposing, self._agreeing
        winning, losing = votes[::-1] if self.swapped else votes
        if winning >= MIN_VOTES and winning > MAJORITY * losing:
            self.swapped = not self.swapped

    def _is_colourless(self, labels: IntArray) -> bool:
        unknown = int((labels == UNKNOWN).sum())
        self._unknown = REMEMBERED * self._unknown + unknown
        self._known = REMEMBERED * self._known + len(labels) - unknown
        total = self._known + self._unknown
        return total >= MIN_DETECTIONS and self._unknown > self.settings.colourless * total

    def _sides(self, pose: Array, path: PathAhead) -> IntArray:
        near = self._cones
        seen = np.flatnonzero(near.counts >= SIGHTINGS)
        sides = np.full(len(near.points), UNKNOWN)
        if len(seen) == 0:
            return sides
        stations, lateral = path.locate(near.points[seen])
        rows = {label: self._beginning(label, pose, path, seen, stations, lateral) for label in BOUNDARIES}
        taken = [cone for row in rows.values() for cone in row.cones]
        ahead = seen[stations > path.driven]
        votes = near.votes[:, ::-1] if self.swapped else near.votes
        follow_rows(rows, near.points, votes, np.setdiff1d(ahead, taken))
        for label, row in rows.items():
            sides[row.cones] = label
        return sides

    def _beginning(
        self, label: int, pose: Array, path: PathAhead, seen: IntArray, stations: Array, lateral: Array
    ) -> "ConeRow":
        side = SIDES[label] * lateral
        beside = (side > MIN_LATERAL) & (side < MAX_LATERAL)
        beside &= (stations > path.driven - BEHIND) & (stations < path.driven + SURE)
        order = np.flatnonzero(beside)[np.argsort(stations[beside])]
        cones = seen[order[in_front_row(stations[order], side[order], BESIDE, LATERAL_GAP)]].tolist()
        left = np.array([-np.sin(pose[2]), np.cos(pose[2])])
        points = self._cones.points[cones[-2:]]
        row = ConeRow(cones, pose[:2] + SIDES[label] * HALF_WIDTH * left, float(pose[2]))
        if cones:
            row.end = points[-1]
        if len(cones) > 1:
            row.heading = float(np.arctan2(*(points[1] - points[0])[::-1]))
        return row


@dataclass
class ConeRow:
    """A row of cones, the nearest first."""

    cones: list[int]
    end: Array  # (2,) point at which the row ends, m
    heading: float  # direction in which it leads there, rad

    def lead_to(self, cone: int, point: Array) -> None:
        dx, dy = point - self.end
        self.cones.append(cone)
        self.end, self.heading = point, float(np.arctan2(dy, dx))


def follow_rows(rows: Mapping[int, ConeRow], points: Array, votes: IntArray, free: IntArray) -> None:
    """Lead both rows on through free cones (k,), as long as it is clear which cone comes next.

    All cones have points (n, 2) in m, and votes (n, 2) for left and right. The next one has the least
    `distance (1 + TURN_COST turn^2)` from the end of its row, and is far dearer for the other row.
    """
    left = free.tolist()
    while left:
        candidates = np.array(left)
        to_lead = [_costs(rows, label, points, votes, candidates) for label in (LEFT, RIGHT)]
        costs = np.array([cost for cost, _ in to_lead])
        within = np.where([distance < GAP for _, distance in to_lead], costs, np.inf)
        label, best = divmod(int(within.argmin()), len(left))
        if np.isinf(within[label, best]) or costs[1 - label, best] < CLEAR * within[label, best]:
            return
        rows[label].lead_to(left[best], points[left[best]])
        del left[best]


def _costs(
    rows: Mapping[int, ConeRow], label: int, points: Array, votes: IntArray, cones: IntArray
) -> tuple[Array, Array]:
    """Return what it costs a row to lead on to cones (k,), and how far they are from its end (m)."""
    row, other = rows[label], rows[LEFT + RIGHT - label]
    dx, dy = (points[cones] - row.end).T
    distance, turn = np.hypot(dx, dy), wrap_angle(np.arctan2(dy, dx) - row.heading)
    allowed = np.abs(turn) < TURN
    allowed &= votes[cones, LEFT + RIGHT - label] <= votes[cones, label] + 1
    if other.cones:
        off = points[cones][:, None] - points[other.cones][None]
        allowed &= np.hypot(off[..., 0], off[..., 1]).min(axis=1) > MIN_WIDTH
    return np.where(allowed, distance * (1.0 + TURN_COST * turn**2), np.inf), distance


class NearCones:
    """Cones near the vehicle as means of their detections, with the colours in which they were seen."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) place of each cone in the frame of the front end, m
        self.counts: IntArray = np.zeros(0, np.intp)  # (n,) number of detections
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)  # (n, 2) detections by label
        self.judged: BoolArray = np.zeros(0, bool)  # (n,) whether its colour was compared with its side
        self._last: Array = np.zeros(0)

    def copy(self) -> Self:
        """Return a copy that goes on independently: arrays that are written into are new in each call."""
        return shallow(self)

    def add(self, t: float, points: Array, labels: IntArray) -> IntArray:
        """Add detections at points (m, 2) with labels (m,), seen at t (s); return the cone (m,) of each."""
        kept = newest_of(self._last, MAX_CONES) & (self._last > t - FORGET_AFTER)
        for name, column in vars(self).items():
            setattr(self, name, column[kept])
        cones, known = nearest_within(points, self.points, MERGE_RADIUS)
        new = int((~known).sum())
        cones[~known] = len(self.points) + np.arange(new)
        for name, column in vars(self).items() if new else ():
            setattr(self, name, np.concatenate([column, np.zeros((new, *column.shape[1:]), column.dtype)]))
        coloured = labels != UNKNOWN
        np.add.at(self.votes, (cones[coloured], labels[coloured]), 1)
        np.add.at(self.counts, cones, 1)
        np.add.at(self.points, cones, (points - self.points[cones]) / self.counts[cones, None])
        self._last[cones] = t
        return cones

    def judge(self, cones: IntArray) -> None:
        """Note that the colours of cones (k,) were compared with their sides."""
        self.judged = self.judged.copy()
        self.judged[cones] = True
