"""The calibrations in a batch: the prior, the keys, and a search that begins without errors."""

from __future__ import annotations

import numpy as np

from pathspace_graph.front_end.log_odometry import no_errors, sensor_prior, sensor_prior_cost
from pathspace_graph.graph.keys import CALIBRATION_KEY, SENSOR_KEY, control_keys, pose_keys
from pathspace_graph.graph.variables import Variables
from pathspace_graph.settings.calibration import CalibrationSettings

KNOWN, ESTIMATED = CalibrationSettings(sensor=False), CalibrationSettings()


def test_a_search_begins_without_errors_of_what_is_estimated() -> None:
    np.testing.assert_array_equal(no_errors(KNOWN), np.zeros(2))
    np.testing.assert_array_equal(no_errors(ESTIMATED), np.zeros(7))


def test_both_calibrations_are_one_view() -> None:
    variables = Variables()
    variables.insert_calibrations(np.arange(7.0))
    variables.insert(control_keys(0, np.arange(2)), np.zeros(4))
    variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    np.testing.assert_array_equal(variables.calibrations, np.arange(7.0))
    np.testing.assert_array_equal(variables.calibration_keys, [CALIBRATION_KEY, SENSOR_KEY])
    variables.calibrations[:] = 1.0
    np.testing.assert_array_equal(variables.calibration, 1.0)
    np.testing.assert_array_equal(variables.sensor, 1.0)


def test_the_prior_counts_in_its_sigmas() -> None:
    variables = Variables()
    variables.insert_calibrations(np.concatenate([np.zeros(2), 2.0 * np.array(ESTIMATED.sigmas)]))
    (rows,) = sensor_prior(variables, ESTIMATED)
    np.testing.assert_allclose(rows.residual, 2.0)
    np.testing.assert_allclose(np.diag(rows.jacobian) * ESTIMATED.sigmas, 1.0)
    assert sensor_prior_cost(variables, ESTIMATED) == 0.5 * 5 * 4.0


def test_a_sensor_that_is_known_has_no_prior() -> None:
    variables = Variables()
    variables.insert_calibrations(np.zeros(2))
    assert sensor_prior(variables, KNOWN) == []
    assert sensor_prior_cost(variables, KNOWN) == 0.0
    np.testing.assert_array_equal(variables.calibration_keys, [CALIBRATION_KEY])
