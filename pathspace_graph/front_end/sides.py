"""The side of each detection: what is left of the way driven is left, and colours are evidence of it.

A detector may have no colours, and a track may be driven the other way round, with its blue cones on the
right. The coloured cones beside the path decide together what the colours mean. Where most detections
have no colour, two rows of cones are followed from beside the vehicle ahead. What is in neither of them stays
unknown.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.path import SIDES, DrivenPath, PathAhead, in_front_row
from pathspace_graph.settings.front_end import SidesSettings

from .cones import NearCones
from .rows import Row, follow_rows

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class SideJudge:
    """Gives the detections of each cycle the labels of their sides."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.swapped = False
        """The flag is set where the colours of the log so far are on the other sides."""
        self.colourless = False
        """The flag is set where most detections have no colour, so that the way driven tells their sides."""
        self._path: DrivenPath | None = None
        self._cones = NearCones(settings)
        self._agreeing = self._opposing = 0  # cones on the side of their colour, and on the other one
        self._known = self._unknown = 0.0  # newest detections with and without a colour

    def update(
        self, pose: Array, twists: Array, detections: Detections, *, in_lane: bool = False
    ) -> Detections:
        """Returns the detections of a cycle with the labels of their sides.

        The pose (3,) is in the frame of the front end, and the vehicle came there with twists (k, 3). In a
        lane between orange cones it isn't on the road yet, and the colours of others prove nothing.
        """
        labels, self.colourless = detections.labels, self._is_colourless(detections.labels)
        if not self.colourless and self._agreeing + self._opposing >= self.settings.enough_votes:
            self._path = None  # it begins anew, if it is needed again
            return self.relabelled(detections, labels) if self.swapped else detections
        self._path = self._path or DrivenPath()
        self._path.update(pose)
        self._path.steer(twists)
        path = self._path.ahead(pose, self.settings.reach)
        points = to_map(detections.points_vehicle, pose[None])
        cones = self._cones.add(detections.t, points, labels)
        if not in_lane:
            self._judge_colours(path)
        sides = self._sides(pose, path)[cones] if self.colourless else np.full(len(labels), UNKNOWN)
        return self.relabelled(detections, sides)

    def relabelled(self, detections: Detections, sides: IntArray) -> Detections:
        """Returns detections with the right colours, and with sides (m,) for those that have none."""
        labels = detections.labels
        coloured = LEFT + RIGHT - labels if self.swapped else labels
        labels = np.where(labels == UNKNOWN, sides, coloured)
        return detections if (labels == detections.labels).all() else replace(detections, labels=labels)

    # --- what the colours mean ---------------------------------------------------------------------------

    def _judge_colours(self, path: PathAhead) -> None:
        """Counts cones on the side of their colour and on the other one, and swaps the colours by majority.

        Each cone is counted once, when it is a little ahead.
        """
        settings, near = self.settings, self._cones
        fresh = np.flatnonzero(~near.judged & near.votes.any(axis=1))
        if len(fresh) == 0:
            return
        stations, lateral = path.locate(near.points[fresh])
        beside = (np.abs(lateral) > settings.min_lateral) & (np.abs(lateral) < settings.max_lateral)
        beside &= (stations > path.driven) & (stations < path.driven + settings.reach)
        near.judged[fresh[beside]] = True
        is_left = near.votes[fresh, LEFT] > near.votes[fresh, RIGHT]
        agree = (lateral > 0.0) == is_left
        self._agreeing += int((agree & beside).sum())
        self._opposing += int((~agree & beside).sum())
        winning, losing = self._opposing, self._agreeing
        if self.swapped:
            winning, losing = losing, winning
        if winning >= settings.min_votes and winning > settings.majority * losing:
            self.swapped = not self.swapped

    # --- sides without colours ---------------------------------------------------------------------------

    def _is_colourless(self, labels: IntArray) -> bool:
        """Returns whether most detections have no colour, of which the newest ones count most."""
        settings, unknown = self.settings, int((labels == UNKNOWN).sum())
        self._unknown = settings.remembered * self._unknown + unknown
        self._known = settings.remembered * self._known + len(labels) - unknown
        total = self._known + self._unknown
        return total >= settings.min_detections and self._unknown > settings.colourless * total

    def _sides(self, pose: Array, path: PathAhead) -> IntArray:
        """Returns the side (n,) of each near cone; it is unknown for those in neither row."""
        near, settings = self._cones, self.settings
        seen = np.flatnonzero(near.counts >= settings.sightings)
        sides = np.full(len(near.points), UNKNOWN)
        if len(seen) == 0:
            return sides
        stations, lateral = path.locate(near.points[seen])
        rows = {label: self._beginning(label, pose, path, seen, stations, lateral) for label in BOUNDARIES}
        taken = [cone for row in rows.values() for cone in row.cones]
        ahead = seen[stations > path.driven]
        votes = near.votes[:, ::-1] if self.swapped else near.votes
        follow_rows(rows, near.points, votes, np.setdiff1d(ahead, taken), settings)
        for label, row in rows.items():
            sides[row.cones] = label
        return sides

    def _beginning(
        self, label: int, pose: Array, path: PathAhead, seen: IntArray, stations: Array, lateral: Array
    ) -> Row:
        """Returns the row of a boundary beside the vehicle, where the path tells the side of each cone.

        Of cones beside one another, only the nearest to the path is in the row. The cones `seen` (k,) are at
        these stations and lateral distances (k,). A row without any cone begins beside the vehicle.
        """
        settings, side = self.settings, SIDES[label] * lateral
        found = (side > settings.min_lateral) & (side < settings.max_lateral)
        found &= (stations > path.driven - settings.behind) & (stations < path.driven + settings.sure)
        order = np.flatnonzero(found)[np.argsort(stations[found])]
        in_front = in_front_row(stations[order], side[order], settings.beside, settings.lateral_gap)
        cones = seen[order[in_front]].tolist()
        left = np.array([-np.sin(pose[2]), np.cos(pose[2])])
        row = Row([], pose[:2] + SIDES[label] * settings.half_width * left, float(pose[2]))
        for cone in cones[-2:]:
            row.lead_to(cone, self._cones.points[cone])
        if len(cones) < 2:
            row.heading = float(pose[2])
        row.cones = cones
        return row
