"""The way driven and the way ahead: stations, arcs and distances by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose
from pathspace_graph.mapping import path as path_module
from pathspace_graph.mapping.path import DrivenPath, PathAhead, along_and_across
from pathspace_graph.settings.mapper import ClosingSettings

Array = NDArray[np.float64]


def driven(xs: list[float]) -> DrivenPath:
    """A path along x."""
    path = DrivenPath()
    for x in xs:
        path.update(np.array([x, 0.0, 0.0]))
    return path


def test_positions_are_kept_a_step_apart() -> None:
    path = driven([0.0, 0.1, 0.2, 0.4, 0.5])
    np.testing.assert_allclose(path.points, [[0.0, 0.0], [0.4, 0.0]])
    np.testing.assert_allclose(path.stations, [0.0, 0.4])
    assert path.length == pytest.approx(0.5)


def test_standing_still_adds_nothing() -> None:
    path = driven([0.0, 1.0, *[1.0] * 50])
    assert len(path.points) == 2
    assert path.length == 1.0


def test_only_the_last_stretch_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(path_module, "PATH_MEMORY", 5.0)
    path = driven(np.arange(0.0, 21.0).tolist())
    np.testing.assert_allclose(path.stations, np.arange(15.0, 21.0))
    np.testing.assert_allclose(path.points[:, 0], np.arange(15.0, 21.0))


def test_the_curvature_is_smoothed_clipped_and_not_taken_from_a_creeping_vehicle() -> None:
    path = driven([0.0])
    path.steer(np.array([[5.0, 0.0, 1.0]]))
    assert path.curvature == pytest.approx(0.08)
    path.steer(np.array([[5.0, 0.0, 9.0], [5.0, 0.0, 11.0]]))
    assert path.curvature == pytest.approx(0.08 + 0.4 * (0.3 - 0.08))
    path.steer(np.array([[0.5, 0.0, 1.0]]))
    path.steer(np.zeros((0, 3)))
    assert path.curvature == pytest.approx(0.08 + 0.4 * (0.3 - 0.08))


def test_the_prediction_of_a_straight_goes_on_straight() -> None:
    path = driven([0.0, 1.0, 2.0, 3.0])
    path_ahead = path.ahead(np.array([3.0, 0.0, 0.0]), 0.9)
    np.testing.assert_allclose(path_ahead.points[:, 0], [0.0, 1.0, 2.0, 3.0, 3.3, 3.6, 3.9])
    np.testing.assert_allclose(path_ahead.stations, path_ahead.points[:, 0])
    np.testing.assert_array_equal(path_ahead.points[:, 1], 0.0)
    assert path_ahead.driven == 3.0
    np.testing.assert_allclose(path_ahead.beside(3.4, -2.0), [3.6, -2.0])


@pytest.mark.parametrize(("station", "first"), [(-1.0, 0), (0.5, 0), (1.0, 0), (1.5, 1), (2.0, 1), (9.0, 3)])
def test_the_way_since_a_station_begins_at_the_last_position_before_it(station: float, first: int) -> None:
    """Positions a metre apart, but for one gap of 4 m: the segment that holds the station is kept whole."""
    stations = np.array([0.0, 1.0, 2.0, 6.0])
    points = np.column_stack([stations, np.zeros(4)])
    since = PathAhead(points, stations, 2.0).since(station)
    np.testing.assert_array_equal(since.stations, stations[first:])
    np.testing.assert_array_equal(since.points, points[first:])
    assert since.driven == 2.0


@pytest.mark.parametrize("radius", [10.0, -4.0])
def test_the_prediction_of_a_turn_is_its_circle(radius: float) -> None:
    """Heading along y at (1, 0): the centre is `radius` to the left."""
    path = driven([1.0])
    path.curvature = 1.0 / radius
    path_ahead = path.ahead(np.array([1.0, 0.0, np.pi / 2]), 6.0)
    angle = path_ahead.stations / radius
    expected = np.column_stack([1.0 - radius * (1.0 - np.cos(angle)), radius * np.sin(angle)])
    np.testing.assert_allclose(path_ahead.points, expected, atol=1e-12)
    np.testing.assert_allclose(np.diff(path_ahead.stations), 0.3)
    assert path_ahead.stations[-1] >= 6.0


CORNER = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
"""East, then north."""


@pytest.mark.parametrize(
    ("point", "station", "lateral"),
    [
        ((1.0, 2.0), 11.0, 2.0),
        ((2.0, -1.5), 12.0, -1.5),
        ((5.0, 1.0), 15.0, -1.0),
        ((3.0, 2.0), 16.0, 1.0),
        ((4.0, 5.0), 19.0, 0.0),
        ((3.0, 6.0), 20.0, 1.0),
        ((7.0, 4.0), 18.0, -3.0),
        ((-1.0, 1.0), 10.0, np.sqrt(2.0)),
        ((5.0, -1.0), 14.0, -np.sqrt(2.0)),
    ],
)
def test_along_and_across_a_corner(point: tuple[float, float], station: float, lateral: float) -> None:
    s, across = along_and_across(np.array([point]), CORNER, np.array([10.0, 14.0, 17.0]))
    assert s[0] == pytest.approx(station)
    assert across[0] == pytest.approx(lateral)


def test_no_points() -> None:
    s, across = along_and_across(np.zeros((0, 2)), CORNER, np.array([10.0, 14.0, 17.0]))
    assert len(s) == len(across) == 0


@given(st.floats(-3.0, 3.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_stations_move_with_the_frame(angle: float, x: float, y: float) -> None:
    points = np.array([[1.0, 2.0], [6.0, 1.5], [3.5, -2.0], [4.5, 8.0]])
    stations = np.array([0.0, 4.0, 7.0])
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, s], [-s, c]])
    moved = along_and_across(points @ rotation + [x, y], CORNER @ rotation + [x, y], stations)
    np.testing.assert_allclose(moved, along_and_across(points, CORNER, stations), atol=1e-9)


def test_driving_backwards_takes_the_path_back() -> None:
    path = DrivenPath()
    for x in [*np.arange(0.0, 6.01, 0.5), *np.arange(5.8, 1.99, -0.2)]:
        path.update(np.array([x, 0.0, 0.0]))
    assert path.length == pytest.approx(2.0)
    assert path.points[:, 0].max() <= 2.0


def test_turning_on_the_spot_keeps_the_path() -> None:
    path = DrivenPath()
    for x in np.arange(0.0, 6.01, 0.5):
        path.update(np.array([x, 0.0, 0.0]))
    for theta in np.linspace(0.0, np.pi, 20):
        path.update(np.array([6.0 + 1e-3 * np.cos(7.0 * theta), 0.0, theta]))
    assert path.length == pytest.approx(6.0, abs=0.5)


def test_a_rigid_motion_moves_the_way_behind_and_not_the_beginning() -> None:
    """A quarter turn and a shift; the way goes on from the moved pose, and no station changes."""
    path = driven([0.0, 1.0, 2.0])
    beginning, stations = path.beginning.copy(), path.stations.copy()
    path.move(np.array([5.0, 0.0, 0.5 * np.pi]))
    np.testing.assert_allclose(path.points, [[5.0, 0.0], [5.0, 1.0], [5.0, 2.0]], atol=1e-12)
    np.testing.assert_array_equal(path.beginning, beginning)
    np.testing.assert_array_equal(path.stations, stations)
    path.update(np.array([5.0, 3.0, 0.5 * np.pi]))
    assert path.length == pytest.approx(3.0)


def test_a_vehicle_that_reverses_after_a_motion_takes_the_path_back() -> None:
    """Seen from where it was before the motion by 10 m, the step back would be one ahead."""
    path = driven([0.0, 1.0, 2.0, 3.0])
    path.move(np.array([10.0, 0.0, 0.0]))
    path.update(np.array([11.8, 0.0, 0.0]))
    np.testing.assert_allclose(path.points[:, 0], [10.0, 11.0, 11.8])
    assert path.length == pytest.approx(1.8)


@pytest.mark.parametrize(
    ("pose", "near"),
    [
        ((0.0, 0.0, 0.0), True),
        ((10.0, 9.0, 0.3), True),
        ((10.0, 12.0, 0.3), False),
        ((10.0, 0.0, np.pi), False),
        ((10.0, 0.0, 2.0 * np.pi), True),
    ],
)
def test_near_the_start_is_a_matter_of_place_and_direction(
    pose: tuple[float, ...], near: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 80 m straight on, on the first 20 m: within 8 m + 3 % of 80 m, and 0.8 rad."""
    monkeypatch.setattr(path_module, "PATH_MEMORY", 20.0)
    path, frame = DrivenPath(), np.array([3.0, -5.0, 0.7])
    for x in np.arange(0.0, 80.1, 0.5):
        path.update(compose(frame, np.array([x, 0.0, 0.0])))
    there = compose(frame, np.array(pose))
    assert path.near_beginning(there, ClosingSettings()) is near
    monkeypatch.setattr(ClosingSettings, "min_path", 100.0)
    assert not path.near_beginning(there, ClosingSettings())
