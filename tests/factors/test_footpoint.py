"""Foot points against brute force, at degenerate curves, and in their stretches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import Curves
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.bspline import SpanPolynomials, clamped_knots, periodic_knots, uniform_knots
from pathspace_graph.factors.footpoint import FootPoints, foot_points

GRID = 400
"""Coarse grid steps over the domain."""


def curve_points(tables: SpanPolynomials, control_points: Array, u: Array) -> Array:
    """S(u) (k, 2)."""
    values, span = tables.evaluate(u)
    columns = span[:, None] + np.arange(-tables.degree, 1)
    return np.einsum("kj,kjd->kd", values[0], control_points[columns])


def refine_foot_points(
    tables: SpanPolynomials, control_points: Array, points: Array, *stretch: Array, iterations: int = 2
) -> FootPoints:
    """The refinement on one curve."""
    alone = np.zeros(len(points), np.intp)
    return FootPoints(*Curves([tables]).refine(control_points, points, alone, *stretch, iterations))


def whole(tables: SpanPolynomials, control_points: Array, points: Array, step: float = 0.0) -> FootPoints:
    """Foot points with the whole domain as the stretch."""
    step = step or (tables.high - tables.low) / GRID
    low, high = np.full(len(points), tables.low), np.full(len(points), tables.high)
    return foot_points(tables, control_points, points, low, high, step)


def assert_sane(feet: FootPoints, tables: SpanPolynomials, control_points: Array, points: Array) -> None:
    """Everything finite, inside the domain, and consistent with everything else."""
    for array in (feet.u, feet.position, feet.tangent_unit, feet.normal_unit, feet.distance, feet.basis):
        assert np.isfinite(array).all()
    assert ((feet.u >= tables.low) & (feet.u <= tables.high)).all()
    np.testing.assert_allclose(np.linalg.norm(feet.tangent_unit, axis=1), 1.0, atol=1e-12)
    turned = np.stack([-feet.tangent_unit[:, 1], feet.tangent_unit[:, 0]], axis=1)
    np.testing.assert_allclose(feet.normal_unit, turned, atol=1e-12)
    offset = points - feet.position
    np.testing.assert_allclose(feet.distance, np.sum(offset * feet.normal_unit, axis=1), atol=1e-9)
    np.testing.assert_allclose(feet.position, curve_points(tables, control_points, feet.u), atol=1e-9)
    columns = feet.span[:, None] + np.arange(-tables.degree, 1)
    again = np.einsum("kj,kjd->kd", feet.basis, control_points[columns])
    np.testing.assert_allclose(again, feet.position, atol=1e-9)


@st.composite
def curves(draw: st.DrawFn) -> tuple[SpanPolynomials, Array, np.random.Generator]:
    """Open or periodic curves of degree 1 to 4, some with repeated knots or control points."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    degree, m = draw(st.integers(1, 4)), draw(st.integers(5, 12))
    points = rng.normal(size=(m, 2)) * 5.0
    if draw(st.booleans()):
        points[2:5] = points[2]
    if draw(st.booleans()):
        breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(0.3, 2.0, m))])
        unwrapped = np.concatenate([points, points[:degree]])
        return SpanPolynomials(periodic_knots(breaks, degree), degree, True), unwrapped, rng
    steps = rng.choice([0.3, 0.5, 1.0, 2.0], m - degree)
    if degree > 1 and len(steps) > 2:
        steps[1] = 0.0
    breaks = np.concatenate([[0.0], np.cumsum(steps)])
    knots = clamped_knots(breaks, degree) if draw(st.booleans()) else uniform_knots(m, degree, 1.3)
    return SpanPolynomials(knots, degree), points, rng


@given(curve=curves())
def test_no_point_of_a_dense_grid_is_nearer(
    curve: tuple[SpanPolynomials, Array, np.random.Generator],
) -> None:
    tables, control_points, rng = curve
    points = np.concatenate([rng.normal(size=(15, 2)) * 8.0, control_points])
    feet = whole(tables, control_points, points)
    assert_sane(feet, tables, control_points, points)
    grid = curve_points(tables, control_points, np.linspace(tables.low, tables.high, 10 * GRID + 1))
    to_grid = np.linalg.norm(points[:, None] - grid, axis=2)
    found = np.linalg.norm(points - feet.position, axis=1)
    assert (found <= to_grid[:, ::10].min(axis=1) + 1e-6).all()
    longest_step = np.linalg.norm(np.diff(grid, axis=0), axis=1).max() * 10
    assert (found <= to_grid.min(axis=1) + longest_step).all()
    # between two points of the search's own grid, a nearer piece of a polygon may be missed
    assert (found <= to_grid.min(axis=1) + 1e-6).mean() > (0.9 if tables.degree > 1 else 0.75)


