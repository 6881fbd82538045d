"""Knots where cones ask for them: at the shape that needs them, and how many."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.accuracy import closest_points
from pathspace_graph.factors.arrays import Array
from pathspace_graph.spline.bspline import (
    ENERGY_WEIGHT,
    BSpline,
    chosen_breaks,
    energy_rows,
    fewest_breaks,
    fit_spline,
    thin,
)

DEGREE = 3


def keyhole(count: int = 60) -> Array:
    """Points (k, 2) 2 m apart: a straight, and a bend of 3 m radius in the middle of it."""
    s = 2.0 * (np.arange(count) - count / 2)
    heading = np.pi * np.clip(s / (np.pi * 3.0) + 0.5, 0.0, 1.0)
    return np.cumsum(2.0 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)


def along(points: Array) -> Array:
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))


def circle(count: int, noise: float) -> Array:
    phi = 2.0 * np.pi * np.arange(count) / count
    points = 20.0 * np.column_stack([np.cos(phi), np.sin(phi)])
    return np.asarray(points + np.random.default_rng(0).normal(0.0, noise, points.shape))


def test_each_step_takes_out_one_knot_and_misses_more() -> None:
    points = keyhole()
    path = list(thin(points, False, DEGREE, 8))
    assert [curve.size for curve in path] == list(range(path[0].size, 7, -1))
    assert path[0].size == len(points) + 2
    assert (np.diff([(curve.residual**2).sum() for curve in path]) > -1e-6).all()


def test_the_price_of_a_knot_is_what_the_fit_loses() -> None:
    """The knot taken out is the one without which a least-squares fit of its own is best, of all."""
    points = keyhole(24)
    u = along(points)
    path = list(thin(points, False, DEGREE, 12))
    before, after = path[8], path[9]
    best = min(
        sum_of_squares(points, u, np.delete(before.breaks, k)) for k in range(1, len(before.breaks) - 1)
    )
    np.testing.assert_allclose(sum_of_squares(points, u, after.breaks), best, rtol=1e-6)


def sum_of_squares(points: Array, u: Array, breaks: Array) -> float:
    """What `thin` minimizes, bending included."""
    frame = BSpline.clamped_from(breaks, np.zeros((len(breaks) + 2, 2)), 3)
    stacked = np.concatenate([frame.basis_matrix(u), np.sqrt(ENERGY_WEIGHT) * energy_rows(frame).toarray()])
    target = np.concatenate([points, np.zeros((len(stacked) - len(points), 2))])
    solution = np.linalg.lstsq(stacked, target, rcond=None)[0]
    return float(((stacked @ solution - target) ** 2).sum())


def test_knots_go_where_the_curve_bends() -> None:
    points = keyhole()
    chosen = chosen_breaks(points, False, DEGREE, 8, 20)
    middle = along(points)[len(points) // 2]
    inside = np.abs(chosen.breaks - middle) < 10.0
    assert inside.mean() > 0.5
    assert 20.0 / along(points)[-1] < 0.2


def test_a_smaller_curve_is_taken_where_it_foretells_better() -> None:
    """A circle is a curve of few control points; more of them only follow the noise."""
    chosen = chosen_breaks(circle(80, 0.2), True, DEGREE, 8, 40)
    assert chosen.size < 40
    x = 2.0 * np.arange(60)
    waves = chosen_breaks(np.column_stack([x, np.sin(x / 2.0)]), False, DEGREE, 8, 24)
    assert waves.size == 24


@pytest.mark.parametrize(("height", "seed", "size"), [(0.5, 3, 24), (1.0, 3, 24), (0.3, 0, 18), (0.7, 3, 21)])
def test_of_curves_that_foretell_equally_well_the_largest_is_taken(
    height: float, seed: int, size: int
) -> None:
    """A smaller curve has to foretell better by a tenth: here it does by 8, 6, 11 and 18 %."""
    x = 2.0 * np.arange(60)
    y = height * np.sin(x / 2.5) + np.random.default_rng(seed).normal(0.0, 0.1, 60)
    points = np.column_stack([x, y])
    crossed = {c.size: c.crossed for c in thin(points, False, DEGREE, 8) if c.size <= 24}
    best = min(crossed, key=crossed.__getitem__)
    assert best < 24
    assert size == (best if 1.1 * crossed[best] < crossed[24] else 24)
    assert chosen_breaks(points, False, DEGREE, 8, 24).size == size


def test_knots_of_a_straight_that_needs_none_stay_spread() -> None:
    """Every knot is then missed equally little, but for rounding: none may leave a long interval behind."""
    points = np.column_stack([4.0 * np.arange(16.0), np.zeros(16)])
    *_, last = thin(points, False, DEGREE, 8)
    assert np.diff(last.breaks).max() <= 4 * 4.0 + 1e-9


@pytest.mark.parametrize("gap", [0.0, 1e-14, 1e-12])
def test_cones_at_one_place_share_a_knot(gap: float) -> None:
    """Two knots that coincide up to rounding would be one constraint twice, of which one costs 0 / 0."""
    points = np.insert(keyhole(), 30, keyhole()[30] + gap, axis=0)
    with np.errstate(all="raise"):
        path = list(thin(points, False, DEGREE, 8))
    assert path[0].size == len(points) + 1
    assert np.diff(path[0].breaks).min() > 1.0


@pytest.mark.parametrize("end", [0, -1])
def test_cones_at_an_end_up_to_rounding_add_no_knot(end: int) -> None:
    points = keyhole()
    beside = points[end][None] + 1e-12
    parts = [beside, points] if end == 0 else [points, beside]
    first = next(thin(np.concatenate(parts), False, DEGREE, 8))
    assert first.size == len(points) + 2
    np.testing.assert_allclose(first.breaks[[0, -1]], [0.0, along(points)[-1]], atol=1e-9)


@pytest.mark.parametrize("count", [3, 4, 5, 7])
@pytest.mark.parametrize("periodic", [True, False])
def test_few_cones_have_a_curve_through_them(count: int, periodic: bool) -> None:
    """There are fewer than the control points that are asked for."""
    points = circle(count, 0.0)
    chosen = chosen_breaks(points, periodic, DEGREE, 8, 8)
    spline, _ = fit_spline(points, chosen.breaks, periodic, DEGREE)
    assert np.abs(closest_points(spline, points).distance).max() < 0.5


@pytest.mark.parametrize("tolerance", [0.02, 0.1])
def test_a_line_has_the_fewest_knots_that_its_points_allow(tolerance: float) -> None:
    """On a circle of 20 m, the curve with one control point less is farther from points left out."""
    points = circle(120, 0.0)
    chosen = fewest_breaks(points, True, DEGREE, 6, tolerance)
    by_size = {curve.size: np.sqrt(curve.crossed / 120.0) for curve in thin(points, True, DEGREE, 6)}
    assert by_size[chosen.size] <= tolerance < by_size[chosen.size - 1]
    assert 6 < chosen.size < 20
