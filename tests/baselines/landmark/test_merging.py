"""Two landmarks of one cone are found by their joint covariance, and merging them is an exact constraint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.baselines.landmark_graph import remove_rare
from pathspace_graph.baselines.landmarks import LandmarkState, find_duplicates, merge
from pathspace_graph.graph.gaussian import normal_equations
from pathspace_graph.graph.variables import Layout
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings

from .scenes import QUADRATIC, driven, oracle_system


def duplicates(points: list[float], labels: list[int], joint: np.ndarray, known: int) -> list[list[int]]:
    """Newer and older landmarks of one cone, of landmarks along x."""
    state = LandmarkState()
    state.add(np.column_stack([points, np.zeros(len(points))]), np.array(labels))
    entries, wide = Layout(state.keys).entries, np.asarray(np.kron(joint, np.eye(2)), np.float64)
    found = find_duplicates(
        state, known, lambda keys: wide[np.ix_(entries(keys), entries(keys))], MapperSettings()
    )
    return [column.tolist() for column in found]


def test_pairs_are_near_have_one_label_and_the_newer_landmark_comes_first() -> None:
    labels = [LEFT, RIGHT, LEFT, LEFT]
    assert duplicates([0.0, 0.5, 0.2, 9.0], labels, np.eye(4), 4) == [[2], [0]]


def test_a_landmark_is_in_one_pair_only_which_is_the_best() -> None:
    """2 fits 0 better than 1 does; 3 and 2 are too far apart for their covariance."""
    assert duplicates([0.0, 0.3, 0.1, 0.9], [LEFT] * 4, 0.005 * np.eye(4), 4) == [[2], [0]]


@pytest.mark.parametrize(("correlation", "known", "expected"), [(0.0, 3, 1), (0.99, 3, 0), (0.0, 2, 0)])
def test_the_joint_covariance_decides_whether_two_are_one_cone(
    correlation: float, known: int, expected: int
) -> None:
    """0.5 m is little between independent landmarks with a sigma of 1 m, and much if they share the error."""
    joint = correlation + (1.0 - correlation) * np.eye(3)
    assert duplicates([0.0, 9.0, 0.5], [LEFT] * 3, joint, known) == [[2] * expected, [0] * expected]


@pytest.mark.parametrize("tolerance", [1e-12, 10.0])  # with the second, no factor becomes stale by itself
def test_merging_is_the_constraint_that_both_are_equal(tolerance: float) -> None:
    stale = RelinearizeSettings(tolerance, tolerance)
    smoother = driven(8, replace(QUADRATIC, lag=0.3, relinearize=stale))
    layout, variables, state = smoother.layout, smoother.variables, smoother.map.state
    hessian, vector = normal_equations(smoother.linear_graph(), layout)
    negative_gradient = vector - hessian @ (variables.values - variables.reference)
    constraint = np.zeros((2, layout.size))
    constraint[:, layout.entries(state.keys[[4]])] = np.eye(2)
    constraint[:, layout.entries(state.keys[[0]])] = -np.eye(2)
    kkt = np.block([[hessian, constraint.T], [constraint, np.zeros((2, 2))]])
    step = np.linalg.solve(kkt, np.append(negative_gradient, -constraint @ variables.values))[: layout.size]
    expected = (variables.values + step)[layout.entries(state.keys[:4])]
    before = state.landmarks[0].copy()
    merge(smoother, np.array([4]), np.array([0]))
    np.testing.assert_array_equal(state.numbers, np.arange(4))
    assert smoother.map.merged_into == {4: 0}
    assert set(smoother.map.detections.landmark.tolist()) == {0, 1, 2, 3}
    np.testing.assert_allclose(state.landmarks, expected.reshape(-1, 2), atol=1e-3)
    assert np.abs(expected[:2] - before).max() > 0.01


def test_a_duplicate_in_the_batch_is_merged_and_every_cone_stays(bean: Log) -> None:
    system, state = oracle_system(bean, 60)
    detections, settings, count = system.detections, system.settings, len(state)
    numbers, counts = np.unique(detections.landmark[detections.used], return_counts=True)
    often = numbers[counts.argmax()]
    original = state.positions(np.array([often]))
    duplicate = state.add(state.landmarks[original] + 0.05, state.labels[original])
    rows = np.flatnonzero(detections.landmark == often)
    detections.take(rows[::2], np.repeat(duplicate, len(rows[::2])))
    system.optimize(state)
    gone, kept = find_duplicates(state, len(state), system.eliminated(state).joint, settings)
    detections.merge(state.numbers[gone], state.numbers[kept])
    remove_rare(state, detections, 1)
    assert len(state) == len(state.landmarks) == count
    assert (detections.landmark[rows] == often).all()
