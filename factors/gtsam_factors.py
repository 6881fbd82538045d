"""Residuals as GTSAM factors for any nonlinear graph: projection, ribbon, spacing, smoothness and odometry.

A factor holds its measurement and its keys, but no graph. It is a pure function of the values.
"""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from .arrays import Array, BoolArray, IntArray
from .bspline import SpanPolynomials
from .footpoint import FootPoints, foot_points
from .linear import linear_factor
from .noise import huber_roots, huber_weights
from .odometry import IntegratedOdometry, odometry_residuals
from .residuals import RIBBON, beyond_edge, sigma_across
from .se2 import rotation, to_map
from .sensor import corrected, sensor_rows

JacobianList = MutableSequence[Array]

GRID_SHARE = 0.25
"""The coarse step of the foot-point search is this share of the mean knot interval."""


def spline_projection_factor(
    pose_key: int,
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
) -> gtsam.CustomFactor:
    """Return the factor `e_i = n_i . (R z_i + t - S(u_i)) / sigma_i` of one cycle on one boundary.

    The rows are those of `project`. control_keys (k,) are the keys of all distinct control points; the factor
    holds those that matter in the stretches [low, high] (m,), where foot points are searched for. A stretch
    is a few metres about the expected foot point. points_vehicle z (m, 2) and covariances (m, 2, 2) are in
    the vehicle frame, and sigma_model is in m. A row's weight falls beyond the whitened residual `huber`,
    which may be infinite.

    With a `sensor_key`, the detections are corrected by the sensor's calibration (5,) of that key (see
    `sensor.by_sensor`), with twists (m, 3) of the vehicle in m/s, m/s and rad/s.

    Foot points, standard deviations and weights are recomputed at every evaluation. With Jacobians, rows are
    scaled by the square root of their Huber weight. Without, half their squares are the Huber loss, so that
    an optimizer judges its steps by the true cost. No derivative contains the turning of sigma with the
    normal, so an optimizer that judges by the error may stop beside the fixed point of Gauss-Newton, by as
    much as sigma depends on the direction. A row whose foot point is not interior contributes zero; where
    foot points leave their stretches, the factor is to be created again.
    """
    _require_alike("detections, covariances and stretches", points_vehicle, covariances, low, high)
    curve = Curve.of(control_keys, tables, low, high)
    detections = points_vehicle, covariances, sigma_model, huber
    return _Sightings(int(pose_key), curve, *detections, sensor_key, twists).factor


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
    """Return a `spline_projection_factor` for each pose in pose_keys (m,), the key of each row's own pose.

    The rows of one pose are neighbours. All other arguments are those of `spline_projection_factor`.
    """
    changes = np.flatnonzero(np.diff(pose_keys)) + 1
    return [
        spline_projection_factor(
            int(pose_keys[own[0]]),
            control_keys,
            tables,
            points_vehicle=points_vehicle[own],
            covariances=covariances[own],
            low=low[own],
            high=high[own],
            sigma_model=sigma_model,
            huber=huber,
            sensor_key=sensor_key,
            twists=None if twists is None else twists[own],
        )
        for own in np.split(np.arange(len(pose_keys)), changes)
        if len(own)
    ]


