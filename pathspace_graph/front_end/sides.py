"""The side of each detection: what is left of the way driven is left, and colours are evidence of it.

A detector may have no colours, and a track may be driven the other way round. The coloured cones beside the
path decide together what colours mean. Where most have none, two rows of cones are followed from beside the
vehicle ahead, each cone to the row that it fits better.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.front_end.cone_rows import ConeRow, deal_out
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.path import LATERAL_GAP, ROW_BESIDE, SIDES, DrivenPath, PathAhead, in_front_row
from pathspace_graph.mapping.tentative import nearest_within, newest_of
from pathspace_graph.settings.online import SidesSettings

VOTE_REACH: Final = 8.0  # length of the predicted path beside which cones say what the colours mean, m
NEAREST_SIDE: Final = 0.5
FARTHEST_SIDE: Final = 8.0  # distances from the path between which it tells the side of a cone, m
MAJORITY: Final = 2.5  # least ratio of cones on the other colour's side where colours are swapped
MIN_VOTES: Final = 3  # least number of cones on the other colour's side where colours are swapped
ENOUGH_VOTES: Final = 30  # number of cones that settles what the colours mean
REMEMBERED: Final = 0.98  # factor from cycle to cycle of the detections so far in the colourless share
MIN_SHARED: Final = 6  # least number of detections of which the share is taken
MERGE_RADIUS: Final = 1.0  # distance within which detections are of one cone, m
FORGET_AFTER: Final = 3.0  # time without a detection after which a cone is forgotten, s
MOST_CONES: Final = 2000  # largest number of cones that are remembered, the ones that were seen last
SIDED_FROM: Final = 2  # detections from which a cone has a side
BEHIND: Final = 8.0  # length behind the vehicle at which the rows begin, m along the path
PATH_TELLS: Final = 3.0  # length ahead of it up to which the path tells sides, m; beyond, the rows do
HALF_WIDTH: Final = 1.5  # distance beside the vehicle at which a row without any cone begins, m


class SideJudge(Copyable):
    """Judge of the side of each detection, which gives it the label."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.swapped = False  # whether the colours of the log so far are on the other sides
        self.colourless = False  # whether most detections have no colour
        self._path: DrivenPath | None = None
        self._cones = NearCones()
        self._agreeing = self._opposing = 0  # cones on the side of their colour, and on the other one
        self._known = self._unknown = 0.0  # newest detections with and without a colour

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
        path = self._path.ahead(pose, VOTE_REACH)
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
        beside = (np.abs(lateral) > NEAREST_SIDE) & (np.abs(lateral) < FARTHEST_SIDE)
        beside &= (stations > path.driven) & (stations < path.driven + VOTE_REACH)
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
        return total >= MIN_SHARED and self._unknown > self.settings.colourless * total

    def _sides(self, pose: Array, path: PathAhead) -> IntArray:
        near = self._cones
        seen = np.flatnonzero(near.counts >= SIDED_FROM)
        sides = np.full(len(near.points), UNKNOWN)
        if len(seen) == 0:
            return sides
        stations, lateral = path.locate(near.points[seen])
        rows = [self._beginning(label, pose, path, seen, stations, lateral) for label in BOUNDARIES]
        free = np.setdiff1d(seen[stations > path.driven], [*rows[0].chosen, *rows[1].chosen])
        votes = near.votes[free, ::-1] if self.swapped else near.votes[free]
        deal_out(rows, free, votes.T[::-1] <= votes.T + 1)  # one wrong colour excludes no cone
        for label, row in zip(BOUNDARIES, rows, strict=True):
            sides[row.chosen] = label
        return sides

    def _beginning(
        self, label: int, pose: Array, path: PathAhead, seen: IntArray, stations: Array, lateral: Array
    ) -> ConeRow:
        """Return the row of a boundary up to the vehicle, through the cones (k,) that were seen."""
        side = SIDES[label] * lateral
        beside = (side > NEAREST_SIDE) & (side < FARTHEST_SIDE)
        beside &= (stations > path.driven - BEHIND) & (stations < path.driven + PATH_TELLS)
        order = np.flatnonzero(beside)[np.argsort(stations[beside])]
        cones = seen[order[in_front_row(stations[order], side[order], ROW_BESIDE, LATERAL_GAP)]]
        candidates, ahead = self._cones.points, np.array([np.cos(pose[2]), np.sin(pose[2])])
        line = candidates[cones]
        if len(cones) == 0:
            line = pose[None, :2] + SIDES[label] * HALF_WIDTH * np.array([[-ahead[1], ahead[0]]])
        if len(cones) > 1:
            step = line[-1] - line[-2]
            ahead = step / np.hypot(*step)
        return ConeRow(SIDES[label], line, ahead, candidates, cones.tolist())


class NearCones(Copyable):
    """Cones near the vehicle as means of their detections, with the colours in which they were seen."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) place of each cone in the frame of the front end, m
        self.counts: IntArray = np.zeros(0, np.intp)  # (n,) number of detections
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)  # (n, 2) detections by label
        self.judged: BoolArray = np.zeros(0, bool)  # (n,) whether its colour was compared with its side
        self._last: Array = np.zeros(0)

    def add(self, t: float, points: Array, labels: IntArray) -> IntArray:
        """Add detections at points (m, 2) with labels (m,), seen at t (s); return the cone (m,) of each."""
        kept = newest_of(self._last, MOST_CONES) & (self._last > t - FORGET_AFTER)
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
