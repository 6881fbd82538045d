"""The side of each detection, by the driven path and by colours.

A detector may have no colours, and a track may be driven in reverse. A vote of the coloured cones beside the
path decides whether colours are swapped. If most detections have no colour, two rows of cones are extended
from beside the vehicle, and each cone gets the side of the row that it fits better.
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

VOTE_REACH: Final = 8.0  # length of the predicted path beside which cones vote (m)
NEAREST_SIDE: Final = 0.5  # least distance from the path of a cone whose side the path determines (m)
FARTHEST_SIDE: Final = 8.0  # largest such distance (m)
MAJORITY: Final = 2.5  # least ratio of votes that swaps the colours
MIN_VOTES: Final = 3  # least number of votes that swaps the colours
ENOUGH_VOTES: Final = 30  # number of votes after which the meaning of the colours is final
REMEMBERED: Final = 0.98  # forgetting factor per cycle of the share without colour
MIN_SHARED: Final = 6  # least number of detections for that share
MERGE_RADIUS: Final = 1.0  # distance within which detections are merged to one cone (m)
FORGET_AFTER: Final = 3.0  # time without a detection after which a cone is forgotten (s)
MOST_CONES: Final = 2000  # largest number of remembered cones
SIDED_FROM: Final = 2  # least number of detections of a cone with a side
BEHIND: Final = 8.0  # distance behind the vehicle at which rows begin (m along the path)
PATH_TELLS: Final = 3.0  # distance ahead up to which the path determines sides (m); the rows do beyond
HALF_WIDTH: Final = 1.5  # distance beside the vehicle at which a row without cones begins (m)


class SideJudge(Copyable):
    """Estimator of the side of each detection, which is its label."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.swapped = False  # whether the colours of the log are swapped
        self.colourless = False  # whether most detections have no colour
        self._path: DrivenPath | None = None
        self._cones = NearCones()
        self._agreeing = self._opposing = 0  # votes of cones on the side of their colour, and on the other
        self._known = self._unknown = 0.0  # detections with and without a colour, with forgetting

    def update(
        self, pose: Array, twists: Array, detections: Detections, *, in_lane: bool = False
    ) -> Detections:
        """Return the detections of a cycle, labelled by side.

        The pose (3,) is by dead reckoning, and the twists (k, 3) lead to it. In a lane of orange cones the
        vehicle is not on the track yet, and colours get no vote.
        """
        labels, self.colourless = detections.labels, self._is_colourless(detections.labels)
        if not self.colourless and self._agreeing + self._opposing >= ENOUGH_VOTES:
            self._path = None  # a new path begins if it is needed again
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
        """Swap colours if necessary, and label detections without a colour by sides (m,)."""
        labels = detections.labels
        coloured = LEFT + RIGHT - labels if self.swapped else labels
        labels = np.where(labels == UNKNOWN, sides, coloured)
        return detections if (labels == detections.labels).all() else replace(detections, labels=labels)

    def _judge_colours(self, path: PathAhead) -> None:
        """Count the vote of each cone once, and swap colours by majority."""
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
        deal_out(rows, free, votes.T[::-1] <= votes.T + 1)  # a single wrong colour excludes no cone
        for label, row in zip(BOUNDARIES, rows, strict=True):
            sides[row.chosen] = label
        return sides

    def _beginning(
        self, label: int, pose: Array, path: PathAhead, seen: IntArray, stations: Array, lateral: Array
    ) -> ConeRow:
        """Return the row of a boundary up to the vehicle, through the cones `seen` (k,), by index."""
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
    """Cones near the vehicle, as means of their detections, with their colours."""

    def __init__(self) -> None:
        self.points: Array = np.zeros((0, 2))  # (n, 2) positions by dead reckoning (m)
        self.counts: IntArray = np.zeros(0, np.intp)  # (n,) number of detections
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)  # (n, 2) detections by label
        self.judged: BoolArray = np.zeros(0, bool)  # (n,) whether the cone has voted
        self._last: Array = np.zeros(0)  # (n,) stamp of the newest detection (s)

    def add(self, t: float, points: Array, labels: IntArray) -> IntArray:
        """Merge detections at points (m, 2) with labels (m,) and a stamp t (s); return their cones (m,)."""
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
        """Mark cones (k,) as having voted."""
        self.judged = self.judged.copy()
        self.judged[cones] = True