@given(curve=curves(), share=st.floats(0.0, 1.2))
def test_foot_points_stay_in_their_stretch(
    curve: tuple[SpanPolynomials, Array, np.random.Generator], share: float
) -> None:
    tables, control_points, rng = curve
    period = tables.high - tables.low
    points = rng.normal(size=(12, 2)) * 8.0
    u_low = rng.uniform(tables.low - period, tables.high, 12)
    u_high = u_low + share * rng.uniform(0.0, period, 12)
    start = rng.uniform(tables.low - period, tables.high + period, 12)
    found = foot_points(tables, control_points, points, u_low, u_high, period / GRID)
    warm = refine_foot_points(tables, control_points, points, start, u_low, u_high)
    for feet in (found, warm):
        assert_sane(feet, tables, control_points, points)
        if tables.periodic:
            beyond = np.mod(feet.u - u_low + 1e-9, period) - 1e-9 - (u_high - u_low)
        else:
            low, high = np.clip(u_low, tables.low, tables.high), np.clip(u_high, tables.low, tables.high)
            beyond = np.maximum(low - feet.u, feet.u - high)
        assert (beyond <= 1e-8).all()


def straight() -> tuple[SpanPolynomials, Array]:
    """The x axis from 0 to 10, S(u) = (u, 0)."""
    knots = uniform_knots(13, 3)
    greville = (knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3.0
    return SpanPolynomials(knots, 3), np.stack([greville, np.zeros(13)], axis=1)


def test_a_straight_line_gives_the_answers_done_by_hand() -> None:
    tables, control_points = straight()
    points = np.array([[3.3, 2.0], [7.1, -1.5], [-4.0, 3.0], [14.0, 1.0]])
    feet = whole(tables, control_points, points, 0.5)
    np.testing.assert_allclose(feet.u, [3.3, 7.1, 0.0, 10.0], atol=1e-9)
    np.testing.assert_allclose(feet.distance, [2.0, -1.5, 3.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(feet.normal_unit, np.tile([0.0, 1.0], (4, 1)), atol=1e-12)
    assert feet.interior.tolist() == [True, True, False, False]


def test_a_stretch_limit_is_interior_only_where_the_foot_point_is_inside() -> None:
    tables, control_points = straight()
    points = np.array([[5.0, 1.0], [5.0, 1.0], [5.0, 1.0]])
    low, high = np.array([2.0, 5.5, 4.0]), np.array([4.0, 8.0, 6.0])
    feet = foot_points(tables, control_points, points, low, high, 0.5)
    np.testing.assert_allclose(feet.u, [4.0, 5.5, 5.0], atol=1e-9)
    assert feet.interior.tolist() == [False, False, True]
    warm = refine_foot_points(tables, control_points, points, np.full(3, 4.7), low, high)
    np.testing.assert_allclose(warm.u, feet.u, atol=1e-9)
    assert warm.interior.tolist() == [False, False, True]


def circle(degree: int = 3, m: int = 16) -> tuple[SpanPolynomials, Array]:
    """A closed curve close to a circle of radius 10 about the origin, once around in u = 16."""
    angle = 2.0 * np.pi * np.arange(m) / m
    points = 10.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    knots = periodic_knots(np.arange(m + 1.0), degree)
    return SpanPolynomials(knots, degree, True), np.concatenate([points, points[:degree]])


def test_the_centre_of_curvature_and_the_seam_are_no_trouble() -> None:
    tables, control_points = circle()
    seam = curve_points(tables, control_points, np.array([tables.low]))[0]
    points = np.array([[0.0, 0.0], 1.1 * seam, [1e-14, 0.0]])
    feet = whole(tables, control_points, points)
    assert_sane(feet, tables, control_points, points)
    assert feet.interior.all()
    assert min(feet.u[1], 16.0 - feet.u[1]) < 1e-8
    assert feet.distance[0] == pytest.approx(10.0, rel=0.03)
    assert feet.distance[1] < 0.0


def test_a_stretch_may_run_past_the_seam() -> None:
    tables, control_points = circle()
    target = np.array([15.5, 0.4, 0.4])
    points = 0.9 * curve_points(tables, control_points, target)
    low, high = np.array([14.0, 14.0, 30.0]), np.array([18.0, 18.0, 34.0])
    feet = foot_points(tables, control_points, points, low, high, 0.3)
    np.testing.assert_allclose(feet.u, target, atol=1e-2)
    assert feet.interior.all()
    warm = refine_foot_points(
        tables, control_points, points, np.array([-0.6, 16.5, 0.3]), low, high, iterations=4
    )
    np.testing.assert_allclose(warm.u, feet.u, atol=1e-8)
    far = refine_foot_points(
        tables, control_points, points, np.array([5.0, 10.0, 2.5]), low, high, iterations=8
    )
    assert (np.mod(far.u - low, 16.0) <= 4.0 + 1e-9).all()


def test_a_point_shared_by_two_stretches_goes_to_the_row_of_its_own() -> None:
    """A hairpin: the rows run 1 m apart, and the nearer one is not in the stretch."""
    x = np.concatenate([np.linspace(0.0, 20.0, 21), np.linspace(20.0, 0.0, 21)])
    y = np.concatenate([np.zeros(21), np.ones(21)])
    tables, control_points = SpanPolynomials(uniform_knots(42, 3), 3), np.stack([x, y], axis=1)
    points = np.array([[5.0, 0.9]])
    near = foot_points(tables, control_points, points, np.array([0.0]), np.array([15.0]), 0.5)
    assert near.position[0, 1] == pytest.approx(0.0, abs=1e-9)
    assert near.distance[0] == pytest.approx(0.9, abs=1e-9)
    assert whole(tables, control_points, points).position[0, 1] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_curve_that_is_one_point_gives_finite_answers(degree: int) -> None:
    tables = SpanPolynomials(uniform_knots(8, degree), degree)
    control_points = np.full((8, 2), 3.0)
    points = np.array([[0.0, 0.0], [3.0, 3.0], [1e6, -1e6]])
    feet = whole(tables, control_points, points)
    assert_sane(feet, tables, control_points, points)
    warm = refine_foot_points(tables, control_points, points, feet.u, feet.u - 1.0, feet.u + 1.0)
    assert_sane(warm, tables, control_points, points)


def test_a_cusp_takes_its_tangent_from_the_control_polygon() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 2.0]])
    tables = SpanPolynomials(clamped_knots(np.arange(5.0), 3), 3)
    feet = whole(tables, points, np.array([[3.0, -1.0]]))
    assert_sane(feet, tables, points, np.array([[3.0, -1.0]]))
    np.testing.assert_allclose(feet.position[0], [2.0, 0.0], atol=1e-6)


