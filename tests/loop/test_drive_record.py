"""The record of the open lap: its measurements, and its poses in the closed map."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise, RayNoise
from pathspace_graph.factors.odometry import MIN_SIGMA, integrate_twists
from pathspace_graph.factors.se2 import compose, wrap_angle
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.rows import Revisit
from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.labels import LEFT, ORANGE, RIGHT
from pathspace_graph.loop import drive as drives
from pathspace_graph.loop.drive import Drive, DriveRecord
from pathspace_graph.mapping.motion import MeasuredMotion, integrate_odometry, known_noise
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings, OdometrySettings

from ..scenes.maps import boundary_through

Array = NDArray[np.float64]

RADIUS, SPEED, CYCLE = 40.0, 10.0, 0.1
LAP = 2.0 * np.pi * RADIUS
AGAIN = Revisit(0, 1, np.zeros(3), np.eye(3))
NOISE = NoiseLearner(known_noise(np.full(3, 0.01)), None)
NOTHING = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.intp)


def on_circle(angle: Array, side: float = 0.0) -> Array:
    """Returns points (k, 2) at angles (k,) driven on a circle to the left, which begins at the origin."""
    r = RADIUS - side
    return np.column_stack([r * np.sin(angle), RADIUS - r * np.cos(angle)])


def driven(laps: float, drift: float) -> DriveRecord:
    """Returns the record of a circle, driven for some laps; its odometry turns by `drift` rad/m too much."""
    record, road = DriveRecord(), Road(MapperSettings())
    state, end = road.smoother.map.state, 2.0 * np.pi * laps
    state.variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    angles = np.arange(0.0, end + 0.3, 3.0 / RADIUS)
    for label, side in ((LEFT, 2.0), (RIGHT, -2.0)):
        state.add_boundary(label, *boundary_through(on_circle(angles, side)))
    twist = np.array([[SPEED, 0.0, SPEED * (1.0 / RADIUS + drift)]])
    for cycle in range(1, int(end * RADIUS / SPEED / CYCLE)):
        t, angle = CYCLE * cycle, SPEED * CYCLE * cycle / RADIUS
        step = integrate_odometry(Odometry(np.array([t - CYCLE]), twist), t, np.full(3, 0.01))
        nothing = Detections(t, *NOTHING)
        motion, none = MeasuredMotion(step, twist), np.zeros(0, bool)
        record.measured(Reading(motion, nothing, none, nothing, (nothing, nothing), NOISE))
        state.poses[-1] = np.append(on_circle(np.array([angle]))[0], angle)
        state.pose_u = {LEFT: np.array([angle * (RADIUS - 2.0)]), RIGHT: np.array([angle * (RADIUS + 2.0)])}
        record.estimated(road)
    return record


def test_a_record_that_was_given_up_keeps_the_first_reason() -> None:
    record = driven(0.2, 0.0)
    record.give_up("one")
    record.give_up("two")
    assert record.unsolvable == "one"


def test_the_chain_of_the_lap_is_the_odometry_that_was_measured() -> None:
    record = driven(0.5, 0.0)
    settings = MapperSettings(odometry=OdometrySettings(sigma_scale=0.1, sigma_bias=0.2))
    chain = record.lap(3, None, (AGAIN,), settings, NOISE).chain
    np.testing.assert_array_equal(chain.calibration_sigma, [0.1, 0.2])
    poses = chain.dead_reckoned(np.zeros(2))
    angle = len(poses) * SPEED * CYCLE / RADIUS
    np.testing.assert_allclose(poses[-1, 2], angle)
    np.testing.assert_allclose(poses[-1, :2], on_circle(np.array([angle]))[0], atol=1e-6)


def test_the_heading_of_replaced_poses_does_not_jump() -> None:
    """A batch may hand back wrapped ones; means and steps of headings need a continuous turn."""
    record = driven(1.1, 0.0)
    wrapped = record.poses.copy()
    wrapped[:, 2] = wrap_angle(wrapped[:, 2])
    assert np.abs(np.diff(wrapped[:, 2])).max() > 6.0
    record.replaced(wrapped)
    for poses in (record.poses, record.corrected):
        np.testing.assert_allclose(np.diff(poses[:, 2]), SPEED * CYCLE / RADIUS, atol=1e-9)


def test_the_newest_path_keeps_the_shape_in_which_it_was_driven() -> None:
    """Updates turn the window by a little each, and so do the recorded poses from cycle to cycle."""
    straight, record = np.arange(20.0)[:, None] * [1.0, 0.0, 0.0], DriveRecord()
    turns = np.arange(20.0)[:, None] * [0.0, 0.1, 0.01]
    for k in range(20):
        window = compose(turns[k], straight[max(k - 1, 0) : k + 1])
        road: Any = SimpleNamespace(closed=False, poses=window, smoother=SimpleNamespace(first_cycle=18))
        record.estimated(road)
    found = record.with_newest_path(road, 10.0)
    np.testing.assert_allclose(found[10:], compose(turns[-1], straight[10:]))
    np.testing.assert_allclose(found[:10], compose(turns[:10], straight[:10]))


def test_orange_cones_go_with_the_poses_of_another_map(monkeypatch: pytest.MonkeyPatch) -> None:
    road, drive = Road(MapperSettings()), Drive(MapperSettings())
    road.smoother.variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    cone = Detections(0.1, np.array([[6.0, 2.0]]), 0.01 * np.eye(2)[None], np.array([ORANGE]))
    road.orange.add(cone, 1, np.zeros(3), np.array([1.0, 0.0, 0.0]))
    monkeypatch.setattr(drives, "take_marginal", lambda *_: np.zeros(3))
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.3], [2.0, 0.4, 0.3]])
    solved: Any = SimpleNamespace(closed=False, seconds=0.1, poses=poses, first_kept=2)
    drive.take(road, solved)
    np.testing.assert_array_equal(road.orange.pose, poses[1:2])


# --- noise -----------------------------------------------------------------------------------------------


def test_a_lap_is_solved_with_the_noise_that_is_known_when_it_closes() -> None:
    """Cycle 0 was driven with the stated noise, before any was measured: it counts as the others do."""
    stated, drift = np.array([0.01, 0.01, 0.002]), np.array([0.05, 0.05, 0.0017])
    front_end = FrontEnd(MapperSettings(noise="measured"), KnownNoise(stated))
    noise, record = front_end.noise, DriveRecord()
    cone = Detections(0.2, np.array([[6.0, 2.0]]), 1e-4 * np.eye(2)[None], np.array([LEFT]))
    twist = np.array([[SPEED, 0.0, 0.3]] * 4)
    for k in range(2):
        odometry = Odometry(0.2 * k + np.array([0.0, 0.05, 0.1, 0.15]), twist)
        record.measured(front_end.update(odometry, replace(cone, t=0.2 * (k + 1))))
    along, across = RayNoise(np.array([0.1, 0.05])), RayNoise(np.array([0.0, 0.02]))
    noise.measured = MeasuredNoise(stated, drift, 0.05, along, across)
    lap = record.lap(0, None, (AGAIN,), MapperSettings(), noise)
    expected = integrate_twists(np.full(4, 0.05), twist, np.hypot(stated, drift / np.sqrt(0.05)))
    found = lap.chain.odometry.intervals[0].covariance
    np.testing.assert_allclose(found, expected.covariance, atol=2.0 * MIN_SIGMA**2)
    np.testing.assert_array_equal(lap.detections.covariance, noise.for_map(cone).covariances[[0, 0]])
    assert lap.detections.covariance[0, 0, 0] > 100.0 * cone.covariances[0, 0, 0]
