"""Road that is met again on an open road, after another way there.

A lap closes where it began, but the second round of a skidpad does not, nor does a lane that leads into a
circuit. There the cones of the last metres are registered to those of the earlier pass
(`places.passes`), which gives the relative pose of two cycles (`graph.relative:Revisit`).
"""

from typing import Final

import numpy as np

from pathspace_graph.batch.start import REVISIT_INTERVAL
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import path_lengths, to_vehicle
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.mapping.path import HEADING
from pathspace_graph.mapping.road import Road
from pathspace_graph.places.constellation import Prior
from pathspace_graph.places.passes import NEARBY, newest_place, revisit_of
from pathspace_graph.settings.mapper import MapperSettings

from .drive_record import DriveRecord

REVISIT_ATTEMPTS: Final = 3.0  # distance between attempts (m along the path)
RETURN: Final = 30.0  # least path length between both passes (m)
RADIUS: Final = 4.0  # largest distance between both passes in the map (m)
DIVERGED: Final = 8.0  # least separation of the ways to both passes, seen from the place (m)
WAY: Final = 100.0  # length of the compared ways (m)
WAY_STEP: Final = 4.0  # step of their points (m)


class Revisits(Copyable):
    """Search for road that an open drive revisits."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self._next = RETURN  # path length of the next attempt (m)

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the window's oldest pose relative to one of an earlier pass, if an attempt finds it.

        The newest pose will stay in the window, and the batch's marginal has no measurement of such a pose.
        """
        length = road.path.length
        if length < self._next or self.settings.of_lines:
            return None
        self._next = length + REVISIT_ATTEMPTS
        poses = record.with_window(road)
        place, later = earlier_pass(poses), road.smoother.first_cycle
        if place is None or place >= later:
            return None
        seen_in = record.seen_in(road.smoother.variables.sensor, noise)
        found = newest_place(seen_in, poses, place, Prior.about(poses[-1], *NEARBY), self.settings)
        if found is None:
            return None
        self._next = length + REVISIT_INTERVAL
        return revisit_of(found, poses, place, later)


def earlier_pass(poses: Array) -> int | None:
    """Return the nearest cycle of the first earlier pass by the newest of the poses (P, 3), if there is one.

    The ways to both passes must part: otherwise the drive came past its start, as in a lap.
    """
    newest = poses[-1]
    near = np.hypot(*(poses[:, :2] - newest[:2]).T) < RADIUS
    if path_lengths(poses[near.argmax() :])[-1] <= RETURN:
        return None  # only the newest poses are near
    stations = path_lengths(poses)
    near &= np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING)
    near &= stations < stations[-1] - RETURN
    cycles = np.flatnonzero(near)
    for run in np.split(cycles, np.flatnonzero(np.diff(cycles) > 1) + 1) if len(cycles) else []:
        place = int(run[np.hypot(*(poses[run, :2] - newest[:2]).T).argmin()])
        if have_parted(poses, stations, place):
            return place
    return None


def have_parted(poses: Array, stations: Array, place: int) -> bool:
    """Whether the ways to the newest of the poses (P, 3) and to an earlier one at `place` part."""
    back, ways = np.arange(0.0, min(float(stations[place]), WAY), WAY_STEP), []
    for cycle in (place, -1):
        at = stations[cycle] - back
        points = np.column_stack([np.interp(at, stations, poses[:, k]) for k in range(2)])
        ways.append(to_vehicle(points, poses[cycle][None]))
    return bool((np.hypot(*(ways[0] - ways[1]).T) > DIVERGED).any())
