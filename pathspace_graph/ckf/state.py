"""The paper's state: the vehicle's pose and the control points of clamped splines, with one covariance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.bspline import clamped_knots, end_change_matrix
from pathspace_graph.factors.footpoint import FootPoints, foot_points
from pathspace_graph.factors.gauge import greville, smoothness_matrix
from pathspace_graph.mapping.belief import PLANE, Belief, point_columns
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary, relocate
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class CurveState:
    """`x = [pose | calibration | left control points | right control points]`, and the curves' knots."""

    def __init__(self, belief: Belief, settings: MapperSettings) -> None:
        self.settings = settings
        self.belief = belief
        """Mean and covariance of x."""
        self.curves: dict[int, BSpline] = {}
        """The curves by label; of their control points only the number is up to date, see `spline`."""
        self.pose_u: dict[int, float] = {}
        """Parameter of the vehicle's foot point on each curve; not wrapped."""

    @property
    def pose(self) -> Array:
        """(3,) x (m), y (m), theta (rad, not wrapped), map frame: a view."""
        return self.belief.pose

    def offset(self, label: int) -> int:
        """Points before a curve's first."""
        return sum(curve.size for other, curve in self.curves.items() if other < label)

    def control_points(self, label: int) -> Array:
        """Distinct control points (m, 2) of a curve, map frame, m: a view."""
        start = self.offset(label)
        return self.belief.points[start : start + self.curves[label].size]

    def columns(self, label: int, control: IntArray) -> IntArray:
        """(2 k,) entries of x of control points (k,) of a curve."""
        return point_columns(self.offset(label) + control)

    def covariance(self, label: int) -> Array:
        """(2m, 2m) joint covariance of a curve's control points, m^2: a copy."""
        columns = self.columns(label, np.arange(self.curves[label].size))
        return self.belief.covariance[np.ix_(columns, columns)]

    def spline(self, label: int) -> BSpline:
        """The curve as it stands."""
        return self.curves[label].with_points(self.control_points(label).copy())

    def find(self, label: int, points: Array, low: Array, high: Array) -> FootPoints:
        """Foot points of points (m, 2) in stretches [low, high] (m,) of a curve."""
        curve, s = self.spline(label), self.settings.spline
        return foot_points(
            curve.tables, curve.control_points, points, low, high, s.search_step, s.search_iterations
        )

    def locate_vehicle(self) -> None:
        """The vehicle's station on each curve: near the last one, or anew where that can't be its own."""
        gate = self.settings.gate
        heading = np.array([np.cos(self.pose[2]), np.sin(self.pose[2])])
        for label, station in self.pose_u.items():
            low, high = np.array([station - gate.station_behind]), np.array([station + gate.station_ahead])
            foot = self.find(label, self.pose[None, :2], low, high)
            u = float(foot.u[0])
            if foot.tangent_unit[0] @ heading < 0.0 or abs(foot.distance[0]) > gate.station_lateral:
                u = relocate(self.boundary(label), self.control_points(label), self.pose, gate.station_room)
            if self.curves[label].periodic:
                begin, end = self.curves[label].domain
                u += (end - begin) * round((station - u) / (end - begin))
            self.pose_u[label] = u

    def visible(self, label: int, count: int) -> tuple[Array, Array]:
        """Limits (count,) of the stretch of a curve that the vehicle sees."""
        gate, station = self.settings.gate, self.pose_u[label]
        return np.full(count, station - gate.view_behind), np.full(count, station + gate.view_ahead)

    # --- what changes the curves -------------------------------------------------------------------------

    def begin(self, label: int, detections: Array, covariances: Array) -> None:
        """A clamped curve of one span along the polyline of readings (k >= 2, 2) of the vehicle frame."""
        belief, p, k = self.belief, self.settings.spline.degree, len(detections)
        count = len(belief.points)
        belief.observe(detections, covariances)
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(detections, axis=0).T)))
        at = np.linspace(0.0, along[-1], p + 1)
        matrix = np.column_stack([np.interp(at, along, row) for row in np.eye(k)])
        belief.change(count, count + k, matrix, np.full(p + 1, self.settings.ckf.sigma_start))
        knots = clamped_knots(np.array([0.0, along[-1]]), p)
        self._take_up(label, BSpline(knots, belief.points[count:], p), p + 1)
        self.pose_u[label] = 0.0

    def extend(self, label: int, reading: Array, covariance: Array) -> None:
        """Lead a curve on to a reading (2,) of the vehicle frame: unclamp, insert, clamp (Hu et al. 2002).

        The new control point has the reading's uncertainty (2, 2) and the vehicle's.
        """
        belief, spline, p = self.belief, self.spline(label), self.curves[label].degree
        belief.observe(reading[None], covariance[None])
        knots = spline.extension_knots(belief.points[-1])
        matrix = end_change_matrix(spline.knots, p, knots)
        n, end = spline.size, self.offset(label) + spline.size
        last = slice(n - p - 1, n)
        belief.change(end - p - 1, end, matrix[last, last], np.zeros(p + 1))
        self._take_up(label, BSpline(knots, np.zeros((n + 1, 2)), p), 1)
        self._straighten(label, p + 1)

    def _straighten(self, label: int, count: int) -> None:
        """A prior of little bending on a curve's last `count` control points."""
        curve = self.curves[label]
        last = np.arange(curve.size - count, curve.size)
        abscissae = greville(curve.knots, curve.degree)[last]
        matrix = np.kron(smoothness_matrix(abscissae, None), np.eye(PLANE))
        sigma = self.settings.ckf.sigma_bend * float(np.mean(np.diff(abscissae)))
        noise = sigma**2 * np.eye(len(matrix))
        self.belief.update(self.columns(label, last), lambda x: x @ matrix.T, np.zeros(len(matrix)), noise)

    def _take_up(self, label: int, curve: BSpline, added: int) -> None:
        """The last `added` points of x move to the end of a curve, which has these knots now."""
        self.curves = dict(sorted({**self.curves, label: curve}.items()))
        end, count = self.offset(label) + curve.size, len(self.belief.points)
        order = np.arange(count - added)
        self.belief.reorder(np.insert(order, end - added, np.arange(count - added, count)))

    def replace(self, label: int, curve: BSpline, matrix: Array, sigma: float) -> None:
        """A curve on other knots, its control points `matrix` (k, n) times the old, and sigma (m) beside."""
        start = self.offset(label)
        stop = start + self.curves[label].size
        self.belief.change(start, stop, matrix, np.full(len(matrix), sigma))
        self.curves[label] = curve

    def boundary(self, label: int) -> Boundary:
        """A curve's knots as the mapper's closing and simplification take them."""
        curve, settings = self.curves[label], self.settings
        boundary = Boundary(curve.knots, curve.periodic, settings.spline, settings.gauge)
        boundary.confirmed_end = boundary.tables.high
        return boundary
