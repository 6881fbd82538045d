"""Places on a known road: hypotheses by the shape of the path, fits on curves, and the odds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.places.find import (
    CURVE_SIGMA,
    FITS_BY_CHANCE,
    LINE_WEIGHT,
    PATH_STEP,
    REACH,
    SURE_ODDS,
    Constellation,
    KnownRoad,
    Prior,
    SampledCurves,
    along,
    find,
    sure,
)
from pathspace_graph.spline.bspline import BSpline

SIDES = {LEFT: 2.0, RIGHT: -2.0}
MOTION = np.array([5.0, -3.0, 1.0])
"""Motion of a drive's own frame to that of the map."""


def ring(dents: tuple[float, float], phi: Array, side: float = 0.0) -> Array:
    """Return points (n, 2) of a road around `25 (1 + a cos(2 phi) + b sin(3 phi))`, anticlockwise."""
    radius = 25.0 * (1.0 + dents[0] * np.cos(2.0 * phi) + dents[1] * np.sin(3.0 * phi)) - side
    return radius[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])


def curves(dents: tuple[float, float]) -> dict[int, BSpline]:
    breaks, found = np.linspace(0.0, 150.0, 101), dict[int, BSpline]()
    phi = breaks[:-1] / 150.0 * 2.0 * np.pi
    blank = BSpline.periodic_from(breaks, np.arange(200.0).reshape(-1, 2))
    for label, side in SIDES.items():
        points = np.linalg.solve(blank.basis_matrix(breaks[:-1]), ring(dents, phi, side))
        found[label] = BSpline.periodic_from(breaks, points)
    return found


def driven(dents: tuple[float, float], begin: float, end: float) -> Array:
    """Return poses (n, 3) on the middle of the road."""
    phi = np.linspace(begin, end, 60)
    xy, ahead = ring(dents, phi), ring(dents, phi + 1e-6)
    return np.column_stack([xy, np.unwrap(np.arctan2(*(ahead - xy)[:, ::-1].T))])


PEAR, OVAL, OTHER = (0.25, 0.12), (0.25, 0.0), (0.05, 0.2)
CONES = np.arange(0.0, 150.0, 4.3) + 0.8 * np.sin(np.arange(35))
"""Parameters of cones at varied distances."""


def road(dents: tuple[float, float], has_cones: bool) -> KnownRoad:
    splines, cones = curves(dents), np.column_stack([CONES, np.full(len(CONES), 0.1)])
    return KnownRoad.of(splines, dict.fromkeys(splines, cones) if has_cones else None)


def seen_from(dents: tuple[float, float], poses: Array) -> Constellation:
    """Return the cones of a road near a path (P, 3), as seen from its newest pose."""
    known = road(dents, True).seen
    assert isinstance(known, Constellation)
    away = np.hypot(*(known.points[:, None] - poses[:, :2]).transpose(2, 0, 1)).min(axis=1)
    near = away < 10.0
    seen = Constellation(known.points[near], known.covariances[near], known.labels[near])
    return seen.seen_from(poses[-1])


@pytest.mark.parametrize("has_cones", [True, False])
@pytest.mark.parametrize("begin", [0.2, 1.9, 4.5])
def test_a_vehicle_is_found_anywhere(begin: float, has_cones: bool) -> None:
    poses = driven(PEAR, begin, begin + 2.4)
    known = road(PEAR, has_cones)
    place = find(seen_from(PEAR, poses), known.seen, known.along(compose(inverse(MOTION), poses)))
    assert place is not None and place.odds >= SURE_ODDS
    np.testing.assert_allclose(place.pose[:2], poses[-1, :2], atol=0.05)
    np.testing.assert_allclose(np.sin(place.pose[2] - poses[-1, 2]), 0.0, atol=0.01)


