"""Several drives as one problem: its rows, what each drive keeps for itself, and what is better together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.association import Cones, first_parameter, seen_by_most
from pathspace_graph.batch.joint import (
    OTHER_TRACK,
    PlacedDrive,
    drives_of,
    joint_state,
    joint_system,
    solve_together,
)
from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.batch.system import Optimizer
from pathspace_graph.batch.system import moved as stepped
from pathspace_graph.errors import SettingsError, SolveError
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.eval.metrics.alignment import shape_rmse
from pathspace_graph.eval.metrics.trajectory import position_rms, trajectory_errors
from pathspace_graph.factors.se2 import inverse
from pathspace_graph.graph.variables import CALIBRATION_KEY, SENSOR_KEY
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings

from .several import alone, lap, together, true_start

Array = NDArray[np.float64]


def placed(*vehicles: str) -> list[PlacedDrive]:
    """Returns drives of the first log, all where it is."""
    return [PlacedDrive(str(k), alone(lap(0)), np.zeros(3), name) for k, name in enumerate(vehicles)]


def test_drives_of_one_vehicle_share_its_sensor() -> None:
    drives = drives_of(placed("red", "", "red", ""))
    cycles = len(lap(0).cycles)
    assert drives.first == (0, cycles, 2 * cycles, 3 * cycles)
    assert drives.sensors == (0, 1, 0, 2)


def test_one_drive_is_the_problem_that_it_is_alone() -> None:
    """From its optimum the search goes nowhere."""
    (one,) = placed("")
    at, convergence = Optimizer(joint_system([one])).find(joint_state([one], one))
    assert convergence.converged
    assert at.cost == pytest.approx(one.alone.cost, rel=0.01)
    np.testing.assert_allclose(at.state.poses, one.state.poses, atol=0.03)


def test_the_rows_are_the_derivatives_of_every_drives_residuals() -> None:
    """The odometry of each drive depends on its own calibration, and the sensors' priors on their own."""
    drives = placed("", "", "")
    system, state = joint_system(drives), joint_state(drives, drives[0])
    layout, rng = state.variables.layout, np.random.default_rng(0)
    step = 1e-6 * rng.normal(size=layout.size)
    before, after = system.drive_rows(state), system.drive_rows(stepped(state, step))
    for rows, changed in zip(before, after, strict=True):
        for k in range(len(rows)):
            entries = layout.entries(rows.keys[k])
            expected = rows.residual[k] + rows.jacobian[k] @ step[entries]
            assert changed.residual[k] == pytest.approx(expected, abs=1e-6 * (1.0 + abs(expected)))
    keys = {int(key) for rows in before for key in np.unique(rows.keys)}
    assert keys >= {CALIBRATION_KEY, CALIBRATION_KEY + 2, SENSOR_KEY, SENSOR_KEY + 2}


def test_odometry_of_two_drives_is_in_one_factor_only_where_they_meet() -> None:
    """A factor across two groups of poses takes twice the time."""
    drives = placed("", "")
    rows = joint_system(drives).drive_rows(joint_state(drives, drives[0]))
    odometry = [one.owner for one in rows if one.keys.shape[1] == 3]
    assert len(odometry) == 2
    assert len(np.intersect1d(*odometry)) <= 1


def test_wider_priors_of_one_drive_are_those_of_its_calibrations_alone() -> None:
    drives = placed("", "")
    system, state = joint_system(drives), joint_state(drives, drives[0])
    before = system.drive_rows(state)
    settings = drives[1].settings
    odometry, sensor = settings.odometry, settings.calibration
    wide = replace(
        settings,
        odometry=replace(
            odometry, sigma_scale=2.0 * odometry.sigma_scale, sigma_bias=2.0 * odometry.sigma_bias
        ),
        calibration=replace(sensor, sigma_yaw=2.0 * sensor.sigma_yaw),
    )
    system.widen_priors(1, wide)
    for old, new in zip(before, system.drive_rows(state), strict=True):
        keys = np.unique(old.keys)
        ratio = np.ones(len(old.residual))
        if np.array_equal(keys, [CALIBRATION_KEY + 1]) and len(ratio) == 2:
            ratio[:] = 2.0
        elif np.array_equal(keys, [SENSOR_KEY + 1]):
            ratio[0] = 2.0
        np.testing.assert_allclose(ratio[:, None] * new.jacobian, old.jacobian, rtol=1e-12)


