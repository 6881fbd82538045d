"""Cycles that are counted on from drive to drive, and what the sensor of each drive has seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    ONE_DRIVE,
    SENSOR_KEY,
    Drives,
    Variables,
    control_keys,
    of_sensor,
    pose_keys,
)

Array = NDArray[np.float64]

THREE = Drives(first=(0, 4, 6), sensors=(0, 1, 0))


def test_each_cycle_is_of_the_drive_that_began_last() -> None:
    assert THREE.of(np.array([0, 3, 4, 5, 6, 9])).tolist() == [0, 0, 1, 1, 2, 2]
    assert [(part.start, part.stop) for part in THREE.parts(10)] == [(0, 4), (4, 6), (6, 10)]
    assert np.flatnonzero(THREE.begins(10)).tolist() == [3, 5]  # of the steps to a next pose
    assert THREE.longest(9) == slice(0, 4)
    assert ONE_DRIVE.parts(7) == [slice(0, 7)] and not ONE_DRIVE.begins(7).any()


def test_terms_come_back_in_the_order_of_the_cycles_each_by_its_sensor() -> None:
    """The first and the third drive share a sensor; the cycles are in no order."""
    cycles, calibrations = np.array([8, 4, 0, 5, 6]), np.arange(10.0)

    def terms(own: NDArray[np.intp] | slice, sensor: Array) -> tuple[Array, Array]:
        return cycles[own] + 0.0, np.full(len(cycles[own]), sensor[0])

    same, sensor = THREE.by_sensor(terms, cycles, calibrations)
    np.testing.assert_array_equal(same, cycles)
    np.testing.assert_array_equal(sensor, [0.0, 5.0, 0.0, 5.0, 0.0])


def test_a_sensor_that_is_not_estimated_has_no_calibration() -> None:
    assert of_sensor(np.zeros(0), 3).size == 0


def test_every_sensor_has_five_entries_and_every_odometry_two() -> None:
    variables = Variables()
    variables.insert(CALIBRATION_KEY + np.arange(3), np.arange(6.0))
    variables.insert(SENSOR_KEY + np.arange(2), np.arange(10.0))
    variables.insert(control_keys(0, np.arange(2)), np.zeros(4))
    variables.insert(pose_keys(np.arange(2)), np.zeros(6))
    assert variables.layout.widths.tolist() == [2, 2, 2, 5, 5, 2, 2, 3, 3]
    assert variables.calibrations.tolist() == [*np.arange(6.0), *np.arange(10.0)]
    assert len(variables.calibration_keys) == 5
    assert len(variables.layout.turning) == 4  # two points and two poses
