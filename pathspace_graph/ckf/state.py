"""The paper's state: the vehicle's pose and the control points of clamped splines, jointly Gaussian."""

from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.bspline import clamped_knots
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.residuals import greville, smoothness_matrix
from pathspace_graph.graph.variables import POINT
from pathspace_graph.mapping.belief import Belief, point_columns
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary, relocate
from pathspace_graph.spline.bspline import BSpline, end_change_matrix

SIGMA_START: Final = 0.3
"""Standard deviation (m) of each control point of a new curve, beyond the uncertainty of its first
detections."""


class CurveState:
    """The state `x = [pose | calibration | left control points | right control points]` and the curves'
    knots."""

    def __init__(self, belief: Belief, settings: MapperSettings) -> None:
        self.settings = settings
        self.belief = belief
        """Mean and covariance of x."""
        self.curves: dict[int, BSpline] = {}
        """Curves by label. Only the number of their control points is current; see `spline`."""
        self.pose_u: dict[int, float] = {}
        """Parameter of the vehicle's foot point on each curve, not wrapped."""

    @property
    def pose(self) -> Array:
        """Return the pose (3,), x (m), y (m), theta (rad, not wrapped), in the map frame: a view."""
        return self.belief.pose

    def offset(self, label: int) -> int:
        """Return the number of points in x before a curve's first control point."""
        return sum(curve.size for other, curve in self.curves.items() if other < label)

    def control_points(self, label: int) -> Array:
        """Return the distinct control points (m, 2) of a curve in m, map frame: a view."""
        start = self.offset(label)
        return self.belief.points[start : start + self.curves[label].size]

    def columns(self, label: int, control: IntArray) -> IntArray:
        """Return the entries (2 k,) of x that are control points (k,) of a curve."""
        return point_columns(self.offset(label) + control)

    def covariance(self, label: int) -> Array:
        """Return the joint covariance (2m, 2m) of a curve's control points in m^2: a copy."""
        columns = self.columns(label, np.arange(self.curves[label].size))
        return self.belief.covariance[np.ix_(columns, columns)]

    def spline(self, label: int) -> BSpline:
        """Return a curve with its current control points."""
        return self.curves[label].with_points(self.control_points(label).copy())

    def foot_points(self, label: int, points: Array, low: Array, high: Array) -> FootPoints:
        """Return the foot points of points (m, 2) in the stretches [low, high] (m,) of a curve."""
        curve, s = self.spline(label), self.settings.spline
        return foot_points(
            curve.tables, curve.control_points, points, low, high, s.search_step, s.search_iterations
        )

    def locate_vehicle(self) -> None:
        """Update the vehicle's parameter on each curve: near the last one, or on the whole curve if it has
        left."""
        gate = self.settings.gate
        heading = np.array([np.cos(self.pose[2]), np.sin(self.pose[2])])
        for label, last in self.pose_u.items():
            low, high = np.array([last - gate.station_behind]), np.array([last + gate.station_ahead])
            foot = self.foot_points(label, self.pose[None, :2], low, high)
            u = float(foot.u[0])
            if foot.tangent_unit[0] @ heading < 0.0 or abs(foot.distance[0]) > gate.station_lateral:
                u = relocate(self.boundary(label), self.control_points(label), self.pose, gate.station_room)
            if self.curves[label].periodic:
                begin, end = self.curves[label].domain
                u += (end - begin) * round((last - u) / (end - begin))
            self.pose_u[label] = u

    def visible_range(self, label: int, count: int) -> tuple[Array, Array]:
        """Return the limits of the stretch of a curve that the vehicle sees, each `count` times."""
        gate, u = self.settings.gate, self.pose_u[label]
        return np.full(count, u - gate.view_behind), np.full(count, u + gate.view_ahead)

    def begin(self, label: int, detections: Array, covariances: Array) -> None:
        """Begin a clamped curve of one span along the polyline of detections (k >= 2, 2), vehicle frame."""
        belief, p, k = self.belief, self.settings.spline.degree, len(detections)
        count = len(belief.points)
        belief.add_points(detections, covariances)
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(detections, axis=0).T)))
        at = np.linspace(0.0, along[-1], p + 1)
        matrix = np.column_stack([np.interp(at, along, row) for row in np.eye(k)])
        belief.transform_points(count, count + k, matrix, np.full(p + 1, SIGMA_START))
        knots = clamped_knots(np.array([0.0, along[-1]]), p)
        self._append_points(label, BSpline(knots, belief.points[count:], p), p + 1)
        self.pose_u[label] = 0.0

    def extend(self, label: int, detection: Array, covariance: Array) -> None:
        """Extend a curve to a detection (2,), vehicle frame: unclamp, insert, clamp (Hu et al. 2002).

        The new control point has the uncertainty of the detection (2, 2) and of the pose.
        """
        belief, spline, p = self.belief, self.spline(label), self.curves[label].degree
        belief.add_points(detection[None], covariance[None])
        knots = spline.extension_knots(belief.points[-1])
        matrix = end_change_matrix(spline.knots, p, knots)
        n, end = spline.size, self.offset(label) + spline.size
        last = slice(n - p - 1, n)
        belief.transform_points(end - p - 1, end, matrix[last, last], np.zeros(p + 1))
        self._append_points(label, BSpline(knots, np.zeros((n + 1, 2)), p), 1)
        self._limit_bending(label, p + 1)

    def _limit_bending(self, label: int, count: int) -> None:
        """Apply a prior of little bending to a curve's last `count` control points."""
        curve = self.curves[label]
        last = np.arange(curve.size - count, curve.size)
        abscissae = greville(curve.knots, curve.degree)[last]
        matrix = np.kron(smoothness_matrix(abscissae, None), np.eye(POINT))
        sigma = self.settings.ckf.sigma_bend * float(np.mean(np.diff(abscissae)))
        noise = sigma**2 * np.eye(len(matrix))
        self.belief.update(self.columns(label, last), lambda x: x @ matrix.T, np.zeros(len(matrix)), noise)

    def _append_points(self, label: int, curve: BSpline, added: int) -> None:
        """Move the last `added` points of x to the end of a curve, whose knots are now those of `curve`."""
        self.curves = dict(sorted({**self.curves, label: curve}.items()))
        end, count = self.offset(label) + curve.size, len(self.belief.points)
        order = np.arange(count - added)
        self.belief.reorder(np.insert(order, end - added, np.arange(count - added, count)))

    def replace(self, label: int, curve: BSpline, matrix: Array, sigma: float) -> None:
        """Replace a curve by one with `matrix` (k, n) times its control points, plus noise of sigma (m)."""
        start = self.offset(label)
        stop = start + self.curves[label].size
        self.belief.transform_points(start, stop, matrix, np.full(len(matrix), sigma))
        self.curves[label] = curve

    def boundary(self, label: int) -> Boundary:
        """Return a curve as the boundary that registration and simplification take; its end is confirmed."""
        curve, settings = self.curves[label], self.settings
        boundary = Boundary(curve.knots, curve.periodic, settings.spline, settings.gauge)
        boundary.confirmed_end = boundary.tables.high
        return boundary
