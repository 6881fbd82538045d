"""A track as a ribbon: one B-spline for its centre line and half its width, and the edges that follow."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.residuals import RIBBON, greville, smoothness_coefficients
from pathspace_graph.factors.se2 import left_of
from pathspace_graph.labels import LEFT, RIGHT

from .bspline import BSpline

SIDE: Final = {LEFT: 1.0, RIGHT: -1.0}
"""Side of the centre line on which the edge of each label is."""
_SAMPLE_STEP: Final = 0.5
"""Distance of the points of a ribbon to which an edge is fitted (m)."""
_EDGE_BREAKS: Final = 2
"""Knot intervals of an edge for each one of the ribbon, since it is no B-spline itself."""


@dataclass(frozen=True, eq=False)
class Ribbon(BSpline):
    """A spline (x, y, h)(u) = sum_j N_j(u) c_j, with C = (x, y) and the edges C + h n and C - h n.

    Its parameter is about a length (m) along the line; h is half the width (m).
    """

    DIMENSION = RIBBON

    @cached_property
    def centre(self) -> BSpline:
        """The centre line alone."""
        centre = BSpline(self.knots, self.control_points[:, :2], self.degree, self.periodic)
        centre.__dict__["tables"] = self.tables
        return centre

    def half_width(self, u: Array) -> Array:
        """Return half the width (k,) of the track in m."""
        return np.asarray(self.evaluate(u)[:, 2])

    @cached_property
    def bending(self) -> Array:
        """Coefficients (r, 3) of the second differences of the control points j, j + 1 and j + 2."""
        period = self.tables.length if self.periodic else None
        return smoothness_coefficients(greville(self.knots, self.degree)[: self.size], period)

    @property
    def spacing(self) -> float:
        """Mean distance of neighbouring knots (m)."""
        return self.tables.length / len(self.tables.starts)

    def edge(self, u: Array, side: float) -> tuple[Array, Array]:
        """Return points (k, 2) of an edge, and their derivatives (k, 2, 3 m) by the control points.

        With dn = -t (n . dC') / |C'|, the derivatives of `C + s h n` by c_j and h_j are
        `beta_j I - s h / |C'| beta'_j t n'` and `s beta_j n`.
        """
        B, slope = self.basis_matrix(u), self.basis_matrix(u, 1)
        at, first = B @ self.distinct_control_points, slope @ self.distinct_control_points[:, :2]
        speed = np.hypot(first[:, 0], first[:, 1])
        t = first / speed[:, None]
        n = left_of(t)
        half = side * at[:, 2]
        by_control = np.zeros((len(u), 2, self.size, RIBBON))
        by_control[:, 0, :, 0] = by_control[:, 1, :, 1] = B
        turned = (half / speed)[:, None] * slope
        by_control[:, :, :, :2] -= t[:, :, None, None] * turned[:, None, :, None] * n[:, None, None, :]
        by_control[:, :, :, 2] = side * n[:, :, None] * B[:, None, :]
        return at[:, :2] + half[:, None] * n, by_control.reshape(len(u), 2, -1)

    def edge_spline(self, label: int) -> tuple[BSpline, Array]:
        """Return an edge as a B-spline of m' control points, and their derivatives (2m', 3m).

        It is the least-squares fit to the edge, on twice the knots, at the same parameters. The derivatives
        are by the ribbon's control points.
        """
        low, high = self.domain
        count = _EDGE_BREAKS * len(self.tables.starts)
        if self.periodic:
            blank = BSpline.periodic_from(np.linspace(low, high, count + 1), np.zeros((count, 2)))
        else:
            blank = BSpline.open_uniform(
                np.zeros((count + self.degree, 2)), self.degree, (high - low) / count, low
            )
        steps = int(np.ceil((high - low) / _SAMPLE_STEP))
        u = np.linspace(low, high, steps + 1)[: steps if self.periodic else None]
        points, jacobian = self.edge(u, SIDE[label])
        fit = np.linalg.pinv(blank.basis_matrix(u))
        by_ribbon = np.einsum("ik,kdc->idc", fit, jacobian).reshape(2 * blank.size, -1)
        return blank.with_points(fit @ points), by_ribbon
