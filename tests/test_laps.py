"""The lap counter, on circles whose laps are known and on what makes counting hard."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.laps import LapCounter, lap_end_indices

RADIUS = 20.0
"""m; a lap is 125.7 m."""


def circle(laps: float, step: float = 0.5, radius: float = RADIUS) -> NDArray[np.float64]:
    """Poses around (0, radius), anticlockwise from (0, 0) heading +x."""
    angle = np.arange(0.0, laps * 2 * np.pi, step / radius)
    heading = np.arctan2(np.sin(angle), np.cos(angle))
    return np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), heading], axis=1)


def count(poses: NDArray[np.float64]) -> LapCounter:
    counter = LapCounter()
    for pose in poses:
        counter.update(pose)
    return counter


@pytest.mark.parametrize(
    ("laps", "lap", "completed"),
    [
        (0.02, 1, 0),
        (0.9, 1, 0),
        (0.98, 1, 1),
        (1.02, 2, 1),
        (2.5, 3, 2),
        (4.99, 5, 5),
        (5.01, 6, 5),
    ],
)
def test_laps_of_a_circle(laps: float, lap: int, completed: int) -> None:
    counter = count(circle(laps))
    assert (counter.lap, counter.completed) == (lap, completed)


def test_ends_are_the_first_poses_past_the_line() -> None:
    poses = circle(2.99)
    ends = lap_end_indices(poses)
    assert len(ends) == 3
    assert ends[-1] == len(poses) - 1
    for end in ends[:-1]:
        assert poses[end - 1, 0] < 0.0 <= poses[end, 0]


def test_a_log_without_poses_has_no_laps() -> None:
    assert len(lap_end_indices(np.zeros((0, 3)))) == 0


def test_standing_and_jitter_on_the_line_are_no_laps() -> None:
    rng = np.random.default_rng(0)
    jitter = np.column_stack([rng.normal(0.0, 0.3, (2000, 2)), np.zeros(2000)])
    assert count(jitter).completed == 0


def test_the_line_crossed_backwards_is_no_lap() -> None:
    poses = circle(1.02)
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2] + np.pi), np.cos(poses[:, 2] + np.pi))
    assert count(poses).completed == 0


def test_a_jump_over_the_line_is_noticed_once() -> None:
    """An estimate that drifted off sideways is pulled over the line by a loop closing, then jitters on it."""
    poses = circle(1.0)
    drifted = poses + np.array([0.0, 9.0, 0.0]) * np.linspace(0.0, 1.0, len(poses))[:, None]
    behind = np.array([[1.5, 0.2, 0.05], [-0.4, 0.1, 0.0], [0.3, 0.1, 0.0], [2.0, 0.1, 0.0]])
    counter = count(np.concatenate([drifted, behind]))
    assert counter.lap == 2
    assert not counter.last_lap_is_complete


def test_sparse_poses_that_leap_the_gate_are_counted() -> None:
    assert count(circle(3.1, step=22.0, radius=80.0)).lap == 4
