"""Association in a batch: poses along the curves, detections on curves and stations, and of cones."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.factors.se2 import path_lengths, to_map, to_vehicle
from pathspace_graph.graph.variables import Drives, Variables, pose_keys
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.mapping.detection_rows import CurveStations, Stations
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.mapping.path import LATERAL_GAP, ROW_BESIDE, SIDES, in_front_row
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.tracks import nearest_within
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import SAME_DIRECTION, ahead_of

DENSITY_STEP: Final = 0.1  # step of the sampled density of detections along a curve (m)
SEPARATION: Final = 0.6  # least distance of two cones along a curve, relative to `growth.merge_radius`
BANDWIDTH: Final = 0.4  # of the Gaussian that smooths the density, relative to that least distance
SHARP: Final = 0.6  # largest standard deviation of detections that place a cone (m)
SHARP_SHARE: Final = 0.1  # share of such detections below which all detections place cones
MIN_SHARE: Final = 0.1  # least size of a cone's cluster, relative to the median cluster
MIN_SHARE_BESIDE: Final = 0.3  # `MIN_SHARE` of a cluster of unused detections beside a curve
LINE_STEP: Final = 3.0  # distance of the points that replace the cones of a line (m)
ROW_CONES: Final = 4  # least number of cones of a curve; from fewer, none is removed
POSE_STEP: Final = 1.0  # step of the curve in the search of the point nearest to a pose (m along the curve)
DIRECTION_PENALTY: Final = 100.0  # distance added in quadrature where the curve runs against a heading (m)
FOOT_ROOM: Final = 1.5  # room in which the foot point of a cone is searched (m along the curve)
PASS_STRETCH: Final = 5.0  # largest distance of a cone from the poses that pass it (m along the curve)
COURSE: Final = 2.0  # stretch of a drive that gives its direction (m)
POSE_ROOM: Final = (
    2.0  # largest excess of the distance of two poses along an open curve over the driven one (m)
)
NEAREST: Final = 8  # number of a curve's samples that are nearest to a pose, before all of them are searched
FOLD_COSINE: Final = 0.5  # a row folds back where the cosine of its turn is below minus this
FOLD_DISTANCE: Final = (
    1.5  # distance from its nearer neighbour below which a cone at a fold is a duplicate (m)
)


# --- poses along the curves ------------------------------------------------------------------------------


def add_drive(state: State, poses: Array, calibration: Array) -> None:
    """Add the poses (P, 3) of all cycles to a state that already has its curves."""
    insert_drive(state.variables, calibration, poses)
    locate_poses(state)


def insert_drive(variables: Variables, calibration: Array, poses: Array) -> None:
    """Insert the calibration, (2,) or (7,), and the poses (P, 3) of a whole log as variables."""
    variables.insert_calibrations(calibration)
    variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())


def locate_poses(state: State) -> None:
    """Set `pose_u`, the parameter of the nearest point of each curve in the direction of each pose.

    A vehicle faces along the road, or moves along it while it spins. The parameter increases from lap to lap
    on a closed curve. On an open curve, which may have drifted over itself, it follows the driven path.
    """
    poses, heads = state.poses, headings(state.poses)
    courses = np.concatenate([courses_of(poses[part]) for part in state.drives.parts(len(poses))])
    for label, boundary in state.boundaries.items():
        count = int(np.ceil(boundary.length / POSE_STEP))
        u = boundary.tables.low + boundary.length * (np.arange(count) + 0.5) / count
        position, tangent = (boundary.evaluate(state.control_points(label), u, order) for order in (0, 1))
        tangent /= np.maximum(np.hypot(*tangent.T), np.finfo(float).tiny)[:, None]

        def against(i: IntArray, j: IntArray, tangent: Array = tangent) -> Array:
            """Penalty (m^2) of samples j of the curve that run along neither of the ways of poses i."""
            alike = ((way[i] * tangent[j]).sum(axis=-1) for way in (heads, courses))
            return np.where(np.maximum(*alike) < SAME_DIRECTION, DIRECTION_PENALTY**2, 0.0)

        if boundary.periodic:
            near = nearest_by(poses[:, :2], position, against)
            state.pose_u[label] = _from_lap_to_lap(u[near], boundary.length, state.drives)
        else:
            square = cdist(poses[:, :2], position, "sqeuclidean")
            square += against(*np.ogrid[: len(poses), :count])
            driven = np.hypot(*np.diff(poses[:, :2], axis=0).T) + POSE_ROOM
            driven[state.drives.begins(len(poses))] = boundary.length
            state.pose_u[label] = u[_along(square, driven * count / boundary.length)]


Penalty = Callable[[IntArray, IntArray], Array]
"""Penalty (m^2, not negative) of known points j for points i, given by indices that are broadcast."""


def nearest_by(points: Array, known: Array, penalty: Penalty) -> IntArray:
    """Return the index (m,) of the known point (n, 2) of least squared distance and penalty from each point.

    The nearest few decide, or all where these cannot.
    """
    few = np.arange(1, min(NEAREST, len(known)) + 1)
    distance, near = map(np.asarray, KDTree(known).query(points, few))
    rows = np.arange(len(points))
    square = distance**2 + penalty(rows[:, None], near)
    best = square.argmin(axis=1)
    nearest = np.asarray(near[rows, best], np.intp)
    others = np.flatnonzero(square[rows, best] > distance[:, -1] ** 2)
    square = cdist(points[others], known, "sqeuclidean") + penalty(others[:, None], np.arange(len(known)))
    nearest[others] = square.argmin(axis=1)
    return nearest


def _from_lap_to_lap(u: Array, length: float, drives: Drives) -> Array:
    """Unwrap parameters (P,) to increase from lap to lap, and from drive to drive by whole laps."""
    parts, last = list[Array](), -np.inf
    for part in drives.parts(len(u)):
        own = np.unwrap(u[part], period=length)
        if parts:
            own = own + length * np.ceil((last - own[0]) / length)
        parts.append(own)
        last = float(own[-1])
    return np.concatenate(parts)


def _along(square: Array, steps: Array) -> IntArray:
    """Choose the samples (P,) beside the poses with the least total squared distance (P, n).

    From pose k to the next, the sample changes by at most `steps[k]` (P - 1,). Dynamic programming.
    """
    total, reach = square.copy(), np.ceil(steps).astype(np.intp)
    for k in range(1, len(total)):
        padded = total[k - 1].take(np.arange(-reach[k - 1], total.shape[1] + reach[k - 1]), mode="clip")
        total[k] += sliding_window_view(padded, 2 * int(reach[k - 1]) + 1).min(axis=1)
    samples = np.empty(len(total), np.intp)
    samples[-1:] = total[-1:].argmin(axis=1)
    for k in range(len(total) - 1, 0, -1):
        low = max(samples[k] - reach[k - 1], 0)
        samples[k - 1] = low + total[k - 1, low : samples[k] + reach[k - 1] + 1].argmin()
    return samples


def headings(poses: Array) -> Array:
    """Unit vectors (m, 2) of the headings of poses (m, 3)."""
    return np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])


def courses_of(poses: Array) -> Array:
    """Unit vectors (m, 2) of the directions in which a drive with poses (m, 3) moves, over `COURSE` metres.

    Zero for a drive that stands.
    """
    driven = path_lengths(poses)
    before, after = driven - 0.5 * COURSE, driven + 0.5 * COURSE
    x, y = (np.interp(after, driven, p) - np.interp(before, driven, p) for p in poses[:, :2].T)
    return np.asarray(np.column_stack([x, y]) / np.maximum(np.hypot(x, y), np.finfo(float).tiny)[:, None])


# --- detections on the curves ----------------------------------------------------------------------------


def associate(
    state: State, detections: DetectionTable, settings: MapperSettings, gate: float, strict: bool
) -> None:
    """Associate all detections again; a detection within `gate` sigmas of its curve is used.

    It is searched on the stretch of the curve that its pose sees. Only when the curves are about right
    (`strict`), a detection without a match there is searched on the whole of a closed curve, since the sensor
    sees across the infield, and a detection of unknown colour goes to the curve that fits better. An open
    curve may have drifted from itself by more than the gate.
    """
    boundary_of, u = np.full(len(detections), UNKNOWN), detections.u.copy()
    for whole in (False, True) if strict else (False,):
        unexplained = boundary_of == UNKNOWN
        best = np.full(len(detections), gate)
        for label, boundary in state.boundaries.items():
            if whole and not boundary.periodic:
                continue
            possible = (detections.label == label) | (strict & (detections.label == UNKNOWN))
            rows = np.flatnonzero(unexplained & possible)
            misfit, foot_u = _misfit(state, detections, settings, label, rows, whole)
            nearer = misfit < best[rows]
            rows = rows[nearer]
            best[rows], boundary_of[rows], u[rows] = misfit[nearer], label, foot_u[nearer]
    detections.release(np.arange(len(detections)))
    used = np.flatnonzero(boundary_of != UNKNOWN)
    detections.take(used, boundary_of[used], u[used])


def _misfit(
    state: State,
    detections: DetectionTable,
    settings: MapperSettings,
    label: int,
    rows: IntArray,
    whole: bool,
) -> tuple[Array, Array]:
    """Return the distances (m,) of rows (m,) from a curve, in sigmas, and the foot points u (m,).

    The distance is infinite if the detection cannot belong to the curve. `whole` searches the whole curve.
    """
    boundary, control_points = state.boundaries[label], state.control_points(label)
    poses = state.variables.poses_at(detections.cycle[rows])
    points = to_map(detections.point[rows], poses)
    if whole:
        foot = boundary.find_anywhere(control_points, points)
    else:
        in_view = _in_view(state, detections.cycle[rows], label, settings)
        begin = boundary.find(control_points, points, *in_view).u
        foot = boundary.refine(control_points, points, begin)  # the foot point may lie slightly beyond
    sigma_model = settings.spline.sigma_model
    sigma = sigma_across(foot.normal_unit, detections.covariance[rows], poses, sigma_model)
    possible = foot.interior & (np.abs(foot.distance) < settings.gate.rough)
    if boundary.periodic and not whole:  # drop a detection if another stretch of the curve is nearer
        room = settings.growth.merge_radius
        far = np.flatnonzero(possible & (np.abs(foot.distance) >= room))
        nearest = boundary.find_anywhere(control_points, points[far])
        distance = np.hypot(*(points[far] - nearest.position).T) + room
        possible[far] = ~nearest.interior | (np.abs(foot.distance[far]) < distance)
    return np.where(possible, np.abs(foot.distance) / sigma, np.inf), foot.u


def _in_view(state: State, cycles: IntArray, label: int, settings: MapperSettings) -> tuple[Array, Array]:
    """Return the limits of the stretches (m,) of a curve that the poses of cycles (m,) see."""
    boundary, u = state.boundaries[label], state.pose_u[label][cycles]
    ends = (-np.inf, np.inf) if boundary.periodic else (boundary.tables.low, boundary.tables.high)
    return np.clip(u - settings.gate.view_behind, *ends), np.clip(u + settings.gate.view_ahead, *ends)


# --- cones of a curve ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Cones:
    """Cones of a boundary in driving order."""

    points: Array  # (k, 2) weighted means of the detections in m, map frame
    u: Array  # (k,) parameters along the curve or path (m)
    count: IntArray  # (k,) numbers of detections

    def where(self, chosen: BoolArray | IntArray) -> "Cones":
        """Select cones, in the given order if by index."""
        return Cones(self.points[chosen], self.u[chosen], self.count[chosen])

    def merged(self, other: "Cones") -> "Cones":
        """Merge with other cones, ordered by parameter."""
        u = np.append(self.u, other.u)
        both = Cones(np.concatenate([self.points, other.points]), u, np.append(self.count, other.count))
        return both.where(np.argsort(u, kind="stable"))


def cones_of_curve(state: State, detections: DetectionTable, label: int, settings: MapperSettings) -> Cones:
    """Find the cones of a boundary that has a curve.

    A cone that is often detected beside the curve, but too far for its gate, counts as well: the curve cuts a
    corner there. The cones of a closed curve are in the order in which the vehicle passed them. A line has no
    cones; means of its detections around equally distant points replace them.
    """
    boundary, begin = state.boundaries[label], first_parameter(state, label)
    rows = np.flatnonzero(detections.label == label)
    sigma = np.sqrt(0.5 * np.trace(detections.covariance[rows], axis1=1, axis2=2))
    if (sigma < SHARP).sum() >= SHARP_SHARE * len(rows):  # far detections are smeared
        rows = rows[sigma < SHARP]
    cycles, covariances = detections.cycle[rows], detections.covariances_map(rows, state.variables)
    points = to_map(detections.point[rows], state.variables.poses_at(cycles))
    used = detections.used[rows] & (detections.boundary[rows] == label)
    beside, on_curve, u = used.copy(), used.copy(), detections.u[rows].copy()
    beside[~used], on_curve[~used], u[~used] = _beside(state, points[~used], cycles[~used], label, settings)
    u = np.mod(u - begin, boundary.length) if boundary.periodic else u - begin

    def along(chosen: BoolArray | IntArray) -> tuple[Array, Array, Array, float, bool, MapperSettings]:
        return points[chosen], u[chosen], covariances[chosen], boundary.length, boundary.periodic, settings

    if settings.of_lines:
        return points_along(*along(on_curve))
    cones = cluster(*along(on_curve))
    if len(cones.u) == 0:
        return cones
    others = np.flatnonzero(beside & ~on_curve)
    near = nearest_within(points[others], cones.points, settings.growth.merge_radius)[1]
    off_curve = cluster(*along(others[~near]))
    cones = cones.merged(off_curve.where(off_curve.count >= MIN_SHARE_BESIDE * np.median(cones.count)))
    if boundary.periodic:
        longest = state.drives.longest(len(state.poses))
        poses, pose_u = state.poses[longest], state.pose_u[label][longest]
        lap = pose_u > pose_u[-1] - boundary.length  # the last one
        u, pose_u = cones.u + begin, pose_u[lap]

        def apart(i: IntArray, j: IntArray) -> Array:
            """Penalty (m^2) of poses j beside another stretch of the curve than that of cones i."""
            away = np.abs(ahead_of(pose_u[j], u[i], boundary.length))
            return np.where(away >= PASS_STRETCH, DIRECTION_PENALTY**2, 0.0)

        cones = along_drive(cones, poses[lap], apart, label)
    if len(detections.drives) > 1:
        cones = cones.where(seen_by_most(state, label, cones, points, cycles, settings))
    return without_folds(cones, boundary.periodic)


def seen_by_most(
    state: State, label: int, cones: Cones, points: Array, cycles: IntArray, settings: MapperSettings
) -> BoolArray:
    """Whether at least half of the drives that passed a cone (k,) have detected it.

    points (m, 2) are the detections of the boundary, map frame, made in cycles (m,).
    """
    u = first_parameter(state, label) + cones.u
    boundary, drive, growth = state.boundaries[label], state.drives.of(cycles), settings.growth
    seen, passed = np.zeros(len(u)), np.zeros(len(u))
    for d, part in enumerate(state.drives.parts(len(state.poses))):
        pose_u = state.pose_u[label][part]
        apart = ahead_of(pose_u, u[:, None], boundary.length) if boundary.periodic else u[:, None] - pose_u
        passes = np.abs(apart).min(axis=1) < PASS_STRETCH
        own, radius = KDTree(points[drive == d]), growth.merge_radius
        near = own.query_ball_point(cones.points, radius, return_length=True)
        passed += passes
        seen += passes & (near >= growth.sightings)
    return np.asarray(2.0 * seen >= passed)


def first_parameter(state: State, label: int) -> float:
    """Parameter of a curve at which the parameters of its cones begin."""
    boundary = state.boundaries[label]
    return float(state.pose_u[label][0]) if boundary.periodic else boundary.tables.low


def feet_of_cones(state: State, cones: Cones, label: int) -> FootPoints:
    """Foot points of a boundary's cones on its curve, near their places along it."""
    boundary, u = state.boundaries[label], first_parameter(state, label) + cones.u
    return boundary.find(state.control_points(label), cones.points, u - FOOT_ROOM, u + FOOT_ROOM)