@pytest.mark.parametrize("has_cones", [True, False])
def test_on_another_road_it_is_nowhere(has_cones: bool) -> None:
    known = road(OTHER, has_cones)
    for begin in np.arange(0.0, 6.0, 0.5):
        poses = driven(PEAR, begin, begin + 2.4)
        assert sure(find(seen_from(PEAR, poses), known.seen, known.along(poses))) is None


@pytest.mark.parametrize("has_cones", [True, False])
def test_of_two_places_that_look_alike_none_is_sure(has_cones: bool) -> None:
    """After half a turn the oval is the same, but for its cones."""
    poses = driven(OVAL, 0.5, 2.9)
    known = road(OVAL, False)
    place = find(seen_from(OVAL, poses), known.seen, known.along(poses))
    assert place is not None and place.odds == pytest.approx(0.0, abs=1.0)
    away = [np.hypot(*(place.pose - sign * poses[-1])[:2]) for sign in (1.0, -1.0)]
    assert min(away) < 0.2


def test_the_more_places_are_tried_the_more_fit_by_chance() -> None:
    """Nine more hypotheses, at which no cone is in reach, cost the odds ln(10)."""
    poses = driven(PEAR, 1.0, 3.4)
    known, seen = road(PEAR, True), seen_from(PEAR, poses)
    few = Constellation(*(column[:8] for column in seen.cones))
    elsewhere = poses[-1] + np.column_stack([500.0 * np.arange(10), np.zeros((10, 2))])
    odds = []
    for tried in (poses[-1], elsewhere):
        place = find(few, known.seen, Prior.about(tried, (3.0, 3.0, 0.2), (1.0, 0.1), failed=0.0))
        assert place is not None
        odds.append(place.odds)
    assert odds[0] == pytest.approx(8.0 * np.log(1.0 / FITS_BY_CHANCE), abs=0.01)
    assert odds[0] - odds[1] == pytest.approx(np.log(10.0), abs=0.01)


def test_backwards_left_is_right() -> None:
    poses = driven(PEAR, 1.0, 3.4)
    seen, own = seen_from(PEAR, poses), compose(inverse(MOTION), poses)
    turned = road(PEAR, True).backwards()
    assert sure(find(seen, turned.seen, turned.along(own))) is None
    forwards = turned.backwards()
    assert sure(find(seen, forwards.seen, forwards.along(own))) is not None


# --- hypotheses --------------------------------------------------------------------------------------------


def test_a_path_is_laid_where_it_belongs() -> None:
    """A part of a loop is found at its place, the best first, and the others are apart."""
    way = road(PEAR, False).way
    assert np.abs(np.diff(path_lengths(way)) - PATH_STEP).max() < 0.1
    poses = driven(PEAR, 4.0, 7.0)
    found = along(compose(inverse(MOTION), poses), way, True)
    np.testing.assert_allclose(found[0][:2], poses[-1, :2], atol=1.0)
    np.testing.assert_allclose(np.sin(found[0][2] - poses[-1, 2]), 0.0, atol=0.05)
    assert len(found) < 2 or pdist(found[:, :2]).min() > 0.5 * REACH[0]


def test_on_an_open_road_a_path_is_inside() -> None:
    way = road(PEAR, False).way[:40]
    inside, beyond = driven(PEAR, 1.0, 2.0), driven(PEAR, 5.0, 6.2)
    assert np.hypot(*(along(inside, way, False)[:, :2] - inside[-1, :2]).T).min() < 1.5
    for found in along(beyond, way, False):
        assert np.hypot(*(way - found[:2]).T).min() < 4.0
    assert len(along(driven(PEAR, 0.0, 6.0), way, False)) == 0  # longer than the road


def straight(length: float) -> dict[int, BSpline]:
    x = np.arange(0.0, length, 3.0)
    return {
        label: BSpline.open_uniform(np.column_stack([x, np.full(len(x), y)])) for label, y in SIDES.items()
    }


# --- curves ------------------------------------------------------------------------------------------------