def test_a_polygon_finds_its_corners_and_its_edges() -> None:
    tables = SpanPolynomials(clamped_knots(np.arange(3.0), 1), 1)
    control_points = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]])
    points = np.array([[1.3, 0.7], [5.0, -1.0], [3.0, 2.5]])
    feet = whole(tables, control_points, points, 0.1)
    np.testing.assert_allclose(feet.position, [[1.3, 0.0], [4.0, 0.0], [4.0, 2.5]], atol=1e-6)
    np.testing.assert_allclose(feet.distance[[0, 2]], [0.7, 1.0], atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_warm_start_never_ends_farther_away_and_converges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tables = SpanPolynomials(uniform_knots(20, 3), 3)
    control_points = np.cumsum(rng.normal(size=(20, 2)) + np.array([1.0, 0.0]), axis=0)
    points = control_points[rng.integers(0, 20, 30)] + rng.normal(size=(30, 2))
    start = rng.uniform(tables.low, tables.high, 30)
    low, high = start - 3.0, start + 3.0
    before = np.linalg.norm(points - curve_points(tables, control_points, start), axis=1)
    feet = refine_foot_points(tables, control_points, points, start, low, high)
    assert_sane(feet, tables, control_points, points)
    assert (np.linalg.norm(points - feet.position, axis=1) <= before + 1e-6).all()
    done = refine_foot_points(tables, control_points, points, start, low, high, iterations=60)
    along = np.abs(np.sum((points - done.position) * done.tangent_unit, axis=1))
    assert (along[done.interior] < 1e-6).all()


def test_newton_is_exact_where_it_is_warm() -> None:
    tables, control_points = circle()
    truth = np.linspace(0.2, 15.8, 50)
    positions = curve_points(tables, control_points, truth)
    points = 1.05 * positions
    exact = whole(tables, control_points, points)
    low, high = exact.u - 2.0, exact.u + 2.0
    warm = refine_foot_points(tables, control_points, points, exact.u + 0.02, low, high)
    assert np.abs(warm.u - exact.u).max() < 1e-9
    along = np.sum((points - exact.position) * exact.tangent_unit, axis=1)
    assert np.abs(along).max() < 1e-9


def test_no_rows_give_no_foot_points() -> None:
    tables, control_points = straight()
    none = np.zeros(0)
    feet = foot_points(tables, control_points, np.zeros((0, 2)), none, none, 1.0)
    warm = refine_foot_points(tables, control_points, np.zeros((0, 2)), none, none, none)
    assert feet.position.shape == warm.position.shape == (0, 2)
    assert feet.basis.shape == warm.basis.shape == (0, 4)