def test_the_sensor_of_a_vehicle_begins_at_the_mean_of_its_drives() -> None:
    one, other = alone(lap(0)), alone(lap(1, 9.0))
    drives = [PlacedDrive(str(k), result, np.zeros(3), "red") for k, result in enumerate((one, other))]
    sensors = [result.optimum.state.variables.sensor for result in (one, other)]
    assert np.abs(sensors[0] - sensors[1]).max() > 1e-4
    state = joint_state(drives, drives[0])
    np.testing.assert_allclose(state.variables.sensor, 0.5 * (sensors[0] + sensors[1]))


def test_only_the_first_drive_has_a_first_pose() -> None:
    drives = placed("", "")
    rows = joint_system(drives).drive_rows(joint_state(drives, drives[0]))
    alone_on_poses = [one.keys[0, 0] for one in rows if one.keys.shape[1] == 1 and len(one.jacobian[0]) == 3]
    assert len(alone_on_poses) == 1


# --- the result ------------------------------------------------------------------------------------------


def truth_of(log: Log) -> object:
    assert log.truth is not None
    return log.truth


def test_a_drive_of_another_track_is_left_out() -> None:
    result = together()
    assert [*result.drives] == ["first", "elsewhere"]
    assert result.left_out == {"other": OTHER_TRACK}


def test_each_drive_is_where_it_began_in_the_frame_of_the_first() -> None:
    result = together()
    np.testing.assert_allclose(result.frames["first"], 0.0, atol=1e-6)
    off = result.frames["elsewhere"] - true_start(lap(1), 9.0)
    assert np.hypot(*off[:2]) < 0.25
    assert abs(np.sin(off[2])) < 0.02


def test_the_map_is_better_than_those_of_the_drives_alone() -> None:
    """The shape is: where the frame lies depends on the first pose of the first drive alone."""
    result, logs = together(), {"first": lap(0), "elsewhere": lap(1, 9.0)}
    shapes = [shape_rmse(alone(log).map, truth_of(log)) for log in logs.values()]
    track = result.drives["first"].map
    assert track.closed
    assert shape_rmse(track, truth_of(lap(0))) < 0.9 * np.mean(shapes)
    for name, log in logs.items():
        own = result.drives[name].moved(inverse(result.frames[name]))
        metrics = lap_metrics(own.map, truth_of(log), 1)
        assert metrics.missed == 0.0 and metrics.rmse < 0.25
        assert position_rms(trajectory_errors(own.trajectory_t, own.trajectory, truth_of(log))) < 0.35


def test_each_drive_has_its_own_calibration_and_covariances() -> None:
    result = together()
    for name, log in {"first": lap(0), "elsewhere": lap(1, 9.0)}.items():
        drive, truth = result.drives[name], truth_of(log)
        found = drive.vehicle
        off = (drive.calibration - truth.calibration) / found.sigmas[3:]
        assert np.abs(off).max() < 4.0
        assert len(drive.trajectory) == len(drive.cycles) == len(drive.pose_covariances) == len(log.cycles)
        assert np.linalg.eigvalsh(drive.pose_covariances).min() > 0.0
    first, second = (one.calibration for one in result.drives.values())
    assert np.abs(first - second).max() > 1e-4


def test_the_graph_of_several_drives_is_refused() -> None:
    with pytest.raises(SettingsError, match="expected the batch of one drive, found 2 drives"):
        together().drives["first"].graph()


class Solved(BatchMapper):
    """A mapper that knows the result of a log already, or that there is none."""

    def solve(self, log: Log, *_: Any) -> BatchResult:
        if log is lap(0):
            raise SolveError("no way to an optimum")
        return alone(log)


def test_a_log_that_cannot_be_solved_alone_is_left_out() -> None:
    def mapper(settings: MapperSettings, log: Log) -> BatchMapper:
        return Solved(settings)

    result = solve_together({"broken": lap(0), "good": lap(1, 9.0)}, mapper)
    assert [*result.drives] == ["good"]
    assert result.left_out == {"broken": "no way to an optimum"}
    with pytest.raises(SolveError, match="no way to an optimum"):
        solve_together({"broken": lap(0)}, mapper)


def test_a_cone_that_most_drives_have_not_seen_is_none() -> None:
    """Of three drives one has seen a cone beside the road; a second one would make it a half."""
    drives = placed("", "", "")
    system, state = joint_system(drives), joint_state(drives, drives[0])
    label, starts = next(iter(state.boundaries)), np.array(state.drives.first)
    curve = state.spline(label)
    u = curve.domain[0] + 5.0
    cone = Cones(curve.evaluate(np.array([u])), np.array([u - first_parameter(state, label)]), np.array([6]))
    seen = np.repeat(cone.points, 6, axis=0)
    for cycles, stands in ((np.repeat(starts[0], 6), False), (np.repeat(starts[:2], 3), True)):
        found = seen_by_most(state, label, cone, seen, cycles, system.settings)
        assert found.tolist() == [stands]
