"""Scan matching: the pose that lays the detections of a cycle on those of the cycles before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.front_end import scan_matching
from pathspace_graph.front_end.scan_matching import (
    ERRORS,
    MEMORY,
    REACH,
    REACH_LAST,
    REACHES_CHECK,
    SIGMA_CONE,
    RecentDetections,
    match,
    reaches,
)

CONES = np.array([[2.0, 2.0], [6.0, 2.2], [10.0, 2.0], [2.5, -1.9], [7.0, -2.0], [11.0, -2.1]])


def remember(recent: RecentDetections, t: float, points: np.ndarray) -> None:
    """Adds detections from the origin, by a sensor without errors."""
    recent.add(t, points, np.zeros((len(points), 2, len(ERRORS))), np.zeros(3))


def seen_once(cones: np.ndarray = CONES) -> RecentDetections:
    """The cones as they were detected once, without noise, from the origin."""
    recent = RecentDetections()
    remember(recent, 0.0, cones)
    return recent


def detected(pose: np.ndarray, cones: np.ndarray = CONES) -> np.ndarray:
    return to_vehicle(cones, np.tile(pose, (len(cones), 1)))


@given(x=st.floats(0.0, 1.2), y=st.floats(-0.3, 0.3), theta=st.floats(-0.05, 0.05))
def test_exact_detections_give_the_exact_motion(x: float, y: float, theta: float) -> None:
    pose = np.array([x, y, theta])
    start = np.array([x - 0.4, 0.0, 0.0])
    found = match(seen_once(), detected(pose), np.full(6, 0.01), start, reaches(8))
    np.testing.assert_allclose(found.pose, pose, atol=1e-3)
    assert found.matched == 6
    assert found.is_certain


def test_the_information_is_that_of_two_detections_of_every_cone() -> None:
    """Each offset has the variance of two detections and of the cone: `2 * 0.01 + SIGMA_CONE^2`."""
    found = match(seen_once(), CONES, np.full(6, 0.01), np.zeros(3), reaches(1))
    precision = 1.0 / (2 * 0.01 + SIGMA_CONE**2)
    assert found.information[0, 0] == pytest.approx(6 * precision)
    assert found.information[2, 2] == pytest.approx(precision * (CONES**2).sum())
    assert found.information[1, 2] == pytest.approx(precision * CONES[:, 0].sum())
    assert found.misfit == pytest.approx(0.0, abs=1e-12)


def test_the_covariance_is_that_of_many_noisy_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, sigma = np.random.default_rng(0), 0.1
    monkeypatch.setattr(scan_matching, "SIGMA_CONE", 1e-6)
    monkeypatch.setattr(scan_matching, "HUBER", np.inf)
    errors = []
    for _ in range(400):
        recent = RecentDetections()
        remember(recent, 0.0, CONES + sigma * rng.standard_normal(CONES.shape))
        points = CONES + sigma * rng.standard_normal(CONES.shape)
        found = match(recent, points, np.full(6, sigma**2), np.zeros(3), reaches(4))
        errors.append(found.pose)
    covariance = np.linalg.inv(found.information)
    np.testing.assert_allclose(
        np.cov(np.array(errors).T), covariance, atol=0.15 * covariance.max(), rtol=0.25
    )


def test_a_detection_of_nothing_has_no_say() -> None:
    points = np.vstack([detected(np.array([0.5, 0.0, 0.0])), [[4.0, 0.0]]])
    found = match(seen_once(), points, np.full(7, 0.01), np.array([0.3, 0.0, 0.0]), reaches(6))
    assert found.matched == 6
    np.testing.assert_allclose(found.pose, [0.5, 0.0, 0.0], atol=1e-3)


def test_one_cone_holds_no_motion() -> None:
    found = match(seen_once(CONES[:1]), CONES[:1], np.full(1, 0.01), np.zeros(3), reaches(3))
    assert found.matched == 1
    assert not found.is_certain


def test_detections_of_one_cone_alone_hold_no_motion_however_many_they_are() -> None:
    """All offsets have the same arm, so that the information is singular."""
    points = np.tile(CONES[:1], (5, 1))
    found = match(seen_once(CONES[:1]), points, np.full(5, 0.01), np.zeros(3), reaches(6))
    assert found.matched == 5
    assert np.isfinite(found.pose).all()
    assert not found.is_certain


def test_old_detections_are_forgotten() -> None:
    recent = seen_once()
    remember(recent, 0.1, CONES[:2])
    recent.forget(MEMORY + 0.01)
    np.testing.assert_array_equal(recent.points, CONES[:2])


def test_remembered_detections_follow_what_is_learned_of_the_sensor() -> None:
    """A detection at (4, 0) from (1, 2), which looks to the left, moves by its derivative, turned as well."""
    recent = RecentDetections()
    columns = np.array([[[0.0, -3.0], [4.0, 0.0]]])  # a turned sensor moves it to the left
    recent.add(0.0, np.array([[4.0, 0.0]]), columns, np.array([1.0, 2.0, np.pi / 2]))
    np.testing.assert_allclose(recent.points, [[1.0, 6.0]], atol=1e-12)
    np.testing.assert_allclose(recent.seen_from, [1.0, 2.0])
    recent.correct(np.array([0.01, 0.1]))
    np.testing.assert_allclose(recent.points, [[1.0 - 0.04, 6.0 - 0.3]], atol=1e-12)


def test_a_detection_is_seen_again_where_one_was() -> None:
    seen = seen_once().has(np.array([[2.1, 2.0], [4.0, 0.0]]))
    np.testing.assert_array_equal(seen, [True, False])


def test_the_reaches_shrink_from_the_first_to_the_last() -> None:
    np.testing.assert_allclose(reaches(3), [1.0, np.sqrt(0.4), 0.4])
    assert REACHES_CHECK == (REACH, REACH_LAST)
