"""Bands and ellipses are as wide as they say, wherever they are drawn."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from pathspace_graph.eval.figures.style import (
    curve_parameters,
    draw_band,
    ellipse_outlines,
    point_blocks,
    uncertainty_band,
)
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.spline.bspline import BSpline

from ...scenes.rings import SHIFT, shifted_ring


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_the_band_is_two_sigma_to_either_side_along_the_normal(scale: float) -> None:
    ring = shifted_ring(18.0)
    u = curve_parameters(ring.spline, 7)
    left, right = uncertainty_band(ring, u, scale)
    centre = ring.spline.evaluate(u)
    np.testing.assert_allclose(np.linalg.norm(left - centre, axis=1), 2 * SHIFT * scale, rtol=1e-9)
    np.testing.assert_allclose(left + right, 2 * centre, atol=1e-12)
    # left of the direction of travel is inside of an anticlockwise ring
    middle = np.array([0.0, 20.0])
    assert (np.linalg.norm(left - middle, axis=1) < np.linalg.norm(right - middle, axis=1)).all()


def drawn_band(boundary: SplineBoundary) -> PathPatch:
    axes = Figure().subplots()
    draw_band(axes, boundary, "black", "band")
    (band,) = axes.patches
    assert isinstance(band, PathPatch)
    return band


def area(band: PathPatch) -> float:
    """The area of its polygons, those that run clockwise taken as negative."""
    return sum(
        0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        for x, y in (np.asarray(polygon).T for polygon in band.get_path().to_polygons())
    )


def test_the_band_of_a_closed_curve_is_a_ring_and_reaches_as_far() -> None:
    ring = shifted_ring(22.0)
    band, curve = drawn_band(ring), ring.spline.evaluate(curve_parameters(ring.spline))
    extents = band.get_path().get_extents()
    assert extents.x1 == pytest.approx(curve[:, 0].max() + 2 * SHIFT, abs=1e-3)
    assert extents.y0 == pytest.approx(curve[:, 1].min() - 2 * SHIFT, abs=1e-3)
    # the inner edge runs the other way, so the areas subtract
    assert abs(area(band)) == pytest.approx(4 * SHIFT * ring.spline.length(), rel=1e-3)


def test_the_band_of_an_open_curve_is_one_polygon() -> None:
    """A straight of 6 m whose control points have 0.1 m each, all of them moving as one: 6 m by 0.4 m."""
    points = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0], [6.0, 0.0]])
    straight = BSpline.clamped_from(np.array([0.0, 6.0]), points)
    together = np.tile(np.eye(2), (4, 1))
    band = drawn_band(SplineBoundary(straight, 0.01 * together @ together.T))
    assert len(band.get_path().to_polygons()) == 1
    assert abs(area(band)) == pytest.approx(6.0 * 0.4)


def test_every_span_is_sampled_from_end_to_end() -> None:
    spline = BSpline.clamped_from(np.array([0.0, 1.0, 1.5, 9.0]), np.zeros((6, 2)))
    u = curve_parameters(spline, 4)
    assert (u[0], u[-1], len(u)) == (0.0, 9.0, 13)
    assert set(spline.breaks) <= set(u)


def test_a_points_own_covariance_is_a_block_of_the_joint_one() -> None:
    joint = np.arange(36.0).reshape(6, 6)
    np.testing.assert_array_equal(point_blocks(joint)[1], joint[2:4, 2:4])
    assert point_blocks(np.zeros((0, 0))).shape == (0, 2, 2)


def test_an_outline_of_an_ellipse_is_two_sigma_away_in_every_direction() -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    joint = np.block([[np.eye(2), 0.1 * np.eye(2)], [0.1 * np.eye(2), covariance]])
    first, second = ellipse_outlines(points, joint)
    assert first.shape == (33, 2)
    np.testing.assert_allclose(np.linalg.norm(first - points[0], axis=1), 2.0, rtol=1e-12)
    offset = second - points[1]
    squares = np.einsum("ci,ij,cj->c", offset, np.linalg.inv(covariance), offset)
    np.testing.assert_allclose(squares, 4.0, rtol=1e-12)
    np.testing.assert_allclose(second[0], second[-1], atol=1e-12)
    wider, _ = ellipse_outlines(points, joint, 3.0)
    np.testing.assert_allclose(wider - points[0], 3.0 * (first - points[0]), atol=1e-12)
