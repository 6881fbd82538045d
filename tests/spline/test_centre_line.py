"""The centre line against circles, straights and perturbed control points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.boundary import boundaries_cross
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import CentreCurve, find_line
from pathspace_graph.spline.planning import CentreLine, _sigmas, centre_line
from pathspace_graph.spline.planning import _uncrossed as uncrossed

from ..scenes.maps import circle

Array = NDArray[np.float64]

QUANTITIES = ("points", "heading", "curvature", "arc_length", "width_left", "width_right")


def straight(y: float, begin: float = 0.0, end: float = 30.0, size: int = 12) -> BSpline:
    """A straight along x."""
    greville = np.linspace(begin, end, size)
    return BSpline.open_uniform(np.column_stack([greville, np.full(size, y)]))


def wavy(radius: float, size: int, closed: bool, seed: int) -> BSpline:
    """A ring with three waves and rough control points, or most of it."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2 * np.pi, size + 1)[:-1]
    at = radius + 1.5 * np.sin(3 * angle)
    points = np.column_stack([at * np.cos(angle), at * np.sin(angle)]) + rng.normal(0.0, 0.05, (size, 2))
    if closed:
        return BSpline.periodic_from(np.arange(size + 1.0), points)
    return BSpline.clamped_from(np.arange(size - 2.0), points)


def moved(splines: tuple[BSpline, BSpline], change: Array) -> tuple[BSpline, BSpline]:
    """Adds a change (2 m,) to the control points of both boundaries."""
    left, right = splines
    parts = np.split(change, [2 * left.size])
    return (
        left.with_points(left.distinct_control_points + parts[0].reshape(-1, 2)),
        right.with_points(right.distinct_control_points + parts[1].reshape(-1, 2)),
    )


def where_it_crosses(line: CentreLine, base: CentreLine) -> dict[str, Array]:
    """What a moved line is where it crosses the normals of the base, by interpolation."""
    wrap = 3 if line.closed else 0

    def around(values: Array, period: float = 0.0) -> Array:
        return np.concatenate([values[len(values) - wrap :] - period, values, values[:wrap] + period])

    def curve(values: Array, period: float = 0.0) -> CubicSpline:
        return CubicSpline(around(line.arc_length, line.length), around(values, period))

    x, y = (curve(line.points[:, d]) for d in range(2))
    tangent = np.column_stack([np.cos(base.heading), np.sin(base.heading)])
    s = line.arc_length[KDTree(line.points).query(base.points)[1]]
    for _ in range(20):
        off = np.column_stack([x(s), y(s)]) - base.points
        speed = np.column_stack([x(s, 1), y(s, 1)])
        s = s - (off * tangent).sum(axis=1) / (speed * tangent).sum(axis=1)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    turns = 2 * np.pi if line.closed else 0.0
    result = {name: curve(getattr(line, name))(s) for name in ("curvature", "width_left", "width_right")}
    result["points"] = (off * normal).sum(axis=1)
    result["heading"] = curve(np.unwrap(line.heading), turns)(s)
    ahead = s - s[0]  # a loop may begin a little later
    return result | {"arc_length": np.mod(ahead + 1e-6, line.length) - 1e-6 if line.closed else ahead}


@pytest.mark.parametrize("turn", [1.0, -1.0])
@pytest.mark.parametrize("step", [0.2, 1.0, 3.0])
def test_between_concentric_circles(turn: float, step: float) -> None:
    left, right = (circle(20.0 - 2.0 * turn, turn=turn), circle(20.0 + 2.0 * turn, 150, turn))
    line = centre_line(left, right, None, step)
    assert len(line.points) == round(40 * np.pi / step)
    assert np.hypot(*line.points.T) == pytest.approx(20.0, abs=1e-4)
    assert line.length == pytest.approx(40 * np.pi, abs=2e-4)
    assert line.curvature == pytest.approx(turn / 20.0, abs=2e-4)
    assert line.width_left == pytest.approx(2.0, abs=1e-4)
    assert line.width_right == pytest.approx(2.0, abs=1e-4)
    assert np.diff(line.arc_length) == pytest.approx(line.length / len(line.points), abs=1e-9)
    angle = np.arctan2(line.points[:, 1], line.points[:, 0])
    assert np.cos(line.heading - angle - turn * np.pi / 2) == pytest.approx(1.0, abs=1e-8)
    assert np.isnan(line.points_sigma).all()


