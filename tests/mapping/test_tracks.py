"""Tracks: merged by weight, counted, confirmed, forgotten; every answer by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import rotation
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping import tracks as tracks_module
from pathspace_graph.mapping.tracks import Tracks, linked

from ..scenes.digest import digest
from ..shared.copied import copied

Array = NDArray[np.float64]

MEMORY = 6.0


def add(found: Tracks, points: Array, covariances: Array, t: float, label: int = LEFT) -> list[int]:
    return found.add(points, covariances, np.full(len(points), label), t).tolist()


def tracked(*detections: tuple[float, float, float, float]) -> Tracks:
    """Tracks after detections (x, y, variance, t), one at a time; the variance is the trace."""
    found = Tracks(1.0, MEMORY)
    for x, y, variance, t in detections:
        add(found, np.array([[x, y]]), round_covariances(variance), t)
    return found


def round_covariances(*variances: float) -> Array:
    """Returns covariances (m, 2, 2) that are alike in all directions, of these traces."""
    return 0.5 * np.array(variances)[:, None, None] * np.eye(2)


def test_a_merged_sighting_is_the_weighted_mean() -> None:
    """Weights 1 and 2: a third of the way is left to the first."""
    found = tracked((0.0, 0.0, 1.0, 0.0), (0.3, -0.6, 0.5, 0.1))
    np.testing.assert_allclose(found.points, [[0.2, -0.4]], atol=1e-15)
    np.testing.assert_allclose(found.information, [6.0 * np.eye(2)])
    assert found.counts.tolist() == [2]
    assert found.last_t.tolist() == [0.1]


def test_two_readings_of_one_cycle_merge_one_after_the_other() -> None:
    found = tracked((0.0, 0.0, 1.0, 0.0))
    add(found, np.array([[0.6, 0.0], [0.0, 0.3]]), round_covariances(1.0, 1.0), 0.1)
    np.testing.assert_allclose(found.points, [[0.2, 0.1]], atol=1e-15)
    assert found.counts.tolist() == [3]


@pytest.mark.parametrize(("distance", "count"), [(0.99, 1), (1.01, 2)])
def test_of_what_is_known_well_only_what_is_near_merges(distance: float, count: int) -> None:
    """Each is known to 0.22 m, so 1.01 m are more than three sigmas of both together."""
    assert len(tracked((0.0, 0.0, 0.1, 0.0), (distance, 0.0, 0.1, 0.1)).points) == count


def test_a_reading_goes_to_the_nearest() -> None:
    found = tracked((0.0, 0.0, 0.1, 0.0), (1.5, 0.0, 0.1, 0.0), (0.9, 0.0, 0.1, 0.1))
    np.testing.assert_allclose(found.points, [[0.0, 0.0], [1.2, 0.0]], atol=1e-15)
    assert found.counts.tolist() == [1, 2]


def test_confirmed_when_seen_three_times() -> None:
    twice = [(0.0, 0.0, 1.0, 0.1 * k) for k in range(2)]
    assert tracked(*twice).confirmed(LEFT, 3).tolist() == []
    found = tracked((9.0, 0.0, 1.0, 0.0), *twice, (0.1, 0.0, 1.0, 0.2))
    assert found.confirmed(LEFT, 3).tolist() == [1]


@pytest.mark.parametrize(("t", "left"), [(5.9, 2), (6.1, 1), (6.3, 0)])
def test_what_is_not_seen_again_is_forgotten(t: float, left: int) -> None:
    """Also in a cycle in which nothing is seen."""
    found = tracked((0.0, 0.0, 1.0, 0.0), (5.0, 0.0, 1.0, 0.2))
    add(found, np.zeros((0, 2)), np.zeros((0, 2, 2)), t)
    assert len(found.points) == len(found.information) == len(found.counts) == len(found.last_t) == left


def test_seeing_it_again_keeps_it() -> None:
    found = tracked((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 1.0, 5.0), (9.0, 0.0, 1.0, 10.0))
    assert found.counts.tolist() == [2, 1]


def test_remove_and_clear() -> None:
    found = tracked(*((3.0 * k, 0.0, 1.0, 0.1 * k) for k in range(3)))
    found.remove(np.array([1]))
    np.testing.assert_array_equal(found.points[:, 0], [0.0, 6.0])
    np.testing.assert_array_equal(found.last_t, [0.0, 0.2])
    found.clear()
    assert found.points.shape == (0, 2)
    assert found.confirmed(LEFT, 3).tolist() == []


def test_a_rigid_motion_moves_every_track() -> None:
    """A half turn and a shift; what is alike in all directions and the counts stay."""
    found = tracked((1.0, 0.0, 1.0, 0.0), (4.0, 2.0, 0.5, 0.0))
    found.move(np.array([1.0, 1.0, np.pi]))
    np.testing.assert_allclose(found.points, [[0.0, 1.0], [-3.0, -1.0]], atol=1e-12)
    np.testing.assert_allclose(found.information, [2.0 * np.eye(2), 4.0 * np.eye(2)], atol=1e-12)
    assert found.counts.tolist() == [1, 1]


def test_of_too_many_tracks_those_stay_that_were_seen_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tracks_module, "MAX_TRACKS", 3)
    found = Tracks(1.0, MEMORY)
    for k, t in enumerate([0.4, 0.1, 0.3, 0.2, 0.5]):
        add(found, np.array([[3.0 * k, 0.0]]), round_covariances(1.0), t)
    assert found.points[:, 0].tolist() == [0.0, 6.0, 12.0]
    assert found.last_t.tolist() == [0.4, 0.3, 0.5]
    endless = Tracks(1.0, np.inf)
    add(endless, np.array([[3.0 * k, 0.0] for k in range(5)]), round_covariances(*np.ones(5)), 0.0)
    assert endless.numbers.tolist() == [0, 1, 2, 3, 4]


def test_a_late_detection_makes_no_track_older() -> None:
    found = tracked((0.0, 0.0, 1.0, 2.0), (0.0, 0.0, 1.0, 1.5))
    assert found.last_t.tolist() == [2.0]
    assert found.counts.tolist() == [2]


# --- covariances -----------------------------------------------------------------------------------------


def along(theta: float, long: float, wide: float) -> Array:
    """Returns a covariance (1, 2, 2) with these standard deviations along a direction and across it."""
    turn = rotation(theta)
    return np.asarray((turn @ np.diag([long**2, wide**2]) @ turn.T)[None])


def test_sightings_of_one_cone_that_are_smeared_along_their_rays_are_one_track() -> None:
    """From 25 m away the range errs by 0.8 m: 1.7 m are more than the radius, but within 2.5 sigmas."""
    ray = np.array([np.cos(0.3), np.sin(0.3)])
    found = Tracks(1.0, MEMORY)
    for t, off in enumerate((0.0, 1.7, -0.6, 1.2)):
        add(found, ((25.0 + off) * ray)[None], along(0.3, 0.8, 0.1), 0.1 * t)
    assert found.counts.tolist() == [4]
    across = Tracks(1.0, MEMORY)
    side = np.array([-ray[1], ray[0]])
    for t, off in enumerate((0.0, 1.7)):
        add(across, (25.0 * ray + off * side)[None], along(0.3, 0.8, 0.1), 0.1 * t)
    assert across.counts.tolist() == [1, 1]


@pytest.mark.parametrize(("distance", "count"), [(1.99, 1), (2.01, 2)])
def test_however_uncertain_what_is_farther_than_two_radii_is_another_cone(
    distance: float, count: int
) -> None:
    found = Tracks(1.0, MEMORY)
    for x in (0.0, distance):
        add(found, np.array([[x, 0.0]]), along(0.0, 3.0, 3.0), 0.0)
    assert len(found.points) == count


def test_cones_of_a_row_two_and_a_half_metres_apart_stay_apart() -> None:
    """Each is seen 30 times with 0.3 m of noise, as both are passed."""
    rng, found = np.random.default_rng(0), Tracks(1.0, MEMORY)
    cones = np.array([[0.0, 0.0], [2.5, 0.0], [5.0, 0.0]])
    for k in range(30):
        add(found, cones + 0.3 * rng.normal(size=(3, 2)), np.repeat(along(0.0, 0.3, 0.3), 3, axis=0), 0.1 * k)
    assert found.counts.tolist() == [30, 30, 30]
    np.testing.assert_allclose(found.points, cones, atol=4 * 0.3 / np.sqrt(30))


def test_a_detection_goes_to_the_track_that_explains_it_best_in_sigmas() -> None:
    """It lies 1.4 m before one track along its own ray, and 1.2 m beside another one, across it."""
    found = Tracks(1.0, MEMORY)
    add(found, np.array([[1.4, 0.0], [0.0, 1.2]]), np.repeat(along(0.0, 0.1, 0.1), 2, axis=0), 0.0)
    add(found, np.zeros((1, 2)), along(0.0, 0.8, 0.1), 0.1)
    assert found.counts.tolist() == [2, 1]


def test_the_place_of_a_track_is_the_least_squares_of_its_detections() -> None:
    """Covariances differ in direction; half the trace and the worst direction are those of its own."""
    rng, found = np.random.default_rng(1), Tracks(1.0, MEMORY)
    points = 0.2 * rng.normal(size=(6, 2))
    covariances = [along(float(a), 0.5, 0.1)[0] for a in rng.uniform(0.0, np.pi, 6)]
    for t, (point, covariance) in enumerate(zip(points, covariances, strict=True)):
        add(found, point[None], covariance[None], 0.1 * t)
    information = [np.linalg.inv(covariance) for covariance in covariances]
    joint = np.linalg.inv(np.sum(information, axis=0))
    mean = joint @ sum(i @ p for i, p in zip(information, points, strict=True))
    np.testing.assert_allclose(found.points, [mean], atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(found.information[0]), joint, atol=1e-12)
    assert found.variances(np.array([0]))[0] == pytest.approx(0.5 * np.trace(joint))
    assert found.sigmas(np.array([0]))[0] == pytest.approx(np.sqrt(np.linalg.eigvalsh(joint)[1]))


def test_a_rigid_motion_turns_what_is_known_of_a_track() -> None:
    found = Tracks(1.0, MEMORY)
    add(found, np.array([[2.0, 1.0]]), along(0.4, 0.5, 0.1), 0.0)
    found.move(np.array([1.0, -1.0, 0.9]))
    np.testing.assert_allclose(found.points[0], rotation(0.9) @ [2.0, 1.0] + [1.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(found.information), along(1.3, 0.5, 0.1), atol=1e-12)


def test_a_cone_that_is_taken_back_from_a_curve_is_confirmed_and_rather_certain() -> None:
    found = tracked((1.0, 2.0, 1.0, 0.0))
    found.restore(np.array([[1.0, 2.0], [4.0, 2.0]]), LEFT, 3, 3.0)
    assert found.confirmed(LEFT, 3).tolist() == [1, 2] and found.numbers.tolist() == [0, 1, 2]
    np.testing.assert_allclose(found.sigmas(np.array([1, 2])), 0.3)
    assert found.last_t.tolist() == [0.0, 3.0, 3.0]
    assert add(found, np.array([[9.0, 2.0]]), round_covariances(1.0), 3.1) == [3]


def test_a_copy_of_tracks_stays_as_it_is() -> None:
    found = tracked((0.0, 0.0, 1.0, 0.0), (5.0, 0.0, 1.0, 0.2))
    copy, expected = found.copy(), copied(found)
    add(found, np.array([[0.1, 0.0], [9.0, 0.0]]), round_covariances(1.0, 1.0), 0.3)
    found.move(np.array([1.0, 0.0, 0.1]))
    found.remove(np.array([0]))
    assert digest(copy) == digest(expected) != digest(found)


# --- labels, stamps and numbers --------------------------------------------------------------------------


def test_a_track_has_detections_of_one_label_unless_labels_are_only_votes() -> None:
    places, t = np.zeros((3, 2)), np.arange(3.0)
    labels, covariances = np.array([LEFT, RIGHT, LEFT]), round_covariances(1.0, 1.0, 1.0)
    apart, together = Tracks(1.0, MEMORY), Tracks(1.0, MEMORY, by_label=False)
    assert apart.add(places, covariances, labels, t).tolist() == [0, 1, 0]
    assert together.add(places, covariances, labels, t).tolist() == [0, 0, 0]
    assert apart.votes[:, [LEFT, RIGHT, UNKNOWN]].tolist() == [[2, 0, 0], [0, 1, 0]]
    assert together.votes[:, [LEFT, RIGHT, UNKNOWN]].tolist() == [[2, 1, 0]]
    assert apart.confirmed(LEFT, 2).tolist() == [0] and apart.confirmed(RIGHT, 1).tolist() == [1]


def test_detections_of_a_stamp_that_are_of_no_track_begin_one_each() -> None:
    found, both = Tracks(1.0, MEMORY), np.array([[0.0, 0.0], [0.3, 0.0]])
    assert add(found, both, round_covariances(1.0, 1.0), 0.0) == [0, 1]
    assert add(found, both, round_covariances(1.0, 1.0), 0.1) == [0, 1]


def test_detections_of_several_stamps_are_added_as_one_stamp_after_the_other() -> None:
    """A cone that is out of sight for longer than the memory is another one, which has another number."""
    rng = np.random.default_rng(2)
    t = np.repeat([0.0, 0.1, 0.2, 7.0, 7.1], 3)
    points = np.tile([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]], (5, 1)) + 0.1 * rng.normal(size=(15, 2))
    covariances, labels = np.repeat(along(0.3, 0.2, 0.1), 15, axis=0), np.full(15, RIGHT)
    whole, parts = Tracks(1.0, MEMORY), Tracks(1.0, MEMORY)
    numbers = whole.add(points, covariances, labels, t)
    each = [parts.add(points[t == one], covariances[t == one], labels[t == one], one) for one in np.unique(t)]
    assert numbers.tolist() == np.concatenate(each).tolist() == [0, 1, 2] * 3 + [3, 4, 5] * 2
    assert digest(whole) == digest(parts)
    assert whole.numbers.tolist() == [3, 4, 5] and whole.counts.tolist() == [2, 2, 2]


def test_a_number_is_never_given_again() -> None:
    found = tracked((0.0, 0.0, 1.0, 0.0), (5.0, 0.0, 1.0, 0.0))
    found.clear()
    assert add(found, np.array([[9.1, 0.0], [0.0, 0.0]]), round_covariances(1.0, 1.0), 0.2) == [2, 3]


@pytest.mark.parametrize(("others", "expected"), [(2, True), (3, True), (4, False)])
def test_the_label_that_is_detected_more_often_at_a_place_counts(others: int, expected: bool) -> None:
    """Three detections, and others of the other boundary half a metre away; the unknown ones have no vote."""
    found = Tracks(1.0, MEMORY)
    for label, x, count in ((LEFT, 0.0, 3), (RIGHT, 0.5, others), (UNKNOWN, 0.1, 9), (RIGHT, -1.1, 9)):
        for k in range(count):
            add(found, np.array([[x, 0.0]]), along(0.0, 0.1, 0.1), 0.1 * k, label)
    assert found.undisputed(found.confirmed(LEFT, 3), LEFT).tolist() == [expected]


def test_points_are_linked_with_all_that_their_neighbours_are_linked_with() -> None:
    points = np.array([[0.0, 0.0], [30.0, 0.0], [9.0, 0.0], [18.0, 0.0], [35.0, 0.0]])
    assert sorted(row.tolist() for row in linked(points, 10.0)) == [[0, 2, 3], [1, 4]]
    assert linked(np.zeros((0, 2)), 10.0) == []
