"""Residuals as GTSAM factors for any nonlinear graph: projection, spacing, smoothness and odometry.

A factor holds its measurement and its keys, but no graph. It is a pure function of the values.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from . import _kernels as kernels
from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials
from .footpoint import FootPoints, foot_points
from .linear import linear_factor
from .noise import huber_roots, huber_weights
from .odometry import IntegratedOdometry
from .residuals import sigma_across
from .se2 import rotation, to_map
from .sensor import corrected, sensor_rows

JacobianList = MutableSequence[Array]

GRID_SHARE = 0.25  # coarse step of the foot-point search by the mean knot interval


def spline_projection_factors(
    pose_keys: IntArray,
    control_keys: Sequence[int],
    tables: SpanPolynomials,
    *,
    points_vehicle: Array,
    covariances: Array,
    low: Array,
    high: Array,
    sigma_model: float,
    huber: float,
    sensor_key: int | None = None,
    twists: Array | None = None,
) -> list[gtsam.CustomFactor]:
    """Return a factor `e_i = n_i . (R z_i + t - S(u_i)) / sigma_i` for the detections of each pose.

    The rows are those of `project`. pose_keys (m,) are the keys of each row's own pose, and those of one pose
    are neighbours. control_keys (k,) are the keys of all distinct control points; a factor holds those that
    matter in the stretches [low, high] (m,), where foot points are searched for: a few metres about the
    expected ones. points_vehicle z (m, 2) and covariances (m, 2, 2) are in the vehicle frame, and sigma_model
    is in m. A row's weight falls beyond the whitened residual `huber`, which may be infinite.

    With a `sensor_key`, the detections are corrected by the sensor's calibration (5,) of that key (see
    `sensor.by_sensor`), with twists (m, 3) of the vehicle in m/s, m/s and rad/s.

    Foot points, standard deviations and weights are recomputed at every evaluation. With Jacobians, rows are
    scaled by the square root of their Huber weight. Without, half their squares are the Huber loss, so that
    an optimizer judges its steps by the true cost. No derivative contains the turning of sigma with the
    normal, so an optimizer that judges by the error may stop beside the fixed point of Gauss-Newton, by as
    much as sigma depends on the direction. A row whose foot point is not interior contributes zero; where
    foot points leave their stretches, the factor is to be created again.
    """
    if len(pose_keys) == 0:
        return []
    twists = np.zeros((len(low), 3)) if twists is None else twists
    _require_alike("poses, detections and stretches", pose_keys, points_vehicle, covariances, low, high)
    factors = []
    for own in np.split(np.arange(len(pose_keys)), np.flatnonzero(np.diff(pose_keys)) + 1):
        pose_key, curve = int(pose_keys[own[0]]), Curve.of(control_keys, tables, low[own], high[own])
        measured = points_vehicle[own], covariances[own], twists[own]
        factors.append(_projection_factor(pose_key, curve, *measured, sigma_model, huber, sensor_key))
    return factors


def _projection_factor(
    pose_key: int,
    curve: Curve,
    measured: Array,
    covariances: Array,
    twists: Array,
    sigma_model: float,
    huber: float,
    sensor_key: int | None,
) -> gtsam.CustomFactor:
    """Return the factor on the pose of the detections, the sensor's calibration and the control points."""

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        pose = values.atPose2(pose_key)
        poses = np.tile(pose_array(pose), (len(measured), 1))
        sensor = np.zeros(0) if sensor_key is None else np.array(values.atVector(sensor_key))
        points = to_map(corrected(measured, twists, sensor), poses)
        foot, residual, gradient, by_control = curve.distances(values, points)
        sigma = sigma_across(foot.normal_unit, covariances, poses, sigma_model)
        steepness = np.hypot(gradient[:, 0], gradient[:, 1])
        direction = gradient / steepness[:, None]
        by = sensor_rows(direction, residual / steepness, poses, measured, twists, sensor)
        usable, slots = curve.usable(foot)
        whitened = by.factor * residual / sigma
        if H is None:
            return np.asarray(huber_roots(whitened, huber) * usable)
        root = np.sqrt(huber_weights(whitened, huber)) * usable
        scale, arm = by.factor * root / sigma, points - poses[:, :2]
        by_theta = gradient[:, 1] * arm[:, 0] - gradient[:, 0] * arm[:, 1]
        by_pose = np.column_stack([gradient @ rotation(pose.theta()), by_theta]) * scale[:, None]
        by_calibration = [by.by_sensor * (steepness * root / sigma)[:, None]] if len(sensor) else []
        fill(H, [by_pose, *by_calibration, *curve.by_key(by_control * scale[:, None, None], slots)])
        return np.asarray(whitened * root)

    keys = [pose_key, *([] if sensor_key is None else [int(sensor_key)]), *curve.keys]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(measured)), keys, error)


