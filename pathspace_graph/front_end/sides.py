"""The side of each detection, by the driven path and by colours.

A detector may have no colours, and a track may be driven in reverse. A vote of the coloured cones beside the
path decides whether colours are swapped. If most detections have no colour, two rows of cones are extended
from beside the vehicle, and each cone gets the side of the row that it fits better.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.front_end.cone_rows import ConeRow, extend_rows
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
    in_front_row,
)
from pathspace_graph.mapping.tracks import Tracks
from pathspace_graph.settings.online import GrowthSettings, SidesSettings

NEARBY: Final = 8.0  # distance ahead, behind and beside the path within which it tells sides (m)
MAJORITY: Final = 2.5  # least ratio of votes that swaps the colours
MIN_VOTES: Final = 3  # least number of votes that swaps the colours
ENOUGH_VOTES: Final = 30  # number of votes after which the meaning of the colours is final
REMEMBERED: Final = 0.98  # forgetting factor per cycle of the share without colour
MIN_SHARED: Final = 6  # least number of detections for that share
SIDED_FROM: Final = 2  # least number of detections of a cone with a side
PATH_TELLS: Final = 3.0  # distance ahead up to which the path determines sides (m); the rows do beyond


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
        self._known = self._unknown = 0.0  # detections with and without a colour, with forgetting

    def update(
        self, pose: Array, twists: Array, detections: Detections, *, in_lane: bool = False
    ) -> Detections:
        """Return the detections of a cycle, labelled by side.

        The pose (3,) is by dead reckoning, and the twists (k, 3) lead to it. In a lane of orange cones the
        vehicle is not on the track yet, and colours get no vote.
        """
        labels = detections.labels
        unknown = int((labels == UNKNOWN).sum())
        self._unknown = REMEMBERED * self._unknown + unknown
        self._known = REMEMBERED * self._known + len(labels) - unknown
        total = self._known + self._unknown
        self.colourless = total >= MIN_SHARED and self._unknown > self.settings.colourless * total
        if not self.colourless and self._agreeing + self._opposing >= ENOUGH_VOTES:
            self._path = None  # a new path begins if it is needed again
            return self.relabelled(detections, labels) if self.swapped else detections
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
        if winning >= MIN_VOTES and winning > MAJORITY * losing:
            self.swapped = not self.swapped

    def _sides(self, pose: Array, path: PathAhead) -> IntArray:
        near = self._cones
        seen = np.flatnonzero(near.counts >= SIDED_FROM)
        sides = np.full(len(near.points), UNKNOWN)
        if len(seen) == 0:
            return sides
        points, begins = near.points[seen], list[tuple[Array, Array]]()
        stations, lateral = path.locate(points)
        for label in BOUNDARIES:  # each up to the vehicle
            side, ahead = SIDES[label] * lateral, np.array([np.cos(pose[2]), np.sin(pose[2])])
            beside = (side > MIN_LATERAL) & (side < NEARBY)
            beside &= (stations > path.driven - NEARBY) & (stations < path.driven + PATH_TELLS)
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
