"""Residuals as GTSAM factors for any nonlinear graph: projection, spacing, smoothness and odometry.

A factor holds its measurement and its keys, but no graph. It is a pure function of the values.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from .footpoint import FootPoints, foot_points
from .noise import huber_roots, huber_weights
from .odometry import IntegratedOdometry, odometry_residuals
from .projection import project
from .se2 import rotation, to_map
from .sensor import corrected, sensor_rows
from .spans import SpanPolynomials

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
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
    """Returns the factor `e_i = n_i . (R z_i + t - S(u_i)) / sigma_i` of one cycle on one boundary.

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
    if not len(points_vehicle) == len(covariances) == len(low) == len(high) > 0:
        raise ValueError(
            f"expected as many detections, covariances and stretches, at least one, found "
            f"{len(points_vehicle)}, {len(covariances)} and {len(low)}, {len(high)}"
        )
    curve = Curve.of(control_keys, tables, low, high)
    return _Projection(
        int(pose_key), curve, points_vehicle, covariances, sigma_model, huber, sensor_key, twists
    ).factor


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
    """Returns a `spline_projection_factor` for each pose in pose_keys (m,), the key of each row's own pose.

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


def boundary_point_factor(
    control_keys: Sequence[int],
    tables: SpanPolynomials,
    *,
    points_map: Array,
    sigma: Array,
    low: Array,
    high: Array,
) -> gtsam.CustomFactor:
    """Returns the factor `e_i = n_i . (p_i - S(u_i)) / sigma_i`: a boundary passes through surveyed points.

    A surveyed point is, for example, the corner of a wall. points_map p (m, 2) are in the map frame and sigma
    (m,) in m; u_i is the foot point of p_i in the stretch [low_i, high_i] of the curve. Keys and stretches
    are as in `spline_projection_factor`. A row whose foot point is not interior contributes zero.
    """
    if not len(points_map) == len(sigma) == len(low) == len(high) > 0:
        raise ValueError(
            f"expected as many points, sigmas and stretches, at least one, found "
            f"{len(points_map)}, {len(sigma)} and {len(low)}, {len(high)}"
        )
    curve = Curve.of(control_keys, tables, low, high)
    function = _BoundaryPoint(curve, points_map, sigma)
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(low)), list(curve.keys), function)


@dataclass(frozen=True, eq=False)
class Curve:
    """Holds the stretches of a curve that a factor depends on, and the keys that matter there."""

    keys: tuple[int, ...]
    """These are the keys of the control points `touched`."""
    touched: IntArray
    """These are the indices of the control points whose keys are held."""
    tables: SpanPolynomials
    """These are the basis functions."""
    low: Array
    """The stretch where each foot point is searched for begins here (m,)."""
    high: Array
    """The stretch where each foot point is searched for ends here (m,)."""

    @staticmethod
    def of(control_keys: Sequence[int], tables: SpanPolynomials, low: Array, high: Array) -> Curve:
        """Selects, from the keys of all distinct control points, those that matter in the stretches (m,)."""
        size = _distinct(tables)
        if len(control_keys) != size:
            raise ValueError(f"expected a key for each of {size} control points, found {len(control_keys)}")
        touched = _touched(tables, low, high)
        return Curve(tuple(int(control_keys[j]) for j in touched), touched, tables, low, high)

    @property
    def size(self) -> int:
        """Returns the number of distinct control points."""
        return _distinct(self.tables)

    @property
    def step(self) -> float:
        """Returns the coarse step of the foot-point search (m along the curve)."""
        return GRID_SHARE * (self.tables.high - self.tables.low) / len(self.tables.starts)

    def unwrapped(self, distinct: Array) -> Array:
        """Returns the control points, with those that a closed curve repeats, from the distinct ones."""
        return np.asarray(distinct[np.arange(_unwrapped(self.tables)) % len(distinct)])

    def find(self, values: gtsam.Values, points: Array) -> FootPoints:
        """Returns foot points within the stretches; control points that do not matter there stay zero."""
        distinct = np.zeros((self.size, 2))
        distinct[self.touched] = [values.atPoint2(key) for key in self.keys]
        return foot_points(self.tables, self.unwrapped(distinct), points, self.low, self.high, self.step)

    def usable(self, foot: FootPoints) -> tuple[NDArray[np.bool_], IntArray]:
        """Returns which rows (m,) may contribute, and the slots (m, p + 1) of their control points' keys."""
        size = self.size
        slot_of = np.full(size, -1, dtype=np.intp)
        slot_of[self.touched] = np.arange(len(self.touched))
        slots = slot_of[(foot.span[:, None] + np.arange(-self.tables.degree, 1)) % size]
        return foot.interior & (slots >= 0).all(axis=1), slots

    def by_key(self, by_control: Array, slots: IntArray) -> Array:
        """Returns derivatives by key (keys, m, d) from those by the points of each span (m, p + 1, d)."""
        blocks = np.zeros((len(self.touched), len(by_control), by_control.shape[2]))
        np.add.at(blocks, (slots, np.arange(len(by_control))[:, None]), by_control)
        return blocks


