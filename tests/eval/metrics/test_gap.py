"""The gap between two runs: of curves both ways, of trajectories along and across."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.eval.metrics.alignment import aligned_distance
from pathspace_graph.eval.metrics.reference import gap
from pathspace_graph.factors.bspline import clamped_knots
from pathspace_graph.factors.residuals import greville
from pathspace_graph.factors.se2 import move_points
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

Array = NDArray[np.float64]

STAMPS = np.arange(0.0, 5.0, 0.1)


def line(y: float, length: float = 20.0) -> SplineBoundary:
    """A straight curve along x, whose parameter is x."""
    breaks = np.linspace(0.0, length, 6)
    points = np.column_stack([greville(clamped_knots(breaks, 3), 3), np.full(8, y)])
    spline = BSpline.clamped_from(breaks, points, 3)
    return SplineBoundary(spline, np.eye(16))


def run(boundaries: dict[int, SplineBoundary | PointBoundary], poses: Array, t: Array = STAMPS) -> RunResult:
    return RunResult("a", {}, Map(False, dict(boundaries)), t, poses, (), 0)


def drive(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> Array:
    """Poses towards `heading`, shifted by (x, y) in the vehicle's own frame."""
    c, s = np.cos(heading), np.sin(heading)
    local = np.column_stack([4.0 * STAMPS + x, np.full(len(STAMPS), y)])
    return np.column_stack([local @ np.array([[c, s], [-s, c]]), np.full(len(STAMPS), heading)])


def test_a_run_has_no_gap_from_itself() -> None:
    same = run({LEFT: line(2.0), RIGHT: line(-2.0)}, drive())
    found = gap(same, same)
    assert set(found.curves) == {"left", "right"}
    np.testing.assert_allclose(
        [*found.curves.values(), found.along, found.across, found.heading], 0.0, atol=1e-9
    )


def test_curves_apart() -> None:
    first, second = run({LEFT: line(2.0), RIGHT: line(-2.0)}, drive()), run({LEFT: line(2.3)}, drive())
    found = gap(first, second)
    assert set(found.curves) == {"left"}
    np.testing.assert_allclose(found.curves["left"], 0.3, atol=1e-3)


def test_what_only_one_has_mapped_counts() -> None:
    """Both ways: half of the longer curve is 0 to 10 m from the shorter one's end, half of it is on it."""
    found = gap(run({LEFT: line(2.0, 10.0)}, drive()), run({LEFT: line(2.0, 20.0)}, drive()))
    np.testing.assert_allclose(found.curves["left"], 0.5 * 2.5, rtol=0.05)


def test_trajectories_along_and_across() -> None:
    for heading in (0.0, 2.0):
        found = gap(run({}, drive(0.4, -0.3, heading)), run({}, drive(heading=heading)))
        np.testing.assert_allclose([found.along, found.across, found.heading], [0.4, 0.3, 0.0], atol=1e-9)


def test_headings_are_compared_around_the_circle() -> None:
    first, second = drive(), drive()
    first[:, 2], second[:, 2] = np.pi - 0.01, -np.pi + 0.01
    np.testing.assert_allclose(gap(run({}, first), run({}, second)).heading, 0.02, atol=1e-9)


def test_landmarks_are_points_of_the_curve() -> None:
    points = np.column_stack([np.arange(0.0, 20.1, 0.02), np.full(1005, 2.5)])
    landmarks = PointBoundary(points, np.zeros((2 * len(points), 2 * len(points))))
    found = gap(run({LEFT: landmarks}, drive()), run({LEFT: line(2.0)}, drive()))
    np.testing.assert_allclose(found.curves["left"], 0.5, atol=1e-2)


def bend(motion: Array, width: float = 4.0) -> Map:
    """Both boundaries of a bend after a rigid motion (3,); the left one is `width` from the right one."""
    angle = np.linspace(0.0, np.pi, 10)
    boundaries = {}
    for label, radius in ((LEFT, 20.0), (RIGHT, 20.0 + width)):
        points = radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
        spline = BSpline.clamped_from(np.linspace(0.0, 60.0, 8), move_points(motion, points), 3)
        boundaries[label] = SplineBoundary(spline, np.eye(20))
    return Map(False, boundaries)


def test_maps_in_different_frames_are_aligned() -> None:
    reference = bend(np.zeros(3))
    assert aligned_distance(bend(np.array([2.5, -0.6, 0.05])), reference) < 1e-3
    assert aligned_distance(bend(np.array([1.0, 0.5, 0.0]), width=5.0), reference) == pytest.approx(
        0.5, abs=0.1
    )
    assert aligned_distance(Map(False, {LEFT: line(0.0)}), Map(False, {RIGHT: line(0.0)})) == np.inf
