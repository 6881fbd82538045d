"""Whether the batch's uncertainty is honest: the squared error of its curves in units of its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import SplineBoundary

from .table1 import closest_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Nees:
    """`e' (B Sigma B' + sigma^2 I)^-1 e` over the true cones, chi-squared where the covariance is honest."""

    value: float
    """The sum."""
    cones: int
    """Its degrees of freedom."""

    def inside(self, share: float = 0.95) -> bool:
        """Whether it lies within the two-sided interval that it falls into with that probability."""
        tail = 0.5 * (1.0 - share)
        return bool(chi2.ppf(tail, self.cones) <= self.value <= chi2.ppf(1.0 - tail, self.cones))


def curve_nees(result: BatchResult, truth: Truth) -> Nees:
    """Errors of both curves together across themselves at the true cones.

    e_i = n_i . (cone_i - S(u_i)), its covariance that of the curves, B Sigma B' with B the derivative by all
    control points, plus the variance of `Scatter`: a true cone stands off any smooth curve, one that was
    never seen the more. Errors along a curve, and of one curve and the other, hang together, above all by the
    heading of the whole map.
    """
    errors, sigmas, designs, offset = [np.zeros(0)], [np.zeros(0)], [], 0
    size = len(result.map_covariance)
    for label, boundary in sorted(result.map.boundaries.items()):
        assert isinstance(boundary, SplineBoundary)
        feet = closest_points(boundary.spline, truth.cones[truth.cone_labels == label])
        basis = boundary.spline.basis_matrix(feet.u)
        design = np.zeros((len(feet.u), size))
        design[:, offset : offset + 2 * boundary.size : 2] = basis * feet.normal_unit[:, :1]
        design[:, offset + 1 : offset + 2 * boundary.size : 2] = basis * feet.normal_unit[:, 1:]
        errors.append(feet.distance)
        sigmas.append(result.scatter.sigma(label, feet.u))
        designs.append(design)
        offset += 2 * boundary.size
    e, B = np.concatenate(errors), np.concatenate([np.zeros((0, size)), *designs])
    covariance = B @ result.map_covariance @ B.T + np.diag(np.concatenate(sigmas) ** 2)
    return Nees(float(e @ np.linalg.solve(covariance, e)), len(e))
