"""What a planner is given of a track: a centre line with widths and curvature, each with its sigma."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.se2 import left_of

from .bspline import BSpline
from .centre_line import Line, Stations, crossing, find_line

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CentreLine:
    """Holds the centre line of a track at n points, evenly spaced, in the map frame.

    Each point is equally far from both boundaries. A standard deviation is that of the quantity where the
    line crosses its normal at the point; it is NaN where the map has no covariance.
    """

    points: Array
    """These are the points (n, 2) in m; a closed line doesn't repeat the first one."""
    heading: Array
    """This is the direction of travel (n,) in rad, in (-pi, pi]."""
    curvature: Array
    """This is the curvature (n,) in 1/m, positive in a left turn."""
    arc_length: Array
    """This is the length (n,) of the line from its first point, in m."""
    width_left: Array
    """This is the distance (n,) along the normal to the left boundary, in m."""
    width_right: Array
    """This is the distance (n,) along the normal to the right boundary, in m."""
    closed: bool
    """The line is a loop where this is true."""
    length: float
    """The whole line has this length (m), the way back to the first point included where it is closed."""
    points_sigma: Array
    """This is the standard deviation (n,) across the line, in m."""
    heading_sigma: Array
    """This is the standard deviation (n,) of the heading, in rad."""
    curvature_sigma: Array
    """This is the standard deviation (n,) of the curvature, in 1/m."""
    arc_length_sigma: Array
    """This is the standard deviation (n,) of the arc length, in m; the first one is 0."""
    width_left_sigma: Array
    """This is the standard deviation (n,) of the width to the left, in m."""
    width_right_sigma: Array
    """This is the standard deviation (n,) of the width to the right, in m."""
    length_sigma: float
    """This is the standard deviation of the whole length, in m."""


def centre_line(
    left: BSpline, right: BSpline, covariance: Array | None, closed: bool, step: float
) -> CentreLine:
    """Returns the centre line between two boundaries at points `step` (m) apart, see `find_line`.

    The joint covariance is of the distinct control points of the left and then the right boundary, in the
    order x0, y0, x1, y1 and so on (m^2). It is propagated to first order.
    """
    line = find_line(left, right, closed, step)
    sides = (_Side(left, line.stations.left, 0), _Side(right, line.stations.right, left.size))
    fine = _Centre(line.stations, *sides, left.size + right.size)
    rows = np.arange(0, len(line.arc_length), line.every)
    centre = fine.where(rows)
    tangent = centre.stations.tangent
    offsets = [centre.offset(side) for side in (centre.left, centre.right)]
    jacobians = (centre.across, centre.heading, centre.bend, *(jacobian for _, jacobian in offsets))
    sigmas = [_sigma(jacobian, covariance) for jacobian in jacobians]
    lengths = _sigma(_length_rows(fine, line, rows), covariance)
    return CentreLine(
        points=centre.stations.points,
        heading=np.arctan2(tangent[:, 1], tangent[:, 0]),
        curvature=centre.curvature,
        arc_length=line.arc_length[rows],
        width_left=offsets[0][0],
        width_right=-offsets[1][0],
        closed=closed,
        length=line.length,
        points_sigma=sigmas[0],
        heading_sigma=sigmas[1],
        curvature_sigma=sigmas[2],
        arc_length_sigma=lengths[:-1],
        width_left_sigma=sigmas[3],
        width_right_sigma=sigmas[4],
        length_sigma=float(lengths[-1]),
    )


