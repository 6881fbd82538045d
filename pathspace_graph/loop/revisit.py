"""Places that are met again while the loop is open: by another way, or after a lap, by its shape.

A lap closes where it began. The second round of a skidpad does not, nor does a lane that leads into a
circuit. There the cones of the last metres are laid on those of the earlier pass
(`mapping.constellation`), which gives a factor between two poses (`graph.relative:Revisit`). The open map
is optimized with it as with a closed loop, but goes on to grow.

After a long lap the vehicle may be anywhere along the first few hundred metres, and the detections of the
last seconds agree with any place along a straight there. The bends in the newest stretch of the curves tell
the place.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pathspace_graph.batch.start import REVISIT_INTERVAL
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import (
    compose,
    inverse,
    left_of,
    path_lengths,
    rotations,
    to_vehicle,
    wrap_angle,
)
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.changes import solve_revisit
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.constellation import NEARBY, SeenIn, lay_newest, revisit_of
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import (
    BEGINNING_SHARE,
    HEADING,
    START_CHI2,
    START_STEP,
    Motion,
    RefinedMotion,
    Registration,
    Sightings,
    by_motion,
    is_lost,
    sigma_of_information,
)
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import ClosingSettings

from .closing import SIGMA_STEP
from .drive_record import DriveRecord

REVISIT_ATTEMPTS: Final = 3.0  # least distance of two attempts (m along the path)
RETURN: Final = 30.0  # least length of the path between both passes (m)
RADIUS: Final = 4.0  # largest distance of both passes, as the map has them (m)
DIVERGED: Final = 8.0  # distance that the ways to the place must have had, as seen from the place (m)
WAY, WAY_STEP = 100.0, 4.0  # length of the ways that are compared, and the step at which they are (m)


class Revisits(Copyable):
    """The search for road of an open drive that is met again."""

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self._next = RETURN  # path (m) from which on the next one is looked for

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return a new revisit, if it is time to look for one, and the window's oldest pose has one."""
        smoother, length = road.smoother, road.path.length
        if length < self._next or record.unsolvable is not None:
            return None
        if smoother.submaps is None or not smoother.submaps.keyframes:
            return None
        self._next = length + REVISIT_ATTEMPTS
        poses = record.with_window(road)
        place = earlier_pass(poses)
        seen_in = record.seen_in(smoother.variables.sensor, noise)
        revisit = None if place is None else self._measured(smoother, seen_in, poses, place)
        if revisit is not None:
            self._next = length + REVISIT_INTERVAL
        return revisit

    def _measured(self, smoother: CurveSmoother, seen_in: SeenIn, poses: Array, place: int) -> Revisit | None:
        """Return the oldest pose of the window, as seen from the keyframe next to an earlier place."""
        laid = lay_newest(seen_in, poses, place, NEARBY, self.settings.growth)
        if laid is None or not laid.is_sure:
            return None
        keyframes = np.array(smoother.keyframe_cycles)
        earlier = int(keyframes[np.abs(keyframes - place).argmin()])
        return revisit_of(laid, poses, earlier, smoother.first_cycle)


def lay_on(road: Road, record: DriveRecord, revisit: Revisit) -> Array:
    """Optimize an open map with a revisit, and return the jump (3,) of the newest pose."""
    before = road.poses[-1].copy()
    iterations = road.settings.closing.iterations
    keyframes = solve_revisit(road.smoother, revisit.factor(), iterations, SIGMA_STEP)
    after = road.poses[-1].copy()
    road.move(compose(after, inverse(before)))
    record.bent(keyframes, road)
    return np.asarray(after - before)


