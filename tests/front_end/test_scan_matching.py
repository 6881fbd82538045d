"""Scan matching: the pose that lays the detections of a cycle on those of the cycles before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors.se2 import to_map, to_vehicle
from pathspace_graph.front_end import scan_matching
from pathspace_graph.front_end.scan_matching import (
    MOST_MISFIT,
    REACH_LAST,
    REACHES,
    SCAN_MEMORY,
    SIGMA_CONE,
    Match,
    ScanMatcher,
    Seen,
)
from pathspace_graph.settings.mapper import MotionSettings

from ..scenes.drives import detections
from ..scenes.jacobians import numeric_jacobian

CONES = np.array([[2.0, 2.0], [6.0, 2.2], [10.0, 2.0], [2.5, -1.9], [7.0, -2.0], [11.0, -2.1]])


def remember(matcher: ScanMatcher, t: float, points: np.ndarray) -> None:
    """Adds detections from the origin."""
    matcher.remember(detections(t, points, np.zeros(len(points), np.intp)), np.zeros(3), np.zeros(3))


def seen_once(cones: np.ndarray = CONES) -> ScanMatcher:
    """The cones as they were detected once, without noise, from the origin."""
    matcher = ScanMatcher(MotionSettings())
    remember(matcher, 0.0, cones)
    return matcher


def match(matcher: ScanMatcher, points: np.ndarray, variances: np.ndarray, *start: Any) -> Match:
    found = matcher.match(Seen(points, variances), *start)
    assert found is not None
    return found


def detected(pose: np.ndarray, cones: np.ndarray = CONES) -> np.ndarray:
    return to_vehicle(cones, np.tile(pose, (len(cones), 1)))


@given(x=st.floats(0.0, 1.2), y=st.floats(-0.3, 0.3), theta=st.floats(-0.05, 0.05))
def test_exact_detections_give_the_exact_motion(x: float, y: float, theta: float) -> None:
    pose = np.array([x, y, theta])
    start = np.array([x - 0.4, 0.0, 0.0])
    found = match(seen_once(), detected(pose), np.full(6, 0.01), start, REACHES)
    np.testing.assert_allclose(found.pose, pose, atol=1e-3)
    assert found.matched == 6


# the information, where no coordinate, heading, weight or variance is a special one
POSE = np.array([3.0, -2.0, 0.7])
ASYMMETRIC = np.array([[8.0, 1.0], [4.0, 5.5], [12.0, 9.0], [5.0, -4.0], [2.5, 1.0]])
VARIANCES = np.array([0.01, 0.04, 0.02, 0.09, 0.03])


@pytest.mark.parametrize("n", [1, 3])
def test_the_information_is_that_of_one_detection_and_the_mean_of_n(n: int) -> None:
    """Each offset has the variance `v (1 + 1/n) + sigma_cone^2`; its derivatives are numeric ones."""
    seen = detected(POSE, ASYMMETRIC)
    recent = seen_once(np.tile(ASYMMETRIC, (n, 1)))
    found = match(recent, seen, VARIANCES, POSE, REACHES[:1])
    jacobian = numeric_jacobian(lambda pose: to_map(seen, np.tile(pose, (len(seen), 1))).ravel(), POSE)
    precision = np.repeat(1.0 / (VARIANCES * (1.0 + 1.0 / n) + SIGMA_CONE**2), 2)
    expected = jacobian.T @ (precision[:, None] * jacobian)
    assert np.abs(expected[2, :2]).min() > 100.0  # x and y are told together with the heading
    np.testing.assert_allclose(found.information, expected, rtol=1e-6, atol=1e-6)
    assert found.misfit == pytest.approx(0.0, abs=1e-12)


def test_the_covariance_is_that_of_many_noisy_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors that are whitened by the claimed covariance have the covariance 1, cross terms included."""
    rng, sigma, n = np.random.default_rng(0), 0.02, 3
    monkeypatch.setattr(scan_matching, "SIGMA_CONE", 1e-6)
    monkeypatch.setattr(scan_matching, "SCAN_HUBER", np.inf)
    seen, errors = detected(POSE, ASYMMETRIC), []
    for _ in range(400):
        recent = ScanMatcher(MotionSettings())
        for k in range(n):
            remember(recent, 0.1 * k, ASYMMETRIC + sigma * rng.standard_normal(ASYMMETRIC.shape))
        points = seen + sigma * rng.standard_normal(seen.shape)
        found = match(recent, points, np.full(len(seen), sigma**2), POSE, [0.4] * 2)
        errors.append(np.linalg.cholesky(found.information).T @ (found.pose - POSE))
    np.testing.assert_allclose(np.cov(np.array(errors).T), np.eye(3), atol=0.2)