@dataclass(frozen=True, eq=False)
class SightedRows:
    """Holds a row for each detection of a cycle, not whitened, with r the residual of a point p."""

    residual: Array
    """These are the residuals (m,) in m."""
    sigma: Array
    """These are their standard deviations (m,) in m."""
    direction: Array
    """These are the unit vectors (m, 2), map frame, along dr/dp."""
    steepness: Array
    """These are the lengths (m,) of dr/dp."""
    by_pose: Array
    """These are the derivatives (m, 3) by the pose (x, y, theta) in the map frame."""
    by_control: Array
    """These are the derivatives (m, degree + 1, d) by the control points of the foot point's span."""
    foot: FootPoints
    """These are the foot points."""


@dataclass(frozen=True, eq=False)
class CycleSightings(ABC):
    """Evaluates a factor on the detections of one cycle; an heir says what is measured, by `rows`."""

    pose_key: int
    """This is the key of the pose that the detections were made from."""
    curve: Curve
    """The detections have their foot points on this curve."""
    points_vehicle: Array
    """These are the detections (m, 2) in the vehicle frame, in m."""
    covariances: Array
    """These are their covariances (m, 2, 2) in the vehicle frame, in m^2."""
    sigma_model: float
    """Cones lie about a smooth curve with this standard deviation (m)."""
    huber: float
    """The weight of a row falls beyond this whitened residual."""
    sensor_key: int | None
    """This is the key of the sensor's calibration, if the detections are corrected by it."""
    twists: Array | None
    """The vehicle moved with these twists (m, 3), in m/s, m/s and rad/s; None means that it stood."""

    @abstractmethod
    def rows(self, values: gtsam.Values, points: Array, poses: Array) -> SightedRows:
        """Returns the rows of corrected detections (m, 2), map frame, from poses (m, 3)."""

    @property
    def factor(self) -> gtsam.CustomFactor:
        """Returns the factor on the pose, the sensor's calibration and the control points."""
        sensor = [] if self.sensor_key is None else [int(self.sensor_key)]
        noise = gtsam.noiseModel.Unit.Create(len(self.points_vehicle))
        return gtsam.CustomFactor(noise, [self.pose_key, *sensor, *self.curve.keys], self)

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Returns robust whitened rows (m,), and writes their Jacobians to H where it is given."""
        pose, measured = values.atPose2(self.pose_key), self.points_vehicle
        twists = np.zeros((len(measured), 3)) if self.twists is None else self.twists
        poses = np.tile(pose_array(pose), (len(measured), 1))
        sensor = np.zeros(0) if self.sensor_key is None else np.array(values.atVector(self.sensor_key))
        rows = self.rows(values, to_map(corrected(measured, twists, sensor), poses), poses)
        usable, slots = self.curve.usable(rows.foot)
        by = sensor_rows(rows.direction, rows.residual / rows.steepness, poses, measured, twists, sensor)
        whitened = by.factor * rows.residual / rows.sigma
        if H is None:
            return np.asarray(huber_roots(whitened, self.huber) * usable)
        root = np.sqrt(huber_weights(whitened, self.huber)) * usable
        own = root / rows.sigma
        scale = by.factor * own
        by_pose = rows.by_pose * scale[:, None]
        by_pose[:, :2] = by_pose[:, :2] @ rotation(pose.theta())
        by_calibration = [by.by_sensor * (rows.steepness * own)[:, None]] if len(sensor) else []
        by_control = self.curve.by_key(rows.by_control * scale[:, None, None], slots)
        fill(H, [by_pose, *by_calibration, *by_control])
        return np.asarray(whitened * root)


@dataclass(frozen=True, eq=False)
class _Projection(CycleSightings):
    """Evaluates a spline-projection factor."""

    def rows(self, values: gtsam.Values, points: Array, poses: Array) -> SightedRows:
        """Returns the signed distances across the curve."""
        foot = self.curve.find(values, points)
        across = project(points, self.covariances, poses, foot, self.sigma_model)
        return SightedRows(
            residual=across.residual,
            sigma=across.sigma,
            direction=foot.normal_unit,
            steepness=np.ones(len(points)),
            by_pose=across.by_pose,
            by_control=across.by_control,
            foot=foot,
        )


@dataclass(frozen=True, eq=False)
class _BoundaryPoint:
    """Evaluates a boundary-point factor."""

    curve: Curve
    """This curve passes through the points."""
    points: Array
    """These are the points (m, 2) in the map frame, in m."""
    sigma: Array
    """These are the standard deviations (m,) across the curve, in m."""

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Returns whitened rows (m,), and writes their Jacobians to H where it is given."""
        foot = self.curve.find(values, self.points)
        usable, slots = self.curve.usable(foot)
        scale = usable / self.sigma
        if H is not None:
            by_control = -foot.basis[:, :, None] * foot.normal_unit[:, None, :] * scale[:, None, None]
            fill(H, [*self.curve.by_key(by_control, slots)])
        return np.asarray(foot.distance * scale)


def pose_array(pose: gtsam.Pose2) -> Array:
    """Returns (x, y, theta) in m, m and rad, with theta in (-pi, pi]."""
    return np.array([pose.x(), pose.y(), pose.theta()])


