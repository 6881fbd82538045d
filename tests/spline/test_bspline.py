"""The curve class against scipy, Monte Carlo, and what clamping, extension and growth promise."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.bspline import uniform_knots
from pathspace_graph.spline.bspline import BSpline

TOLERANCE = 1e-12


def to_scipy(spline: BSpline) -> scipy.interpolate.BSpline:
    """Scipy's class for the same curve."""
    beyond = "periodic" if spline.periodic else False
    return scipy.interpolate.BSpline(spline.knots, spline.control_points, spline.degree, extrapolate=beyond)


def wandering(rng: np.random.Generator, n: int) -> Array:
    """Control points (n, 2) of a curve that goes on about 3 m each step."""
    heading = np.cumsum(rng.normal(scale=0.4, size=n))
    return np.cumsum(3.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)


def ring(m: int = 20, degree: int = 3, seed: int = 0) -> BSpline:
    """A closed curve about 20 m across on uneven breaks."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(m) / m
    points = 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(scale=0.3, size=(m, 2))
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(2.0, 4.0, m))])
    return BSpline.periodic_from(breaks, points, degree)


@st.composite
def open_splines(draw: st.DrawFn) -> BSpline:
    """Open curves of degree 1 to 5, unevenly spaced knots, clamped or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    degree = draw(st.integers(1, 5))
    n = degree + 1 + draw(st.integers(0, 10))
    knots = np.cumsum(rng.uniform(0.6, 1.6, n + degree + 1))
    spline = BSpline(knots, wandering(rng, n), degree)
    return spline.clamp() if draw(st.booleans()) else spline


def inside(spline: BSpline, count: int = 200) -> Array:
    return np.linspace(*spline.domain, count)


@given(spline=open_splines())
def test_values_derivatives_and_matrix_are_scipys(spline: BSpline) -> None:
    u, steps = inside(spline), np.diff(spline.knots)
    size, span = float(np.abs(spline.control_points).max()), float(steps[steps > 0.0].min())
    for order in range(spline.degree + 1):
        expected = to_scipy(spline)(u, nu=order)
        # a derivative is a difference of control points, whose round-off it multiplies by p! / (p - r)! / h^r
        scale = TOLERANCE * max(1.0, size * math.perm(spline.degree, order) / span**order)
        for found in (spline.evaluate(u, order), spline.derivatives(u, spline.degree)[order]):
            np.testing.assert_allclose(found, expected, atol=10 * scale, rtol=0)
        product = spline.basis_matrix(u, order) @ spline.control_points
        np.testing.assert_allclose(product, expected, atol=10 * scale, rtol=0)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_periodic_curve_is_scipys_and_closes_smoothly(degree: int) -> None:
    spline = ring(degree=degree)
    low, high = spline.domain
    u = np.linspace(low - 10.0, high + 10.0, 300)
    np.testing.assert_allclose(spline.evaluate(u), to_scipy(spline)(u), atol=1e-11)
    for order in range(degree):
        seam = spline.evaluate(np.array([low, high - 1e-12]), order)
        np.testing.assert_allclose(seam[0], seam[1], atol=1e-9)
    product = spline.basis_matrix(u) @ spline.distinct_control_points
    np.testing.assert_allclose(product, spline.evaluate(u), atol=TOLERANCE * 100)
    assert spline.size == 20


@given(spline=open_splines())
def test_clamping_and_unclamping_leave_the_curve_as_it_is(spline: BSpline) -> None:
    u = inside(spline)
    curve = spline.evaluate(u)
    scale = 10 * TOLERANCE * max(1.0, float(np.abs(spline.unclamp().control_points).max()))
    for changed in (spline.clamp(), spline.unclamp()):
        assert changed.domain == spline.domain
        np.testing.assert_allclose(changed.evaluate(u), curve, atol=scale, rtol=0)
    clamped = spline.clamp()
    np.testing.assert_allclose(clamped.control_points[[0, -1]], curve[[0, -1]], atol=scale)
    again = clamped.unclamp().clamp()
    np.testing.assert_allclose(again.control_points, clamped.control_points, atol=100 * scale)


@given(spline=open_splines(), distance=st.floats(1.0, 5.0), angle=st.floats(-2.0, 2.0))
def test_extension_keeps_the_old_curve_and_meets_the_point(
    spline: BSpline, distance: float, angle: float
) -> None:
    end = spline.evaluate(np.array([spline.domain[1]]))[0]
    point = end + distance * np.array([np.cos(angle), np.sin(angle)])
    extended = spline.extend_to(point)
    u = inside(spline)
    scale = 10 * TOLERANCE * max(1.0, float(np.abs(extended.control_points).max()))
    np.testing.assert_allclose(extended.evaluate(u), spline.evaluate(u), atol=scale, rtol=0)
    new_end = np.array([extended.domain[1]])
    np.testing.assert_allclose(extended.evaluate(new_end)[0], point, atol=scale, rtol=0)
    assert extended.size == spline.size + 1
    assert extended.domain[0] == spline.domain[0] and extended.domain[1] > spline.domain[1]


def backwards(spline: BSpline) -> BSpline:
    """Return the same curve in the opposite direction: S(-u) on [-high, -low]."""
    return BSpline(-spline.knots[::-1], spline.control_points[::-1], spline.degree, spline.periodic)


def test_a_point_at_the_very_end_still_extends() -> None:
    spline = BSpline.clamped_from(np.array([0.0, 3.0, 6.0]), wandering(np.random.default_rng(1), 5))
    end = spline.control_points[-1]
    extended = spline.extend_to(end)
    assert np.isfinite(extended.control_points).all()
    np.testing.assert_allclose(extended.evaluate(inside(spline)), spline.evaluate(inside(spline)), atol=1e-11)