def earlier_pass(poses: Array) -> int | None:
    """Return the nearest cycle of the first earlier pass of the newest pose (P, 3), if another way led there.

    Where the ways to both passes never part, the drive has come by way of its start, as a lap does.
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
    """Return whether the ways to the newest of the poses (P, 3) and to an earlier place were apart."""
    back, ways = np.arange(0.0, min(float(stations[place]), WAY), WAY_STEP), []
    for cycle in (place, -1):
        at = stations[cycle] - back
        points = np.column_stack([np.interp(at, stations, poses[:, k]) for k in range(2)])
        ways.append(to_vehicle(points, poses[cycle][None]))
    return bool((np.hypot(*(ways[0] - ways[1]).T) > DIVERGED).any())


# --- the recognition of a place --------------------------------------------------------------------------

STRETCH: Final = 150.0  # length at the end of the curves that is registered (m): its bends tell the place
STRETCH_ROOM: Final = 10.0  # beyond the ends of the earlier stretch in which foot points are searched (m)
SIGMAS_BENT: Final = (1.5, 1.5, 0.15)  # of the newest pose in the stretch behind it (m, m, rad)
STRETCHES: Final = 6  # most earlier stretches, alike in their turns, that it is registered with


def recognize(smoother: CurveSmoother) -> RefinedMotion | None:
    """Return the motion of `find_place`; None if there is none, or the vehicle is not lost.

    The newest stretch was laid as it is, but odometry has bent it, so the covariance is wider.
    """
    settings, track = smoother.map.settings.closing, smoother.map
    if set(track.state.boundaries) != set(BOUNDARIES) or not may_tell_place(track.state, settings):
        return None
    smoother.transform_to_origin()
    covariance = smoother.newest_covariance()
    found = find_place(track, covariance, settings) if is_lost(covariance, settings) else None
    return found and replace(found, covariance=found.covariance + np.diag(SIGMAS_BENT) ** 2)


def may_tell_place(state: State, settings: ClosingSettings) -> bool:
    """Return whether a lap lies between an earlier stretch and the newest one, and this may tell a place.

    Laid on itself, the newest stretch must hold the vehicle in every direction, as no straight does.
    """
    end = min(boundary.confirmed_end for boundary in state.boundaries.values())
    if not STRETCH < BEGINNING_SHARE * end < end - STRETCH - settings.min_path:
        return False
    stretch, centre = newest_stretch(state), state.poses[-1, :2]
    rows = np.concatenate([by_motion(normals, cones - centre) for cones, normals in stretch.values()])
    rows /= settings.sigma_reading
    return sigma_of_information(rows.T @ rows) <= settings.sigma_max


def find_place(track: CurveMap, covariance: Array, settings: ClosingSettings) -> RefinedMotion | None:
    """Return the only motion by which the newest stretch of the curves lies on an earlier stretch.

    It is searched for within the `covariance` (3, 3) of the newest pose. None if no place agrees, if several
    do, or if the place along the track is uncertain.
    """
    state = track.state
    newest = {label: cones for label, (cones, _) in newest_stretch(state).items()}
    centre = state.poses[-1, :2].copy()
    # a lap away the heading turns the position on an arc, which correlations follow only for small angles
    variance = np.linalg.eigvalsh(covariance[:2, :2])[-1]
    wide = np.diag([variance, variance, covariance[2, 2]])
    prior = np.asarray(np.linalg.inv(wide * settings.prior_scale**2), np.float64)
    found: RefinedMotion | None = None
    for vector, low in _starts(state, prior, settings):
        place = _register(state, newest, Motion(centre, vector), low, prior, settings)
        if place is None:
            continue
        if found is None:
            found = place
        elif np.hypot(*(place.motion.vector - found.motion.vector)[:2]) >= settings.overlap:
            return None  # two places are enough
    return found


def newest_stretch(state: State) -> dict[int, tuple[Array, Array]]:
    """Return the confirmed cones (k, 2) on the last `STRETCH` metres of each curve, and the normals there."""
    found = {}
    for label, boundary in state.boundaries.items():
        u, points = boundary.cone_parameters, state.control_points(label)
        chosen = u[(u > boundary.confirmed_end - STRETCH) & (u <= boundary.confirmed_end)]
        tangents = boundary.evaluate(points, chosen, 1)
        tangents /= np.hypot(tangents[:, :1], tangents[:, 1:])
        found[label] = boundary.evaluate(points, chosen), left_of(tangents)
    return found


def _starts(state: State, prior: Array, settings: ClosingSettings) -> list[tuple[Array, float]]:
    """Return motions (3,) onto earlier stretches that turn as the newest one does, most similar first.

    Each goes with the parameter at which the earlier stretch of the first boundary begins. The headings along
    both stretches are compared, after a common turn.
    """
    (label, boundary), step = next(iter(state.boundaries.items())), START_STEP
    u = np.arange(boundary.confirmed_end % step, boundary.confirmed_end, step)
    points, tangents = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
    headings = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    count, last = int(STRETCH / step), int(BEGINNING_SHARE * len(points))
    turns = sliding_window_view(headings[:last], count) - headings[-count:]
    places = sliding_window_view(points[:last], count, axis=0).mean(axis=2)
    turn, unlike = turns.mean(axis=1), turns.std(axis=1)
    centre, middle = state.poses[-1, :2], points[-count:].mean(axis=0)
    turned = rotations(turn) @ (middle - centre) + centre
    motions = np.column_stack([places - turned, wrap_angle(turn)])
    possible = np.einsum("ij,jk,ik->i", motions, prior, motions) < START_CHI2
    best = _minima(np.where(possible, unlike, np.inf), int(settings.overlap / step))[:STRETCHES]
    return [(motions[i], float(step * i)) for i in best]


def _minima(values: Array, apart: int) -> list[int]:
    """Return the indices of finite values that are the least of all that are as near as `apart`."""
    padded = np.pad(values, apart, constant_values=np.inf)
    least = sliding_window_view(padded, 2 * apart + 1).min(axis=1)
    found = np.flatnonzero(np.isfinite(values) & (values == least))
    return list(found[np.argsort(values[found])])


def _register(
    state: State, newest: dict[int, Array], start: Motion, low: float, prior: Array, settings: ClosingSettings
) -> RefinedMotion | None:
    """Return the motion of the newest cones, registered from a start whose first boundary begins at `low`."""
    first, boundary = next(iter(state.boundaries.items()))
    corners = boundary.evaluate(state.control_points(first), np.array([low, low + STRETCH]))
    stretches = {label: _between(state, label, corners) for label in state.boundaries}
    points = np.concatenate([*newest.values()])
    labels = np.repeat([*newest], [len(cones) for cones in newest.values()])
    seen = Sightings.of_points(np.arange(len(points)), labels, points)
    found = Registration(state, seen, stretches, settings).refine(start, np.zeros(3), prior)
    shares = [len(found.matches.inliers(b)[0]) / max(len(cones), 1) for b, cones in newest.items()]
    sigma = sigma_of_information(found.matches.hessian)
    is_there = min(shares) >= settings.inlier_share and sigma <= settings.sigma_max
    return found if is_there else None


def _between(state: State, label: int, corners: Array) -> tuple[float, float]:
    """Return the parameters of the stretch of a boundary between two points (2, 2), and some room."""
    boundary = state.boundaries[label]
    high = np.full(len(corners), BEGINNING_SHARE * boundary.confirmed_end)
    u = boundary.find(state.control_points(label), corners, np.zeros(len(corners)), high).u
    return max(float(u[0]) - STRETCH_ROOM, 0.0), float(u[1]) + STRETCH_ROOM