def test_along_a_straight_from_where_both_begin_to_where_both_end() -> None:
    left, right = straight(1.5, 0.0, 33.0), straight(-2.5, 5.0, 45.0)
    low, high = (
        right.evaluate(np.array([right.domain[0]]))[0, 0],
        left.evaluate(np.array([left.domain[1]]))[0, 0],
    )
    line = centre_line(left, right, None, 0.5)
    assert line.points[:, 1] == pytest.approx(-0.5, abs=1e-9)
    assert line.points[0, 0] == pytest.approx(low, abs=0.3)
    assert line.points[-1, 0] == pytest.approx(high, abs=0.3)
    assert line.heading == pytest.approx(0.0, abs=1e-9)
    assert line.curvature == pytest.approx(0.0, abs=1e-9)
    assert line.width_left == pytest.approx(2.0, abs=2e-3)
    assert line.width_right == pytest.approx(2.0, abs=2e-3)
    assert line.arc_length == pytest.approx(line.points[:, 0] - line.points[0, 0], abs=0.01)


def test_sigmas_of_circles_by_hand() -> None:
    """The radii change by a and b: the line by their mean, a width by half their difference."""
    left, right = circle(18.0), circle(22.0)
    outward = [
        (spline.distinct_control_points / radius).ravel() for spline, radius in ((left, 18.0), (right, 22.0))
    ]
    change = np.r_[0.3 * outward[0], 0.1 * outward[1]]
    line = centre_line(left, right, np.outer(change, change), 1.0)
    assert line.points_sigma == pytest.approx(0.2, abs=1e-6)
    assert line.width_left_sigma == pytest.approx(0.1, abs=1e-6)
    assert line.width_right_sigma == pytest.approx(0.1, abs=1e-6)
    assert line.curvature_sigma == pytest.approx(0.2 / 20.0**2, abs=1e-5)
    assert line.heading_sigma == pytest.approx(0.0, abs=1e-6)
    assert line.arc_length_sigma == pytest.approx(0.2 / 20.0 * line.arc_length, abs=1e-3)
    assert line.length_sigma == pytest.approx(0.2 * 2 * np.pi, abs=1e-3)


