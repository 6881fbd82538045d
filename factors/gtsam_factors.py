"""GTSAM factors for any nonlinear graph: projection, stations, smoothness and odometry.

A factor has its measurement and its keys, but no state: its error is a pure function of the values.
"""

from __future__ import annotations

from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from . import _kernels as kernels
from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials
from .footpoint import FootPoints, foot_points
from .linear import linear_factor
from .noise import huber_roots, huber_weights
from .odometry import IntegratedOdometry
from .se2 import rotation, to_map
from .sensor import corrected

JacobianList = MutableSequence[Array]

POSE_SIZE = 3
GRID_SHARE = 0.25  # coarse step of the foot-point search, as a share of the mean knot interval


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
    """Build a factor `e_i = n_i . (R z_i + t - S(u_i)) / sigma_i` for the detections of each pose.

    The rows come from `detection_rows`. pose_keys (m,) are the keys of the rows' poses; rows of one pose are
    neighbours. control_keys (k,) are the keys of all distinct control points. A factor depends on those that
    matter in the stretches [low, high] (m,), in which foot points are searched: a few metres about the
    expected ones. points_vehicle z (m, 2) and covariances (m, 2, 2) are in the vehicle frame, sigma_model is
    in m. The weight of a row falls beyond the whitened residual `huber`, which may be infinite.

    With a `sensor_key`, the detections are corrected by the sensor's calibration (5,) of that key (see
    `sensor.by_sensor`), with twists (m, 3) of the vehicle in m/s, m/s and rad/s.

    Foot points, standard deviations and weights are recomputed at every evaluation. With Jacobians, rows are
    scaled by the square root of their Huber weight. Without, half their squares are the Huber loss, so that
    an optimizer judges its steps by the true cost. The Jacobians neglect that sigma rotates with the normal,
    so an optimizer that judges by the error may stop beside the fixed point of Gauss-Newton if sigma depends
    on the direction. A row whose foot point is not interior contributes zero. If foot points leave their
    stretches, build the factors again.
    """
    if len(pose_keys) == 0:
        return []
    twists = np.zeros((len(low), 3)) if twists is None else twists
    _require_alike("poses, detections and stretches", pose_keys, points_vehicle, covariances, low, high)
    factors = []
    for own in _of_each_pose(pose_keys):
        seen = _Seen(int(pose_keys[own[0]]), points_vehicle[own], covariances[own], twists[own], sensor_key)
        curve = Curve.of(control_keys, tables, low[own], high[own])
        factors.append(_detection_factor(seen, curve, partial(_across, sigma_model), huber))
    return factors


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
    """Build a factor `e_i = t_i . (R z_i + t - S(u_i)) / sigma_i` for the detections of each pose.

    The rows come from `station_rows`, at the stations u (m,) of cones with standard deviations sigma_station
    (m,) along the curve, in m. All else is as in `spline_projection_factors`.
    """
    factors = []
    for own in _of_each_pose(pose_keys):
        seen = _Seen(int(pose_keys[own[0]]), points_vehicle[own], covariances[own], twists[own], sensor_key)
        curve = Curve.of(control_keys, tables, u[own], u[own])
        factors.append(_detection_factor(seen, curve, partial(_along, u[own], sigma_station[own]), huber))
    return factors


def _of_each_pose(pose_keys: IntArray) -> list[IntArray]:
    """Split rows by pose, given the key (m,) of each row's pose."""
    every = np.arange(len(pose_keys))
    return np.split(every, np.flatnonzero(np.diff(pose_keys)) + 1) if len(every) else []


@dataclass(frozen=True, eq=False)
class _Seen:
    """The detections of one pose."""

    pose_key: int
    measured: Array  # (m, 2) in m, vehicle frame
    covariances: Array  # (m, 2, 2)
    twists: Array  # (m, 3)
    sensor_key: int | None

    def at(self, values: gtsam.Values) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
        """Return points, covariances and poses, and measured points, twists and the calibration."""
        poses = np.tile(pose_array(values.atPose2(self.pose_key)), (len(self.measured), 1))
        sensor = np.zeros(0) if self.sensor_key is None else np.array(values.atVector(self.sensor_key))
        points = to_map(corrected(self.measured, self.twists, sensor), poses)
        return (points, self.covariances, poses), (self.measured, self.twists, sensor)


Terms = tuple[Array, Array, Array, BoolArray, IntArray]
"""Residuals, sigmas and derivatives of rows, whether they contribute, and the slots of their keys."""


def _across(sigma_model: float, seen: _Seen, curve: Curve, values: gtsam.Values) -> Terms:
    """Terms of detections across a curve."""
    placed, measured = seen.at(values)
    foot = curve.foot(values, placed[0])
    on_curve = foot.normal_unit, foot.distance, foot.basis
    terms = kernels.detection_rows(*placed, *on_curve, *measured, sigma_model)
    return *terms, *curve.usable(foot)


def _along(u: Array, sigma_station: Array, seen: _Seen, curve: Curve, values: gtsam.Values) -> Terms:
    """Terms of detections at stations along a curve."""
    placed, measured = seen.at(values)
    basis, span = curve.tables.evaluate(u, 1)
    value, slope = np.ascontiguousarray(basis)
    control = curve.control_points(values)[span[:, None] + np.arange(-curve.tables.degree, 1)]
    terms = kernels.station_rows(*placed, value, slope, control, *measured, sigma_station)
    return *terms, np.ones(len(u), bool), curve.slots(span)