def ribbon_factor(
    pose_key: int,
    control_keys: Sequence[int],
    tables: SpanPolynomials,
    *,
    points_vehicle: Array,
    covariances: Array,
    sides: Array,
    low: Array,
    high: Array,
    sigma_model: float,
    huber: float,
    sensor_key: int | None = None,
    twists: Array | None = None,
) -> gtsam.CustomFactor:
    """Return the factor `e_i = r_i / sigma_i` of the detections of one cycle, on either side of a ribbon.

    r is that of `beyond_edge`, and sigma that across the centre line. The keys of the control points hold
    `Point3` (x, y, h). sides (m,) are 1 for left and -1 for right. All other arguments, and how the robust
    weights enter, are those of `spline_projection_factor`.
    """
    _require_alike(
        "detections, covariances, sides and stretches", points_vehicle, covariances, sides, low, high
    )
    curve = Curve.of(control_keys, tables, low, high)
    detections = points_vehicle, covariances, sigma_model, huber
    return _Sightings(int(pose_key), curve, *detections, sensor_key, twists, sides).factor


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
    are as in `spline_projection_factor`. A row whose foot point is not interior contributes zero.
    """
    _require_alike("points, sigmas and stretches", points_map, sigma, low, high)
    curve = Curve.of(control_keys, tables, low, high)
    function = _BoundaryPoint(curve, points_map, sigma)
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(low)), list(curve.keys), function)


@dataclass(frozen=True, eq=False)
class Curve:
    """Stretches of a curve that a factor depends on, and the keys that matter there."""

    keys: tuple[int, ...]
    """Keys of the control points `touched`."""
    touched: IntArray
    """Indices of the control points whose keys are held."""
    tables: SpanPolynomials
    low: Array
    high: Array
    """Limits (m,) of the stretch where each foot point is searched for."""

    @staticmethod
    def of(control_keys: Sequence[int], tables: SpanPolynomials, low: Array, high: Array) -> Curve:
        """Select, from the keys of all distinct control points, those that matter in the stretches (m,)."""
        size = _distinct(tables)
        if len(control_keys) != size:
            raise ValueError(f"expected a key for each of {size} control points, found {len(control_keys)}")
        touched = _touched(tables, low, high)
        return Curve(tuple(int(control_keys[j]) for j in touched), touched, tables, low, high)

    @property
    def size(self) -> int:
        """Return the number of distinct control points."""
        return _distinct(self.tables)

    def control_points(self, values: gtsam.Values, entries: int = 2) -> Array:
        """Return the unwrapped control points (n, entries); those that do not matter here stay zero."""
        at, distinct = values.atPoint2 if entries == 2 else values.atPoint3, np.zeros((self.size, entries))
        distinct[self.touched] = [at(key) for key in self.keys]
        return np.asarray(distinct[np.arange(len(self.tables.starts) + self.tables.degree) % self.size])

    def find(self, control_points: Array, points: Array) -> FootPoints:
        step = GRID_SHARE * self.tables.length / len(self.tables.starts)
        return foot_points(self.tables, control_points, points, self.low, self.high, step)

    def usable(self, foot: FootPoints) -> tuple[BoolArray, IntArray]:
        """Return which rows (m,) may contribute, and the slots (m, p + 1) of their control points' keys."""
        size = self.size
        slot_of = np.full(size, -1, dtype=np.intp)
        slot_of[self.touched] = np.arange(len(self.touched))
        slots = slot_of[(foot.span[:, None] + np.arange(-self.tables.degree, 1)) % size]
        return foot.interior & (slots >= 0).all(axis=1), slots

    def by_key(self, by_control: Array, slots: IntArray) -> Array:
        """Return derivatives by key (keys, m, d) from those by the points of each span (m, p + 1, d)."""
        blocks = np.zeros((len(self.touched), len(by_control), by_control.shape[2]))
        np.add.at(blocks, (slots, np.arange(len(by_control))[:, None]), by_control)
        return blocks


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Factor on the detections of one cycle: of a boundary, or of the edges of a ribbon."""

    pose_key: int
    """Key of the pose that the detections were made from."""
    curve: Curve
    points_vehicle: Array
    """Detections (m, 2) in the vehicle frame, in m."""
    covariances: Array
    """Their covariances (m, 2, 2) in the vehicle frame, in m^2."""
    sigma_model: float
    """Cones lie about a smooth curve with this standard deviation (m)."""
    huber: float
    """The weight of a row falls beyond this whitened residual."""
    sensor_key: int | None
    """Key of the sensor's calibration, if the detections are corrected by it."""
    twists: Array | None
    """The vehicle moved with these twists (m, 3), in m/s, m/s and rad/s; None means that it stood."""

    sides: Array | None = None
    """Each detection (m,) of a ribbon is of the left edge (1) or of the right one (-1)."""

    @property
    def factor(self) -> gtsam.CustomFactor:
        """Return the factor on the pose, the sensor's calibration and the control points."""
        sensor = [] if self.sensor_key is None else [int(self.sensor_key)]
        noise = gtsam.noiseModel.Unit.Create(len(self.points_vehicle))
        return gtsam.CustomFactor(noise, [self.pose_key, *sensor, *self.curve.keys], self)

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Return robust whitened rows (m,), and write their Jacobians to H where it is given."""
        pose, measured = values.atPose2(self.pose_key), self.points_vehicle
        twists = np.zeros((len(measured), 3)) if self.twists is None else self.twists
        poses = np.tile(pose_array(pose), (len(measured), 1))
        sensor = np.zeros(0) if self.sensor_key is None else np.array(values.atVector(self.sensor_key))
        points = to_map(corrected(measured, twists, sensor), poses)
        foot, residual, gradient, by_control = self._distances(values, points)
        sigma = sigma_across(foot.normal_unit, self.covariances, poses, self.sigma_model)
        steepness = np.hypot(gradient[:, 0], gradient[:, 1])
        direction = gradient / steepness[:, None]
        by = sensor_rows(direction, residual / steepness, poses, measured, twists, sensor)
        usable, slots = self.curve.usable(foot)
        whitened = by.factor * residual / sigma
        if H is None:
            return np.asarray(huber_roots(whitened, self.huber) * usable)
        root = np.sqrt(huber_weights(whitened, self.huber)) * usable
        scale, arm = by.factor * root / sigma, points - poses[:, :2]
        by_theta = gradient[:, 1] * arm[:, 0] - gradient[:, 0] * arm[:, 1]
        by_pose = np.column_stack([gradient @ rotation(pose.theta()), by_theta]) * scale[:, None]
        by_calibration = [by.by_sensor * (steepness * root / sigma)[:, None]] if len(sensor) else []
        fill(H, [by_pose, *by_calibration, *self.curve.by_key(by_control * scale[:, None, None], slots)])
        return np.asarray(whitened * root)

    def _distances(self, values: gtsam.Values, points: Array) -> tuple[FootPoints, Array, Array, Array]:
        """Return foot points, distances (m,), and their derivatives (m, 2) and (m, degree + 1, d).

        The derivatives are by the points (m, 2), map frame, and by the control points of each span.
        """
        if self.sides is None:
            foot = self.curve.find(self.curve.control_points(values), points)
            n = foot.normal_unit
            return foot, foot.distance, n, -foot.basis[:, :, None] * n[:, None, :]
        ribbon = self.curve.control_points(values, RIBBON)
        foot = self.curve.find(np.ascontiguousarray(ribbon[:, :2]), points)
        beyond = beyond_edge(self.curve.tables, ribbon, self.sides, foot)
        return foot, beyond.residual, beyond.by_point, beyond.by_control


@dataclass(frozen=True, eq=False)
class _BoundaryPoint:
    curve: Curve
    points: Array
    """Points (m, 2) in the map frame, in m."""
    sigma: Array
    """Standard deviations (m,) across the curve, in m."""

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Return whitened rows (m,), and write their Jacobians to H where it is given."""
        foot = self.curve.find(self.curve.control_points(values), self.points)
        usable, slots = self.curve.usable(foot)
        scale = usable / self.sigma
        if H is not None:
            by_control = -foot.basis[:, :, None] * foot.normal_unit[:, None, :] * scale[:, None, None]
            fill(H, [*self.curve.by_key(by_control, slots)])
        return np.asarray(foot.distance * scale)