def test_points_are_laid_across_curves_and_not_along() -> None:
    """On a straight, the information along it is that of nothing, and across it that of each point."""
    known = SampledCurves.of(straight(60.0))
    points = np.array([[20.0, 2.0], [25.0, 2.0], [22.0, -2.0], [27.0, -2.0]])
    seen = Constellation(points, np.zeros((4, 2, 2)), np.repeat([LEFT, RIGHT], 2), weight=LINE_WEIGHT)
    start = np.array([0.3, 0.6, 0.02])
    fits = known.fits(seen, Prior(start[None], np.diag([1.0, 1e-6, 1e-6]), (4.0, 0.3)))
    np.testing.assert_allclose(fits.poses[0], [0.3, 0.0, 0.0], atol=1e-3)
    assert fits.counts[0] == pytest.approx(4 * LINE_WEIGHT)
    assert fits.squares[0] == pytest.approx(0.0, abs=1e-6)
    assert fits.information[0, 0, 0] < 0.02
    assert fits.information[0, 1, 1] == pytest.approx(0.01 + 4 * LINE_WEIGHT / CURVE_SIGMA**2)


def test_beyond_the_end_of_an_open_curve_nothing_is_in_view() -> None:
    points = np.array([[5.0, 2.0], [10.0, -2.0], [40.0, 2.0], [-9.0, -2.0]])
    seen = Constellation(points, np.zeros((4, 2, 2)), np.array([LEFT, RIGHT, LEFT, RIGHT]))
    fits = SampledCurves.of(straight(30.0)).fits(seen, Prior(np.zeros((1, 3)), np.eye(3), (4.0, 0.3)))
    assert fits.counts[0] == 2.0


def circle(count: int) -> Array:
    """Return the way (n, 2) around a circle, on which a path fits everywhere."""
    phi = 2.0 * np.pi * np.arange(count) / count
    return 0.5 * PATH_STEP / np.sin(np.pi / count) * np.column_stack([np.cos(phi), np.sin(phi)])


def test_hypotheses_are_spread_over_the_seam_of_a_closed_way() -> None:
    """The last and the first point of a ring are neighbours; on an open road they are its ends."""
    way = circle(20)
    heading = np.arctan2(*np.roll(way, -1, axis=0).T[::-1] - way.T[::-1])
    poses = np.column_stack([way, np.unwrap(heading)])[3:9]
    around, between = (nearest(way, along(poses, way, closed)) for closed in (True, False))
    assert (np.diff([*around, around[0] + 20]) >= 3).all()
    assert (np.diff(between) >= 3).all()
    assert between.min() >= 5, "a path of five steps does not end before the fifth"


def nearest(way: Array, poses: Array) -> Array:
    """Return the indices of the points of a way beside poses (k, 3), ascending."""
    return np.sort(KDTree(way).query(poses[:, :2])[1])


def test_a_path_is_aligned_by_the_least_squares_of_its_points() -> None:
    """Of all stretches, by singular values (Umeyama 1991)."""
    rng, way = np.random.default_rng(0), road(PEAR, False).way
    points = way[10:22] + 0.1 * rng.normal(size=(12, 2))
    length = path_lengths(points)
    at = length[-1] - PATH_STEP * np.arange(int(length[-1] / PATH_STEP), -1, -1)
    path = np.column_stack([np.interp(at, length, axis) for axis in points.T])
    fits = []
    for end in range(len(way)):
        target = way[np.arange(end - len(path) + 1, end + 1) % len(way)]
        left, _, right = np.linalg.svd((target - target.mean(axis=0)).T @ (path - path.mean(axis=0)))
        turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
        misfit = target - target.mean(axis=0) - (path - path.mean(axis=0)) @ turn.T
        fits.append(((misfit**2).sum(), *turn @ (points[-1] - path.mean(axis=0)) + target.mean(axis=0)))
    found = along(np.column_stack([points, np.zeros(12)]), way, True)
    np.testing.assert_allclose(found[0][:2], min(fits)[1:], atol=1e-9)