def along_drive(cones: Cones, lap: Array, apart: Penalty, label: int) -> Cones:
    """Select the cones of the row nearest to the poses (l, 3) of a lap, in the order in which these pass it.

    `apart` is the penalty of poses beside another stretch of the curve than a cone: if one row bounds two
    lanes, the poses of the other lane may be nearer. A cone behind the row belongs to another stretch, or is
    smeared between two rows by far detections.
    """
    nearest = nearest_by(cones.points, lap[:, :2], apart)
    ahead, left = to_vehicle(cones.points, lap[nearest]).T
    station, side = path_lengths(lap)[nearest] + ahead, SIDES[label] * left
    front = in_front_row(station, side, ROW_BESIDE, LATERAL_GAP)
    order = np.argsort(station, kind="stable")
    return cones.where(order[front[order]])


def _beside(
    state: State, points: Array, cycles: IntArray, label: int, settings: MapperSettings
) -> tuple[BoolArray, BoolArray, Array]:
    """Return whether points (m, 2) lie beside a curve, whether around its end, and foot points u (m,)."""
    boundary, control_points = state.boundaries[label], state.control_points(label)
    if boundary.periodic:
        foot = boundary.find_anywhere(control_points, points)
    else:
        foot = boundary.find(control_points, points, *_in_view(state, cycles, label, settings))
    distance = np.hypot(*(points - foot.position).T)
    beside = foot.interior & (distance < settings.gate.rough)
    return beside, ~foot.interior & (distance < settings.growth.merge_radius), foot.u