# --- derivatives by the control points -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Side:
    """Holds a boundary at the foot points (n,) of the stations."""

    spline: BSpline
    foot: FootPoints
    first: int
    """The boundary's control points begin at this one of all."""

    @property
    def speed(self) -> Array:
        return np.asarray(np.linalg.norm(self.spline.evaluate(self.foot.u, 1), axis=1))

    @property
    def curvature(self) -> Array:
        return self.spline.curvature(self.foot.u)

    @property
    def offset_curvature(self) -> Array:
        """Returns k / (1 - k d): the curvature of the parallel curve at the signed distance d."""
        return self.curvature / self.spread

    @property
    def spread(self) -> Array:
        """Returns 1 - k d (n,): the length of the parallel curve for each length of the boundary."""
        spread = 1.0 - self.curvature * self.foot.distance
        return np.where(np.abs(spread) > np.finfo(float).eps, spread, np.finfo(float).eps)

    @property
    def curvature_slope(self) -> Array:
        """Returns the derivative (n,) of the curvature by the arc length of the boundary, in 1/m^2."""
        first, second, third = (self.spline.evaluate(self.foot.u, order) for order in (1, 2, 3))
        speed = self.speed
        along = np.einsum("kd,kd->k", first, second) / speed**2
        by_parameter = _cross(first, third) / speed**3 - 3.0 * self.curvature * along
        return np.asarray(by_parameter / speed)


@dataclass(frozen=True, eq=False)
class _Centre:
    """Holds how the line at its stations (n,) changes with the control points of both boundaries.

    Each Jacobian is sparse (n, 2 m), by x0, y0, x1, y1 and so on. It is taken where the line crosses its old
    normal, so that points move across the line only.
    """

    stations: Stations
    left: _Side
    right: _Side
    size: int

    def where(self, rows: NDArray[np.intp]) -> _Centre:
        """Returns the same at some of the stations."""
        left, right = (replace(side, foot=side.foot.where(rows)) for side in (self.left, self.right))
        return _Centre(self.stations.where(rows), left, right, self.size)

    @property
    def cosine(self) -> Array:
        """Returns the cosine (n,) of half the angle between the boundaries."""
        return np.asarray(np.einsum("kd,kd->k", self.stations.normal, self.left.foot.normal_unit))

    @property
    def curvature(self) -> Array:
        """Returns (cos a / 2) (K_l + K_r), where a is half the angle between the boundaries.

        K_l and K_r are the curvatures of their parallel curves through the station.
        """
        return 0.5 * self.cosine * (self.left.offset_curvature + self.right.offset_curvature)

    @property
    def across(self) -> csr_array:
        """Returns e = (n_l . dS_l + n_r . dS_r) / (2 cos a): the move of the line along its normal."""
        moves = self._moved(self.left) + self._moved(self.right)
        return _scaled(0.5 / self.cosine, moves)

    @property
    def heading(self) -> csr_array:
        """Returns the change of the heading: the mean of those of both boundaries at their foot points."""
        return csr_array(0.5 * (self._turned(self.left)[0] + self._turned(self.right)[0]))

    @property
    def bend(self) -> csr_array:
        """Returns the change of the curvature."""
        left, right = self._turned(self.left), self._turned(self.right)
        normal, tangent = self.stations.normal, self.left.foot.tangent_unit
        sine = np.einsum("kd,kd->k", normal, tangent)
        total = self.left.offset_curvature + self.right.offset_curvature
        opened = _scaled(-0.25 * sine * total, left[0] - right[0])
        bent = self._bent(self.left, left[1]) + self._bent(self.right, right[1])
        return csr_array(opened + _scaled(0.5 * self.cosine, bent))

    def offset(self, side: _Side) -> tuple[Array, csr_array]:
        """Returns the signed offset (n,) at which the normal crosses a boundary, and its Jacobian.

        The crossing at c + o n stays on the boundary: N . (dS - e n - o dn) = do N . n, with dn = -t dtheta.
        """
        normal = self.stations.normal
        u, offset = crossing(side.spline, self.stations.points, normal, side.foot)
        own = left_of(side.spline.tangent_unit(u))
        facing = np.einsum("kd,kd->k", own, normal)
        turn = offset * np.einsum("kd,kd->k", own, self.stations.tangent) / facing
        moved = self._rows(side, u, 0, own / facing[:, None])
        return offset, moved + _scaled(turn, self.heading) - self.across

    def _moved(self, side: _Side) -> csr_array:
        return self._rows(side, side.foot.u, 0, side.foot.normal_unit)

    def _turned(self, side: _Side) -> tuple[csr_array, csr_array]:
        """Returns how the boundary's heading changes at the foot point, and how far that moves along it.

        Of the condition T . (c - S) = 0 follows (1 - k d) ds = T . (dc - dS) + d phi, where
        phi = N . dS' / |S'| is the turn at a fixed parameter.
        """
        foot = side.foot
        turned = self._rows(side, foot.u, 1, foot.normal_unit / side.speed[:, None])
        along = np.einsum("kd,kd->k", foot.tangent_unit, self.stations.normal)
        pushed = _scaled(along, self.across) - self._rows(side, foot.u, 0, foot.tangent_unit)
        moved = _scaled(1.0 / side.spread, pushed + _scaled(foot.distance, turned))
        return turned + _scaled(side.curvature, moved), moved

    def _bent(self, side: _Side, moved: csr_array) -> csr_array:
        """Returns the change of k / (1 - k d), which is (dk + k^2 dd) / (1 - k d)^2."""
        foot, speed, curvature = side.foot, side.speed, side.curvature
        first, second = (side.spline.evaluate(foot.u, order) for order in (1, 2))
        cube = (speed**3)[:, None]
        by_first = -left_of(second) / cube - 3.0 * (curvature / speed)[:, None] * foot.tangent_unit
        bent = self._rows(side, foot.u, 1, by_first) + self._rows(side, foot.u, 2, left_of(first) / cube)
        bent = bent + _scaled(side.curvature_slope, moved)
        distance = _scaled(self.cosine, self.across) - self._moved(side)
        return _scaled(1.0 / side.spread**2, bent + _scaled(curvature**2, distance))

    def _rows(self, side: _Side, u: Array, derivative: int, along: Array) -> csr_array:
        """Returns the Jacobian of a . S^(r)(u) at a fixed parameter, where a (n, 2) is `along`."""
        values, columns = side.spline.local_basis(u, derivative)
        entries = (values[:, :, None] * along[:, None, :]).reshape(-1)
        at = (2 * (columns + side.first)[:, :, None] + np.arange(2)).reshape(-1)
        of = np.repeat(np.arange(len(u)), 2 * values.shape[1])
        return csr_array((entries, (of, at)), shape=(len(u), 2 * self.size))


