"""The record of the open lap: after which path length the drive recurs, by its odometry or from a place."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.graph.variables import CALIBRATION_KEY, pose_keys
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.loop.drive_record import DriveRecord
from pathspace_graph.loop.recognition import RecognizedPlace
from pathspace_graph.mapping.motion import MeasuredMotion, integrate_odometry
from pathspace_graph.mapping.registration import Motion
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.calibration import OdometrySettings
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.maps import boundary_through

Array = NDArray[np.float64]

RADIUS, SPEED, CYCLE = 40.0, 10.0, 0.1
LAP = 2.0 * np.pi * RADIUS
NOTHING = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.intp)


def on_circle(angle: Array, side: float = 0.0) -> Array:
    """Returns points (k, 2) at angles (k,) driven on a circle to the left, which begins at the origin."""
    r = RADIUS - side
    return np.column_stack([r * np.sin(angle), RADIUS - r * np.cos(angle)])


def driven(laps: float, drift: float) -> DriveRecord:
    """Returns the record of a circle, driven for some laps; its odometry turns by `drift` rad/m too much."""
    record, state, end = DriveRecord(MapperSettings()), State(), 2.0 * np.pi * laps
    state.variables.insert(np.array([CALIBRATION_KEY]), np.zeros(2))
    state.variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    angles = np.arange(0.0, end + 0.3, 3.0 / RADIUS)
    for label, side in ((LEFT, 2.0), (RIGHT, -2.0)):
        state.add_boundary(label, *boundary_through(on_circle(angles, side)))
    twist = np.array([[SPEED, 0.0, SPEED * (1.0 / RADIUS + drift)]])
    for cycle in range(1, int(end * RADIUS / SPEED / CYCLE)):
        t, angle = CYCLE * cycle, SPEED * CYCLE * cycle / RADIUS
        step = integrate_odometry(Odometry(np.array([t - CYCLE]), twist), t, np.full(3, 0.01))
        nothing = Detections(t, *NOTHING)
        record.measured(MeasuredMotion(step, twist), nothing, nothing)
        state.poses[-1] = np.append(on_circle(np.array([angle]))[0], angle)
        state.pose_u = {LEFT: np.array([angle * (RADIUS - 2.0)]), RIGHT: np.array([angle * (RADIUS + 2.0)])}
        record.estimated(state)
    return record


@pytest.mark.parametrize("back", [1.0, 1.2])
def test_the_drive_recurs_since_it_was_beside_the_place(back: float) -> None:
    """The place is `back` laps behind; the path length and the turn since then are those of the odometry."""
    drift, before = 0.004, 2.0 * np.pi * (1.5 - back)
    record = driven(1.5, drift)
    beside = {LEFT: before * (RADIUS - 2.0), RIGHT: before * (RADIUS + 2.0)}
    found = record.recurrence_since(RecognizedPlace(Motion(np.zeros(2), np.zeros(3)), beside))
    assert found.lap == pytest.approx(back * LAP, abs=2.5 * SPEED * CYCLE)
    assert found.turn == pytest.approx(found.lap * (1.0 / RADIUS + drift), abs=1e-2)
    assert found.driven[-1] == pytest.approx(1.5 * LAP, abs=4.0)
    assert found.recurs


def test_a_lap_is_over_once_a_good_part_of_it_was_driven_again() -> None:
    """A circle turns alike everywhere, so only how near the drive is to its beginning tells the lap."""
    assert driven(1.2, 0.0).recurrence() is None
    found = driven(1.5, 0.0).recurrence()
    assert found is not None
    assert found.lap == pytest.approx(LAP, abs=20.0)


def test_a_record_that_was_given_up_keeps_the_first_reason() -> None:
    record = driven(0.2, 0.0)
    record.give_up("one")
    record.give_up("two")
    assert record.unsolvable == "one"


def test_the_chain_of_the_lap_is_the_odometry_that_was_measured() -> None:
    record = driven(0.5, 0.0)
    place = RecognizedPlace(Motion(np.zeros(2), np.zeros(3)), {LEFT: 0.0})
    settings = MapperSettings(odometry=OdometrySettings(sigma_scale=0.1, sigma_bias=0.2))
    chain = record.lap(3, record.recurrence_since(place), settings).chain
    np.testing.assert_array_equal(chain.calibration_sigma, [0.1, 0.2])
    poses = chain.dead_reckoned(np.zeros(2))
    angle = len(poses) * SPEED * CYCLE / RADIUS
    np.testing.assert_allclose(poses[-1, 2], angle)
    np.testing.assert_allclose(poses[-1, :2], on_circle(np.array([angle]))[0], atol=1e-6)
