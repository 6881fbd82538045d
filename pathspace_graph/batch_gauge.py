"""Weak priors on what readings leave free, over a whole curve: spacing and smoothness of control points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import smoothness_matrix

from .boundary import Boundary
from .window import Rows

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CurveGauge:
    """`(|c_{j+1} - c_j| - nominal_j) / (share nominal_j)` and `D c / sigma`, D of `smoothness_matrix`."""

    nominal: Array
    """(r,) distances of neighbours, m: those that the curve began with, so that nothing slides at first."""
    sigma: Array
    """(r,) their standard deviations, m."""
    smoothness: Array
    """(2m, 2m) `D' D / sigma^2`; zero along a straight line."""
    anchor: float
    """Information (1/m^2) that holds each control point where it is: no gradient, so not in the cost."""

    def spacing(self, control_points: Array) -> Rows:
        """Whitened rows on the control points' own entries (2m,)."""
        j = np.arange(len(self.nominal))
        k = (j + 1) % len(control_points)
        offset = control_points[k] - control_points[j]
        length = np.hypot(offset[:, 0], offset[:, 1])
        direction = offset / np.maximum(length, np.finfo(float).tiny)[:, None] / self.sigma[:, None]
        columns = np.column_stack([2 * j, 2 * j + 1, 2 * k, 2 * k + 1])
        jacobian = np.concatenate([-direction, direction], axis=1)
        return Rows(columns, jacobian, (length - self.nominal) / self.sigma)

    def cost(self, control_points: Array) -> float:
        """Half the sum of squares."""
        residual, flat = self.spacing(control_points).residual, control_points.ravel()
        return 0.5 * float(residual @ residual + flat @ self.smoothness @ flat)


def curve_gauge(boundary: Boundary, control_points: Array) -> CurveGauge:
    """The gauge of a curve that begins with control points (m, 2)."""
    following = np.roll(control_points, -1, axis=0) if boundary.periodic else control_points[1:]
    offset = following - control_points[: len(following)]
    settings, abscissae = boundary.gauge, boundary.abscissae
    mean = boundary.length / (len(boundary.knots) - 2 * boundary.degree - 1)
    nominal = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), SHORTEST * mean)
    scaled = smoothness_matrix(abscissae, boundary.length if boundary.periodic else None)
    scaled = scaled / (settings.sigma_smoothness * mean)
    smoothness = np.asarray(np.kron(scaled.T @ scaled, np.eye(2)), float)
    return CurveGauge(nominal, settings.sigma_spacing * nominal, smoothness, settings.sigma_anchor**-2.0)


SHORTEST = 0.1
"""Least nominal distance of two control points, as a share of the mean knot interval."""
