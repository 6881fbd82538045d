"""The limit of a run: the error that is left where associations are told and curves fitted to the truth."""

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
    """The least error that a run could have been expected to have."""

    l: float  # noqa: E741 - the issue's and the paper's tables call it so
    """m, rmse in the plane of the landmark batch that is told every association."""

    f: float
    """m, rmse of the true cones to splines of the mapped size that are fitted to them."""

    @property
    def total(self) -> float:
        """sqrt(l^2 + f^2), m."""
        return float(np.hypot(self.l, self.f))


def limit(log: Log, track: Map) -> Limit:
    """sqrt(l^2 + f^2) of a simulated log and the map that was made of it."""
    truth = _truth(log)
    return Limit(l=landmark_rmse(solve_oracle_landmarks(log), truth), f=fit_rmse(track, truth))


def solve_oracle_landmarks(log: Log, *, with_covariance: bool = False) -> LandmarkSolution:
    """The landmark batch that is *told* which true cone every reading saw; landmark ids are true cones."""
    truth = _truth(log)
    if truth.associations is None:
        raise ValueError("expected a simulated log, whose associations are known, found one without")
    return solve_landmarks(log, truth.associations, with_covariance=with_covariance)


def landmark_rmse(solution: LandmarkSolution, truth: Truth) -> float:
    """sqrt(mean |l_j - cone_j|^2) over the cones of a boundary that were seen at least once, m."""
    counted = np.isin(truth.cone_labels[solution.landmark_ids], BOUNDARIES)
    errors = solution.landmarks - truth.cones[solution.landmark_ids]
    return root_mean_square(np.linalg.norm(errors[counted], axis=1))


def fit_rmse(track: Map, truth: Truth) -> float:
    """sqrt(mean d^2), m, of the mapped boundaries' true cones to splines of the mapped size fitted to them.

    A boundary mapped as points, or with a control point for every cone, can be exact: its distances are 0.
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
    """(k,) m: from cones (k, 2) in driving order to the spline of `size` control points fitted to them.

    Degree and closedness are those of `like`; knots follow the curvature (paper: Simplification).
    """
    fitted = fit_spline(cones, size, like.periodic, FitSettings(degree=like.degree))
    return np.asarray(np.linalg.norm(cones - closest_points(fitted, cones).position, axis=1))


def _truth(log: Log) -> Truth:
    if log.truth is None:
        raise ValueError("expected a log with truth, found one without")
    return log.truth
