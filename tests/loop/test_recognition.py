"""A lost place is found by the shape of the newest stretch of the curves, or rightly not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.graph.variables import CALIBRATION_KEY, pose_keys
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.revisit import find_place, is_recognizable
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.registration import RefinedMotion
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import ClosingSettings

from ..scenes.maps import boundary_through

Array = NDArray[np.float64]

RADIUS, SIDES = 130.0, {LEFT: -4.0, RIGHT: 4.0}
TURN = 0.4
LOST = np.diag([60.0, 60.0, 0.3]) ** 2


def rim(phi: Array, side: float, bends: tuple[float, float], turn: float) -> Array:
    """Returns points (k, 2) of a closed track at angles (k,); a lap turns by `turn` as a whole (rad)."""
    two, three = bends
    r = (RADIUS + side) * (1.0 + two * np.cos(2.0 * phi) + three * np.sin(3.0 * phi))
    angle = phi + turn * phi / (2.0 * np.pi)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


def driven(laps: float, bends: tuple[float, float] = (0.1, 0.3), turn: float = TURN) -> CurveMap:
    """Returns curves after some laps, with the vehicle at their end."""
    state, end = State(), 2.0 * np.pi * laps
    x, y = rim(np.array([end]), 0.0, bends, turn)[0]
    state.variables.insert(np.array([CALIBRATION_KEY]), np.zeros(2))
    state.variables.insert(pose_keys(np.arange(1)), np.array([x, y, end + 0.5 * np.pi]))
    for label, side in SIDES.items():
        phi = np.arange(0.0, end, 5.0 / RADIUS)
        state.add_boundary(label, *boundary_through(rim(phi, side, bends, turn)))
    return CurveMap(MapperSettings(), state)


def found(track: CurveMap, covariance: Array = LOST, **settings: float) -> RefinedMotion | None:
    return find_place(track, covariance, replace(ClosingSettings(), **settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("laps", [1.28, 1.3, 1.32])
def test_a_lap_that_has_turned_as_a_whole_is_turned_back(laps: float) -> None:
    """A lap later the same place is turned by `TURN` about the origin, which is 50 m away and more."""
    track = driven(laps)
    place = found(track)
    assert place is not None
    end = np.array([2.0 * np.pi * laps])
    before = rim(end - 2.0 * np.pi, 0.0, (0.1, 0.3), TURN)
    np.testing.assert_allclose(place.motion.apply(track.state.poses[-1:, :2]), before, atol=0.5)
    assert place.motion.vector[2] == pytest.approx(-TURN, abs=0.01)


def test_a_circle_has_no_place_along_it() -> None:
    track = driven(1.3, (0.0, 0.0))
    assert not is_recognizable(track.state, ClosingSettings())
    assert found(track) is None


def test_where_two_places_agree_there_is_none() -> None:
    """In the third lap the vehicle may be beside the first one or beside the second."""
    assert found(driven(2.3, turn=0.15)) is None
    assert found(driven(1.3, turn=0.15)) is not None


def test_a_place_farther_away_than_the_vehicle_may_be_is_none() -> None:
    assert found(driven(1.3), np.diag([5.0, 5.0, 0.05]) ** 2) is None


def test_a_curve_of_less_than_a_lap_and_a_stretch_is_not_asked() -> None:
    assert not is_recognizable(driven(0.4).state, ClosingSettings())
    assert is_recognizable(driven(1.3).state, ClosingSettings())


def test_another_track_is_no_place() -> None:
    """The second lap winds about the first one."""
    track = driven(1.3)
    for label in SIDES:
        points = track.state.control_points(label)
        late = len(points) * 2 // 3
        points[late:, 0] += 2.0 * np.sin(np.arange(len(points) - late) / 2.0)
    assert found(track) is None
