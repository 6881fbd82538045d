"""The paper's filter: a joint Gaussian over pose and curves, propagated by the cubature rule.

The paper's transform is the third-degree spherical-radial rule (Arasaratnam and Haykin 2009). The state holds
the pose and the control points of clamped splines (paper: Expansion).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.linalg import block_diag, lapack

from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import clamped_knots, scatter
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.odometry import CALIBRATION_SIZE, IntegratedOdometry
from pathspace_graph.factors.residuals import greville, project, smoothness_matrix
from pathspace_graph.factors.sensor import SENSOR_SIZE, by_sensor, corrected
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import BOUNDARIES, UNKNOWN
from pathspace_graph.mapping import path
from pathspace_graph.mapping.motion import MeasuredMotion
from pathspace_graph.mapping.path import END_BEHIND, SIDES, Candidates, End, PathAhead, chain
from pathspace_graph.mapping.tracks import FORGET_AFTER, Tracks, nearest_within
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary, relocate
from pathspace_graph.spline.bspline import BSpline, end_change_matrix

_LEAST_VARIANCE: Final = 1e-12
"""Least eigenvalue of a covariance without a Cholesky factor, relative to the largest one."""


@dataclass(frozen=True, eq=False)
class Transformed:
    """Moments of a function of a Gaussian, by the cubature rule."""

    mean: Array  # (q,) mean of the function
    covariance: Array  # (q, q) covariance of the function
    slope: Array
    """(q, d) Statistical linearization `C_yx C_xx^-1`. The covariance of the function with a variable z that
    it does not depend on is `slope @ C_xz`, exactly for Gaussians."""


def square_root(covariance: Array) -> Array:
    """Lower L with `L L' = covariance` (d, d); small eigenvalues of a singular covariance are raised."""
    factor, info = lapack.dpotrf(covariance, lower=1, clean=1)
    if info == 0:
        return np.asarray(factor)
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    lifted = np.maximum(values, _LEAST_VARIANCE * max(float(values[-1]), _LEAST_VARIANCE))
    return np.asarray(np.linalg.qr((vectors * np.sqrt(lifted)).T)[1].T)


def transform(function: Callable[[Array], Array], mean: Array, covariance: Array) -> Transformed:
    """Compute mean, covariance and slope of `function`, which maps points (k, d) row by row to (k, q).

    Its 2 d points are `mean +- sqrt(d) L e_i`, of equal weight, where L is the root of the covariance. All
    are exact for a linear function; the mean is exact for a polynomial of the third degree.
    """
    root = square_root(covariance)
    d = len(mean)
    offsets = np.sqrt(d) * root.T
    values = function(np.concatenate([mean + offsets, mean - offsets]))
    centre = values.mean(axis=0)
    spread = (values - centre) / np.sqrt(2.0 * d)
    half = (values[:d] - values[d:]) / (2.0 * np.sqrt(d))
    slope, _ = lapack.dtrtrs(root, half, lower=1, trans=1)
    return Transformed(centre, spread.T @ spread, np.asarray(slope).T)


HEAD: Final = POSE + CALIBRATION_SIZE + SENSOR_SIZE  # number of entries of the state before its points
SENSOR_COLUMNS: Final = np.arange(POSE + CALIBRATION_SIZE, HEAD)  # entries of the sensor's calibration


class Belief:
    """Gaussian over `x = [pose | calibration of odometry and sensor | points]`.

    Pose (x, y, theta) and points (x, y) are in the map frame, in m and rad. The calibration is the scale
    error of the speeds, the bias of the yaw rate (rad/s), and `factors.sensor:SENSOR`. Only the entries of x
    that a model depends on get cubature points. The others follow by the joint covariance. The result is that
    of the full rule, without its cubic cost.
    """

    def __init__(self, pose: Array, covariance: Array, calibration_sigma: Array | None = None) -> None:
        sigma, known = np.zeros(HEAD - POSE), () if calibration_sigma is None else calibration_sigma
        sigma[: len(known)] = known
        self.mean: Array = np.concatenate([pose, np.zeros(HEAD - POSE)])  # (n,) mean of x
        self.covariance: Array = block_diag(covariance, np.diag(sigma**2))  # (n, n) covariance of x
        self.twist: Array = np.zeros(POSE)  # (3,) twist of the vehicle, in m/s, m/s and rad/s

    @property
    def pose(self) -> Array:
        """View of the mean pose (3,); theta is not wrapped."""
        return self.mean[:POSE]

    @property
    def points(self) -> Array:
        """View of the mean points (m, 2)."""
        return self.mean[HEAD:].reshape(-1, POINT)

    @property
    def sensor(self) -> Array:
        """View of the mean calibration of the sensor (5,)."""
        return self.mean[POSE + CALIBRATION_SIZE : HEAD]

    def corrected(self, detections: Detections) -> Detections:
        """Correct the newest detections by the mean calibration of the sensor."""
        points = detections.points_vehicle
        twists = np.tile(self.twist, (len(points), 1))
        return replace(detections, points_vehicle=corrected(points, twists, self.sensor))

    def by_sensor(self, points_vehicle: Array) -> Array:
        """Derivatives (m, 2, 5) of the newest detections (m, 2) by the sensor's calibration."""
        return by_sensor(points_vehicle, np.tile(self.twist, (len(points_vehicle), 1)))

    def follow(self, motion: MeasuredMotion) -> None:
        """Predict the pose by a motion, and update by a bias that was measured at rest."""
        self.predict(motion.odometry)
        if motion.bias is not None:
            measured, noise = np.array([motion.bias.value]), np.array([[motion.bias.sigma**2]])
            self.update(np.array([POSE + 1]), lambda x: x, measured, noise)

    def predict(self, odometry: IntegratedOdometry) -> None:
        """Predict `pose <- pose * delta * (error - J calibration)`; the error is that of the odometry."""
        drift, size, self.twist = odometry.calibration_jacobian, HEAD + POSE, odometry.twist
        augmented = np.zeros((size, size))
        augmented[:HEAD, :HEAD] = self.covariance[:HEAD, :HEAD]
        augmented[HEAD:, HEAD:] = odometry.covariance

        def drive(x: Array) -> Array:
            error = x[:, HEAD:] - x[:, POSE : POSE + CALIBRATION_SIZE] @ drift.T
            return se2.compose(se2.compose(x[:, :POSE], odometry.delta), error)

        moved = transform(drive, np.append(self.mean[:HEAD], np.zeros(POSE)), augmented)
        cross = moved.slope[:, :HEAD] @ self.covariance[:HEAD, POSE:]
        self.mean[:POSE] = moved.mean
        self.covariance[:POSE, :POSE] = moved.covariance
        self.covariance[:POSE, POSE:] = cross
        self.covariance[POSE:, :POSE] = cross.T

    def update(
        self, columns: IntArray, function: Callable[[Array], Array], measured: Array, noise: Array
    ) -> None:
        """Update by `measured` (q,): `function(x[columns])`, row by row, plus noise of covariance (q, q)."""
        predicted = transform(function, self.mean[columns], self.covariance[np.ix_(columns, columns)])
        root = square_root(predicted.covariance + noise)
        cross = predicted.slope @ self.covariance[columns]
        half, _ = lapack.dtrtrs(root, np.column_stack([cross, measured - predicted.mean]), lower=1)
        self.mean += half[:, :-1].T @ half[:, -1]
        self.covariance -= half[:, :-1].T @ half[:, :-1]
        self.covariance = 0.5 * (self.covariance + self.covariance.T)

    def measuring_columns(self, others: IntArray) -> IntArray:
        """Entries of x that detections depend on: pose, sensor, and others (k,)."""
        return np.concatenate([np.arange(POSE), SENSOR_COLUMNS, others])

    def measuring(self, points: IntArray) -> Callable[[Array], Array]:
        """Return the function from [pose | sensor | points] (k, d) to corrected detections of points (k,).

        It is `R' (p - t) - C (b - b0)`, where b0 is the mean calibration of the correction.
        """
        expected = to_vehicle_rows(self.pose[None], self.points[points].reshape(1, -1)).reshape(-1, POINT)
        shift, now = self.by_sensor(expected).reshape(-1, SENSOR_SIZE), self.sensor.copy()

        def detect(x: Array) -> Array:
            seen = to_vehicle_rows(x[:, :POSE], x[:, POSE + SENSOR_SIZE :])
            return seen - (x[:, POSE : POSE + SENSOR_SIZE] - now) @ shift.T

        return detect

    def add_points(self, detections: Array, covariances: Array) -> None:
        """Add points at the end of x, at detections (k, 2) with covariances (k, 2, 2), vehicle frame."""
        joint = block_diag(self.covariance[:POSE, :POSE], *covariances)
        mean = np.concatenate([self.pose, detections.ravel()])
        placed = transform(lambda x: to_map_rows(x[:, :POSE], x[:, POSE:]), mean, joint)
        cross = placed.slope[:, :POSE] @ self.covariance[:POSE]
        self.mean = np.concatenate([self.mean, placed.mean])
        self.covariance = np.block([[self.covariance, cross.T], [cross, placed.covariance]])

    def transform_points(self, start: int, stop: int, matrix: Array, sigma: Array) -> None:
        """Multiply points [start, stop) by `matrix` (k, stop - start), and add noise of sigma (k,) in m."""
        low, high = HEAD + POINT * start, HEAD + POINT * stop
        full = np.kron(matrix, np.eye(POINT))
        mean, covariance = self.mean, self.covariance
        cross = full @ covariance[low:high]
        block = cross[:, low:high] @ full.T + np.diag(np.repeat(sigma, POINT) ** 2)
        before, after = slice(0, low), slice(high, len(mean))
        self.mean = np.concatenate([mean[before], full @ mean[low:high], mean[after]])
        self.covariance = np.block(
            [
                [covariance[before, before], cross[:, before].T, covariance[before, after]],
                [cross[:, before], block, cross[:, after]],
                [covariance[after, before], cross[:, after].T, covariance[after, after]],
            ]
        )

    def reorder(self, points: IntArray) -> None:
        """Reorder or select points by their indices (k,)."""
        columns = np.concatenate([np.arange(HEAD), point_columns(points)])
        self.mean = self.mean[columns]
        self.covariance = self.covariance[np.ix_(columns, columns)]


