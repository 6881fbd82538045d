"""The events of Formula Student: geometry by the rules, and how they are driven."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import EVENTS, acceleration, skidpad, to_map_frame


def test_the_circles_of_a_skidpad_are_those_of_the_rules() -> None:
    track = skidpad()
    for row, side in ((track.left, 1.0), (track.right, -1.0)):
        inner = np.hypot(row[:, 0], row[:, 1] - side * 18.25 / 2)
        outer = np.hypot(row[:, 0], row[:, 1] + side * 18.25 / 2)
        assert np.isclose(inner, 15.25 / 2).sum() == 16
        # one inner cone of the other circle lies on this one, between the lanes
        assert np.isclose(outer, 15.25 / 2 + 3.0).sum() == 13 + 1
    assert np.abs(track.other[:, 1]).max() == 1.5


def test_a_skidpad_is_driven_twice_to_the_right_and_twice_to_the_left() -> None:
    line = to_map_frame(skidpad()).centre_line
    s = np.linspace(0.0, line.length, 2000)
    turn = line.curvatures(s) * (s[1] - s[0])
    assert -turn[turn < 0.0].sum() == pytest.approx(4 * np.pi, rel=0.02)
    assert turn[turn > 0.0].sum() == pytest.approx(4 * np.pi, rel=0.02)
    assert line.length == pytest.approx(30.0 + 8 * np.pi * 18.25 / 2, rel=0.01)
    assert line.clearance.min() > 1.2


def test_the_rows_of_a_skidpad_are_those_that_are_passed_each_round_anew() -> None:
    """Right of the first circle are its inner cones, twice around; then the other circle's outer ones."""
    left, right = skidpad().rows
    below, above = np.array([0.0, -18.25 / 2]), np.array([0.0, 18.25 / 2])
    assert np.isclose(np.hypot(*(right - below).T), 15.25 / 2).sum() >= 2 * 16
    assert np.isclose(np.hypot(*(left - above).T), 15.25 / 2).sum() >= 2 * 16
    for row in (left, right):
        assert np.hypot(*np.diff(row, axis=0).T).max() < 6.0  # no jump from circle to circle
    np.testing.assert_array_equal(acceleration().rows[0], acceleration().left)


def test_an_acceleration_is_straight_and_leaves_room_to_brake() -> None:
    track = acceleration()
    assert track.centre_line.length == pytest.approx(150.0)
    np.testing.assert_allclose(track.left[:, 1], 1.5)
    np.testing.assert_allclose(track.right[:, 1], -1.5)


@pytest.mark.parametrize("name", EVENTS)
def test_each_event_can_be_driven(name: str) -> None:
    track = EVENTS[name]()
    log = simulate(track, SimulationSettings(), seed=0)
    assert log.truth is not None
    end = to_map_frame(track).centre_line.points(np.array([to_map_frame(track).centre_line.length]))[0]
    assert np.hypot(*(log.truth.poses[-1, :2] - end)) < 1.0
