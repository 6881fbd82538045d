"""NEES of the batch's curves at the true cones, on curves whose errors are drawn from what they claim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.mapper import BatchResult
from pathspace_graph.batch.simplification import Scatter
from pathspace_graph.eval.metrics.nees import Nees, curve_nees
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

POINTS = 8
X = np.arange(1.0, 29.0, 2.0)
SIGMA, SCATTER = 0.05, 0.1


@dataclass(frozen=True)
class Claim:
    """What `curve_nees` reads of a result."""

    map: Map
    map_covariance: Array
    scatter: Scatter


def curve(y: Array) -> SplineBoundary:
    """Along x, its control points at heights (8,)."""
    points = np.column_stack([np.linspace(0.0, 30.0, POINTS), y])
    return SplineBoundary(
        BSpline.clamped_from(np.linspace(0.0, 30.0, POINTS - 2), points, 3), np.eye(2 * POINTS)
    )


def drawn(rng: np.random.Generator, common: float, factor: float = 1.0) -> tuple[BatchResult, Truth]:
    """Curves that err by SIGMA a point and by `common` together, cones by SCATTER; `factor` times as much."""
    covariance = SIGMA**2 * np.eye(4 * POINTS)
    ys = np.arange(1, 4 * POINTS, 2)
    covariance[np.ix_(ys, ys)] += common**2
    offset = factor * rng.multivariate_normal(np.zeros(4 * POINTS), covariance)[ys]
    boundaries = {LEFT: curve(2.0 + offset[:POINTS]), RIGHT: curve(-2.0 + offset[POINTS:])}
    places = dict.fromkeys(boundaries, X)
    scatter = Scatter(SCATTER, SCATTER, places, dict.fromkeys(boundaries, np.inf))
    cones = np.column_stack([np.tile(X, 2), np.repeat([2.0, -2.0], len(X))])
    cones[:, 1] += factor * rng.normal(0.0, SCATTER, len(cones))
    truth = Truth(np.zeros(1), np.zeros((1, 3)), cones, np.repeat([LEFT, RIGHT], len(X)))
    claim = Claim(Map(False, dict(boundaries)), covariance, scatter)
    return claim, truth  # type: ignore[return-value]  # only what is read


def mean_ratio(common: float, factor: float, count: int = 60) -> float:
    rng = np.random.default_rng(0)
    found = [curve_nees(*drawn(rng, common, factor)) for _ in range(count)]
    return float(np.mean([n.value / n.cones for n in found]))


def test_an_honest_curve_has_one_per_cone() -> None:
    np.testing.assert_allclose(mean_ratio(0.0, 1.0), 1.0, atol=0.1)


def test_errors_that_both_curves_share_count_once() -> None:
    """As the heading of a whole map: with cross terms a common error of ten sigmas is honest."""
    np.testing.assert_allclose(mean_ratio(0.5, 1.0), 1.0, atol=0.1)


def test_twice_the_error_is_four_times_the_nees() -> None:
    np.testing.assert_allclose(mean_ratio(0.2, 2.0), 4.0, atol=0.4)


def test_a_cone_that_was_never_seen_may_be_farther_off() -> None:
    rng = np.random.default_rng(3)
    claim, truth = drawn(rng, 0.0)
    cones = truth.cones.copy()
    cones[6, 1] += 1.0
    off = Truth(truth.pose_t, truth.poses, cones, truth.cone_labels)
    seen = curve_nees(claim, off)
    places = {label: np.delete(X, 6) for label in (LEFT, RIGHT)}
    scatter = Scatter(SCATTER, 0.5, places, dict.fromkeys(places, np.inf))
    unseen = curve_nees(Claim(claim.map, claim.map_covariance, scatter), off)  # type: ignore[arg-type]
    assert not seen.inside()
    assert unseen.value < 0.6 * seen.value


def test_inside_is_the_two_sided_interval() -> None:
    """Of chi-squared with 100 degrees of freedom: 74.2 to 129.6."""
    assert [Nees(value, 100).inside() for value in (74.0, 74.5, 129.0, 130.0)] == [False, True, True, False]