def point_columns(points: IntArray) -> IntArray:
    """Entries (2 k,) of points (k,) in x."""
    return (HEAD + POINT * points[:, None] + np.arange(POINT)).ravel()


def to_map_rows(poses: Array, detections: Array) -> Array:
    """Transform r detections (k, 2 r) from each of k poses (k, 3) to the map frame: `R z + t`."""
    repeated = np.repeat(poses, detections.shape[1] // POINT, axis=0)
    return se2.to_map(detections.reshape(-1, POINT), repeated).reshape(len(poses), -1)


def to_vehicle_rows(poses: Array, points: Array) -> Array:
    """Transform r map points (k, 2 r) to the vehicle frame of each of k poses (k, 3): `R' (p - t)`."""
    repeated = np.repeat(poses, points.shape[1] // POINT, axis=0)
    return se2.to_vehicle(points.reshape(-1, POINT), repeated).reshape(len(poses), -1)


# --- the paper's state: pose and control points of clamped splines, growth and update (paper: Expansion)

RIDGE: Final = 0.05  # lambda of the ridge regression, which ties control points to their places
SIGMA_ALONG: Final = 1.0  # standard deviation of a cone's distance along the curve from its foot point (m)
GROWTH_THRESHOLD: Final = 4.0  # distance from the end below which a detection updates the curve only (m)
SEPARATION: Final = 4.0  # least distance of an extension from the second-to-last control point (m)
SIGMA_START: Final = 0.3  # added standard deviation of a new curve's control points (m)


def in_map(detections: Detections, pose: Array) -> tuple[Array, Array]:
    """Transform detections from a pose (3,) to the map frame: points (m, 2) and covariances (m, 2, 2)."""
    turned = se2.rotated(detections.covariances, np.full(len(detections.labels), pose[2]))
    return se2.to_map(detections.points_vehicle, pose[None]), turned


class CurveState:
    """State `x = [pose | calibration | left control points | right control points]`, and the knots."""

    def __init__(self, belief: Belief, settings: MapperSettings) -> None:
        self.settings = settings
        self.belief = belief  # mean and covariance of x
        self.curves: dict[int, BSpline] = {}  # by label; knots are current, control points are in the belief
        self.pose_u: dict[int, float] = {}  # parameter of the vehicle's foot point on each curve, not wrapped

    def offset(self, label: int) -> int:
        """Number of points in x before a curve's first control point."""
        return sum(curve.size for other, curve in self.curves.items() if other < label)

    def control_points(self, label: int) -> Array:
        """View of the distinct control points (m, 2) of a curve in m, map frame."""
        start = self.offset(label)
        return self.belief.points[start : start + self.curves[label].size]

    def columns(self, label: int, control: IntArray) -> IntArray:
        """Entries (2 k,) of control points (k,) of a curve in x."""
        return point_columns(self.offset(label) + control)

    def covariance(self, label: int) -> Array:
        """Copy of the joint covariance (2m, 2m) of a curve's control points in m^2."""
        columns = self.columns(label, np.arange(self.curves[label].size))
        return self.belief.covariance[np.ix_(columns, columns)]

    def spline(self, label: int) -> BSpline:
        return self.curves[label].with_points(self.control_points(label).copy())

    def foot_points(self, label: int, points: Array, low: Array, high: Array) -> FootPoints:
        """Find the foot points of points (m, 2) in the stretches [low, high] (m,) of a curve."""
        curve, s = self.spline(label), self.settings.spline
        search = s.search_step, s.search_iterations
        return foot_points(curve.tables, curve.control_points, points, low, high, *search)

    def locate_vehicle(self) -> None:
        """Update the vehicle's parameter on each curve: near the last one, or everywhere if it is far off."""
        gate = self.settings.gate
        heading = np.array([np.cos(self.belief.pose[2]), np.sin(self.belief.pose[2])])
        for label, last in self.pose_u.items():
            low, high = np.array([last - gate.station_behind]), np.array([last + gate.station_ahead])
            foot = self.foot_points(label, self.belief.pose[None, :2], low, high)
            u = float(foot.u[0])
            if foot.tangent_unit[0] @ heading < 0.0 or abs(foot.distance[0]) > gate.station_lateral:
                u = relocate(
                    self.boundary(label), self.control_points(label), self.belief.pose, gate.station_room
                )
            if self.curves[label].periodic:
                begin, end = self.curves[label].domain
                u += (end - begin) * round((last - u) / (end - begin))
            self.pose_u[label] = u

    def visible_range(self, label: int, count: int) -> tuple[Array, Array]:
        """Limits of the stretch of a curve that the vehicle sees, each `count` times."""
        gate, u = self.settings.gate, self.pose_u[label]
        return np.full(count, u - gate.view_behind), np.full(count, u + gate.view_ahead)

    def begin(self, label: int, detections: Array, covariances: Array) -> None:
        """Begin a clamped curve of one span along a polyline of detections (k >= 2, 2), vehicle frame."""
        belief, p, k = self.belief, self.settings.spline.degree, len(detections)
        count = len(belief.points)
        belief.add_points(detections, covariances)
        along = se2.path_lengths(detections)
        at = np.linspace(0.0, along[-1], p + 1)
        matrix = np.column_stack([np.interp(at, along, row) for row in np.eye(k)])
        belief.transform_points(count, count + k, matrix, np.full(p + 1, SIGMA_START))
        knots = clamped_knots(np.array([0.0, along[-1]]), p)
        self._append_points(label, BSpline(knots, belief.points[count:], p), p + 1)
        self.pose_u[label] = 0.0

    def extend(self, label: int, detection: Array, covariance: Array) -> None:
        """Extend a curve to a detection (2,), vehicle frame: unclamp, insert, clamp (Hu et al. 2002)."""
        belief, spline, p = self.belief, self.spline(label), self.curves[label].degree
        belief.add_points(detection[None], covariance[None])
        knots = spline.extension_knots(belief.points[-1])
        matrix = end_change_matrix(spline.knots, p, knots)
        n, end = spline.size, self.offset(label) + spline.size
        last = slice(n - p - 1, n)
        belief.transform_points(end - p - 1, end, matrix[last, last], np.zeros(p + 1))
        self._append_points(label, BSpline(knots, np.zeros((n + 1, 2)), p), 1)
        # a prior of little bending: else the uncertainty of the end grows with each extension
        abscissae = greville(knots, p)[-p - 1 :]
        bending = np.kron(smoothness_matrix(abscissae, None), np.eye(POINT))
        sigma = self.settings.ckf.sigma_bend * float(np.mean(np.diff(abscissae)))
        noise, columns = sigma**2 * np.eye(len(bending)), self.columns(label, np.arange(n - p, n + 1))
        belief.update(columns, lambda x: x @ bending.T, np.zeros(len(bending)), noise)

    def _append_points(self, label: int, curve: BSpline, added: int) -> None:
        """Move the last `added` points of x to the end of a curve, which takes the knots of `curve`."""
        self.curves = dict(sorted({**self.curves, label: curve}.items()))
        end, count = self.offset(label) + curve.size, len(self.belief.points)
        order = np.arange(count - added)
        self.belief.reorder(np.insert(order, end - added, np.arange(count - added, count)))

    def replace(self, label: int, curve: BSpline, matrix: Array, sigma: float) -> None:
        start = self.offset(label)
        stop = start + self.curves[label].size
        self.belief.transform_points(start, stop, matrix, np.full(len(matrix), sigma))
        self.curves[label] = curve

    def boundary(self, label: int) -> Boundary:
        """Convert a curve to a confirmed boundary, for registration and simplification."""
        curve, settings = self.curves[label], self.settings
        boundary = Boundary(curve.knots, curve.periodic, settings.spline)
        boundary.confirmed_end = boundary.tables.high
        return boundary


LONGEST_EXTENSION: Final = 12.0  # largest length of one extension (m)


class Expansion:
    """Expands curves by the next detections of confirmed tracks along the path.

    An end that the vehicle has passed is extrapolated beside the path.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.tentative = Tracks(settings.growth.merge_radius, FORGET_AFTER)
        self.observed: dict[int, dict[int, Array]] = {label: {} for label in BOUNDARIES}
        """Confirmed cones, as points (2,) in m, map frame, by label and number of their track."""
        self._carried = dict.fromkeys(BOUNDARIES, 0.0)  # extrapolated lengths since the last cone (m)

    def observe(self, state: CurveState, detections: Detections) -> None:
        """Add all detections of a cycle to the tracks, and newly confirmed ones to the observed cones."""
        points, covariances = in_map(detections, state.belief.pose)
        tracks = self.tentative
        tracks.add(points, covariances, detections.labels, detections.t)
        for label, known in self.observed.items():
            for k in tracks.confirmed(label, self.settings.growth.sightings):
                known.setdefault(int(tracks.numbers[k]), tracks.points[k].copy())

    def expand(
        self, state: CurveState, detections: Detections, path_ahead: PathAhead, free: BoolArray
    ) -> set[int]:
        """Begin or extend each curve by `free` detections (m,), which update none; return grown curves."""
        extended: set[int] = set()
        model = self.settings.ckf.sigma_model**2 * np.eye(2)
        detections = replace(detections, covariances=detections.covariances + model)
        for label in BOUNDARIES:
            rows = np.flatnonzero(free & (detections.labels == label))
            found = self._candidates(state, label, detections, rows, path_ahead)
            if label not in state.curves:
                rows = found.where(found.sides < self.settings.growth.max_lateral).indices
                if len(rows) > 1:
                    state.begin(label, detections.points_vehicle[rows], detections.covariances[rows])
            elif self._extend(state, label, detections, found):
                extended.add(label)
                self._carried[label] = 0.0
            elif self._carry_on(state, label, path_ahead):
                extended.add(label)
        return extended

    def _candidates(
        self, state: CurveState, label: int, detections: Detections, rows: IntArray, path_ahead: PathAhead
    ) -> Candidates:
        settings, tentative = self.settings.growth, self.tentative
        points = se2.to_map(detections.points_vehicle[rows], state.belief.pose[None])
        indices = tentative.confirmed(label, settings.sightings)
        confirmed = tentative.points[indices[tentative.undisputed(indices, label)]]
        near = nearest_within(points, confirmed, settings.merge_radius)[1]
        stations, lateral = path_ahead.locate(points)
        found = Candidates(points, rows, stations, SIDES[label] * lateral)
        found = found.where(near & (stations <= path_ahead.stations[-1]) & (found.sides > 0.0))
        found = found.where(np.argsort(found.stations))
        if label not in state.curves:
            return found.where(chain(found, None))
        end = _end(state, label, path_ahead)
        if len(found.points):
            high, low = state.curves[label].domain[1], state.visible_range(label, len(found.points))[0]
            foot = state.foot_points(label, found.points, np.minimum(low, high), np.full(len(low), high))
            beyond = beyond_end(found.points, foot.u, high, state.control_points(label))
            found = found.where((found.stations > end.station + path.STATION_MARGIN) & beyond)
        return found.where(chain(found, end))

    def _extend(self, state: CurveState, label: int, detections: Detections, found: Candidates) -> bool:
        """Extend a curve to the last candidate of the proximity chain; return whether there is one."""
        if len(found.points) == 0:
            return False
        last = state.control_points(label)[-1].copy()
        order = proximity_chain(found.points, last)
        points, rows = found.points[order], found.indices[order]
        for i in range(len(rows)):
            final = i == len(rows) - 1
            too_far = not final and np.hypot(*(points[i + 1] - last)) > LONGEST_EXTENSION
            if final or (too_far and np.hypot(*(points[i] - last)) > GROWTH_THRESHOLD):
                state.extend(label, detections.points_vehicle[rows[i]], detections.covariances[rows[i]])
                last = points[i]
        return True

    def _carry_on(self, state: CurveState, label: int, path_ahead: PathAhead) -> bool:
        """Extrapolate a passed end beside the path, nearly up to the vehicle; return whether it grew."""
        settings = self.settings.growth
        end = _end(state, label, path_ahead)
        if end.station >= path_ahead.driven - path.STRANDED:
            return False
        side = SIDES[label] * max(end.side, path.MIN_LATERAL)
        point = path_ahead.beside(path_ahead.driven - path.CARRIED_TO, side)
        distance = float(np.hypot(*(point - end.position)))
        if not path.MIN_CARRY <= distance <= settings.max_unseen - self._carried[label]:
            return False
        self._carried[label] += distance
        point_vehicle = (point - state.belief.pose[:2]) @ se2.rotation(state.belief.pose[2])
        state.extend(label, point_vehicle, np.eye(2))  # uncertain by 1 m
        return True


def beyond_end(
    points: Array,
    u: Array,
    high: float,
    control_points: Array,
    threshold: float = GROWTH_THRESHOLD,
    separation: float = SEPARATION,
) -> BoolArray:
    """Whether points (m, 2) with foot points u (m,) meet the paper's three conditions of growth.

    The foot point is the end `high`, the distance from `C_n` exceeds the growth threshold, and the distance
    from `C_{n-1}` exceeds the separation.
    """
    at_end = u >= high - 1e-6  # of round-off (m)
    far = np.hypot(*(points - control_points[-1]).T) > threshold
    apart = np.hypot(*(points - control_points[-2]).T) > separation
    return np.asarray(at_end & far & apart)


def proximity_chain(points: Array, start: Array) -> IntArray:
    """Order points (k, 2) from `start` (2,) on, each the nearest one to the last; return indices (k,)."""
    remaining, order, last = list(range(len(points))), [], start
    while remaining:
        distances = np.hypot(*(points[remaining] - last).T)
        order.append(remaining.pop(int(distances.argmin())))
        last = points[order[-1]]
    return np.array(order, np.intp)


def _end(state: CurveState, label: int, path_ahead: PathAhead) -> End:
    """Locate the end of a curve on the path."""
    position = state.control_points(label)[-1].copy()
    station, lateral = path_ahead.since(path_ahead.driven - END_BEHIND).locate(position[None])
    return End(position, float(station[0]), SIDES[label] * float(lateral[0]))


# --- the update ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OnCurve:
    """Detections of a cycle that update a curve."""

    rows: IntArray  # (m,) rows of the cycle's detections
    basis: Array  # (m, n) the curve's n basis functions at the foot points: the paper's B
    tangents: Array  # (m, 2) unit tangents at the foot points, map frame
    distances: Array  # (m,) squared Mahalanobis distances across the curve

    def where(self, chosen: BoolArray) -> "OnCurve":
        return OnCurve(self.rows[chosen], self.basis[chosen], self.tangents[chosen], self.distances[chosen])


def classify(state: CurveState, detections: Detections) -> dict[int, OnCurve]:
    """Assign detections to the curves that they update; an unknown label updates the nearer curve."""
    found = {label: on_curve(state, label, detections) for label in state.curves}
    nearest = np.full(len(detections.labels), np.inf)
    for on in found.values():
        nearest[on.rows] = np.minimum(nearest[on.rows], on.distances)
    return {label: on.where(on.distances <= nearest[on.rows]) for label, on in found.items()}


def on_curve(state: CurveState, label: int, detections: Detections) -> OnCurve:
    """Select the detections in the gate of a curve: `d^2 < chi^2 (n' K n + sigma^2 + g' Sigma g)`.

    d is the signed distance across the curve, n its normal, K the covariance of the detection, sigma^2 the
    variances of the settings, g the derivative of d by pose, calibration and control points, and Sigma their
    covariance. The foot point must be inside the stretch that the vehicle sees.
    """
    gate, curve = state.settings.gate, state.curves[label]
    rows = np.flatnonzero((detections.labels == label) | (detections.labels == UNKNOWN))
    poses = np.tile(state.belief.pose, (len(rows), 1))
    points = se2.to_map(detections.points_vehicle[rows], poses)
    foot = state.foot_points(label, points, *state.visible_range(label, len(rows)))
    projected = project(points, detections.covariances[rows], poses, foot, state.settings.ckf.sigma_model)
    control, width = foot.span[:, None] + np.arange(-curve.degree, 1), POINT * (curve.degree + 1)
    control = control % curve.size if curve.periodic else control
    expected = se2.to_vehicle(foot.position, poses)
    normals = se2.in_vehicle(foot.normal_unit, poses)
    by_calibration = np.einsum("mi,mik->mk", normals, state.belief.by_sensor(expected))
    by_control = projected.by_control.reshape(len(rows), width)
    gradient = np.concatenate([projected.by_pose, by_calibration, by_control], axis=1)
    head = np.tile(np.append(np.arange(POSE), SENSOR_COLUMNS), (len(rows), 1))
    own = state.columns(label, control.ravel()).reshape(len(rows), width)
    columns = np.concatenate([head, own], axis=1)
    joint = state.belief.covariance[columns[:, :, None], columns[:, None, :]]
    variance = projected.sigma**2 + gate.sigma_floor**2
    variance = variance + np.einsum("mi,mij,mj->m", gradient, joint, gradient)
    squared = foot.distance**2 / variance
    passes = foot.interior & (np.abs(foot.distance) < gate.rough) & (squared < gate.chi**2)
    basis = scatter(foot.basis, foot.span - curve.degree, curve.size, curve.periodic)
    return OnCurve(rows, basis, foot.tangent_unit, squared).where(passes)


@dataclass(frozen=True, eq=False)
class SplineMeasurement:
    """The measurement S_z on r control points, in the frame of the detections."""

    points: Array  # (r, 2) control points of S_z, in m
    covariance: Array  # (2 r, 2 r) their covariance over x0, y0, x1, y1 and so on, in m^2
    gain: Array  # (r, m) G, derivative of S_z by the detections
    taken: Array  # (r, r) G B, derivative of S_z by the control points of a curve through the detections
    known: Array  # (r, 2) control points C_mu before the fit

    def refitted(self, points: Array) -> Array:
        """S_z of detections on curves with control points C (k, r, 2): `C_mu + G B (C - C_mu)`."""
        return np.asarray(self.known + np.einsum("ij,kjd->kid", self.taken, points - self.known))

    def range_basis(self) -> Array:
        """Orthonormal basis (r, q) of the range of G, which the detections can change."""
        vectors, values, _ = np.linalg.svd(self.gain, full_matrices=False)
        return np.asarray(vectors[:, values > 1e-9 * values[0]])


def fit_detections(basis: Array, detections: Array, covariances: Array, known: Array) -> SplineMeasurement:
    """Fit S_z to detections (m, 2) with covariances (m, 2, 2), by a cubature transform of ridge regression.

    The basis B (m, r) is evaluated at their foot points; known (r, 2) are the control points C_mu in their
    frame. The regression is `C = C_mu + G (y - B C_mu)` with the gain `G = (B' B + L)^-1 B'` and the
    regularization `L = ridge diag(1 - B' 1 / m)`, which is less where detections act.
    """
    m, r = basis.shape
    gram = basis.T @ basis + np.diag(RIDGE * (1.0 - basis.mean(axis=0)))
    gain = np.asarray(np.linalg.lstsq(gram, basis.T, rcond=None)[0])
    joint = np.zeros((m, 2, m, 2))
    joint[np.arange(m), :, np.arange(m), :] = covariances
    kept = known - gain @ (basis @ known)

    def fit(samples: Array) -> Array:
        fitted = kept + np.einsum("rm,kmd->krd", gain, samples.reshape(-1, m, 2))
        return np.asarray(fitted.reshape(len(samples), -1))

    fitted = transform(fit, detections.ravel(), joint.reshape(2 * m, 2 * m))
    return SplineMeasurement(fitted.mean.reshape(r, 2), fitted.covariance, gain, gain @ basis, known)


def update(state: CurveState, detections: Detections, found: dict[int, OnCurve]) -> None:
    """Fit S_z of each curve, and update pose and map by all of them at once.

    A fit is on the control points that the detections reach. Their covariances are
    `K + sigma_model^2 I + sigma_along^2 t t'`, vehicle frame, with unit tangents t.
    """
    belief, model = state.belief, state.settings.ckf.sigma_model**2 * np.eye(POINT)
    own_columns, fits = list[IntArray](), list[SplineMeasurement]()
    combinations, by_calibration = list[Array](), list[Array]()  # each (2 r, q) and (2 r, 5)
    for label, on in found.items():
        if not len(on.rows):
            continue
        control = np.flatnonzero(on.basis.sum(axis=0) > 1e-3)
        known = to_vehicle_rows(state.belief.pose[None], state.control_points(label)[control].reshape(1, -1))
        t = on.tangents @ se2.rotation(state.belief.pose[2])
        along = SIGMA_ALONG**2 * t[:, :, None] * t[:, None, :]
        covariances = detections.covariances[on.rows] + model + along
        points, basis = detections.points_vehicle[on.rows], on.basis[:, control]
        fitted = fit_detections(basis, points, covariances, known.reshape(-1, POINT))
        expected = belief.by_sensor(basis @ fitted.known)
        own_columns.append(state.columns(label, control))
        fits.append(fitted)
        combinations.append(np.asarray(np.kron(fitted.range_basis(), np.eye(POINT)), float))
        by_calibration.append(np.einsum("rm,mik->rik", fitted.gain, expected).reshape(-1, SENSOR_SIZE))
    if not fits:
        return
    ends, head, now = np.cumsum([*map(len, own_columns)]), POSE + SENSOR_SIZE, belief.sensor.copy()

    def predict(x: Array) -> Array:
        parts, predicted = np.split(to_vehicle_rows(x[:, :POSE], x[:, head:]), ends[:-1], axis=1), []
        for own, fitted, combine, slope in zip(parts, fits, combinations, by_calibration, strict=True):
            seen = fitted.refitted(own.reshape(len(x), -1, POINT)).reshape(len(x), -1)
            predicted.append((seen - (x[:, POSE:head] - now) @ slope.T) @ combine)
        return np.concatenate(predicted, axis=1)

    pairs = list(zip(fits, combinations, strict=True))
    measured = np.concatenate([fitted.points.ravel() @ combine for fitted, combine in pairs])
    noise = block_diag(*(combine.T @ fitted.covariance @ combine for fitted, combine in pairs))
    belief.update(belief.measuring_columns(np.concatenate(own_columns)), predict, measured, noise)
