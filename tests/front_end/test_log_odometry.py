"""The calibrations in a batch: the priors, and the keys."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.front_end.log_odometry import chained, half_square, sensor_prior
from pathspace_graph.graph.variables import SENSOR_KEY, Variables, pose_keys
from pathspace_graph.io.log import Odometry
from pathspace_graph.mapping.motion import integrate_odometry
from pathspace_graph.settings.mapper import CalibrationSettings, OdometrySettings

KNOWN, ESTIMATED = CalibrationSettings(sensor=False), CalibrationSettings()


def test_the_prior_counts_from_its_mean_in_its_sigmas() -> None:
    known = CalibrationSettings(yaw=0.02, lateral=-0.3, latency=0.05, range_scale=-0.04, range_bias=0.1)
    off = np.array([1.0, -2.0, 3.0, 0.0, 1.0])
    rows = sensor_prior(np.array([0.02, -0.3, 0.05, -0.04, 0.1] + off * known.sigmas), known, 3)
    np.testing.assert_allclose(np.diag(rows.jacobian) * known.sigmas, 1.0)
    np.testing.assert_array_equal(rows.keys, SENSOR_KEY + 3)
    np.testing.assert_allclose(rows.residual, off, atol=1e-12)
    assert half_square([rows]) == pytest.approx(0.5 * 15.0)


@pytest.mark.parametrize(("settings", "keys"), [(KNOWN, 1), (ESTIMATED, 2)])
def test_a_sensor_that_is_known_has_no_prior(settings: CalibrationSettings, keys: int) -> None:
    still = integrate_odometry(Odometry(np.zeros(1), np.zeros((1, 3))), 0.1, np.ones(3))
    chain = chained([0.1], [still], OdometrySettings())
    variables = Variables()
    variables.insert_calibrations(np.zeros(2 + 5 * settings.sensor))
    variables.insert(pose_keys(np.arange(1)), np.zeros(3))
    owned = {int(key) for rows in chain.rows_at(variables, settings) for key in rows.keys.ravel()}
    assert owned == {*variables.calibration_keys.tolist(), int(pose_keys(np.arange(1))[0])}
    assert len(variables.calibration_keys) == keys


def test_the_first_pose_is_as_uncertain_as_the_start_and_the_odometry_since() -> None:
    """It stands for 2 s until its first cycle, by a twist with sigmas of 3 m/s, 1 m/s and 0.5 rad/s."""
    odometry = Odometry(np.zeros(1), np.zeros((1, 3)))
    step = integrate_odometry(odometry, 2.0, np.array([3.0, 1.0, 0.5]))
    settings = OdometrySettings()
    chain = chained([2.0], [step], settings)
    variances = np.square(settings.sigmas_start) + np.array([36.0, 4.0, 1.0])
    np.testing.assert_allclose(np.linalg.inv(chain.first_information), np.diag(variances), rtol=1e-6)