def station_factors(
    pose_keys: IntArray,
    control_keys: Sequence[int],
    tables: SpanPolynomials,
    *,
    u: Array,
    sigma_station: Array,
    points_vehicle: Array,
    covariances: Array,
    twists: Array,
    huber: float,
    sensor_key: int | None = None,
) -> list[gtsam.CustomFactor]:
    """Return a factor `e_i = t_i . (R z_i + t - S(u_i)) / sigma_i` for the detections of each pose.

    The rows are those of `station_rows`, at the stations u (m,) of cones with standard deviations
    sigma_station (m,) along the curve, in m. The rest is as in `spline_projection_factors`.
    """
    factors = []
    for own in np.split(np.arange(len(pose_keys)), np.flatnonzero(np.diff(pose_keys)) + 1):
        if len(own):
            curve = Curve.of(control_keys, tables, u[own], u[own])
            measured = points_vehicle[own], covariances[own], twists[own]
            at = u[own], sigma_station[own]
            factors.append(_station_factor(int(pose_keys[own[0]]), curve, *at, *measured, huber, sensor_key))
    return factors


def _station_factor(
    pose_key: int,
    curve: Curve,
    u: Array,
    sigma_station: Array,
    measured: Array,
    covariances: Array,
    twists: Array,
    huber: float,
    sensor_key: int | None,
) -> gtsam.CustomFactor:
    """Return the factor on the pose of the detections, the sensor's calibration and the control points."""
    (value, slope), span = curve.tables.evaluate(u, 1)
    columns, slots = span[:, None] + np.arange(-curve.tables.degree, 1), curve.slots(span)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        pose = values.atPose2(pose_key)
        poses = np.tile(pose_array(pose), (len(measured), 1))
        sensor = np.zeros(0) if sensor_key is None else np.array(values.atVector(sensor_key))
        points, control = to_map(corrected(measured, twists, sensor), poses), curve.control_points(values)
        basis = np.ascontiguousarray(value), np.ascontiguousarray(slope), control[columns]
        seen = measured, twists, sensor
        residual, sigma, J = kernels.station_rows(points, covariances, poses, *basis, *seen, sigma_station)
        whitened = residual / sigma
        if H is None:
            return huber_roots(whitened, huber)
        root = np.sqrt(huber_weights(whitened, huber))
        J *= (root / sigma)[:, None]
        by_pose = np.column_stack([J[:, :2] @ rotation(pose.theta()), J[:, 2]])
        by_calibration = [J[:, 3 : 3 + len(sensor)]] if len(sensor) else []
        by_control = J[:, 3 + len(sensor) :].reshape(*slots.shape, 2)
        fill(H, [by_pose, *by_calibration, *curve.by_key(by_control, slots)])
        return np.asarray(whitened * root)

    keys = [pose_key, *([] if sensor_key is None else [int(sensor_key)]), *curve.keys]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(measured)), keys, error)


