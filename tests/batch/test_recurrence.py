"""The length of a lap from the path alone: made paths that recur, that drift, and that don't recur."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.start import PROFILE_STEP, SMOOTHING, Recurrence, correlations, find_recurrence
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.batch import COURSE, course_curvature

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


def path(curvature: Array, ds: float) -> Array:
    """Returns poses (n, 3) along a path of given curvature (n,), a step of ds (m) each."""
    theta = np.append(0.0, np.cumsum(curvature[:-1] * ds))
    middle = theta[:-1] + 0.5 * np.diff(theta)
    x, y = (np.append(0.0, np.cumsum(ds * part)) for part in (np.cos(middle), np.sin(middle)))
    return np.column_stack([x, y, theta])


def laps_of_course(laps: float, drift: float = 0.0, ds: float = 0.6) -> Array:
    """Returns poses around the closed course, whose curvature is measured with an error of `drift` (1/m)."""
    return path(course_curvature(np.arange(0.0, laps * COURSE, ds)) + drift, ds)


@pytest.mark.parametrize("drift", [0.0, 3e-4, -3e-4])
@pytest.mark.parametrize("laps", [1.5, 3.2])
def test_a_lap_is_found_in_spite_of_a_drift(laps: float, drift: float) -> None:
    """The drift changes the turn of a lap, but not the whole turns nearest to it."""
    recurrence = find_recurrence(laps_of_course(laps, drift), SETTINGS)
    assert recurrence.recurs
    np.testing.assert_allclose(recurrence.lap, COURSE, atol=PROFILE_STEP)
    np.testing.assert_allclose(recurrence.turn, 2.0 * np.pi + drift * COURSE, atol=0.02)
    np.testing.assert_allclose(recurrence.whole_turn, 2.0 * np.pi)


def test_the_path_is_measured_from_pose_to_pose() -> None:
    poses = laps_of_course(1.5)
    recurrence = find_recurrence(poses, SETTINGS)
    assert recurrence.driven[0] == 0.0
    np.testing.assert_allclose(np.diff(recurrence.driven), np.hypot(*np.diff(poses[:, :2], axis=0).T))


@pytest.mark.parametrize("laps", [0.4, 0.8])
def test_before_a_lap_is_overlapped_there_is_none(laps: float) -> None:
    assert not find_recurrence(laps_of_course(laps), SETTINGS).recurs


def test_a_curvature_that_recurs_elsewhere_is_no_lap() -> None:
    """A slalom goes on along a line: it never comes back to its place."""
    s = np.arange(0.0, 300.0, 0.6)
    recurrence = find_recurrence(path(0.05 * np.sin(2.0 * np.pi * s / 75.0), 0.6), SETTINGS)
    assert not recurrence.recurs
    assert recurrence.lap == np.inf


def test_a_drive_that_stands_still_has_no_lap() -> None:
    assert not find_recurrence(np.zeros((20, 3)), SETTINGS).recurs


def test_a_clockwise_lap_has_a_negative_turn() -> None:
    poses = laps_of_course(1.5) * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(find_recurrence(poses, SETTINGS).whole_turn, -2.0 * np.pi)


def test_the_search_climbs_to_the_peak_of_a_smooth_track() -> None:
    """An oval with long straights agrees with itself well before a whole lap."""
    s = np.arange(0.0, 1.6 * 400.0, 0.6)
    curvature = 2.0 * np.pi / 400.0 * (1.0 - np.cos(4.0 * np.pi * s / 400.0))
    recurrence = find_recurrence(path(curvature, 0.6), SETTINGS)
    np.testing.assert_allclose(recurrence.lap, 400.0, atol=2.0 * PROFILE_STEP)
    assert recurrence.correlation > 0.99


def test_correlations_are_those_of_the_two_stretches() -> None:
    poses = laps_of_course(1.5, 3e-4)
    driven = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    x, y, heading = (np.interp(np.arange(0.0, driven[-1], PROFILE_STEP), driven, part) for part in poses.T)
    padded, lag = np.pad(heading, 3, "edge"), round(COURSE / PROFILE_STEP)
    curvature = (padded[6:] - padded[:-6]) / SMOOTHING
    first, second = curvature[:-lag], curvature[lag:]
    expected = 1.0 - np.mean((first - second) ** 2) / (np.mean(first**2) + np.mean(second**2))
    found = correlations(x + 1j * y, heading, np.array([lag // 2, lag]), SETTINGS.closing)
    np.testing.assert_allclose(found, [-np.inf, expected], atol=1e-9)


def test_a_figure_of_eight_has_no_whole_turn() -> None:
    assert Recurrence(np.zeros(1), 100.0, 0.3, 1.0).whole_turn == 0.0