def _unwrapped(tables: SpanPolynomials) -> int:
    """Returns the number of control points, with those that a periodic spline repeats."""
    return len(tables.knots) - tables.degree - 1


def _distinct(tables: SpanPolynomials) -> int:
    """Returns the number of control points, without those that a periodic spline repeats."""
    return _unwrapped(tables) - (tables.degree if tables.periodic else 0)


def _touched(tables: SpanPolynomials, low: Array, high: Array) -> IntArray:
    """Returns the indices of the control points that matter anywhere in the stretches [low, high] (m,)."""
    period, spans = tables.high - tables.low, len(tables.starts)
    first, last = tables.locate(low)[0], tables.locate(high)[0]
    if tables.periodic:
        turns = np.floor((high - tables.low) / period) - np.floor((low - tables.low) / period)
        last = np.minimum(last + spans * turns.astype(np.intp), first + spans)
    stretches = zip(first, last + tables.degree + 1, strict=True)
    return np.unique(np.concatenate([np.arange(i, end) for i, end in stretches]) % _distinct(tables))


def fill(H: JacobianList, blocks: Sequence[Array]) -> None:
    """Writes every Jacobian to H; GTSAM does not check shapes, so they are checked here."""
    if len(H) != len(blocks):
        raise ValueError(f"expected {len(H)} Jacobians, one a key, found {len(blocks)}")
    for i, block in enumerate(blocks):
        if block.ndim != 2 or len(block) != len(blocks[0]):
            raise ValueError(f"expected {len(blocks[0])} rows in Jacobian {i}, found shape {block.shape}")
        H[i] = block


def spacing_factors(
    control_keys: Sequence[int], nominal: Array, sigma: Array, periodic: bool
) -> list[gtsam.RangeFactor2]:
    """Returns GTSAM's range factors `|c_{j+1} - c_j| - nominal_j` between neighbours.

    nominal and sigma are in m and have k - 1 entries, or k where periodic. See `gauge.spacing_residuals`.
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
    """Returns linear factors `D c ~ N(0, sigma^2)`, one for each row of D (`gauge.smoothness_matrix`)."""
    if matrix.shape[1] != len(control_keys):
        raise ValueError(f"expected a key for each of {matrix.shape[1]} columns, found {len(control_keys)}")
    return [_smoothness_factor(control_keys, row, sigma) for row in matrix]


def linear_factor(keys: Sequence[int], dims: Sequence[int], A: Array, b: Array) -> gtsam.GaussianConditional:
    """Returns the factor `1/2 |A x - b|^2` on any number of keys; A (m, sum of dims) and b (m,) are whitened.

    The binding's constructors take at most three keys. A Gaussian conditional has no such limit, and it is a
    Jacobian factor. The binding does not check shapes: ValueError where they do not fit.
    """
    if len(keys) != len(dims) or len(set(keys)) != len(keys):
        raise ValueError(f"expected one size for each of {len(keys)} different keys, found {len(dims)}")
    if A.shape != (len(b), sum(dims)):
        raise ValueError(f"expected a matrix of shape {(len(b), sum(dims))}, found {A.shape}")
    blocks = np.empty((len(b), A.shape[1] + 1), order="F")
    blocks[:, :-1], blocks[:, -1] = A, b
    return gtsam.GaussianConditional(list(keys), 1, gtsam.VerticalBlockMatrix([*dims, 1], blocks, False))


def _smoothness_factor(control_keys: Sequence[int], row: Array, sigma: float) -> gtsam.LinearContainerFactor:
    """Returns a linear factor about zero; without a linearization point GTSAM takes its error as zero."""
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
    """Returns GTSAM's factor `Log(delta^-1 x_i^-1 x_j)` between two poses, with the odometry's covariance."""
    return gtsam.BetweenFactorPose2(first_key, second_key, gtsam.Pose2(*odometry.delta), _noise(odometry))


def calibrated_odometry_factor(
    first_key: int, second_key: int, calibration_key: int, odometry: IntegratedOdometry
) -> gtsam.CustomFactor:
    """Returns the factor `Log(delta^-1 x_i^-1 x_j) + G b`, b (2,) the scale error and the yaw-rate bias."""
    keys = (int(first_key), int(second_key), int(calibration_key))
    return gtsam.CustomFactor(_noise(odometry), list(keys), _CalibratedOdometry(keys, odometry))


def _noise(odometry: IntegratedOdometry) -> gtsam.noiseModel.Gaussian:
    """Returns the noise model from the information; GTSAM ignores the lower triangle of a square root."""
    return gtsam.noiseModel.Gaussian.Information(odometry.whitener.T @ odometry.whitener)


@dataclass(frozen=True, eq=False)
class _CalibratedOdometry:
    """Evaluates a calibrated odometry factor."""

    keys: tuple[int, int, int]
    """These are the keys of the start, the end and the calibration."""
    odometry: IntegratedOdometry
    """This is the measurement."""

    def __call__(self, _: gtsam.CustomFactor, values: gtsam.Values, H: JacobianList | None) -> Array:
        """Returns the residual (3,), and writes its Jacobians to H; the noise model whitens both."""
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