def boundary_point_factor(
    control_keys: Sequence[int],
    tables: SpanPolynomials,
    *,
    points_map: Array,
    sigma: Array,
    low: Array,
    high: Array,
) -> gtsam.CustomFactor:
    """Return the factor `e_i = n_i . (p_i - S(u_i)) / sigma_i`: a boundary passes through surveyed points.

    A surveyed point is, for example, the corner of a wall. points_map p (m, 2) are in the map frame and sigma
    (m,) in m; u_i is the foot point of p_i in the stretch [low_i, high_i] of the curve. Keys and stretches
    are as in `spline_projection_factors`. A row whose foot point is not interior contributes zero.
    """
    _require_alike("points, sigmas and stretches", points_map, sigma, low, high)
    curve = Curve.of(control_keys, tables, low, high)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        foot, distance, _normal, by_control = curve.distances(values, points_map)
        usable, slots = curve.usable(foot)
        scale = usable / sigma
        if H is not None:
            fill(H, [*curve.by_key(by_control * scale[:, None, None], slots)])
        return np.asarray(distance * scale)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(low)), list(curve.keys), error)


@dataclass(frozen=True, eq=False)
class Curve:
    """Stretches of a curve that a factor depends on, and the keys that matter there."""

    keys: tuple[int, ...]  # of the control points `touched`
    touched: IntArray  # indices of the control points whose keys are held
    tables: SpanPolynomials
    low: Array
    high: Array  # limits (m,) of the stretch where each foot point is searched for

    @staticmethod
    def of(control_keys: Sequence[int], tables: SpanPolynomials, low: Array, high: Array) -> Curve:
        """Select, from the keys of all distinct control points, those that matter in the stretches (m,)."""
        if len(control_keys) != tables.size:
            raise ValueError(
                f"expected a key for each of {tables.size} control points, found {len(control_keys)}"
            )
        touched = _touched(tables, low, high)
        return Curve(tuple(int(control_keys[j]) for j in touched), touched, tables, low, high)

    def control_points(self, values: gtsam.Values) -> Array:
        """Return the unwrapped control points (n, 2); those that do not matter here stay zero."""
        size = self.tables.size
        distinct = np.zeros((size, 2))
        distinct[self.touched] = [values.atPoint2(key) for key in self.keys]
        return np.asarray(distinct[np.arange(len(self.tables.starts) + self.tables.degree) % size])

    def distances(self, values: gtsam.Values, points: Array) -> tuple[FootPoints, Array, Array, Array]:
        """Return foot points, distances (m,), and their derivatives (m, 2) and (m, degree + 1, 2).

        The derivatives are by the points (m, 2), map frame, and by the control points of each span.
        """
        step = GRID_SHARE * self.tables.length / len(self.tables.starts)
        line = self.control_points(values)
        foot = foot_points(self.tables, line, points, self.low, self.high, step)
        return foot, foot.distance, foot.normal_unit, -foot.basis[:, :, None] * foot.normal_unit[:, None, :]

    def usable(self, foot: FootPoints) -> tuple[BoolArray, IntArray]:
        """Return which rows (m,) may contribute, and the slots (m, p + 1) of their control points' keys."""
        slots = self.slots(foot.span)
        return foot.interior & (slots >= 0).all(axis=1), slots

    def slots(self, span: IntArray) -> IntArray:
        """Return the slots (m, p + 1) of the keys of spans' (m,) control points, -1 where none is held."""
        size = self.tables.size
        slot_of = np.full(size, -1, dtype=np.intp)
        slot_of[self.touched] = np.arange(len(self.touched))
        return np.asarray(slot_of[(span[:, None] + np.arange(-self.tables.degree, 1)) % size])

    def by_key(self, by_control: Array, slots: IntArray) -> Array:
        """Return derivatives by key (keys, m, d) from those by the points of each span (m, p + 1, d)."""
        blocks = np.zeros((len(self.touched), len(by_control), by_control.shape[2]))
        np.add.at(blocks, (slots, np.arange(len(by_control))[:, None]), by_control)
        return blocks


def _require_alike(names: str, *arrays: Array | IntArray) -> None:
    lengths = [len(array) for array in arrays]
    if len(set(lengths)) > 1 or lengths[0] == 0:
        raise ValueError(f"expected as many {names}, at least one, found {', '.join(map(str, lengths))}")