def _length_rows(fine: _Centre, line: Line, rows: NDArray[np.intp]) -> csr_array:
    """Returns the Jacobian of the arc length at the points and, in a last row, of the whole length.

    A line that moves by e(s) along its normal changes its length by the integral of -k e, by the trapezoidal
    rule over the fine points.
    """
    interval = np.diff(line.arc_length, append=line.length)
    shorter = _scaled(-fine.curvature, fine.across)
    following = shorter[np.r_[1 : len(interval), 0]]
    pieces = _scaled(0.5 * interval, shorter + following)
    number = np.searchsorted(rows, np.arange(len(interval)), side="right")
    sums = csr_array(
        (np.ones(len(number)), (number, np.arange(len(number)))), shape=(len(rows) + 1, len(number))
    )
    return csr_array(np.cumsum((sums @ pieces).toarray(), axis=0))


def _scaled(factors: Array, rows: csr_array) -> csr_array:
    return csr_array(diags_array(factors) @ rows)


def _sigma(jacobian: csr_array, covariance: Array | None) -> Array:
    """Returns sqrt(diag(J P J^T)) (n,), and NaN without a covariance P."""
    if covariance is None:
        return np.full(jacobian.shape[0], np.nan)
    variance = np.asarray(jacobian.multiply(jacobian @ covariance).sum(axis=1)).ravel()
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