def without_folds(cones: Cones, periodic: bool) -> Cones:
    """Remove duplicate cones, at which the row folds back on itself over a short distance."""
    points = cones.points
    if len(points) < ROW_CONES:
        return cones
    into, out = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*into.T), np.hypot(*out.T)
    cosine = (into * out).sum(axis=1) / np.maximum(lengths[0] * lengths[1], np.finfo(float).tiny)
    folded = (cosine < -FOLD_COSINE) & (np.minimum(*lengths) < FOLD_DISTANCE)
    if not periodic:
        folded[[0, -1]] = False
    return without_folds(cones.where(~folded), periodic) if folded.any() else cones


# --- clustering ------------------------------------------------------------------------------------------


def cluster(
    points: Array, u: Array, covariances: Array, length: float, periodic: bool, settings: MapperSettings
) -> Cones:
    """Place a cone at each peak of the density of detections (m, 2) along a curve or a path.

    u (m,) in [0, length] are their parameters (m). Their weights are the inverse traces of their covariances
    (m, 2, 2), map frame. A cone has at least `growth.sightings` detections within the merge radius of its
    peak. It stands at their mean, weighted by the inverse covariances.
    """
    radius, weight = settings.growth.merge_radius, 1.0 / np.trace(covariances, axis1=1, axis2=2)
    peaks = _peaks(u, weight, length, periodic, SEPARATION * radius)
    return _about(peaks, radius, points, u, covariances, length, periodic, settings)


