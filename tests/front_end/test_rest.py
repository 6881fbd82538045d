"""A vehicle at rest: it does not move, and it measures the bias of its yaw rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.baselines.filters import CkfMapper
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.factors.noise import TwistNoise
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.front_end.log_odometry import half_square, mean_bias
from pathspace_graph.front_end.motion import MotionCheck, Standstill
from pathspace_graph.graph.variables import CALIBRATION_KEY
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.mapping.motion import BiasMeasurement
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import MotionSettings
from pathspace_graph.sim.faults import Faults, OdometryFaults
from pathspace_graph.sim.sensor import OdometryNoise
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.vehicle import VehicleSettings

from ..scenes.drives import bean_track

BIAS = 0.02
REST = 8.0
SIGMA = np.array([0.25, 0.12, 0.035])


@pytest.fixture(scope="module")
def log() -> Log:
    """A vehicle stands for 8 s and drives 4 s then; its yaw rate is 0.02 rad/s too high."""
    settings = SimulationSettings(
        laps=1,
        vehicle=VehicleSettings(rest=REST),
        odometry=OdometryNoise(scale=0.0, gyro_bias=0.0),
        faults=Faults(odometry=OdometryFaults(yaw_rate_bias=BIAS)),
    )
    whole = simulate(bean_track(), settings, seed=2)
    return replace(whole, cycles=tuple(c for c in whole.cycles if c.t < REST + 4.0))


def test_the_bias_is_measured_and_the_vehicle_does_not_move(log: Log) -> None:
    check = MotionCheck(TwistNoise(log.odometry_sigma), MotionSettings())
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(log)]
    measured = mean_bias([motion.bias for motion in motions if motion.bias])
    assert measured is not None
    assert measured.sigma == pytest.approx(0.035 / np.sqrt(50.0 * REST), rel=0.2)
    assert measured.value == pytest.approx(BIAS, abs=3.0 * measured.sigma)
    standing = [m for m, c in zip(motions, log.cycles, strict=True) if 1.2 < c.t < REST - 0.01]
    for motion in standing:
        np.testing.assert_array_equal(motion.odometry.delta, 0.0)
    stamps = np.array([c.t for m, c in zip(motions, log.cycles, strict=True) if m.bias])
    assert len(stamps) == REST and (np.diff(stamps) > 0.99).all()  # each is of a second's readings
    late = [m for m, c in zip(motions, log.cycles, strict=True) if c.t > REST + 1.0]
    assert not any(motion.bias for motion in late)
    assert all(motion.odometry.delta[0] > 0.1 for motion in late)


@pytest.mark.parametrize("make", [FixedLagMapper, LandmarkFixedLag])
def test_an_estimator_knows_the_bias_when_it_leaves(log: Log, make: type) -> None:
    standing = replace(log, cycles=tuple(c for c in log.cycles if c.t < REST))
    estimator = make(MapperSettings(), log.odometry_sigma)
    run = run_online(standing, estimator)
    assert run.vehicle is not None
    bias, sigma = run.vehicle.calibration[1], np.sqrt(run.vehicle.covariance[4, 4])
    assert sigma < 0.0025
    assert bias == pytest.approx(BIAS, abs=3.0 * sigma)
    assert np.abs(run.trajectory[-1]).max() < 0.15


def test_a_filter_takes_the_bias_together_with_its_prior(log: Log) -> None:
    """A filter does not doubt its prior, so the estimate is the mean of both by their information."""
    filtered = CkfMapper(MapperSettings(), log.odometry_sigma)
    run_online(replace(log, cycles=tuple(c for c in log.cycles if c.t < REST)), filtered)
    measured = judge_log(log, log.noise, MapperSettings()).chain.bias
    assert measured is not None
    share = measured.sigma**-2 / (measured.sigma**-2 + MapperSettings().odometry.sigma_bias ** -2)
    assert filtered.vehicle_state().calibration[1] == pytest.approx(share * measured.value, rel=0.15)


def test_a_log_has_the_mean_of_all_that_was_measured_at_rest(log: Log) -> None:
    chain = judge_log(log, log.noise, MapperSettings()).chain
    assert chain.bias is not None
    off = np.array([0.0, chain.bias.value + chain.bias.sigma])
    at_mean = half_square(chain.priors(chain.first, np.array([0.0, chain.bias.value])))
    prior = 0.5 * (off[1] ** 2 - chain.bias.value**2) / chain.calibration_sigma[1] ** 2
    assert half_square(chain.priors(chain.first, off)) - at_mean == pytest.approx(0.5 + prior)
    *_, measured = chain.priors(chain.first, off)
    assert measured.keys[0, 0] == CALIBRATION_KEY
    np.testing.assert_allclose(measured.residual, [1.0])


def test_means_are_weighted_by_information() -> None:
    mean = mean_bias([BiasMeasurement(1.0, 1.0), BiasMeasurement(4.0, 0.5)])
    assert mean is not None
    assert mean.value == pytest.approx((1.0 + 4.0 * 4.0) / 5.0)
    assert mean.sigma == pytest.approx(5.0**-0.5)
    assert mean_bias([]) is None


def test_the_motion_in_which_a_rest_ends_may_have_missed_the_start(log: Log) -> None:
    check = MotionCheck(TwistNoise(log.odometry_sigma), MotionSettings())
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(log)]
    sigmas = np.array([np.sqrt(np.diag(motion.odometry.covariance)) for motion in motions])
    starts = np.flatnonzero(sigmas[:, 0] > 0.2)
    assert len(starts) == 1, "one rest ends"
    assert log.cycles[int(starts[0])].t == pytest.approx(REST, abs=0.5)
    np.testing.assert_allclose(sigmas[starts[0]], np.hypot([0.3, 0.05, 0.0], sigmas[starts[0] + 1]), rtol=0.1)
    again = motions[int(starts[0])].with_noise(TwistNoise(2.0 * log.odometry_sigma))
    assert again.odometry.covariance[0, 0] > 0.3**2, "measured noise does not forget it"


def test_a_vehicle_that_creeps_is_not_at_rest() -> None:
    rest, rng = Standstill(), np.random.default_rng(0)
    told = []
    for k in range(40):
        t = 0.1 * k + 0.02 * np.arange(5)
        twist = np.array([0.3, 0.0, 0.0]) + SIGMA * rng.standard_normal((5, 3))
        told.append(rest.by_twists(Odometry(t, twist), 0.1 * (k + 1), TwistNoise(SIGMA)))
    assert not any(told[12:])


def test_detections_that_move_past_deny_a_rest(log: Log) -> None:
    """The wheels are locked and the yaw rate is right, while the vehicle slides on."""
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(speed_start=6.0))
    sliding = simulate(bean_track(), settings, seed=0)
    twist = sliding.odometry.twist.copy()
    rng = np.random.default_rng(1)
    twist[:] = SIGMA * rng.standard_normal(twist.shape)
    check = MotionCheck(TwistNoise(sliding.odometry_sigma), MotionSettings())
    wrong = replace(sliding, odometry=Odometry(sliding.odometry.t, twist))
    motions = [check.update(odometry, cycle) for odometry, cycle in split_odometry(wrong)]
    assert not any(motion.bias for motion in motions)