def test_the_heading_is_that_where_a_line_that_also_slides_crosses_its_old_normals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A line hardly slides when boundaries move, so any derivatives by them stand for the real ones."""
    line, rng = find_line(wavy(18.0, 24, True, 1), wavy(22.0, 27, True, 2)), np.random.default_rng(4)
    by_boundaries = rng.normal(size=(3 * line.ribbon.size, 2 * line.size))
    monkeypatch.setattr(CentreCurve, "by_boundaries", by_boundaries)
    change, centre, step = rng.normal(size=2 * line.size), line.ribbon.centre, 1e-6
    u = np.linspace(*centre.domain, 50)
    _, heading_sigma, *_ = _sigmas(line, u, line.crossings(u), np.outer(change, change))
    by_line = (by_boundaries @ change).reshape(centre.distinct_control_points.shape[0], -1)[:, :2]
    points, tangent = centre.evaluate(u), centre.tangent_unit(u)
    heading = []
    for h in (step, -step):
        moved_line, v = centre.with_points(centre.distinct_control_points + h * by_line), u
        for _ in range(5):
            off = ((moved_line.evaluate(v) - points) * tangent).sum(axis=1)
            v = v - off / (moved_line.evaluate(v, 1) * tangent).sum(axis=1)
        turned = moved_line.tangent_unit(v)
        heading.append(tangent[:, 0] * turned[:, 1] - tangent[:, 1] * turned[:, 0])
    np.testing.assert_allclose(
        heading_sigma, np.abs(heading[0] - heading[1]) / (2.0 * step), rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("side", [0, 1])
def test_a_crossing_moves_along_its_normal_as_the_derivatives_say(side: int) -> None:
    """The line stays, and its normals cross a boundary that waves by up to a quarter of a right angle."""
    line, step = find_line(wavy(18.0, 24, True, 1), wavy(22.0, 27, True, 2)), 1e-5
    u, own = np.linspace(*line.ribbon.domain, 50), line.sides[side]
    change = np.random.default_rng(7).normal(size=(own.size, 2))
    offsets = []
    for h in (step, -step):
        sides = list(line.sides)
        sides[side] = own.with_points(own.distinct_control_points + h * change)
        offsets.append(replace(line, sides=tuple(sides)).crossings(u)[side].offset)
    found = line.crossings(u)[side].along_normal(0, own.size) @ change.ravel()
    np.testing.assert_allclose(found, (offsets[0] - offsets[1]) / (2.0 * step), atol=1e-4)


@pytest.mark.parametrize("closed", [True, False])
def test_each_sigma_is_the_numeric_derivative_along_a_random_change(closed: bool) -> None:
    """With the covariance d d^T, a sigma is the size of the derivative in the direction d."""
    splines = wavy(18.0, 24, closed, 1), wavy(22.0, 27, closed, 2)
    d = np.random.default_rng(3).normal(size=2 * sum(spline.size for spline in splines))
    base = centre_line(*splines, np.outer(d, d), 1.0)
    step = 1e-5
    forth, back = (
        where_it_crosses(centre_line(*moved(splines, e * d), None, 0.25), base) for e in (step, -step)
    )
    for name in QUANTITIES:
        sigma = getattr(base, f"{name}_sigma")[2:-2]
        error = np.abs(forth[name] - back[name])[2:-2] / (2 * step) - sigma
        # the samples turn with the line, which is of second order in the angle between the boundaries
        assert np.sqrt(np.mean(error**2)) < 0.05 * np.sqrt(np.mean(sigma**2)), name


@pytest.mark.parametrize("seed", range(5))
def test_a_point_is_in_the_middle_where_its_normal_crosses_the_boundaries(seed: int) -> None:
    left, right = wavy(18.0, 24, True, 2 * seed), wavy(22.0, 27, True, 2 * seed + 1)
    line = centre_line(left, right, None, 1.0)
    normal = np.column_stack([-np.sin(line.heading), np.cos(line.heading)])
    for spline, width in ((left, line.width_left), (right, -line.width_right)):
        crossed = spline.foot_points(line.points + width[:, None] * normal)
        assert crossed.distance == pytest.approx(0.0, abs=1e-6)
    assert line.width_left == pytest.approx(line.width_right, abs=0.05)


def test_a_lap_that_overlaps_its_beginning_is_one_line() -> None:
    """The open curves go round more than once, a little off, as before a loop is closed."""
    angle = np.linspace(0.0, 2.3 * np.pi, 60)
    drift = 0.02 * angle[:, None]
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    left, right = (BSpline.clamped_from(np.arange(58.0), radius * ring + drift) for radius in (18.0, 22.0))
    line = centre_line(left, right, None, 1.0)
    assert line.length == pytest.approx(2.3 * np.pi * 20.0, rel=0.02)
    assert np.diff(np.unwrap(line.heading)).min() > 0.0


def test_boundaries_that_cross_are_refused_with_the_place() -> None:
    left = circle(18.0, 40)
    points = left.distinct_control_points.copy()
    points[9:12] *= 1.4  # at the top, beyond the right boundary
    with pytest.raises(SettingsError, match=r"do not cross, found them crossing near x = -?\d+\.\d m, y = "):
        centre_line(left.with_points(points), circle(22.0), None, 1.0)


def crossing_normals(line: CentreLine, horizon: int = 10) -> int:
    """Counts the pairs of neighbours whose normals meet within the widths, as TUM's planners do."""
    normal = np.column_stack([-np.sin(line.heading), np.cos(line.heading)])
    count, met = len(line.points), 0
    for i in range(count):
        for j in range(i + 1, i + 1 + horizon):
            if j < count or line.closed:
                j %= count  # noqa: PLW2901
                A = np.column_stack([normal[i], -normal[j]])
                if abs(np.linalg.det(A)) > 1e-8:
                    a, b = np.linalg.solve(A, line.points[j] - line.points[i])
                    within = -line.width_right[i] <= a <= line.width_left[i]
                    met += within and -line.width_right[j] <= b <= line.width_left[j]
    return met