def _require_alike(names: str, *arrays: Array) -> None:
    lengths = [len(array) for array in arrays]
    if len(set(lengths)) > 1 or lengths[0] == 0:
        raise ValueError(f"expected as many {names}, at least one, found {', '.join(map(str, lengths))}")


def pose_array(pose: gtsam.Pose2) -> Array:
    """Return (x, y, theta) in m, m and rad, with theta in (-pi, pi]."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def _distinct(tables: SpanPolynomials) -> int:
    return len(tables.starts) if tables.periodic else len(tables.starts) + tables.degree


def _touched(tables: SpanPolynomials, low: Array, high: Array) -> IntArray:
    """Return the indices of the control points that matter anywhere in the stretches [low, high] (m,)."""
    period, spans = tables.high - tables.low, len(tables.starts)
    first, last = tables.locate(low)[0], tables.locate(high)[0]
    if tables.periodic:
        turns = np.floor((high - tables.low) / period) - np.floor((low - tables.low) / period)
        last = np.minimum(last + spans * turns.astype(np.intp), first + spans)
    stretches = zip(first, last + tables.degree + 1, strict=True)
    return np.unique(np.concatenate([np.arange(i, end) for i, end in stretches]) % _distinct(tables))


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
    return [_smoothness_factor(control_keys, row, sigma) for row in matrix]


def _smoothness_factor(control_keys: Sequence[int], row: Array, sigma: float) -> gtsam.LinearContainerFactor:
    columns = np.flatnonzero(row)
    keys = [control_keys[int(j)] for j in columns]
    zero = gtsam.Values()
    for key in keys:
        zero.insert(key, np.zeros(2))
    A = np.kron(row[columns] / sigma, np.eye(2)).astype(np.float64)
    linear = linear_factor(keys, [2] * len(keys), A, np.zeros(2))
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(linear), zero)


def odometry_factor(
    first_key: int, second_key: int, odometry: IntegratedOdometry
) -> gtsam.BetweenFactorPose2:
    """Return GTSAM's factor `Log(delta^-1 x_i^-1 x_j)` between two poses, with the odometry's covariance."""
    return gtsam.BetweenFactorPose2(first_key, second_key, gtsam.Pose2(*odometry.delta), _noise(odometry))


def calibrated_odometry_factor(
    first_key: int, second_key: int, calibration_key: int, odometry: IntegratedOdometry
) -> gtsam.CustomFactor:
    """Return the factor `Log(delta^-1 x_i^-1 x_j) + G b`, b (2,) the scale error and the yaw-rate bias."""
    keys = (int(first_key), int(second_key), int(calibration_key))
    return gtsam.CustomFactor(_noise(odometry), list(keys), _CalibratedOdometry(keys, odometry))


def _noise(odometry: IntegratedOdometry) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Information(odometry.whitener.T @ odometry.whitener)


@dataclass(frozen=True, eq=False)
class _CalibratedOdometry:
    keys: tuple[int, int, int]
    """Keys of the start, the end and the calibration."""
    odometry: IntegratedOdometry

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Return the residual (3,), and write its Jacobians to H; the noise model whitens both."""
        start, end = values.atPose2(self.keys[0]), values.atPose2(self.keys[1])
        residual, by_start, by_end = odometry_residuals(
            pose_array(start)[None], pose_array(end)[None], self.odometry.delta[None]
        )
        by_start[0, :, :2] = by_start[0, :, :2] @ rotation(start.theta())
        by_end[0, :, :2] = by_end[0, :, :2] @ rotation(end.theta())
        if H is not None:
            fill(H, [by_start[0], by_end[0], self.odometry.calibration_jacobian])
        calibration = values.atPoint2(self.keys[2])
        return np.asarray(residual[0] + self.odometry.calibration_jacobian @ calibration)
