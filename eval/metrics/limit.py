"""The limit of a run: the error that remains with oracle association and curves fitted to the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.landmark.oracle import LandmarkSolution, solve_landmarks
from pathspace_graph.settings.knots import FitSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import fit_spline

from .curves import driving_order
from .table1 import closest_points, root_mean_square

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Limit:
    """Holds the least error that a run can be expected to reach."""

    l: float  # noqa: E741 - the issue's and the paper's tables call it so
    """This is the rmse (m) in the plane of the landmark batch with oracle association."""

    f: float
    """This is the rmse (m) of the true cones to splines of the mapped size that are fitted to them."""

    @property
    def total(self) -> float:
        """Returns sqrt(l^2 + f^2) in m."""
        return float(np.hypot(self.l, self.f))


def limit(log: Log, track: Map) -> Limit:
    """Returns the limit of a simulated log and a map of it; ValueError without truth or associations."""
    truth = _truth(log)
    return Limit(l=landmark_rmse(solve_oracle_landmarks(log), truth), f=fit_rmse(track, truth))


def solve_oracle_landmarks(log: Log, *, with_covariance: bool = False) -> LandmarkSolution:
    """Returns the landmark batch with oracle association: each detection knows its true cone.

    Landmark ids are indices of true cones.
    """
    truth = _truth(log)
    if truth.associations is None:
        raise ValueError("expected a simulated log, whose associations are known, found one without")
    return solve_landmarks(log, truth.associations, with_covariance=with_covariance)


def landmark_rmse(solution: LandmarkSolution, truth: Truth) -> float:
    """Returns sqrt(mean |l_j - cone_j|^2) in m over the cones of a boundary that were ever detected."""
    counted = np.isin(truth.cone_labels[solution.landmark_ids], BOUNDARIES)
    errors = solution.landmarks - truth.cones[solution.landmark_ids]
    return root_mean_square(np.linalg.norm(errors[counted], axis=1))


def fit_rmse(track: Map, truth: Truth) -> float:
    """Returns sqrt(mean d^2) in m, d from true cones to splines of the mapped size that are fitted to them.

    A boundary of points, or with a control point for every cone, can be exact: its distances are 0.
    Boundaries that aren't mapped don't count.
    """
    distances = [np.zeros(0)]
    for label, boundary in track.boundaries.items():
        cones = driving_order(truth, label)
        if isinstance(boundary, SplineBoundary) and boundary.size < len(cones):
            distances.append(fit_distances(cones, boundary.size, boundary.spline))
        else:
            distances.append(np.zeros(len(cones)))
    return root_mean_square(np.concatenate(distances))


def fit_distances(cones: Array, size: int, like: BSpline) -> Array:
    """Returns the distances (k,) in m of cones (k, 2), in driving order, from a spline fitted to them.

    The spline has `size` control points, and the degree and periodicity of `like`. Its knots follow the
    curvature (paper, section Simplification).
    """
    fitted = fit_spline(cones, size, like.periodic, FitSettings(degree=like.degree))
    return np.asarray(np.linalg.norm(cones - closest_points(fitted, cones).position, axis=1))


def _truth(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a log with truth, found one without")
    return log.truth