def rough(seed: int, closed: bool) -> tuple[BSpline, BSpline]:
    """A narrow, winding track whose boundaries have corners of their own."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
    base = 14.0 + 5.0 * np.sin(3 * angle + rng.uniform(0, 6))
    half = 1.6 + rng.uniform(-0.5, 0.5, (2, 40))
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    inner, outer = (base - half[0])[:, None] * out, (base + half[1])[:, None] * out
    if closed:
        inner, outer = (BSpline.periodic_from(np.arange(41.0), points) for points in (inner, outer))
        return inner, outer
    return BSpline.open_uniform(inner), BSpline.open_uniform(outer)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_no_map_is_refused_and_no_normals_meet(seed: int, closed: bool) -> None:
    left, right = rough(seed, closed)
    assert not boundaries_cross({LEFT: left, RIGHT: right}, 0.05)
    line = centre_line(left, right, None, 1.0)
    assert crossing_normals(line) == 0
    assert np.abs(np.diff(np.unwrap(line.heading))).max() < 0.6
    for spline, way in ((left, 1.0), (right, -1.0)):
        assert (way * spline.foot_points(line.points).distance < 0.0).all()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_both_of_two_normals_that_meet_are_shortened_and_only_on_that_side(side: float) -> None:
    """They meet 5 m and 4 m from their points 3 m apart, and each keeps 0.95 of that; a third meets none."""
    points = np.array([[0.0, 0.0], [3.0, 0.0], [20.0, 0.0]])
    meeting = np.array([3.0, 4.0 * side])
    normal = np.array([side * meeting / 5.0, [0.0, 1.0], [0.0, 1.0]])
    widths = [np.full(3, 6.0), np.full(3, 7.0)]
    left, right = uncrossed(points, normal, widths, False)
    short, kept = (left, right) if side > 0.0 else (right, left)
    np.testing.assert_allclose(short[:2], [0.95 * 5.0, 0.95 * 4.0])
    assert {short[2], *kept} == {6.0, 7.0}


@pytest.mark.parametrize(("apart", "left"), [(10, [0.95 * 125.0**0.5, 0.95 * 5.0]), (11, [20.0, 20.0])])
def test_normals_up_to_ten_points_apart_must_not_meet(apart: int, left: list[float]) -> None:
    """The first one meets the last one 5 m to its left, above the ends of all between."""
    points = np.column_stack([np.arange(apart + 1.0), np.zeros(apart + 1)])
    normal = np.tile([0.0, 1.0], (apart + 1, 1))
    normal[0] = np.array([apart, 5.0]) / np.hypot(apart, 5.0)
    width = np.full(apart + 1, 0.1)
    width[[0, -1]] = 20.0
    shortened, _ = uncrossed(points, normal, [width, width], False)
    np.testing.assert_allclose(shortened[[0, -1]], left)
    np.testing.assert_array_equal(shortened[1:-1], 0.1)


def test_what_has_no_centre_line() -> None:
    with pytest.raises(SettingsError, match="the left boundary to the left of the right one"):
        centre_line(circle(22.0), circle(18.0), None, 1.0)
    for step in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SettingsError, match="step: expected"):
            centre_line(circle(18.0), circle(22.0), None, step)
    with pytest.raises(SettingsError, match="at most"):
        centre_line(circle(1.8e5), circle(2.2e5), None, 1.0)
