"""Pairs of cycles: what a motion explains, what could have been seen, and which pairs are taken."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.factors.se2 import to_vehicle
from pathspace_graph.io.log import Detections
from pathspace_graph.plausibility.hypotheses import EXPLAINED_REACH, LONGEST_PAIR, Pairs, pairs_of, spacing_of

CONES = np.array([[2.0, 2.0], [6.0, 2.2], [10.0, 2.0], [2.5, -1.9], [7.0, -2.0], [11.0, -2.1]])
MOTION = np.array([1.0, 0.3, 0.2])


def cycle(t: float, pose: np.ndarray, cones: np.ndarray = CONES) -> Detections:
    points = to_vehicle(cones, np.tile(pose, (len(cones), 1)))
    return Detections(t, points, np.tile(0.01 * np.eye(2), (len(cones), 1, 1)), np.zeros(len(cones), int))


def pair(motion: np.ndarray = MOTION) -> Pairs:
    found = pairs_of([cycle(0.0, np.zeros(3)), cycle(0.1, motion)])
    assert found is not None
    return found


def test_the_true_motion_explains_everything_and_another_one_little() -> None:
    one = pair()
    assert one.explained(np.eye(2), MOTION[None])[0] == pytest.approx(1.0)
    assert one.explained(np.eye(2), np.zeros((1, 3)))[0] < 0.6


def test_a_frame_that_is_undone_explains_everything() -> None:
    one, mirror = pair(), np.diag([1.0, -1.0])
    mirrored = Pairs(**{**vars(one), "before": one.before @ mirror, "after": one.after @ mirror})
    assert mirrored.explained(mirror, MOTION[None])[0] == pytest.approx(1.0)


def test_a_detection_at_one_reach_counts_by_its_weight() -> None:
    cones = np.array([[0.0, 0.0], [100.0, 0.0]])
    found = pairs_of([cycle(0.0, np.zeros(3), cones), cycle(0.1, np.zeros(3), cones)])
    assert found is not None
    assert found.reach == pytest.approx(100.0 * EXPLAINED_REACH)
    off = np.array([[0.0, found.reach, 0.0]])
    assert found.explained(np.eye(2), off)[0] == pytest.approx(np.exp(-0.5))


def test_cycles_without_cones_in_common_do_not_overlap() -> None:
    one = pair()
    assert one.overlap(np.zeros((1, 3)))[0] > 0.5
    assert one.overlap(np.array([[40.0, 0.0, 0.0]]))[0] == 0.0


def test_variances_are_those_of_differences() -> None:
    assert np.nanmax(pair().variances) == pytest.approx(0.02)


def test_cycles_far_apart_are_no_pair() -> None:
    cycles = [cycle(0.1 * k, np.zeros(3)) for k in range(5)]
    gap = [cycle(100.0 + 0.1 * k, np.zeros(3)) for k in range(5)]
    found = pairs_of([*cycles, *gap])
    assert found is not None
    assert (found.end - found.begin).max() < LONGEST_PAIR


def test_single_detections_give_no_pairs() -> None:
    assert pairs_of([cycle(0.1 * k, np.zeros(3), CONES[:1]) for k in range(9)]) is None
    assert spacing_of([]) is None


def test_the_spacing_is_that_of_nearest_neighbours() -> None:
    assert spacing_of([cycle(0.0, np.zeros(3), np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 7.0]]))]) == 3.0
