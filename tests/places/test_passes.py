"""Constellations, where they lie on others, how sure a place is, and which returns are believed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import log

import numpy as np
import pytest

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import compose, left_of, path_lengths, relative, to_map, to_vehicle
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.places.find import (
    CLOSES_WITHIN,
    FAILED,
    FIT_SIGMA,
    FITS_BY_CHANCE,
    LEAST_CONES,
    MERGE_RANGE,
    PATH_STEP,
    SURE_ODDS,
    Constellation,
    Place,
    Prior,
    SeenIn,
    find,
    find_return,
    return_to_beginning,
    revisit_of,
)
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import path_of
from . import laid_in_numpy

SETTINGS = MapperSettings()
GROWTH = SETTINGS.growth
COVARIANCE = 0.01
"""Variance of a cone in each direction (m^2)."""
POSE = np.array([3.0, -2.0, 0.5])
NOTHING = np.zeros((3, 3))
"""Information of a prior that knows nothing."""
REACH = (4.0, 0.3)


def constellation(points: Array, labels: IntArray | None = None) -> Constellation:
    """Return cones whose colours alternate by default."""
    colours = np.arange(len(points)) % 2 if labels is None else labels
    return Constellation(points, np.tile(COVARIANCE * np.eye(2), (len(points), 1, 1)), colours)


def scattered(count: int = 20, seed: int = 1) -> Constellation:
    return constellation(np.random.default_rng(seed).uniform(-10.0, 10.0, (count, 2)))


def row(gaps: Array) -> Constellation:
    """Return two rows of cones beside a straight, with the same gaps (m)."""
    x = np.append(0.0, np.cumsum(gaps))
    sides = [np.column_stack([x, np.full(len(x), y)]) for y in (2.0, -2.0)]
    return constellation(np.concatenate(sides), np.repeat([LEFT, RIGHT], len(x)))


def beside(known: Constellation, chosen: slice | IntArray, pose: Array = POSE) -> Constellation:
    """Return some of the cones as they are seen from a pose (3,)."""
    picked = np.arange(len(known.labels))[chosen]
    part = Constellation(known.points[picked], known.covariances[picked], known.labels[picked])
    return part.seen_from(pose)


def best(
    seen: Constellation, known: Constellation, mean: Array, information: Array, reach: tuple[float, float]
) -> Place:
    """Return the best place about a pose."""
    place = find(seen, known, Prior(mean[None], information, reach))
    assert place is not None
    return place


def is_sure(place: Place) -> bool:
    return place.odds >= SURE_ODDS


# --- the pose --------------------------------------------------------------------------------------------


def test_a_few_cones_tell_the_pose_from_which_they_were_seen() -> None:
    """The information is that of each cone's distance, by the variances of both and of slow errors."""
    known = scattered()
    laid = best(beside(known, slice(10)), known, POSE + np.array([1.2, -0.9, 0.2]), NOTHING, REACH)
    assert is_sure(laid)
    np.testing.assert_allclose(laid.pose, POSE, atol=1e-6)
    arm = left_of(known.points[:10] - POSE[:2])
    by_turn, sum_of_squares = arm.sum(axis=0), np.sum(arm**2)
    expected = np.array([[10.0, 0.0, by_turn[0]], [0.0, 10.0, by_turn[1]], [*by_turn, sum_of_squares]])
    np.testing.assert_allclose(laid.information, expected / (FIT_SIGMA**2 + 2.0 * COVARIANCE), atol=1e-3)


def test_a_cone_lies_on_one_of_its_own_colour_only() -> None:
    known = scattered()
    other = replace(beside(known, slice(12)), labels=1 - known.labels[:12])
    assert not is_sure(best(other, known, POSE, NOTHING, REACH))


NOWHERE = FAILED + 20 * 2.0 * log(1.0 / FITS_BY_CHANCE)
"""Cost of twenty cones at none of the places, after odometry has failed: less than in any wrong place."""


def test_what_is_expected_counts_until_odometry_has_failed() -> None:
    """The pose is a metre and a tenth of a radian off, which are one sigma each, or any number of them."""
    known, mean = scattered(), POSE + np.array([1.0, 0.0, 0.1])
    for sigmas, cost in (((1.0, 1.0, 0.1), 2.0), ((0.01, 0.01, 0.001), FAILED)):
        laid = best(beside(known, slice(None)), known, mean, np.diag(np.array(sigmas) ** -2.0), REACH)
        np.testing.assert_allclose(laid.pose, POSE, atol=1e-6)
        assert laid.odds == pytest.approx(0.5 * (NOWHERE - cost), abs=1e-3)


