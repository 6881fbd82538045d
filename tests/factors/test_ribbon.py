"""The ribbon kernel and its GTSAM factor: Jacobians with re-found foot points, and answers by hand."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.bspline import SpanPolynomials, uniform_knots
from pathspace_graph.factors.gtsam_factors import pose_array, spline_projection_factors
from pathspace_graph.factors.residuals import RIBBON, beyond_edge
from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.factors.sensor import SENSOR_SIZE

from ..scenes.jacobians import assert_jacobians
from .test_projection import control_columns, find, points_beside, random_curve, unwrapped


def random_ribbon(rng: np.random.Generator, degree: int, kind: str) -> tuple[SpanPolynomials, Array]:
    """A winding track of 3 m to 5 m."""
    tables, centre = random_curve(rng, degree, kind)
    return tables, np.column_stack([centre, rng.uniform(1.5, 2.5, len(centre))])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    degree=st.integers(2, 4),
    kind=st.sampled_from(["open", "clamped", "periodic"]),
)
def test_jacobians_are_exact_metres_away_from_the_centre(seed: int, degree: int, kind: str) -> None:
    """The foot point moves along the centre line, and with it the width that is compared."""
    rng = np.random.default_rng(seed)
    tables, ribbon = random_ribbon(rng, degree, kind)
    points, u = points_beside(rng, tables, ribbon[:, :2], rng.uniform(-4.0, 4.0, 25))
    sides = rng.choice([-1.0, 1.0], len(u))

    def function(moved: Array, control: Array) -> tuple[Array, Array, Array]:
        distinct, at = control.reshape(-1, RIBBON), moved.reshape(-1, 2)
        foot = find(tables, distinct[:, :2], at, u)
        residual, each_by_point, by_span = beyond_edge(tables, unwrapped(tables, distinct), sides, foot)
        by_point = np.zeros((len(u), len(u), 2))
        by_point[np.arange(len(u)), np.arange(len(u))] = each_by_point
        by_control = np.zeros((len(u), len(distinct), RIBBON))
        columns = control_columns(tables, foot.span)
        np.add.at(by_control, (np.arange(len(u))[:, None], columns), by_span)
        return residual, by_point.reshape(len(u), -1), by_control.reshape(len(u), -1)

    assert_jacobians(function, [points.ravel(), ribbon.ravel()], tolerance=1e-5)


def straight_ribbon(half: tuple[float, float]) -> tuple[SpanPolynomials, Array]:
    """A track along x from 0 to 10 m, whose half width changes linearly."""
    knots = uniform_knots(13, 3, 1.0, 0.0)
    x = np.arange(13.0) - 1.0  # Greville abscissae, so that the parameter is x
    width = half[0] + (half[1] - half[0]) * x / 10
    return SpanPolynomials(knots, 3), np.column_stack([x, np.zeros(13), width])


def test_the_distance_from_the_edges_of_a_funnel() -> None:
    """Half the width is 2 m at x = 0 and 3 m at x = 10."""
    tables, ribbon = straight_ribbon((2.0, 3.0))
    points = np.array([[5.0, 2.75], [5.0, -2.0], [8.0, 3.0]])
    foot = find(tables, ribbon[:, :2], points, points[:, 0])
    residual, by_point, _ = beyond_edge(tables, ribbon, np.array([1.0, -1.0, 1.0]), foot)
    np.testing.assert_allclose(residual, [0.25, -0.5, 0.2], atol=1e-9)
    np.testing.assert_allclose(by_point, [[-0.1, 1.0], [-0.1, -1.0], [-0.1, 1.0]], atol=1e-9)


@pytest.mark.parametrize("with_sensor", [False, True])
@pytest.mark.parametrize("kind", ["open", "periodic"])
def test_the_factors_jacobians(kind: str, with_sensor: bool) -> None:
    """GTSAM linearizes as differences of its own error do, on the pose, the sensor and the control points."""
    rng = np.random.default_rng(3)
    tables, ribbon = random_ribbon(rng, 3, kind)
    points, u = points_beside(rng, tables, ribbon[:, :2], rng.uniform(-3.0, 3.0, 12))
    pose, count = gtsam.Pose2(3.0, -1.0, 0.7), len(u)
    keys = [int(gtsam.symbol("a", j)) for j in range(len(ribbon))]
    sensor_key = int(gtsam.symbol("c", 0)) if with_sensor else None
    (factor,) = spline_projection_factors(
        np.full(count, int(gtsam.symbol("x", 0))),
        keys,
        tables,
        points_vehicle=to_vehicle(points, np.tile(pose_array(pose), (count, 1))),
        covariances=np.tile(0.04 * np.eye(2), (count, 1, 1)),
        sides=rng.choice([-1.0, 1.0], count),
        low=u - 2.0,
        high=u + 2.0,
        sigma_model=0.1,
        huber=np.inf,
        sensor_key=sensor_key,
        twists=np.tile([10.0, 0.0, 0.5], (count, 1)),
    )
    values = gtsam.Values()
    values.insert(int(gtsam.symbol("x", 0)), pose)
    for key, point in zip(keys, ribbon, strict=True):
        values.insert(key, gtsam.Point3(*point))
    if sensor_key is not None:
        values.insert(sensor_key, np.array([0.01, 0.02, 0.005, 0.01, 0.03]))
    jacobian = factor.linearize(values).jacobian()[0]
    numeric, step = [], 1e-6
    for key in list(factor.keys()):
        for unit in np.eye(SENSOR_SIZE if key == sensor_key else 3):
            ends = [factor.unwhitenedError(moved(values, key, sign * step * unit)) for sign in (1.0, -1.0)]
            numeric.append((ends[0] - ends[1]) / (2 * step))
    expected = np.column_stack(numeric)
    # how a correction of ranges turns with the normal is in no derivative
    allowed = 1e-2 if with_sensor else 1e-5
    np.testing.assert_allclose(jacobian, expected, rtol=0.0, atol=allowed * np.abs(expected).max())


def moved(values: gtsam.Values, key: int, change: Array) -> gtsam.Values:
    """The values with one of them changed."""
    delta = gtsam.VectorValues()
    delta.insert(key, change)
    return values.retract(delta)


def test_the_factor_asks_for_equal_numbers() -> None:
    tables, ribbon = straight_ribbon((2.0, 2.0))
    keys = [int(gtsam.symbol("a", j)) for j in range(len(ribbon))]
    one, two = np.zeros(1), np.zeros((2, 2))
    with pytest.raises(ValueError, match="as many poses, detections"):
        spline_projection_factors(
            np.zeros(2, np.intp), keys, tables, points_vehicle=two, covariances=np.tile(np.eye(2), (2, 1, 1)),
            sides=one, low=one, high=one, sigma_model=0.1, huber=2.0,
        )  # fmt: skip
