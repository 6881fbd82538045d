"""The ribbon factor: a detection's distance beyond the edge of a track that is a centre line with a width.

A ribbon is one B-spline in (x, y, h): its centre line C(u) in the map frame, and the distance h(u) along the
normal to either edge. The paper leaves this model of a track to future work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np
from numpy.typing import NDArray

from .footpoint import FootPoints, foot_points
from .gtsam_factors import Curve, CycleSightings, SightedRows
from .projection import sigma_across
from .spans import SpanPolynomials

Array = NDArray[np.float64]

RIBBON: Final = 3
"""A control point of a ribbon has this number of entries: x, y (m, map frame) and half the width h (m)."""
_LEAST_SPREAD = 0.05
"""1 - k d, which vanishes at the centre of curvature, counts as at least this."""


@dataclass(frozen=True)
class RibbonRows:
    """Holds one row for each detection: residual, gradient and Jacobian blocks, not whitened."""

    residual: Array
    """This is how far (m,) the detection lies outside of the edge of its side, in m."""
    by_point: Array
    """These are the derivatives (m, 2) by the detection in the map frame."""
    by_control: Array
    """These are the derivatives (m, degree + 1, 3) by the control points (x, y, h) of the span."""


def beyond_edge(tables: SpanPolynomials, control_points: Array, sides: Array, foot: FootPoints) -> RibbonRows:
    """Returns `r = s n . (p - C(u)) - h(u)`, with u the foot point of p on the centre line C.

    The side s (m,) is 1 for the left edge and -1 for the right one. control_points (n, 3) are those of the
    ribbon, with those that a closed one repeats. The distance d = n . (p - C) does not depend on u, but h
    does. With the unit tangent t, the speed |C'| and the curvature k of the centre line,

        du/dp = t / (|C'| (1 - k d)),   du/dc_j = (d beta'_j n / |C'| - beta_j t) / (|C'| (1 - k d)),
        dr/dp = s n - h' du/dp,   dr/dc_j = -s beta_j n - h' du/dc_j,   dr/dh_j = -beta_j

    are exact at an interior foot point.
    """
    (basis, slope, bend), span = tables.evaluate(foot.u, 2)
    columns = span[:, None] + np.arange(-tables.degree, 1)
    points = control_points[columns]
    half, half_slope = (np.einsum("mj,mj->m", values, points[:, :, 2]) for values in (basis, slope))
    first, second = (np.einsum("mj,mjd->md", values, points[:, :, :2]) for values in (slope, bend))
    speed = np.hypot(first[:, 0], first[:, 1])
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    n, t, d = foot.normal_unit, foot.tangent_unit, foot.distance
    along = half_slope / (speed * np.maximum(1.0 - curvature * d, _LEAST_SPREAD))
    by_control = np.empty((*basis.shape, RIBBON))
    turning = (along * d / speed)[:, None] * slope + sides[:, None] * basis
    by_control[:, :, :2] = (along[:, None] * basis)[:, :, None] * t[:, None]
    by_control[:, :, :2] -= turning[:, :, None] * n[:, None]
    by_control[:, :, 2] = -basis
    return RibbonRows(sides * d - half, sides[:, None] * n - along[:, None] * t, by_control)


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
    """Returns the factor `e_i = r_i / sigma_i` of the detections of one cycle, on either side of a ribbon.

    r is that of `beyond_edge`, and sigma that across the centre line. The keys of the control points hold
    `Point3` (x, y, h). sides (m,) are 1 for left and -1 for right. All other arguments, and how the robust
    weights enter, are those of `gtsam_factors.spline_projection_factor`.
    """
    if not len(points_vehicle) == len(covariances) == len(sides) == len(low) == len(high) > 0:
        raise ValueError(
            f"expected as many detections, covariances, sides and stretches, at least one, found "
            f"{len(points_vehicle)}, {len(covariances)}, {len(sides)} and {len(low)}, {len(high)}"
        )
    curve = Curve.of(control_keys, tables, low, high)
    return _Ribbon(
        int(pose_key), curve, points_vehicle, covariances, sigma_model, huber, sensor_key, twists, sides
    ).factor


@dataclass(frozen=True, eq=False)
class _Ribbon(CycleSightings):
    """Evaluates a ribbon factor."""

    sides: Array
    """Each detection (m,) is of the left edge where this is 1, and of the right one where it is -1."""

    def rows(self, values: gtsam.Values, points: Array, poses: Array) -> SightedRows:
        """Returns how far the detections are beyond their edges."""
        curve = self.curve
        distinct = np.zeros((curve.size, RIBBON))
        distinct[curve.touched] = [values.atPoint3(key) for key in curve.keys]
        control_points = curve.unwrapped(distinct)
        centre = np.ascontiguousarray(control_points[:, :2])
        foot = foot_points(curve.tables, centre, points, curve.low, curve.high, curve.step)
        beyond = beyond_edge(curve.tables, control_points, self.sides, foot)
        gradient, arm = beyond.by_point, points - poses[:, :2]
        by_theta = gradient[:, 1] * arm[:, 0] - gradient[:, 0] * arm[:, 1]
        steepness = np.hypot(gradient[:, 0], gradient[:, 1])
        return SightedRows(
            residual=beyond.residual,
            sigma=sigma_across(foot.normal_unit, self.covariances, poses, self.sigma_model),
            direction=gradient / steepness[:, None],
            steepness=steepness,
            by_pose=np.column_stack([gradient, by_theta]),
            by_control=beyond.by_control,
            foot=foot,
        )