def _detection_factor(
    seen: _Seen, curve: Curve, terms: Callable[[_Seen, Curve, gtsam.Values], Terms], huber: float
) -> gtsam.CustomFactor:
    """Build the factor on the pose of the detections, the sensor's calibration and the control points."""
    sensor_keys = [] if seen.sensor_key is None else [int(seen.sensor_key)]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        residual, sigma, J, usable, slots = terms(seen, curve, values)
        whitened = residual / sigma
        if H is None:
            return np.asarray(huber_roots(whitened, huber) * usable)
        root = np.sqrt(huber_weights(whitened, huber)) * usable
        by_pose, by_sensor, by_control = np.split(
            J * (root / sigma)[:, None], [POSE_SIZE, J.shape[1] - 2 * slots.shape[1]], axis=1
        )
        by_pose[:, :2] = by_pose[:, :2] @ rotation(values.atPose2(seen.pose_key).theta())
        by_key = curve.by_key(by_control.reshape(*slots.shape, 2), slots)
        fill(H, [by_pose, *([by_sensor] if sensor_keys else []), *by_key])
        return np.asarray(whitened * root)

    keys = [seen.pose_key, *sensor_keys, *curve.keys]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(seen.measured)), keys, error)


def boundary_point_factor(
    control_keys: Sequence[int] | IntArray,
    tables: SpanPolynomials,
    *,
    points_map: Array,
    sigma: Array,
    low: Array,
    high: Array,
) -> gtsam.CustomFactor:
    """Build the factor `e_i = n_i . (p_i - S(u_i)) / sigma_i`: a boundary passes through surveyed points.

    A surveyed point is, for example, the corner of a wall. points_map p (m, 2) are in the map frame, sigma
    (m,) in m, and u_i is the foot point of p_i in the stretch [low_i, high_i] of the curve. Keys and
    stretches are as in `spline_projection_factors`. A row whose foot point is not interior contributes zero.
    """
    _require_alike("points, sigmas and stretches", points_map, sigma, low, high)
    curve = Curve.of(control_keys, tables, low, high)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        foot = curve.foot(values, points_map)
        usable, slots = curve.usable(foot)
        scale = usable / sigma
        if H is not None:
            by_control = -foot.basis[:, :, None] * (scale[:, None] * foot.normal_unit)[:, None, :]
            fill(H, [*curve.by_key(by_control, slots)])
        return np.asarray(foot.distance * scale)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(low)), list(curve.keys), error)


@dataclass(frozen=True, eq=False)
class Curve:
    """Stretches of a curve, and the control points that a factor on them depends on."""

    keys: tuple[int, ...]  # keys of the control points `touched`
    touched: IntArray  # indices of the control points that matter in the stretches
    tables: SpanPolynomials
    low: Array
    high: Array  # limits (m,) of the stretch in which each foot point is searched

    @staticmethod
    def of(control_keys: Sequence[int] | IntArray, tables: SpanPolynomials, low: Array, high: Array) -> Curve:
        """Select, from the keys of all distinct control points, those that matter in the stretches (m,)."""
        if len(control_keys) != tables.size:
            raise ValueError(
                f"expected a key for each of {tables.size} control points, found {len(control_keys)}"
            )
        touched = _touched(tables, low, high)
        return Curve(tuple(int(control_keys[j]) for j in touched), touched, tables, low, high)

    def control_points(self, values: gtsam.Values) -> Array:
        """Return the unwrapped control points (n, 2); the ones that do not matter here stay zero."""
        size = self.tables.size
        distinct = np.zeros((size, 2))
        distinct[self.touched] = [values.atPoint2(key) for key in self.keys]
        return np.asarray(distinct[np.arange(len(self.tables.starts) + self.tables.degree) % size])

    def foot(self, values: gtsam.Values, points: Array) -> FootPoints:
        """Return the foot points of points (m, 2), map frame, each in its stretch."""
        step = GRID_SHARE * self.tables.length / len(self.tables.starts)
        return foot_points(self.tables, self.control_points(values), points, self.low, self.high, step)

    def usable(self, foot: FootPoints) -> tuple[BoolArray, IntArray]:
        """Return whether rows (m,) contribute, and the slots (m, p + 1) of their control points' keys."""
        slots = self.slots(foot.span)
        return foot.interior & (slots >= 0).all(axis=1), slots

    def slots(self, span: IntArray) -> IntArray:
        """Slots (m, p + 1) in `keys` of the control points of spans (m,), -1 for others."""
        size = self.tables.size
        slot_of = np.full(size, -1, dtype=np.intp)
        slot_of[self.touched] = np.arange(len(self.touched))
        return np.asarray(slot_of[(span[:, None] + np.arange(-self.tables.degree, 1)) % size])

    def by_key(self, by_control: Array, slots: IntArray) -> Array:
        """Sum derivatives by the points of each span (m, p + 1, d) to derivatives by key (keys, m, d)."""
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
    """Write every Jacobian to H, after the checks of shapes that GTSAM leaves out."""
    if len(H) != len(blocks):
        raise ValueError(f"expected {len(H)} Jacobians, one a key, found {len(blocks)}")
    for i, block in enumerate(blocks):
        if block.ndim != 2 or len(block) != len(blocks[0]):
            raise ValueError(f"expected {len(blocks[0])} rows in Jacobian {i}, found shape {block.shape}")
        H[i] = block


def smoothness_factors(
    control_keys: Sequence[int], matrix: Array, sigma: float
) -> list[gtsam.LinearContainerFactor]:
    """Build linear factors `D c ~ N(0, sigma^2)`, one for each row of D (`residuals.smoothness_matrix`)."""
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
    """Build the factor `Log(delta^-1 x_i^-1 x_j) + G b`, b (2,) the scale error and the yaw-rate bias."""
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
