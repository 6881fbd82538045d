"""Which readings made a landmark, and which two landmarks are one cone, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.graph.variables import Layout
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.landmark.state import LandmarkState
from pathspace_graph.landmark.tentative import associate_created, compatible_pairs, pairs_within
from pathspace_graph.settings.comparison import LandmarkSettings
from pathspace_graph.settings.mapper import GrowthSettings, MapperSettings


def test_each_pose_gives_a_landmark_one_reading_the_nearest() -> None:
    landmarks = np.array([[0.0, 0.0], [5.0, 0.0]])
    points = np.array([[0.3, 0.0], [0.1, 0.0], [0.2, 0.0], [4.9, 0.0], [2.5, 0.0]])
    cycles = np.array([0, 0, 1, 1, 1])
    rows, which = associate_created(points, cycles, landmarks, GrowthSettings(merge_radius=1.0))
    order = np.argsort(rows)
    np.testing.assert_array_equal(rows[order], [1, 2, 3])
    np.testing.assert_array_equal(which[order], [0, 0, 1])


def test_no_landmarks_and_no_readings() -> None:
    for points, landmarks in ((0, 2), (2, 0)):
        found = associate_created(
            np.zeros((points, 2)), np.zeros(points, np.intp), np.zeros((landmarks, 2)), GrowthSettings()
        )
        assert [len(column) for column in found] == [0, 0]


def test_pairs_are_of_one_colour_and_the_newer_comes_first() -> None:
    landmarks = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, 0.0], [9.0, 0.0]])
    first, second = pairs_within(landmarks, np.array([LEFT, RIGHT, LEFT, LEFT]), 1.0)
    np.testing.assert_array_equal(first, [2])
    np.testing.assert_array_equal(second, [0])


def test_a_landmark_is_merged_once_with_the_one_that_fits_best() -> None:
    """2 fits 0 better than 1 does; 3 and 0 are too far apart for how surely they are known."""
    first, second = np.array([1, 2, 3]), np.array([0, 0, 0])
    offset = np.array([[0.3, 0.0], [0.1, 0.0], [0.0, 0.9]])
    spread = np.tile(0.01 * np.eye(2), (3, 1, 1))
    np.testing.assert_array_equal(compatible_pairs(first, second, offset, spread, LandmarkSettings()), [1])
    assert (
        len(
            compatible_pairs(
                first[2:], second[2:], offset[2:], 9.0 * spread[2:] + np.eye(2), LandmarkSettings()
            )
        )
        == 1
    )


@pytest.mark.parametrize(("correlation", "known", "expected"), [(0.0, 3, 1), (0.99, 3, 0), (0.0, 2, 0)])
def test_what_is_known_of_both_together_says_whether_they_are_one(
    correlation: float, known: int, expected: int
) -> None:
    """0.5 m apart: little where each is known to a metre, much where all of that is common to both."""
    state = LandmarkState()
    state.add(np.array([[0.0, 0.0], [9.0, 0.0], [0.5, 0.0]]), np.full(3, LEFT))
    joint = np.asarray(np.kron(correlation + (1.0 - correlation) * np.eye(3), np.eye(2)), np.float64)
    entries = Layout(state.keys).entries
    first, second = find_duplicates(
        state, known, lambda keys: joint[np.ix_(entries(keys), entries(keys))], MapperSettings()
    )
    np.testing.assert_array_equal(first, [2] * expected)
    np.testing.assert_array_equal(second, [0] * expected)
