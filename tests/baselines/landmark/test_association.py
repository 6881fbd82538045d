"""Gates and assignment on costs whose best assignment is known, and the prediction against dense algebra."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from pathspace_graph.baselines.landmarks import (
    AMBIGUOUS,
    CREATE_GATE,
    MATCH_GATE,
    UNASSOCIATED,
    assign,
    associate_created,
    associate_newest,
    compatible,
    hysteresis_costs,
    pair_costs,
    predicted_points,
    squared_mahalanobis,
)
from pathspace_graph.factors.residuals import landmark_residuals
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.settings.mapper import GrowthSettings

from ...scenes.drives import detections
from .scenes import SPEED, drive_on, driven, with_covariance

Array = NDArray[np.float64]


def test_gates_are_those_of_two_degrees_of_freedom() -> None:
    """`P(d^2 < x) = 1 - exp(-x / 2)`."""
    assert pytest.approx(-2.0 * np.log(0.05)) == MATCH_GATE
    assert pytest.approx(-2.0 * np.log(0.01)) == CREATE_GATE


def test_a_detection_between_the_gates_is_neither_associated_nor_new() -> None:
    between = 0.5 * (MATCH_GATE + CREATE_GATE)
    landmark, is_new = assign(np.array([[between, 99.0], [99.0, 99.0], [99.0, 1.0]]))
    np.testing.assert_array_equal(landmark, [UNASSOCIATED, UNASSOCIATED, 1])
    np.testing.assert_array_equal(is_new, [False, True, False])


@pytest.mark.parametrize("shape", [(0, 0), (0, 3), (3, 0)])
def test_there_pairs_no_detections_or_no_landmarks(shape: tuple[int, int]) -> None:
    landmark, is_new = assign(np.zeros(shape))
    np.testing.assert_array_equal(landmark, np.full(shape[0], UNASSOCIATED))
    assert is_new.all()


@given(arrays(float, (3, 4), elements=st.floats(0.0, 20.0) | st.just(np.inf)))
def test_it_is_the_best_of_all_one_to_one_and_inside_the_gate(cost: Array) -> None:
    landmark, is_new = assign(cost)
    matched = np.flatnonzero(landmark != UNASSOCIATED)
    assert len(np.unique(landmark[matched])) == len(matched)
    assert (cost[matched, landmark[matched]] < MATCH_GATE).all()
    assert not is_new[matched].any()
    capped = np.minimum(cost, MATCH_GATE)
    best = min(capped[range(3), list(columns)].sum() for columns in permutations(range(4), 3))
    found = cost[matched, landmark[matched]].sum() + MATCH_GATE * (3 - len(matched))
    assert found == pytest.approx(best)


def test_an_unknown_label_is_compatible_with_both() -> None:
    pairs = compatible(np.array([LEFT, RIGHT, UNKNOWN]), np.array([LEFT, RIGHT]))
    np.testing.assert_array_equal(pairs, [[True, False], [False, True], [True, True]])


def test_a_held_pair_stays_as_long_as_it_passes_the_wide_gate() -> None:
    between = 0.5 * (MATCH_GATE + CREATE_GATE)
    cost = np.array([between, between, CREATE_GATE + 1.0, 1.0])
    held = np.array([True, False, True, True])
    kept = hysteresis_costs(cost, held)
    np.testing.assert_array_equal(kept < MATCH_GATE, [True, False, False, True])
    np.testing.assert_array_equal(kept[1:], cost[1:])


def test_distances_are_those_of_the_summed_covariance() -> None:
    rng = np.random.default_rng(0)
    points, predicted = rng.normal(0.0, 5.0, (3, 2)), rng.normal(0.0, 5.0, (4, 2))
    roots = rng.normal(0.0, 1.0, (7, 2, 2)) + 2.0 * np.eye(2)
    covariances = roots @ np.swapaxes(roots, 1, 2)
    found = pair_costs(points, covariances[:3], predicted, covariances[3:])
    for i in range(3):
        for j in range(4):
            r = predicted[j] - points[i]
            expected = r @ np.linalg.solve(covariances[i] + covariances[3 + j], r)
            assert found[i, j] == pytest.approx(expected)
    assert squared_mahalanobis(np.array([3.0, 4.0]), np.eye(2)) == pytest.approx(25.0)


def test_a_held_pair_is_kept_however_its_assignment_is_summed() -> None:
    """The pair is exactly at the edge of the gate, beside a detection without any landmark, in any order."""
    cost = np.array([[np.inf, np.inf], [7.0, np.inf]])
    for own, expected in (
        (cost, [UNASSOCIATED, 0]),
        (cost[::-1], [0, UNASSOCIATED]),
        (cost[:, ::-1], [UNASSOCIATED, 1]),
    ):
        held = np.isfinite(own)
        assert assign(hysteresis_costs(own, held))[0].tolist() == expected


# --- online ----------------------------------------------------------------------------------------------


def test_the_prediction_is_that_of_a_step_with_the_new_pose() -> None:
    """`H Sigma H'` through the odometry equals that of the whole system with the new pose."""
    smoother = driven(6, noise=0.0)
    drive_on(smoother, 6, (SPEED, 0.0, 0.3))
    landmarks, state = np.array([2, 0]), smoother.map.state
    predicted, covariances = predicted_points(smoother, landmarks)
    pose, points = smoother.variables.poses[-1].copy(), state.landmarks[landmarks]
    rows = landmark_residuals(np.tile(pose, (2, 1)), points, np.zeros((2, 2)))
    np.testing.assert_allclose(predicted, rows.residual)
    before = smoother.variables.values.copy()
    smoother.step()
    np.testing.assert_allclose(smoother.variables.values, before, atol=0.1)
    for k, landmark in enumerate(landmarks.tolist()):
        covariance = smoother.last_covariance(np.array([pose_key(6), state.keys[landmark]]))
        h = np.concatenate([rows.by_pose[k], rows.by_landmark[k]], axis=1)
        np.testing.assert_allclose(covariances[k], h @ covariance @ h.T, rtol=2e-3)


@pytest.mark.parametrize(
    ("offset", "label", "eligible", "expected"),
    [
        (0.30, LEFT, True, 0),
        (0.30, UNKNOWN, True, 0),
        (0.39, LEFT, True, AMBIGUOUS),
        (0.60, LEFT, True, UNASSOCIATED),
        (0.30, RIGHT, True, AMBIGUOUS),
        (0.39, RIGHT, True, UNASSOCIATED),
        (0.30, LEFT, False, UNASSOCIATED),
    ],
)
def test_a_detection_beside_a_landmark_by_its_distance_and_label(
    offset: float, label: int, eligible: bool, expected: int
) -> None:
    """With a covariance of 0.02 m^2, the gates are at 0.346 m and 0.429 m."""
    smoother = with_covariance(np.array([[6.0, 2.0]]), np.array([LEFT]), 0.01 * np.eye(2))
    new = smoother.map.detections.append(
        detections(0.0, np.array([[6.0 + offset, 2.0]]), np.array([label])), 0
    )
    associate_newest(smoother, new, np.array([eligible]))
    assert smoother.map.detections.landmark.tolist() == [expected]
    explained = eligible and offset < 0.346 and label != UNKNOWN
    assert smoother.map.state.votes.sum() == explained


def test_each_cycle_gives_a_new_landmark_its_nearest_detection() -> None:
    landmarks = np.array([[0.0, 0.0], [5.0, 0.0]])
    points = np.array([[0.3, 0.0], [0.1, 0.0], [0.2, 0.0], [4.9, 0.0], [2.5, 0.0]])
    cycles = np.array([0, 0, 1, 1, 1])
    rows, landmark = associate_created(points, cycles, landmarks, GrowthSettings(merge_radius=1.0))
    order = np.argsort(rows)
    np.testing.assert_array_equal(rows[order], [1, 2, 3])
    np.testing.assert_array_equal(landmark[order], [0, 0, 1])


@pytest.mark.parametrize(("points", "landmarks"), [(0, 2), (2, 0)])
def test_there_may_be_no_new_landmarks(points: int, landmarks: int) -> None:
    found = associate_created(
        np.zeros((points, 2)), np.zeros(points, np.intp), np.zeros((landmarks, 2)), GrowthSettings()
    )
    assert [len(column) for column in found] == [0, 0]
