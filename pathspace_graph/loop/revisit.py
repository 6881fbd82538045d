"""Revisits: a drive that comes back to its road by another way is laid on the earlier pass.

A lap closes where it began (`mapping.registration`). The second round of a skidpad does not, nor does a lane
that leads into a circuit. There the cones of the last metres are laid on those seen in the earlier pass
(`front_end.scan_matching`), which gives a factor between two poses (`mapping.revisit`). The open map is
optimized with it as with a closed loop, but goes on to grow.
"""

from typing import Final

import numpy as np

from pathspace_graph.batch.association import path_lengths
from pathspace_graph.batch.start import unwrap
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.factors.se2 import compose, inverse, relative, rotation, to_map, to_vehicle
from pathspace_graph.front_end.scan_matching import ERRORS, REACHES, RecentDetections, match
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.registration import HEADING
from pathspace_graph.mapping.revisit import Revisit
from pathspace_graph.mapping.smoother import CurveSmoother

from .closing import SIGMA_STEP
from .drive_record import DriveRecord

ATTEMPTS: Final = 3.0  # least distance of two attempts (m along the path)
INTERVAL: Final = 15.0  # least distance from one revisit to the next (m along the path)
RETURN: Final = 30.0  # least length of the path between both passes (m)
RADIUS: Final = 4.0  # largest distance of both passes, as the map has them (m)
DIVERGED: Final = 8.0  # distance that the ways to the place must have had, as seen from the place (m)
WAY, WAY_STEP = 100.0, 4.0  # length of the ways that are compared, and the step at which they are (m)
NEWEST: Final = 8.0  # length of the newest path whose detections are laid on earlier ones (m)
ABOUT: Final = 12.0  # length of the earlier path, on each side of the place, that these are laid on (m)
MIN_DETECTIONS: Final = 25
MIN_SHARE: Final = 0.8  # least share of the detections that lie on earlier ones
MOST_MISFIT: Final = 3.0  # largest mean square of their whitened distances
MOST_DRIFT: Final = 1.2  # from where the map has the place (m): cones of a row are some 3 m apart


class Revisits:
    """The revisits of an open drive."""

    def __init__(self, smoother: CurveSmoother, path: DrivenPath, record: DriveRecord) -> None:
        self.found: list[Revisit] = []
        self._smoother, self._path, self._record = smoother, path, record
        self._next = RETURN

    def use(self) -> Array | None:
        """Look for a revisit, optimize the open map with it, and return the jump (3,) of the newest pose."""
        smoother, record, length = self._smoother, self._record, self._path.length
        if length < self._next or not smoother.keyframe_cycles or record.unsolvable is not None:
            return None
        self._next = length + ATTEMPTS
        poses = unwrap(np.array([*record.poses[: smoother.first_cycle], *smoother.variables.poses]))
        place = earlier_pass(poses)
        revisit = None if place is None else self._measured(poses, place)
        if revisit is None:
            return None
        self._next = length + INTERVAL
        self.found.append(revisit)
        before = smoother.variables.poses[-1].copy()
        keyframes = smoother.revisit(revisit.factor(), smoother.map.settings.closing.iterations, SIGMA_STEP)
        after = smoother.variables.poses[-1].copy()
        for one in smoother.attached:
            one.move(compose(after, inverse(before)))
        record.bent(keyframes, smoother)
        return np.asarray(after - before)

    def _measured(self, poses: Array, place: int) -> Revisit | None:
        """Return the oldest pose of the window, as seen from the keyframe next to an earlier place."""
        smoother, stations = self._smoother, path_lengths(poses)
        newest = stations > stations[-1] - NEWEST
        earlier, _ = self._scan(np.abs(stations - stations[place]) < ABOUT, poses)
        seen, variances = self._scan(newest, poses)
        if min(len(seen), len(earlier)) < MIN_DETECTIONS:
            return None
        known = RecentDetections()
        known.add(0.0, earlier, np.zeros((len(earlier), 2, len(ERRORS))), np.zeros(3))
        found = match(known, to_vehicle(seen, poses[-1:]), variances, poses[-1], REACHES)
        share = found.matched / len(found.is_matched)
        drift = float(np.hypot(*(found.pose - poses[-1])[:2]))
        if not (found.is_certain and share > MIN_SHARE and found.misfit < MOST_MISFIT and drift < MOST_DRIFT):
            return None
        keyframes = np.array(smoother.keyframe_cycles)
        first, later = int(keyframes[np.abs(keyframes - place).argmin()]), smoother.first_cycle
        information = found.information / newest.sum()  # the errors of a cone stay while it is passed
        moved = compose(found.pose, relative(poses[-1], poses[later]))
        return measured_revisit((first, poses[first]), (later, moved), found.pose, information)

    def _scan(self, of_cycles: BoolArray, poses: Array) -> tuple[Array, Array]:
        """Return all detections (m, 2) of cycles (P,), map frame, and the variance (m,) of a coordinate."""
        points, variances = [np.zeros((0, 2))], [np.zeros(0)]
        for cycle in np.flatnonzero(of_cycles).tolist():
            seen = self._record.seen(cycle, self._smoother.variables.sensor)
            points.append(to_map(seen.points_vehicle, poses[cycle][None]))
            variances.append(0.5 * np.trace(seen.covariances, axis1=1, axis2=2))
        return np.concatenate(points), np.concatenate(variances)


def earlier_pass(poses: Array) -> int | None:
    """Return the nearest cycle of the first earlier pass of the newest pose (P, 3), if another way led there.

    Where the ways to both passes never part, the drive has come by way of its start, as a lap does.
    """
    stations, newest = path_lengths(poses), poses[-1]
    near = np.hypot(*(poses[:, :2] - newest[:2]).T) < RADIUS
    near &= np.cos(poses[:, 2] - newest[2]) > np.cos(HEADING)
    near &= stations < stations[-1] - RETURN
    cycles = np.flatnonzero(near)
    for run in np.split(cycles, np.flatnonzero(np.diff(cycles) > 1) + 1) if len(cycles) else []:
        place = int(run[np.hypot(*(poses[run, :2] - newest[:2]).T).argmin()])
        if have_parted(poses, stations, place):
            return place
    return None


def have_parted(poses: Array, stations: Array, place: int) -> bool:
    """Return whether the ways to the newest of the poses (P, 3) and to an earlier place were apart."""
    back, ways = np.arange(0.0, min(float(stations[place]), WAY), WAY_STEP), []
    for cycle in (place, -1):
        at = stations[cycle] - back
        points = np.column_stack([np.interp(at, stations, poses[:, k]) for k in range(2)])
        ways.append(to_vehicle(points, poses[cycle][None]))
    return bool((np.hypot(*(ways[0] - ways[1]).T) > DIVERGED).any())


def measured_revisit(
    earlier: tuple[int, Array], later: tuple[int, Array], centre: Array, information: Array
) -> Revisit:
    """Return the pose of a later cycle in the frame of an earlier one, each a cycle and its pose (3,).

    The information (3, 3) is about a pose at `centre` (3,), in the map frame; the later pose moves with it.
    """
    (first, frame), (last, pose) = earlier, later
    arm, change = pose[:2] - centre[:2], np.eye(3)
    change[:2, 2] = -arm[1], arm[0]
    change[:2] = rotation(frame[2]).T @ change[:2]
    back = np.linalg.inv(change)
    root = np.linalg.cholesky(back.T @ information @ back).T
    return Revisit(first, last, relative(frame, pose), np.asarray(root))
