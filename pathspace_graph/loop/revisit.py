"""Place recognition on an open road: by cones after another way there, or by shape after a lap.

A lap closes where it began, but the second round of a skidpad does not, nor does a lane that leads into a
circuit. There the cones of the last metres are registered to those of the earlier pass
(`mapping.constellation`), which gives a factor between two poses (`graph.relative:Revisit`). The open map is
optimized with it as with a closed loop, and continues to grow.

After a long lap the vehicle may be anywhere along the first few hundred metres, and the detections of the
last seconds fit any place along a straight. The bends in the newest stretch of the curves identify the place.
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
    START_STEP,
    Motion,
    RefinedMotion,
    Registration,
    Sightings,
    are_possible,
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
        """Return a revisit by the oldest pose of the window, if an attempt is due and finds one."""
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
        """Return the oldest pose of the window relative to the keyframe nearest to an earlier place."""
        laid = lay_newest(seen_in, poses, place, NEARBY, self.settings.growth)
        if laid is None or not laid.is_sure:
            return None
        keyframes = np.array(smoother.keyframe_cycles)
        earlier = int(keyframes[np.abs(keyframes - place).argmin()])
        return revisit_of(laid, poses, earlier, smoother.first_cycle)


def lay_on(road: Road, record: DriveRecord, revisit: Revisit) -> Array:
    """Optimize an open map with a revisit; return the jump (3,) of the newest pose."""
    before = road.poses[-1].copy()
    iterations = road.settings.closing.iterations
    keyframes = solve_revisit(road.smoother, revisit.factor(), iterations, SIGMA_STEP)
    after = road.poses[-1].copy()
    road.move(compose(after, inverse(before)))
    record.bent(keyframes, road)
    return np.asarray(after - before)


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


# --- recognition by shape --------------------------------------------------------------------------------

STRETCH: Final = 150.0  # length of the registered stretch at the end of the curves (m)
STRETCH_ROOM: Final = 10.0  # search range of foot points beyond the ends of the earlier stretch (m)
SIGMAS_BENT: Final = (1.5, 1.5, 0.15)  # drift of the newest pose within its stretch (m, m, rad)
STRETCHES: Final = 6  # largest number of earlier stretches to register to, most similar first


def recognize(smoother: CurveSmoother) -> RefinedMotion | None:
    """Return the motion of `find_place`, or None if there is none or the pose is certain.

    The registration is rigid although odometry has bent the newest stretch, so the covariance is inflated.
    """
    settings, track = smoother.map.settings.closing, smoother.map
    if set(track.state.boundaries) != set(BOUNDARIES) or not is_recognizable(track.state, settings):
        return None
    smoother.transform_to_origin()
    covariance = smoother.newest_covariance()
    found = find_place(track, covariance, settings) if is_lost(covariance, settings) else None
    return found and replace(found, covariance=found.covariance + np.diag(SIGMAS_BENT) ** 2)


def is_recognizable(state: State, settings: ClosingSettings) -> bool:
    """Whether the newest stretch is a lap past the earlier ones and bends enough to fix a pose.

    Registered to itself, it must constrain the pose in every direction; a straight does not.
    """
    end = min(boundary.confirmed_end for boundary in state.boundaries.values())
    if not STRETCH < BEGINNING_SHARE * end < end - STRETCH - settings.min_path:
        return False
    stretch, centre = newest_stretch(state), state.poses[-1, :2]
    rows = np.concatenate([by_motion(normals, cones - centre) for cones, normals in stretch.values()])
    rows /= settings.sigma_reading
    return sigma_of_information(rows.T @ rows) <= settings.sigma_max


def find_place(track: CurveMap, covariance: Array, settings: ClosingSettings) -> RefinedMotion | None:
    """Register the newest stretch of the curves to an earlier one, within the pose's `covariance` (3, 3).

    None if no place agrees, if several do, or if the position along the track is uncertain.
    """
    state = track.state
    newest = {label: cones for label, (cones, _) in newest_stretch(state).items()}
    centre = state.poses[-1, :2].copy()
    # after a lap the heading moves the position on an arc, which correlations describe for small angles only
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
            return None  # the place is ambiguous
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
    """Return motions (3,) onto earlier stretches with similar turns, most similar first.

    Each comes with the first parameter of the earlier stretch on the first boundary. The similarity compares
    the headings along both stretches, up to a common turn.
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
    possible = are_possible(motions, prior)
    best = _minima(np.where(possible, unlike, np.inf), int(settings.overlap / step))[:STRETCHES]
    return [(motions[i], float(step * i)) for i in best]


def _minima(values: Array, apart: int) -> list[int]:
    """Return the indices of finite values that are minima within `apart` indices, least value first."""
    padded = np.pad(values, apart, constant_values=np.inf)
    least = sliding_window_view(padded, 2 * apart + 1).min(axis=1)
    found = np.flatnonzero(np.isfinite(values) & (values == least))
    return list(found[np.argsort(values[found])])


def _register(
    state: State, newest: dict[int, Array], start: Motion, low: float, prior: Array, settings: ClosingSettings
) -> RefinedMotion | None:
    """Register the newest cones from a start; the earlier stretch begins at `low` on the first boundary."""
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
    """Return the parameters of a boundary's stretch between two points (2, 2), widened by `STRETCH_ROOM`."""
    boundary = state.boundaries[label]
    high = np.full(len(corners), BEGINNING_SHARE * boundary.confirmed_end)
    u = boundary.find(state.control_points(label), corners, np.zeros(len(corners)), high).u
    return max(float(u[0]) - STRETCH_ROOM, 0.0), float(u[1]) + STRETCH_ROOM
