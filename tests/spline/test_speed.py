"""The speed profile against what can be worked out by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.settings.mapper import SpeedSettings
from pathspace_graph.spline.planning import speed_profile

Array = NDArray[np.float64]

CAR = SpeedSettings(lateral=9.0, forward=4.0, braking=8.0, top=20.0)


@dataclass(frozen=True, eq=False)
class Line:
    """A line of which only curvature and lengths are known."""

    curvature: Array
    arc_length: Array
    length: float
    closed: bool


def open_line(curvature: Array, step: float) -> Line:
    lengths = step * np.arange(len(curvature))
    return Line(curvature, lengths, float(lengths[-1]), False)


def loop(curvature: Array, step: float) -> Line:
    return Line(curvature, step * np.arange(len(curvature)), step * len(curvature), True)


def test_a_circle_is_driven_at_the_limit_of_friction() -> None:
    radius = 16.0
    profile = speed_profile(loop(np.full(100, 1 / radius), 2 * np.pi * radius / 100), CAR)
    np.testing.assert_allclose(profile.speed, np.sqrt(9.0 * radius))
    np.testing.assert_allclose(profile.acceleration, 0.0, atol=1e-12)
    assert profile.duration == pytest.approx(2 * np.pi * radius / np.sqrt(9.0 * radius))


def test_a_straight_is_accelerated_and_braked_on() -> None:
    """From rest to rest on L metres: the speeds meet where 2 a s = 2 b (L - s)."""
    profile = speed_profile(open_line(np.zeros(121), 0.5), CAR, begin=0.0, end=0.0)
    meet = 60.0 * 8.0 / (4.0 + 8.0)
    assert profile.speed.argmax() == round(meet / 0.5)
    assert profile.speed.max() == pytest.approx(np.sqrt(2 * 4.0 * meet))
    assert profile.duration == pytest.approx(profile.speed.max() / 4.0 + profile.speed.max() / 8.0)
    assert profile.acceleration[-1] == 0.0


def test_nobody_is_faster_than_the_top_speed() -> None:
    profile = speed_profile(open_line(np.zeros(400), 1.0), CAR)
    np.testing.assert_allclose(profile.speed, 20.0)
    assert profile.duration == pytest.approx(399.0 / 20.0)


def test_a_corner_is_braked_for_and_left_with_what_the_tyres_have() -> None:
    curvature = np.zeros(200)
    curvature[100] = 1.0
    profile = speed_profile(open_line(curvature, 0.25), CAR)
    assert profile.speed[100] == pytest.approx(3.0)
    before, after = profile.speed[90:99] ** 2, profile.speed[102:110] ** 2
    np.testing.assert_allclose(np.diff(before), -2 * 8.0 * 0.25)
    np.testing.assert_allclose(np.diff(after), 2 * 4.0 * 0.25)
    assert profile.speed[101] == profile.speed[100]  # nothing is left for acceleration at the apex


@pytest.mark.parametrize(("braking", "most"), [(False, 4.0), (True, 8.0)])
def test_a_bend_is_accelerated_and_braked_in_with_as_much_as_the_ellipse_leaves(
    braking: bool, most: float
) -> None:
    """A radius of 16 m is driven at 12 m/s at most: at 6 m/s a quarter of the grip is taken.

    What is left is `sqrt(1 - 1/16)` = 0.968 of the acceleration, and less the faster the vehicle is.
    """
    ends = {"end" if braking else "begin": 6.0}
    profile = speed_profile(open_line(np.full(40, 1 / 16.0), 0.25), CAR, **ends)
    speed = profile.speed[::-1] if braking else profile.speed
    found = np.abs(profile.acceleration[:-1])
    found = found[::-1] if braking else found
    assert found[0] == pytest.approx(0.968246 * most, rel=1e-6)
    free = speed[1:] < 12.0 - 1e-9
    assert free.sum() > 5
    expected = most * np.sqrt(1.0 - (speed[:-1] ** 2 / (9.0 * 16.0)) ** 2)
    np.testing.assert_allclose(found[free], expected[free])


curvatures = st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=60).map(np.array)


@given(curvatures, st.integers(0, 59))
def test_a_loop_has_the_same_profile_wherever_it_begins(curvature: Array, shift: int) -> None:
    profile = speed_profile(loop(curvature, 0.7), CAR)
    rolled = speed_profile(loop(np.roll(curvature, shift), 0.7), CAR)
    np.testing.assert_allclose(rolled.speed, np.roll(profile.speed, shift), rtol=1e-9)
    np.testing.assert_allclose(rolled.acceleration, np.roll(profile.acceleration, shift), atol=1e-7)
    assert rolled.duration == pytest.approx(profile.duration)


@given(curvatures, st.booleans())
def test_each_step_obeys_the_friction_ellipse_at_its_slower_end(curvature: Array, closed: bool) -> None:
    line = (loop if closed else open_line)(curvature, 0.7)
    profile = speed_profile(line, CAR)
    following = np.roll(profile.speed, -1)
    slower_is_next = following < profile.speed
    bend = np.where(slower_is_next, np.roll(curvature, -1), curvature)
    square = np.minimum(profile.speed, following) ** 2
    most = np.where(profile.acceleration < 0.0, CAR.braking, CAR.forward)
    used = (square * bend / CAR.lateral) ** 2 + (profile.acceleration / most) ** 2
    assert (used[: None if closed else -1] <= 1.0 + 1e-6).all()
    assert (profile.speed**2 * np.abs(curvature) <= CAR.lateral * (1.0 + 1e-9)).all()


def test_bad_lines_and_speeds_are_refused() -> None:
    with pytest.raises(SettingsError, match="at least 2 points, found 1"):
        speed_profile(open_line(np.zeros(1), 1.0))
    with pytest.raises(SettingsError, match="at least 0, found -1"):
        speed_profile(open_line(np.zeros(5), 1.0), begin=-1.0)
    with pytest.raises(SettingsError, match="lateral: expected a positive"):
        SpeedSettings(lateral=0.0)
