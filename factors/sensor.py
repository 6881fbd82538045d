"""Calibration of the sensor: yaw, lateral offset, latency, and scale and bias of the ranges.

All five are estimated along with the map. They are small, so detections are corrected to first order.
"""

import numpy as np

from . import _kernels as kernels
from .arrays import Array
from .se2 import left_of

SENSOR = ("yaw", "lateral", "latency", "range_scale", "range_bias")
"""Entries of the calibration b: yaw (rad) and lateral offset (m), positive to the left; age of detections at
their stamps (s); scale error (-) and bias (m) of the ranges."""
SENSOR_SIZE = len(SENSOR)
RANGE = slice(3, 5)  # entries that are errors of the ranges
BENDS_FROM = 8.0  # range from which ranges may bend (m); cones beside the vehicle are nearer


def by_sensor(points_vehicle: Array, twists: Array) -> Array:
    """Derivatives C (m, 2, 5) of corrected detections `z + C b` by the sensor's calibration b.

    points_vehicle z (m, 2) are the measured positions in m, twists (m, 3) the vehicle's at their stamps (m/s,
    m/s, rad/s). With J the quarter turn and `v + wz J z` the motion relative to a point at rest, the columns
    are

        J z (yaw),   (0, 1) (lateral),   -(v + wz J z) (latency),   -z (range scale),   -z / |z| (range bias)

    The second order is neglected: for a yaw of 2 degrees it is 9 mm at 15 m.
    """
    turned = left_of(points_vehicle)
    distance = np.maximum(np.hypot(points_vehicle[:, 0], points_vehicle[:, 1]), np.finfo(float).tiny)
    columns = np.empty((len(points_vehicle), 2, SENSOR_SIZE))
    columns[:, :, 0] = turned
    columns[:, :, 1] = 0.0, 1.0
    columns[:, :, 2] = -(twists[:, :2] + twists[:, 2:] * turned)
    columns[:, :, 3] = -points_vehicle
    columns[:, :, 4] = -points_vehicle / distance[:, None]
    return columns


def by_bend(points_vehicle: Array) -> Array:
    """Derivative (m,) of `|z'| / |z|` by the bend k of the ranges, for detections z (m, 2).

    A range r beyond b = `BENDS_FROM` is measured too long by `k (r - b)^2`: the derivative is `(r - b)^2 /
    r`. It models a detector whose scale and bias fit near cones, and whose depth error grows with the square.
    """
    distance = np.hypot(points_vehicle[:, 0], points_vehicle[:, 1])
    return np.asarray(np.maximum(distance - BENDS_FROM, 0.0) ** 2 / np.maximum(distance, BENDS_FROM))


def corrected(measured: Array, twists: Array, sensor: Array) -> Array:
    """Correct detections z (m, 2) by the calibration b (5,) to `z + C b`; an empty b changes nothing."""
    return kernels.shifted(measured, twists, sensor) if len(sensor) else measured


def by_range(points_vehicle: Array) -> Array:
    """Derivatives (m, 2, 2, 2) of `-M` by the range scale and by the range bias.

    M is the derivative of a corrected detection by the measured one, z (m, 2). Covariances are stated for
    measured detections, so a residual r of a corrected one counts as `M^-1 r`. Without this, least squares
    would shrink the world. `M^-1` is exact: to first order, a scale error s would still shrink it by the
    order of `s^2`, which is 0.6 % for the 8 % of a poor camera. The derivatives are

        I (range scale),   (I - z z' / |z|^2) / |z| (range bias)
    """
    distance = np.maximum(np.hypot(points_vehicle[:, 0], points_vehicle[:, 1]), np.finfo(float).tiny)
    unit = points_vehicle / distance[:, None]
    rates = np.empty((len(points_vehicle), 2, 2, 2))
    rates[:, 0] = np.eye(2)
    rates[:, 1] = (np.eye(2) - unit[:, :, None] * unit[:, None, :]) / distance[:, None, None]
    return rates


def restored(residual: Array, measured: Array, twists: Array, sensor: Array) -> tuple[Array, Array]:
    """Return `M^-1` (m, 2, 2) and the derivatives of `M^-1 r` (m, 2, 5) by the sensor's calibration.

    residual r (m, 2) is the expected minus the corrected detection, vehicle frame; measured (m, 2) and twists
    (m, 3) are as in `by_sensor`. The derivatives are `-M^-1 C`, plus `dM^-1 r = -M^-1 dM M^-1 r` for those
    of the ranges. For an empty calibration M is the identity, and the derivatives are (m, 2, 0).
    """
    if len(sensor) == 0:
        return np.tile(np.eye(2), (len(measured), 1, 1)), np.zeros((len(measured), 2, 0))
    rates = by_range(measured)
    inverse = np.linalg.inv(np.eye(2) - np.einsum("mkij,k->mij", rates, sensor[RANGE]))
    jacobian = -inverse @ by_sensor(measured, twists)
    lengthened = np.einsum("mij,mj->mi", inverse, residual)
    jacobian[:, :, RANGE] += np.einsum("mil,mklj,mj->mik", inverse, rates, lengthened)
    return inverse, jacobian