def points_along(
    points: Array, u: Array, covariances: Array, length: float, periodic: bool, settings: MapperSettings
) -> Cones:
    """Means of detections (m, 2) of a line around points that are `LINE_STEP` apart."""
    count = max(int(length / LINE_STEP), 1)
    places = length * (np.arange(count) + 0.5) / count
    return _about(places, 0.5 * length / count, points, u, covariances, length, periodic, settings)


def _about(
    peaks: Array,
    radius: float,
    points: Array,
    u: Array,
    covariances: Array,
    length: float,
    periodic: bool,
    settings: MapperSettings,
) -> Cones:
    """Weighted means of detections (m, 2) within a radius (m) of peaks (k,) along a curve."""
    if len(peaks) == 0:
        return Cones(np.zeros((0, 2)), peaks, np.zeros(0, np.intp))
    after = peaks.searchsorted(u)
    beside = np.sort([(after - 1) % len(peaks), after % len(peaks)], axis=0)  # the first of two as near
    distance = np.abs(u - peaks[beside])
    if periodic:
        distance = np.minimum(distance, length - distance)
    inside = distance.min(axis=0) < radius
    member = beside[distance.argmin(axis=0), np.arange(len(u))][inside]
    count = np.bincount(member, minlength=len(peaks))
    enough = count >= max(settings.growth.sightings, MIN_SHARE * float(np.median(count)))
    information, vector = np.zeros((len(peaks), 2, 2)), np.zeros((len(peaks), 2))
    inverse = np.linalg.inv(covariances[inside])
    np.add.at(information, member, inverse)
    np.add.at(vector, member, np.einsum("mij,mj->mi", inverse, points[inside]))
    means = np.asarray(np.linalg.solve(information[enough], vector[enough][:, :, None]))[:, :, 0]
    return without_folds(Cones(means, peaks[enough], count[enough]), periodic)