def test_covariance_along_the_curve_is_that_of_sampled_curves() -> None:
    rng = np.random.default_rng(3)
    for spline in (BSpline.open_uniform(wandering(rng, 9)), ring(8)):
        size = 2 * spline.size
        root = rng.normal(size=(size, size)) * 0.2
        joint = root @ root.T
        u = np.array([spline.domain[0], *rng.uniform(*spline.domain, 4)])
        samples = rng.multivariate_normal(np.zeros(size), joint, 40_000).reshape(-1, spline.size, 2)
        curves = np.einsum("km,smd->skd", spline.basis_matrix(u), samples)
        sampled = np.einsum("ska,skb->kab", curves, curves) / len(curves)
        found = spline.covariance_at(u, joint)
        np.testing.assert_allclose(found, sampled, atol=0.05 * float(np.abs(found).max()))
        blocks = np.kron(spline.basis_matrix(u), np.eye(2))
        exact = (blocks @ joint @ blocks.T).reshape(len(u), 2, len(u), 2)
        np.testing.assert_allclose(found, exact[np.arange(5), :, np.arange(5)], atol=1e-10)


def test_normal_sigma_is_across_the_curve_only() -> None:
    points = np.stack([np.arange(8.0), np.zeros(8)], axis=1)
    spline = BSpline.open_uniform(points)
    joint = np.diag(np.tile([9.0, 0.25], 8))
    u = inside(spline, 20)
    weights = np.sqrt((spline.basis_matrix(u) ** 2).sum(axis=1))
    np.testing.assert_allclose(spline.normal_sigma(u, joint), 0.5 * weights, atol=1e-10)
    common = np.kron(np.ones((8, 8)), np.diag([9.0, 0.25]))
    np.testing.assert_allclose(spline.normal_sigma(u, common), 0.5, atol=1e-10)


def test_curvature_length_and_foot_points_of_a_circle() -> None:
    m, radius = 60, 12.0
    angle = 2.0 * np.pi * np.arange(m) / m
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    spline = BSpline.periodic_from(np.arange(m + 1.0), circle)
    u = inside(spline)
    true_radius = float(np.linalg.norm(spline.evaluate(u), axis=1).mean())
    np.testing.assert_allclose(spline.curvature(u), 1.0 / true_radius, rtol=2e-3)
    np.testing.assert_allclose(backwards(spline).curvature(-u), -1.0 / true_radius, rtol=2e-3)
    assert spline.length() == pytest.approx(2.0 * np.pi * true_radius, rel=1e-6)
    feet = spline.foot_points(circle * 1.2)
    np.testing.assert_allclose(feet.distance, true_radius - 1.2 * radius, atol=1e-3)
    assert feet.interior.all()


@settings(max_examples=30)
@given(spline=open_splines())
def test_arc_length_is_that_of_a_fine_polygon_and_its_inverse_is_one(spline: BSpline) -> None:
    u = inside(spline, 4001)
    polygon = np.linalg.norm(np.diff(spline.evaluate(u), axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(polygon)])
    np.testing.assert_allclose(spline.arc_length(u), along, atol=2e-3 * along[-1])
    lengths = np.linspace(0.0, spline.length(), 50)
    np.testing.assert_allclose(
        spline.arc_length(spline.parameters_at(lengths)), lengths, atol=1e-4 * along[-1]
    )


GOOD = uniform_knots(6, 3)
POINTS = np.stack([np.arange(6.0), np.zeros(6)], axis=1)


@pytest.mark.parametrize(
    ("knots", "points", "degree", "periodic", "message"),
    [
        (GOOD, POINTS, 0, False, "degree must be at least 1"),
        (GOOD, POINTS[:, :1], 3, False, "control points of shape"),
        (GOOD[:7], POINTS[:3], 3, False, "control points of shape"),
        (GOOD[:-1], POINTS, 3, False, "need 10 knots"),
        (GOOD + np.nan, POINTS, 3, False, "finite"),
        (GOOD, POINTS + np.inf, 3, False, "finite"),
        (GOOD[::-1], POINTS, 3, False, "must not decrease"),
        (np.zeros(10), POINTS, 3, False, "must not be empty"),
        (GOOD, POINTS, 3, True, "more than 3 distinct"),
    ],
)
def test_what_is_no_spline_is_refused(
    knots: Array, points: Array, degree: int, periodic: bool, message: str
) -> None:
    with pytest.raises(SettingsError, match=message):
        BSpline(knots, points, degree, periodic)


def test_what_is_no_periodic_spline_is_refused() -> None:
    good = ring()
    points = good.control_points.copy()
    points[-1] += 0.1
    with pytest.raises(SettingsError, match="must repeat the first"):
        BSpline(good.knots, points, 3, periodic=True)
    knots = good.knots.copy()
    knots[0] -= 1.0
    with pytest.raises(SettingsError, match="periodic spline must repeat"):
        BSpline(knots, good.control_points, 3, periodic=True)
    with pytest.raises(SettingsError, match="m \\+ 1 breaks"):
        BSpline.periodic_from(np.arange(5.0), POINTS)
    for refused in (good.clamp, good.unclamp, lambda: good.extend_to(POINTS[0])):
        with pytest.raises(SettingsError, match="periodic"):
            refused()


def test_the_caller_keeps_its_arrays() -> None:
    knots, points = GOOD.copy(), POINTS.copy()
    spline = BSpline(knots, points)
    knots[:], points[:] = 0.0, 0.0
    np.testing.assert_array_equal(spline.knots, GOOD)
    np.testing.assert_array_equal(spline.control_points, POINTS)