def pose_array(pose: gtsam.Pose2) -> Array:
    """Return (x, y, theta) in m, m and rad, with theta in (-pi, pi]."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def _touched(tables: SpanPolynomials, low: Array, high: Array) -> IntArray:
    """Return the indices of the control points that matter anywhere in the stretches [low, high] (m,)."""
    period, spans = tables.high - tables.low, len(tables.starts)
    first, last = tables.locate(low)[0], tables.locate(high)[0]
    if tables.periodic:
        turns = np.floor((high - tables.low) / period) - np.floor((low - tables.low) / period)
        last = np.minimum(last + spans * turns.astype(np.intp), first + spans)
    stretches = zip(first, last + tables.degree + 1, strict=True)
    return np.unique(np.concatenate([np.arange(i, end) for i, end in stretches]) % tables.size)


def fill(H: JacobianList, blocks: Sequence[Array]) -> None:
    """Write every Jacobian to H; GTSAM does not check shapes, so they are checked here."""
    if len(H) != len(blocks):
        raise ValueError(f"expected {len(H)} Jacobians, one a key, found {len(blocks)}")
    for i, block in enumerate(blocks):
        if block.ndim != 2 or len(block) != len(blocks[0]):
            raise ValueError(f"expected {len(blocks[0])} rows in Jacobian {i}, found shape {block.shape}")
        H[i] = block


def spacing_factors(
    control_keys: Sequence[int], nominal: Array, sigma: Array, periodic: bool
) -> list[gtsam.RangeFactor2]:
    """Return GTSAM's range factors `|c_{j+1} - c_j| - nominal_j` between neighbours.

    nominal and sigma are in m and have k - 1 entries, or k where periodic. See `residuals.pair_residuals`.
    """
    expected = len(control_keys) - (0 if periodic else 1)
    if not len(nominal) == len(sigma) == expected:
        raise ValueError(f"expected {expected} distances and sigmas, found {len(nominal)} and {len(sigma)}")
    following = [*control_keys[1:], control_keys[0]]
    return [
        gtsam.RangeFactor2(first, second, float(d), gtsam.noiseModel.Isotropic.Sigma(1, float(s)))
        for first, second, d, s in zip(control_keys, following, nominal, sigma, strict=False)
    ]


def smoothness_factors(
    control_keys: Sequence[int], matrix: Array, sigma: float
) -> list[gtsam.LinearContainerFactor]:
    """Return linear factors `D c ~ N(0, sigma^2)`, one for each row of D (`residuals.smoothness_matrix`)."""
    if matrix.shape[1] != len(control_keys):
        raise ValueError(f"expected a key for each of {matrix.shape[1]} columns, found {len(control_keys)}")
    factors = []
    for row in matrix:
        columns = np.flatnonzero(row)
        keys, zero = np.array(control_keys, np.intp)[columns], gtsam.Values()
        for key in keys.tolist():
            zero.insert(key, np.zeros(2))
        A = np.kron(row[columns] / sigma, np.eye(2)).astype(np.float64)
        linear = linear_factor(keys, np.full(len(keys), 2), A, np.zeros(2))
        factors.append(gtsam.LinearContainerFactor(gtsam.JacobianFactor(linear), zero))
    return factors


def calibrated_odometry_factor(
    first_key: int, second_key: int, calibration_key: int, odometry: IntegratedOdometry
) -> gtsam.CustomFactor:
    """Return the factor `Log(delta^-1 x_i^-1 x_j) + G b`, b (2,) the scale error and the yaw-rate bias."""
    keys, G = [int(first_key), int(second_key), int(calibration_key)], odometry.calibration_jacobian

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        start, end = values.atPose2(keys[0]), values.atPose2(keys[1])
        residual, by_start, by_end = kernels.odometry_residuals(
            pose_array(start)[None], pose_array(end)[None], odometry.delta[None]
        )
        if H is not None:
            by_start[0, :, :2] = by_start[0, :, :2] @ rotation(start.theta())
            by_end[0, :, :2] = by_end[0, :, :2] @ rotation(end.theta())
            fill(H, [by_start[0], by_end[0], G])
        return np.asarray(residual[0] + G @ values.atPoint2(keys[2]))

    noise = gtsam.noiseModel.Gaussian.Information(odometry.whitener.T @ odometry.whitener)
    return gtsam.CustomFactor(noise, keys, error)
