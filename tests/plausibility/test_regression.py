"""The regression: motions by the cones alone, and factors that are found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph import hints
from pathspace_graph.factors.se2 import relative, se2_exp, to_vehicle
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.plausibility.judge import SPEED_UNITS, Hint, objections, unit_of
from pathspace_graph.plausibility.regression import (
    Fit,
    Motions,
    Regression,
    far_better,
    mean_twist,
    motions_of,
    register,
)

from ..scenes.drives import short_drive
from .mistakes import late, with_twists_of

CONES = np.array([[2.0, 2.0], [6.0, 2.2], [10.0, 2.0], [2.5, -1.9], [7.0, -2.0], [11.0, -2.1], [14.0, 1.0]])
STILL = [np.zeros(3)]


def seen(pose: np.ndarray, mirror: float = 1.0) -> Detections:
    points = to_vehicle(CONES, np.tile(pose, (len(CONES), 1))) * [1.0, mirror]
    return Detections(0.0, points, np.tile(0.01 * np.eye(2), (len(CONES), 1, 1)), np.zeros(len(CONES), int))


# --- motions ---------------------------------------------------------------------------------------------


@given(st.floats(-20.0, 20.0), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0))
def test_the_twist_of_a_motion_leads_to_it(vx: float, vy: float, rate: float) -> None:
    motion = se2_exp(0.3 * np.array([[vx, vy, rate]]))[0]
    np.testing.assert_allclose(mean_twist(motion, 0.3), [vx, vy, rate], atol=1e-6)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("motion", [(1.0, 0.1, 0.1), (-0.7, 0.0, -0.15), (2.0, 0.3, 0.1)])
def test_a_motion_is_found_without_odometry_also_in_a_mirrored_frame(
    motion: tuple[float, float, float], mirror: float
) -> None:
    begin, end = np.array([1.0, 0.2, 0.1]), np.array([1.0, 0.2, 0.1]) + motion
    share, found, _ = register(seen(begin, mirror), seen(end, mirror), STILL, 6.0, 4)
    assert share == 1.0
    np.testing.assert_allclose(found, relative(begin, end) * [1.0, mirror, mirror], atol=1e-3)


def test_too_few_cones_tell_no_motion() -> None:
    few = seen(np.zeros(3)).where(np.arange(len(CONES)) < 3)
    assert register(few, few, STILL, 6.0, 4)[0] == 0.0
    assert register(few, few, STILL, 6.0, 3)[0] == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_motions_of_a_log_do_not_depend_on_its_odometry(seed: int) -> None:
    """Between cycles 0.4 s apart a row may be registered a cone too far, which is 10 m/s at 4 m."""
    log = short_drive()
    noise = np.random.default_rng(seed).normal(0.0, (20.0, 20.0, 2.0), log.odometry.twist.shape)
    alone, wrong = motions_of(log), motions_of(with_twists_of(log, noise))
    assert len(wrong.rate) > 0.8 * len(alone.rate)
    v, w = Regression(log.odometry, wrong).stated("twist", 0.0)
    near = wrong.end - wrong.begin < 0.3
    assert near.sum() > 0.6 * len(near)
    for right, least, least_near in (
        (np.abs(wrong.velocity - v) < 2.5, 0.75, 0.85),
        (np.abs(wrong.rate - w) < 0.4, 0.85, 0.85),
    ):
        assert right.mean() > least
        assert right[near].mean() > least_near


# --- factors ---------------------------------------------------------------------------------------------

T = np.arange(0.0, 40.0, 0.02)
ODOMETRY = Odometry(T, np.column_stack([8.0 + 2.0 * np.sin(T), 0.3 * np.cos(T), np.sin(0.7 * T)]))


def moved(fit: Fit, odometry: Odometry = ODOMETRY, noise: float = 0.0) -> Regression:
    """The regression of motions that a fit explains, up to white noise (m/s)."""
    begin = np.arange(3.0, 35.0, 0.1)
    count, rng = len(begin), np.random.default_rng(0)
    covariance = np.tile(np.diag([0.01, 0.01, 1e-4]), (count, 1, 1))
    empty = Motions(begin, begin + 0.1, np.zeros(count, complex), np.zeros(count), covariance, count)
    v, w = Regression(odometry, empty).predicted(fit)
    v = v + noise * (rng.normal(size=count) + 1j * rng.normal(size=count))
    return Regression(odometry, replace(empty, velocity=v, rate=w))


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.01, 50.0),
    st.floats(-3.1, 3.1),
    st.sampled_from([1.0, -1.0, 57.3, 0.0175]),
    st.floats(-3.0, 3.0),
)
def test_factors_are_found_again(size: float, angle: float, rate: float, place: float) -> None:
    true = Fit(gain=complex(size * np.exp(1j * angle)), rate=rate, lever=place + 0.5j)
    found = moved(true).fit("twist", 0.0)
    assert found.gain == pytest.approx(true.gain, rel=1e-3)
    assert found.rate == pytest.approx(true.rate, rel=1e-3)
    assert found.lever * found.rate == pytest.approx(true.lever * true.rate, abs=0.02 * abs(rate) + 0.02)


def test_a_third_of_wild_motions_does_not_change_the_factors() -> None:
    regression = moved(Fit(gain=0.28))
    velocity = regression.motions.velocity.copy()
    velocity[::3] = 0.0
    spoiled = Regression(ODOMETRY, replace(regression.motions, velocity=velocity)).fit("twist", 0.0)
    assert spoiled.gain == pytest.approx(0.28, abs=0.01)


@pytest.mark.parametrize("lag", [-4.0, -0.5, 0.0, 0.5, 3.0])
def test_the_lag_is_found(lag: float) -> None:
    fit, why = moved(Fit(lag=lag, gain=2.0), noise=0.1).best()
    assert fit.lag == pytest.approx(lag, abs=0.02)
    assert ("lag" in why) == (lag != 0.0)
    assert "content" not in why


@pytest.mark.parametrize("tau", [-0.08, 0.03])
def test_a_small_lag_is_estimated_with_its_sigma(tau: float) -> None:
    found, sigma = moved(Fit(lag=tau), noise=0.2).lag(Fit())
    assert abs(found - tau) < 4.0 * sigma < 0.05


def test_a_jump_of_the_lag_is_found_and_none_where_there_is_none() -> None:
    early, late_ = moved(Fit()).motions, moved(Fit(lag=1.0)).motions
    first = early.begin < 20.0
    velocity, rate = np.where(first, early.velocity, late_.velocity), np.where(first, early.rate, late_.rate)
    regression = Regression(ODOMETRY, replace(early, velocity=velocity, rate=rate))
    fit, _ = regression.best()
    when, before, after, shares, constant = regression.jump(fit)
    assert (before, after) == (0.0, 1.0)
    assert when == pytest.approx(20.0, abs=0.5)
    assert far_better(shares, regression.explained(fit).both) is not None
    assert far_better(shares, constant) is not None
    good = moved(Fit(), noise=0.2)
    assert far_better(good.jump(Fit())[3], good.explained(Fit()).both) is None


# --- what is far better ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "is_better"), [(33, False), (34, True)])
def test_what_may_be_chance_is_not_better(count: int, is_better: bool) -> None:
    """A coin falls 34 times on one side once in 1.7e10, which is less than once in 1e10."""
    one, other = np.full(count, 0.9), np.full(count, 0.1)
    assert (far_better(one, other) is not None) == is_better


@pytest.mark.parametrize(("share", "is_better"), [(0.53, False), (0.55, True)])
def test_a_better_reading_explains_nearly_twice_as_much(share: float, is_better: bool) -> None:
    assert (far_better(np.full(99, share), np.full(99, 0.3)) is not None) == is_better


@pytest.mark.parametrize(
    ("size", "name"),
    [(0.278, "km/h"), (0.24, "km/h"), (0.0119, "cm/s"), (1.55, ""), (0.65, ""), (1.65, "units of 1.65")],
)
def test_a_factor_is_a_unit_or_told_by_its_size_or_left_to_the_calibration(size: float, name: str) -> None:
    assert unit_of(size, SPEED_UNITS)[0] == name


# --- whole logs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wz", ["zero", "noise", "constant"])
def test_a_yaw_rate_that_is_missing_is_told(wz: str) -> None:
    log = short_drive()
    noise = np.random.default_rng(0).normal(0.0, 0.01, len(log.odometry.t))
    twist = log.odometry.twist.copy()
    twist[:, 2] = {"zero": 0.0 * noise, "noise": noise, "constant": 0.0 * noise + 0.1}[wz]
    (found,) = hints(with_twists_of(log, twist))
    assert found.likely.startswith("the yaw rate is missing")


def driven_back(log: Log, begin: float, end: float) -> Log:
    """The vehicle drives until the end of a stretch (s), back to its begin, and on again."""
    odometry, back = log.odometry, 2.0 * end + 1e-3
    t, twist = odometry.t, odometry.twist
    first, again, rest = t <= end, (t >= begin) & (t <= end), t > begin
    more = back - 2.0 * begin + 1e-3
    stamps = np.concatenate([t[first], back - t[again][::-1], t[rest] + more])
    cycles = [cycle for cycle in log.cycles if cycle.t <= end]
    cycles += [replace(cycle, t=back - cycle.t) for cycle in log.cycles[::-1] if begin <= cycle.t <= end]
    cycles += [replace(cycle, t=cycle.t + more) for cycle in log.cycles if cycle.t > begin]
    twists = np.vstack([twist[first], -twist[again][::-1], twist[rest]])
    kept = np.append(True, np.diff(stamps) > 0.0)
    within = tuple(cycle for cycle in cycles if cycle.t <= stamps[-1])
    return replace(log, odometry=Odometry(stamps[kept], twists[kept]), cycles=within, truth=None)


def test_a_speed_without_its_sign_is_told_where_the_vehicle_drives_back() -> None:
    good = driven_back(short_drive(), 6.0, 14.0)
    assert hints(good) == []
    twist = good.odometry.twist
    (found,) = hints(with_twists_of(good, np.column_stack([np.abs(twist[:, 0]), twist[:, 1:]])))
    assert found.likely.startswith("the speed has no sign")


@pytest.mark.parametrize(("seconds", "told"), [(0.12, False), (0.3, True)])
def test_a_lag_is_told_beyond_what_the_calibration_finds(seconds: float, told: bool) -> None:
    assert [hint.cause for hint in hints(late(short_drive(), seconds))] == (["clocks"] if told else [])


def test_odometry_that_creeps_while_the_vehicle_stands_is_no_jump_of_a_clock() -> None:
    log = short_drive()
    end, dt = float(log.odometry.t[-1]), 0.02
    t = end + dt * np.arange(1, 250)
    creeping = np.vstack([log.odometry.twist, np.tile([0.6, 0.0, 0.0], (len(t), 1))])
    last = log.cycles[-1]
    standing = tuple(replace(last, t=one) for one in t[::5].tolist())
    odometry = Odometry(np.append(log.odometry.t, t), creeping)
    assert hints(replace(log, odometry=odometry, cycles=(*log.cycles, *standing), truth=None)) == []


def test_odometry_of_another_drive_is_told() -> None:
    log = short_drive()
    backward = replace(log.odometry, twist=log.odometry.twist[::-1])
    assert [hint.cause for hint in hints(replace(log, odometry=backward))] == ["unexplained"]


def test_only_what_spoils_the_map_is_an_objection() -> None:
    def hint(cause: str) -> Hint:
        return Hint(cause, "file", "columns", "found", f"{cause} are wrong", "advice")

    assert objections([hint("labels"), hint("sides"), hint("noise")]) == []
    assert objections([hint("labels"), hint("speeds")]) == ["not a map of the drive: speeds are wrong"]