@pytest.mark.parametrize("away", [(3.6, 0.0, 0.0), (-2.4, 2.6, 0.2)])
def test_a_place_far_from_where_it_is_expected_is_found_among_many_cones(
    away: tuple[float, float, float],
) -> None:
    """Wrong places near the mean have votes too, but the distance counts only until odometry has failed."""
    known = scattered(60)
    sure = np.diag(np.array([0.01, 0.01, 0.001]) ** -2.0)
    laid = best(beside(known, slice(30)), known, POSE + np.array(away), sure, REACH)
    assert is_sure(laid)
    np.testing.assert_allclose(laid.pose, POSE, atol=1e-3)


def test_the_heading_may_have_turned_around() -> None:
    known = scattered()
    mean = POSE + np.array([0.4, 0.4, 2.0 * np.pi])
    laid = best(beside(known, slice(None)), known, mean, np.diag([1.0, 1.0, 100.0]), REACH)
    assert laid.odds == pytest.approx(0.5 * (NOWHERE - 0.32), abs=1e-6)


def test_the_information_is_that_of_repeated_observations() -> None:
    """Errors of samples have the claimed covariance, but for the efficiency that the cap of squares costs.

    Cones whose errors are those of their covariances alone tell more than is claimed.
    """
    rng, known = np.random.default_rng(3), scattered(16)
    variances = FIT_SIGMA**2 + 2.0 * COVARIANCE, 2.0 * COVARIANCE
    for variance, (least, most) in zip(variances, ((0.9, 1.6), (0.15, 0.4)), strict=True):
        squares = []
        for _ in range(300):
            noise = np.sqrt(variance) * rng.normal(size=known.points.shape)
            noisy = replace(known, points=known.points + noise)
            laid = best(noisy.seen_from(POSE), known, POSE, NOTHING, (1.0, 0.1))
            off = laid.pose - POSE
            squares.append(off @ laid.information @ off / 3.0)
        assert least < np.mean(squares) < most


@pytest.mark.parametrize("seed", range(5))
def test_the_compiled_places_are_those_in_numpy(seed: int) -> None:
    """Cones of two colours, the same with noise from a pose, views of them, and what is expected of it."""
    rng = np.random.default_rng(seed)

    def spread(size: int, count: int = 1) -> Array:
        roots = rng.normal(size=(count, size, size))
        return roots @ roots.transpose(0, 2, 1)

    points, labels, pose = rng.uniform(-12.0, 12.0, (17, 2)), rng.integers(0, 2, 17), POSE * [10.0, 10.0, 2.0]
    seen = to_vehicle(points + pose[:2], pose[None]) + 0.1 * rng.normal(size=(17, 2))
    views = np.column_stack(
        [pose + rng.normal(size=(3, 3)), rng.uniform(5.0, 15.0, 3), rng.uniform(0.3, 2.0, 3)]
    )
    arguments = (
        (seen, 0.01 * spread(2, 17), labels),
        (points + pose[:2], 0.01 * spread(2, 17), labels),
        views,
        pose + np.array([[0.7, -0.4, 0.1], [-3.0, 1.0, 0.0]]),
        pose + np.array([[0.7, 0.8, 2.0 * np.pi], [-2.0, 1.0, 0.0]]),
        0.1 * (spread(3)[0] + np.eye(3)),
        REACH,
        (0.25, 9.0, 0.5, 0.05, 1.0, 10.0, 2.0, 20.0),
    )
    for found, expected in zip(kernels.laid(*arguments), laid_in_numpy.laid(*arguments), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12 * max(1.0, np.abs(expected).max()))


# --- how sure it is --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gone", "fits"), [(4, True), (5, False)])
def test_most_cones_must_lie_on_earlier_ones(gone: int, fits: bool) -> None:
    """A fifth of them may lie on none."""
    known = scattered()
    moved = known.points + np.where(np.arange(20) < gone, 50.0, 0.0)[:, None]
    place = best(replace(known, points=moved).seen_from(POSE), known, POSE, NOTHING, REACH)
    assert (place.odds >= SURE_ODDS) is fits