@pytest.mark.parametrize("n", [1, 3])
def test_the_misfit_at_a_pose_is_the_mean_square_of_the_whitened_distances(n: int) -> None:
    """One detection is 0.2 m off, one counts as much as is allowed, and one is of nothing."""
    seen = detected(POSE, ASYMMETRIC[:4])
    recent = seen_once(np.tile(ASYMMETRIC[:3], (n, 1)))
    variances = np.array([0.04, 0.02, 1e-6, 0.01])
    off = np.array([[0.0, 0.2], [0.0, 0.0], [0.0, 0.2], [0.0, 0.0]])
    weight = n * np.exp(-0.5 * (0.2 / REACH_LAST) ** 2)
    square = 0.2**2 / (0.04 * (1.0 + 1.0 / weight) + SIGMA_CONE**2)
    found = recent.misfit(Seen(seen + off, variances), POSE)
    assert found == pytest.approx((square + 0.0 + 2.0 * MOST_MISFIT) / 4.0)


def test_a_detection_of_nothing_has_no_say() -> None:
    points = np.vstack([detected(np.array([0.5, 0.0, 0.0])), [[4.0, 0.0]]])
    found = match(seen_once(), points, np.full(7, 0.01), np.array([0.3, 0.0, 0.0]), REACHES)
    assert found.matched == 6
    np.testing.assert_allclose(found.pose, [0.5, 0.0, 0.0], atol=1e-3)


def test_detections_of_one_cone_alone_hold_no_motion_however_many_they_are() -> None:
    """All offsets have the same arm, so that the information is singular."""
    points = np.tile(CONES[:1], (5, 1))
    one, seen = seen_once(CONES[:1]), Seen(points, np.full(5, 0.01))
    assert one.has(seen, np.zeros(3)).all()
    assert one.match(seen, np.zeros(3), REACHES) is None


def test_old_detections_are_forgotten() -> None:
    recent = seen_once()
    remember(recent, 0.1, CONES[:2])
    recent.corrected(detections(SCAN_MEMORY + 0.01, CONES, np.zeros(6, np.intp)), np.zeros(3))
    np.testing.assert_array_equal(recent.points, CONES[:2])


def test_remembered_detections_follow_what_is_learned_of_the_sensor() -> None:
    """A detection at (4, 0) from (1, 2), which looks to the left, moves by its derivative, turned as well."""
    recent, one = ScanMatcher(MotionSettings()), detections(0.0, np.array([[4.0, 0.0]]), np.zeros(1, np.intp))
    twist, pose = np.array([3.0, 0.0, 0.0]), np.array([1.0, 2.0, np.pi / 2])
    recent.remember(one, twist, pose)
    np.testing.assert_allclose(recent.points, [[1.0, 6.0]], atol=1e-12)
    recent.errors.mean = np.array([0.01, 0.1])
    seen = recent.corrected(one, twist)
    np.testing.assert_allclose(recent.points, [[1.0 - 0.04, 6.0 - 0.3]], atol=1e-12)
    np.testing.assert_allclose(to_map(seen.points, pose[None]), recent.points, atol=1e-12)


def test_a_detection_is_seen_again_where_one_was() -> None:
    points = np.array([[2.1, 2.0], [4.0, 0.0]])
    seen = seen_once().has(Seen(points, np.full(2, 0.01)), np.zeros(3))
    np.testing.assert_array_equal(seen, [True, False])