def _peaks(u: Array, weight: Array, length: float, periodic: bool, apart: float) -> Array:
    """Parameters (k,) of the maxima of the smoothed density, at least `apart` (m) from each other."""
    bins = max(int(np.ceil(length / DENSITY_STEP)), 1)
    step = length / bins
    density = np.bincount((u / step).astype(np.intp).clip(0, bins - 1), weight, bins)
    reach = round(apart / step)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / (BANDWIDTH * apart)) ** 2)
    padded = np.pad(density, reach, "wrap" if periodic else "constant")
    smooth = np.convolve(padded, kernel, "same")
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(smooth, reach), 2 * reach + 1)
    highest = (smooth > 0.0) & (smooth >= windows.max(axis=1))
    return np.asarray((np.flatnonzero(highest[reach : reach + bins]) + 0.5) * step, np.float64)


# --- stations of closed curves ---------------------------------------------------------------------------


SIGMA_STATION: Final = (
    0.02  # standard deviation of a cone along a curve with a control point for each cone (m)
)


def cone_stations(state: State, detections: DetectionTable, settings: MapperSettings) -> Stations | None:
    """Stations of closed curves: the cones of the first drive's first lap, and later ones in its gaps.

    None if a curve has too few cones, or detections are of lines. A lap misses its beginning by some
    decimetres, which would smear the cones of both ends and match a later lap to neighbours. So the first lap
    places the cones; revisits have aligned the later ones.
    """
    if settings.of_lines:
        return None
    places = {}
    for label, boundary in state.boundaries.items():
        laps = laps_of_detections(state, detections, label)
        first = detections.where(np.flatnonzero(laps <= 0)).of_drive(0)
        cones = cones_of_curve(state, first, label, settings)
        if len(cones.u) < ROW_CONES:
            return None
        u = feet_of_cones(state, cones, label).u
        later = feet_of_cones(state, cones_of_curve(state, detections, label, settings), label).u
        low, high = boundary.tables.low, boundary.tables.high
        known = CurveStations.of(label, 0, u, np.zeros(len(u)), (low, high))
        u = np.append(u, later[np.abs(known.nearest(later)[1]) > np.median(known.apart)])
        places[label] = np.column_stack([u, np.full(len(u), SIGMA_STATION)])
    return Stations.of(state, places)


def laps_of_detections(state: State, detections: DetectionTable, label: int) -> IntArray:
    """Lap (m,) on a closed curve in which each detection's foot point was passed, from 0."""
    pose_u, length = state.pose_u[label], state.boundaries[label].length
    at = pose_u[detections.cycle]
    ahead = ahead_of(at, detections.u, length)
    return np.asarray(np.floor((at + ahead - pose_u[0]) / length), np.intp)