@pytest.mark.parametrize(("sigmas", "fits"), [(1.35, True), (1.5, False)])
def test_cones_that_lie_beside_others_do_not_agree(sigmas: float, fits: bool) -> None:
    """Half of them lie to one side and half to the other, by the same distance, which no motion explains."""
    points = np.array([[6.0 * (k // 4), 6.0 * (k % 4)] for k in range(16)])
    off = sigmas * np.sqrt(FIT_SIGMA**2 + 2.0 * COVARIANCE) * np.where(np.arange(16) % 4 % 3, 1.0, -1.0)
    moved = points + np.column_stack([off, np.zeros(16)])
    place = best(constellation(moved).seen_from(POSE), constellation(points), POSE, NOTHING, (0.4, 0.01))
    assert (place.odds >= SURE_ODDS) is fits


@pytest.mark.parametrize(
    ("sigma", "varied", "alone"), [(3.0, 0.0, False), (3.0, 0.8, True), (1.0, 0.0, True)]
)
def test_rows_at_regular_distances_fit_in_many_places(sigma: float, varied: float, alone: bool) -> None:
    """Rows at distances that vary (m) fit in one, and odometry that knows the place rules out others."""
    gaps, pose = 4.0 + np.random.default_rng(2).uniform(-varied, varied, 19), np.array([30.0, 0.0, 0.0])
    chosen, known = np.concatenate([np.arange(5, 13), np.arange(25, 33)]), row(gaps)
    information = np.diag([sigma**-2.0, sigma**-2.0, 100.0])
    laid = best(beside(known, chosen, pose), known, pose, information, (8.0, 0.1))
    np.testing.assert_allclose(laid.pose, pose, atol=0.01)
    assert is_sure(laid) is alone


AHEAD = np.array([[0.0, 0.0, 0.0, 15.0, 1.0], [10.0, 0.0, 0.0, 15.0, 1.0]])
"""Views from a pose at the start and from one 10 m on: cones behind the start were never in view."""


@pytest.mark.parametrize(("views", "fits"), [(AHEAD, True), (None, False)])
def test_a_cone_where_nothing_was_in_view_is_not_asked(views: Array | None, fits: bool) -> None:
    """The vehicle is 4 m past its start. Ten of the cones that it has seen stand before the start."""
    both, pose = row(np.array([3.0, 5.0, 4.0, 6.0, 3.5, 5.5, 4.5, 3.0])), np.array([22.0, 0.0, 0.0])
    first = both.points[:, 0] > 20.0
    known = Constellation(both.points[first], both.covariances[first], both.labels[first])
    if views is not None:
        known = replace(known, views=views + np.array([18.0, 0.0, 0.0, 0.0, 0.0]))
    laid = best(both.seen_from(pose), known, pose, np.diag([1.0, 1.0, 100.0]), (8.0, 0.1))
    assert is_sure(laid) is fits


def test_a_vehicle_that_is_not_back_yet_fits_a_gap_farther_along_a_row() -> None:
    """It is 9 m before its start, and odometry has it there to 2 m. Regular rows fit 12 and 16 m farther."""
    x = 4.0 * np.arange(-5, 15)
    both = constellation(np.array([(a, y) for a in x for y in (2.0, -2.0)]), np.tile([LEFT, RIGHT], len(x)))
    pose, first, near = (
        np.array([-9.0, 0.0, 0.0]),
        both.points[:, 0] > 1.0,
        np.abs(both.points[:, 0] + 4.0) < 13.0,
    )
    known = replace(beside(both, np.flatnonzero(first), np.zeros(3)), views=AHEAD)
    seen = beside(both, np.flatnonzero(near), pose)
    for off in np.linspace(-3.0, 3.0, 7):
        laid = best(seen, known, pose + np.array([off, 0.0, 0.0]), np.diag([0.25, 1.0, 100.0]), (17.0, 0.3))
        assert not is_sure(laid)


@pytest.mark.parametrize(("seen", "known"), [(LEAST_CONES - 1, 20), (20, LEAST_CONES - 1), (20, 0), (0, 20)])
def test_a_few_cones_have_no_sure_place(seen: int, known: int) -> None:
    cones = scattered()
    prior = Prior(POSE[None], NOTHING, REACH)
    place = find(beside(cones, slice(seen)), beside(cones, slice(known), np.zeros(3)), prior)
    assert place is None or place.odds == -np.inf


# --- cones of detections ---------------------------------------------------------------------------------


def test_cones_are_seen_often_enough_near_enough_and_in_colour() -> None:
    """Each of four cones but the first lacks one of these."""
    near, far = [5.0, 1.0], [MERGE_RANGE + 1.0, 0.0]
    rows = [(near, LEFT)] * GROWTH.sightings + [([5.0, -3.0], LEFT)] * (GROWTH.sightings - 1)
    rows += [(far, LEFT)] * GROWTH.sightings + [([1.0, 4.0], UNKNOWN)] * GROWTH.sightings
    points, labels = np.array([point for point, _ in rows]), np.array([label for _, label in rows])
    seen = Detections(0.0, points, np.tile(0.03 * np.eye(2), (len(rows), 1, 1)), labels)
    found = Constellation.of(DetectionColumns.of([seen]), POSE[None], GROWTH)
    np.testing.assert_allclose(found.points, to_map(np.array([near]), POSE[None]))
    np.testing.assert_allclose(found.covariances, [0.03 / GROWTH.sightings * np.eye(2)], atol=1e-12)
    np.testing.assert_array_equal(found.labels, [LEFT])


def test_the_views_are_those_of_nearly_all_detections() -> None:
    """Two of forty detections are farther than the others, and two at a larger bearing."""
    bearing, distance = np.linspace(-0.5, 0.5, 40), np.full(40, 10.0)
    bearing[:2], distance[-2:] = 1.5, 15.0
    points = distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    seen = Detections(0.0, points, np.tile(0.03 * np.eye(2), (40, 1, 1)), np.full(40, LEFT))
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [PATH_STEP + 0.1, 0.0, 0.0]])
    found = Constellation.of(DetectionColumns.of([seen, seen, seen]), poses, GROWTH)
    np.testing.assert_allclose(found.views[:, :3], poses[[0, 2]])
    assert (found.views[:, 3] < 15.0).all() and (found.views[:, 3] >= 10.0).all()
    assert (found.views[:, 4] < 1.5).all() and (found.views[:, 4] >= 0.47).all()


# --- passes of a drive -----------------------------------------------------------------------------------

STEP = 0.5
DRIFT = np.array([1.0, -0.8, 0.03])
"""Error of the last pose of a drive, which grows with the path (m, m, rad)."""


along = partial(path_of, STEP)


def sensor(poses: Array, seed: int = 0) -> SeenIn:
    """Return what is seen from true poses (P, 3): cones at irregular places beside and around the path."""
    rng = np.random.default_rng(seed)
    at = poses[np.arange(0, len(poses), 6), :2]
    cones = at + rng.uniform(-5.0, 5.0, at.shape)

    def seen_in(cycles: IntArray) -> DetectionColumns:
        seen = []
        for k in cycles.tolist():
            points = to_vehicle(cones, poses[k : k + 1])
            near = np.hypot(*points.T) < MERGE_RANGE - 1.0
            covariances = np.tile(0.02 * np.eye(2), (near.sum(), 1, 1))
            seen.append(Detections(0.0, points[near], covariances, np.flatnonzero(near) % 2))
        table = DetectionColumns.of(seen)
        return replace(table, cycle=cycles[table.cycle])

    return seen_in


def drifted(poses: Array) -> Array:
    """Return poses (P, 3) whose error grows to `DRIFT` in the end."""
    return poses + np.linspace(0.0, 1.0, len(poses))[:, None] * DRIFT


UNCERTAIN = np.diag([4.0, 4.0, 0.01])  # covariance of the newest pose
ROUND = 2.0 * np.pi * 12.0
LAP, ON_ROUND, ENTRY = (ROUND, 1.0 / 12.0), (ROUND, -1.0 / 12.0), (20.0, 0.0)


def test_a_lap_ends_where_the_cones_of_its_beginning_are() -> None:
    true = along(LAP, (20.0, 1.0 / 12.0))
    poses = drifted(true)
    revisit = return_to_beginning(sensor(true), poses, UNCERTAIN, SETTINGS)
    assert revisit is not None
    assert revisit.later == len(poses) - 1
    local = relative(true[revisit.earlier], true[-1])
    np.testing.assert_allclose(revisit.local, local, atol=0.3)  # about the drift in the newest metres
    assert abs(revisit.local[0]) < 2.0 * STEP  # the earlier pose is the nearest one


def test_a_round_of_a_skidpad_is_no_lap() -> None:
    """Its cones are met again as surely, but the newest path does not cross the start."""
    true = along(ENTRY, ON_ROUND, (10.0, -1.0 / 12.0))
    poses, seen_in = drifted(true), sensor(true)
    found = find_return(seen_in, poses, 40.0, SETTINGS)
    assert found is not None
    assert return_to_beginning(seen_in, poses, UNCERTAIN, SETTINGS) is None


def test_a_vehicle_that_stood_has_seen_the_earlier_cones_once() -> None:
    """A standing sensor repeats its errors; of its cycles the first one counts."""
    true = along(LAP, (20.0, 1.0 / 12.0))
    stood, poses = (np.concatenate([np.repeat(way[:1], 50, axis=0), way]) for way in (true, drifted(true)))
    seen_in, asked = sensor(stood), list[IntArray]()

    def recorded(cycles: IntArray) -> DetectionColumns:
        asked.append(cycles)
        return seen_in(cycles)

    assert return_to_beginning(recorded, poses, UNCERTAIN, SETTINGS) is not None
    _, earlier = asked
    assert (earlier <= 50).sum() == 1 and len(earlier) > 10


KILOMETRE = (1000.0, 2.0 * np.pi / 1000.0)
FAR = np.array([60.0, -80.0, 0.25])  # drift of the second half of a kilometre


@pytest.mark.parametrize(("sigma", "is_found"), [(60.0, True), (10.0, False)])
def test_a_return_is_searched_wherever_the_drift_allows_it(sigma: float, is_found: bool) -> None:
    """The newest pose is a hundred metres off the beginning, which its covariance allows, or not."""
    true = along(KILOMETRE, (40.0, KILOMETRE[1]))
    poses = np.concatenate([true[:1000], compose(FAR, true[1000:])])
    covariance = np.diag([sigma**2, sigma**2, 0.04])
    revisit = return_to_beginning(sensor(true), poses, covariance, SETTINGS)
    assert (revisit is not None) is is_found
    if revisit is not None:
        np.testing.assert_allclose(revisit.local, relative(true[revisit.earlier], true[-1]), atol=1.0)


@pytest.mark.parametrize(("beyond", "is_found"), [(CLOSES_WITHIN - 10.0, True), (CLOSES_WITHIN + 6.0, False)])
def test_a_lap_closes_on_the_beginning_alone(beyond: float, is_found: bool) -> None:
    """Farther on, the right place may not be among those that are tried."""
    true = along(KILOMETRE, (beyond, KILOMETRE[1]))
    poses = true + np.linspace(0.0, 1.0, len(true))[:, None] * DRIFT
    revisit = return_to_beginning(sensor(true), poses, UNCERTAIN, SETTINGS)
    assert (revisit is not None) is is_found


def test_an_open_road_meets_no_cones_again() -> None:
    true = along((150.0, 0.01))
    assert return_to_beginning(sensor(true), true, UNCERTAIN, SETTINGS) is None


@pytest.mark.parametrize(("lane", "is_same"), [(0.0, True), (2.0, True), (3.2, False), (4.0, False)])
def test_another_road_beside_is_no_return(lane: float, is_same: bool) -> None:
    """The second pass is so far (m) to the left of the first, whose sensor has seen its cones as well."""
    first = along((40.0, 0.0))
    elsewhere, beside_it = np.array([80.0, 40.0, 0.0]), np.array([0.0, lane, 0.0])
    true = np.concatenate([first, along((6.0, 0.0)) + elsewhere, first[10:60] + beside_it])
    found = find_return(sensor(true), true, float(path_lengths(first)[-1]), SETTINGS)
    assert (found is not None) is is_same
    if found is not None:
        np.testing.assert_allclose(found[0].pose, true[-1], atol=0.1)
        assert found[1] == 59


def test_a_pose_before_the_newest_moves_with_it() -> None:
    true = along(LAP, (20.0, 1.0 / 12.0))
    laid = Place(true[-1], np.eye(3), SURE_ODDS)
    revisit = revisit_of(laid, true, 8, len(true) - 11)
    np.testing.assert_allclose(revisit.local, relative(true[8], true[-11]), atol=1e-9)
    assert (revisit.earlier, revisit.later) == (8, len(true) - 11)


def test_the_information_moves_with_the_pose() -> None:
    """The covariance in the frame of the earlier pose is that of samples, for an error of 1 cm and 1 mrad."""
    rng = np.random.default_rng(0)
    frame, later, newest = np.array([[4.0, 1.0, 0.7], [1.0, -1.0, 1.7], [7.0, -3.0, 2.1]])
    spread = rng.normal(size=(3, 3)) * np.array([[1e-2], [1e-2], [1e-3]])
    covariance = spread @ spread.T
    place = Place(newest, np.linalg.inv(covariance), SURE_ODDS)
    revisit = revisit_of(place, np.array([frame, later, newest]), 0, 1)
    np.testing.assert_allclose(revisit.local, relative(frame, later))
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20_000)
    moved = np.array([relative(frame, compose(newest + off, relative(newest, later))) for off in samples])
    found = np.linalg.inv(revisit.root.T @ revisit.root)
    expected = np.cov(moved.T)
    size = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), atol=0.04)
