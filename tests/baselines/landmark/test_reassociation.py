"""A round of the landmark batch: its predictions, its associations, and which landmarks it creates."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.baselines.landmark_graph import predicted_covariances, reassociate, remove_rare
from pathspace_graph.baselines.landmarks import UNASSOCIATED, LandmarkState, LandmarkSystem
from pathspace_graph.factors.residuals import landmark_residuals
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT

from .scenes import normal_equations_of, oracle_system


def assign_anew(system: LandmarkSystem, state: LandmarkState) -> None:
    reassociate(system, state, system.eliminated(state), system.settings)


@pytest.fixture
def optimum(bean: Log) -> tuple[LandmarkSystem, LandmarkState]:
    """Returns the first cycles of the log at the optimum of the oracle associations."""
    system, state = oracle_system(bean, 25)
    system.optimize(state)
    return system, state


def test_its_covariances_are_those_of_the_whole_inverse(
    optimum: tuple[LandmarkSystem, LandmarkState],
) -> None:
    system, state = optimum
    whole = np.linalg.inv(normal_equations_of(system, state)[0])
    cycles, landmarks = np.array([3, 20, 24]), np.array([0, 5, 2])
    r = landmark_residuals(state.variables.poses[cycles], state.landmarks[landmarks], np.zeros((3, 2)))
    jacobian, keys = np.concatenate([r.by_pose, r.by_landmark], axis=2), state.keys[landmarks]
    found = predicted_covariances(system.eliminated(state), cycles, keys, jacobian)
    for k, h in enumerate(jacobian):
        entries = state.variables.layout.entries(np.array([pose_key(cycles[k]), keys[k]]))
        np.testing.assert_allclose(found[k], h @ whole[np.ix_(entries, entries)] @ h.T, rtol=1e-6)


def test_lost_associations_are_found_again(optimum: tuple[LandmarkSystem, LandmarkState]) -> None:
    system, state = optimum
    detections, expected = system.detections, system.detections.landmark.copy()
    lost = np.flatnonzero(detections.used)[::7]
    detections.landmark[lost] = UNASSOCIATED
    count = len(state)
    assign_anew(system, state)
    assert len(state) == count
    found = detections.landmark[lost]
    assert (found == expected[lost]).mean() > 0.9
    assert np.isin(found, [UNASSOCIATED, *expected]).all()


def test_a_landmark_that_was_lost_is_created_again(optimum: tuple[LandmarkSystem, LandmarkState]) -> None:
    """Each confirmed track gives one; the next round merges those of one cone."""
    system, state = optimum
    detections = system.detections
    numbers, counts = np.unique(detections.landmark[detections.used], return_counts=True)
    gone = numbers[counts.argmax()]
    position = state.positions(np.array([gone]))
    place, label = state.landmarks[position[0]].copy(), state.labels[position[0]]
    rows = np.flatnonzero(detections.landmark == gone)
    detections.landmark[rows] = UNASSOCIATED
    remove_rare(state, detections, 1)
    count = len(state)
    assign_anew(system, state)
    assert len(state) > count
    assert (state.labels[count:] == label).all()
    assert np.hypot(*(state.landmarks[count:] - place).T).max() < 0.5
    assert np.isin(detections.landmark[rows], state.numbers[count:]).all()


def test_detections_beside_a_landmark_that_would_be_merged_create_none(
    optimum: tuple[LandmarkSystem, LandmarkState],
) -> None:
    """0.8 m is outside its gates near the vehicle, and within the merge radius."""
    system, state = optimum
    detections, count = system.detections, len(state)
    near = np.flatnonzero(detections.used & (np.hypot(*detections.point.T) < 7.0))
    numbers, counts = np.unique(detections.landmark[near], return_counts=True)
    rows = near[detections.landmark[near] == numbers[counts.argmax()]][::2]
    assert len(rows) >= system.settings.growth.sightings
    detections.landmark[rows] = UNASSOCIATED
    detections.measured[rows] += [0.8, 0.0]
    assign_anew(system, state)
    assert not detections.used[rows].any()
    assert len(state) == count


def test_landmarks_take_the_label_of_most_detections_in_their_gate(
    optimum: tuple[LandmarkSystem, LandmarkState],
) -> None:
    system, state = optimum
    labels = state.labels.copy()
    state.labels = np.full(len(labels), LEFT)
    state.vote(np.full(99, LEFT), np.full(99, state.numbers[0]))  # earlier votes do not count
    assign_anew(system, state)
    np.testing.assert_array_equal(state.labels[: len(labels)], labels)
    assert (labels == RIGHT).any() and state.votes.max() < 99


def test_rare_landmarks_are_removed_and_the_others_keep_their_detections(bean: Log) -> None:
    system, state = oracle_system(bean, 60)
    detections = system.detections
    numbers, counts = np.unique(detections.landmark[detections.used], return_counts=True)
    fewest = int(np.sort(counts)[len(counts) // 3]) + 1
    before, points = detections.landmark.copy(), state.landmarks.copy()
    remove_rare(state, detections, fewest)
    np.testing.assert_array_equal(state.numbers, numbers[counts >= fewest])
    np.testing.assert_array_equal(state.landmarks, points[counts >= fewest])
    kept = np.isin(before, state.numbers)
    np.testing.assert_array_equal(detections.landmark[kept], before[kept])
    assert (detections.landmark[~kept] == UNASSOCIATED).all()
