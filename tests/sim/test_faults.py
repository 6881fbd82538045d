"""Each fault does to a log what its setting says, by hand, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.sim.faults import Faults, OdometryFaults, SensorFaults, VehicleFaults, measure_odometry
from pathspace_graph.sim.sensor import OdometryNoise, SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import Track
from pathspace_graph.sim.vehicle import Trajectory, VehicleSettings

from ..scenes.drives import bean_track

SPEED = 10.0
EXACT = SensorSettings(
    range_sigma=1e-12,
    range_sigma_growth=0.0,
    bearing_sigma=1e-12,
    detection_probability=1.0,
    detection_falloff=0.0,
    blind_fraction=0.0,
    wrong_colour=0.0,
    false_positives=0.0,
)
"""This sensor sees every cone in its field as it is."""
STRAIGHT = SimulationSettings(
    laps=1, sensor=EXACT, vehicle=VehicleSettings(speed_max=SPEED, speed_start=SPEED, wander=0.0)
)
LAPS = SimulationSettings(laps=2)


def straight() -> Track:
    """A road along x, which the vehicle comes to from a centimetre beside it."""
    x = np.arange(0.0, 61.0, 3.0)
    rows = [np.column_stack([x, np.full(len(x), y)]) for y in (2.0, -2.0)]
    return Track(rows[0], rows[1], np.zeros((0, 2)), False, np.array([0.0, 0.01, 0.0]), "straight")


def drive(
    base: SimulationSettings,
    *,
    sensor: SensorFaults | None = None,
    odometry: OdometryFaults | None = None,
    vehicle: VehicleFaults | None = None,
) -> Log:
    """Returns a log with faults: of the straight, or of two laps of the bean."""
    faults = Faults(sensor or SensorFaults(), odometry or OdometryFaults(), vehicle or VehicleFaults())
    track = straight() if base is STRAIGHT else bean_track()
    return simulate(track, replace(base, faults=faults), seed=2)


@pytest.fixture(scope="module")
def clean_straight() -> Log:
    return drive(STRAIGHT)


@pytest.fixture(scope="module")
def clean() -> Log:
    return drive(LAPS)


def truth_of(log: Log) -> Truth:
    assert log.truth is not None
    return log.truth


def seen(log: Log) -> dict[tuple[float, int], np.ndarray]:
    """The detected point (2,) of each cone in each cycle, by stamp and cone."""
    associations = truth_of(log).associations
    assert associations is not None
    stamps = np.repeat([cycle.t for cycle in log.cycles], [len(cycle.labels) for cycle in log.cycles])
    points = np.concatenate([cycle.points_vehicle for cycle in log.cycles])
    return dict(zip(zip(stamps.tolist(), associations.tolist(), strict=True), points, strict=True))


def pairs(log: Log, other: Log, after: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) of the same cones in the same cycles of two logs, from a time (s) on."""
    a, b = seen(log), seen(other)
    both = [key for key in a if key in b and key[0] >= after]
    assert len(both) > 100
    return np.array([a[key] for key in both]), np.array([b[key] for key in both])


def same_cycles(log: Log, other: Log) -> bool:
    """Whether the cycles of `log` are among those of `other`, to the bit."""
    known = {cycle.t: cycle for cycle in other.cycles}
    return all(
        np.array_equal(cycle.points_vehicle, known[cycle.t].points_vehicle)
        and np.array_equal(cycle.labels, known[cycle.t].labels)
        for cycle in log.cycles
    )


def halfway(log: Log, laps: float) -> float:
    """The time (s) at which so many laps of the bean have been driven."""
    truth = truth_of(log)
    driven = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(truth.poses[:, :2], axis=0), axis=1)))
    return float(np.interp(laps * bean_track().centre_line.length, driven, truth.pose_t))


# --- the sensor ------------------------------------------------------------------------------------------


def turned(points: np.ndarray, yaw: float) -> np.ndarray:
    return points @ rotation(yaw)


def scaled(points: np.ndarray) -> np.ndarray:
    ranges = np.linalg.norm(points, axis=1)[:, None]
    return points / ranges * (1.02 * ranges + 0.4)


@pytest.mark.parametrize(
    ("fault", "expected", "atol"),
    [
        (SensorFaults(latency=0.05), lambda points: points - [-0.5, 0.0], 2e-3),  # at 10 m/s
        (SensorFaults(latency=-0.12), lambda points: points - [1.2, 0.0], 4e-3),
        (SensorFaults(yaw=0.035), partial(turned, yaw=0.035), 1e-6),  # more to the right
        (SensorFaults(lateral=0.2), lambda points: points - [0.0, 0.2], 1e-6),
        (SensorFaults(range_scale=0.02, range_bias=0.4), scaled, 1e-6),
    ],
    ids=["late", "early", "turned", "aside", "ranges"],
)
def test_a_constant_error_moves_each_detection_by_its_size(
    fault: SensorFaults, expected: Callable[[np.ndarray], np.ndarray], atol: float, clean_straight: Log
) -> None:
    found, true = pairs(drive(STRAIGHT, sensor=fault), clean_straight, after=2.0)
    np.testing.assert_allclose(found, expected(true), atol=atol)


def test_before_the_start_a_late_sensor_sees_what_it_sees_at_the_start(clean_straight: Log) -> None:
    late = drive(STRAIGHT, sensor=SensorFaults(latency=0.2))
    np.testing.assert_allclose(late.cycles[1].points_vehicle, late.cycles[0].points_vehicle, atol=1e-9)


def test_stamps_that_are_early_end_before_the_drive() -> None:
    laps = drive(LAPS, sensor=SensorFaults(latency=-0.12))
    end = laps.odometry.t[-1]
    assert end - 0.22 - 1e-9 < laps.cycles[-1].t <= end - 0.12


def test_a_share_of_the_detections_loses_its_colour_and_nothing_else(clean: Log) -> None:
    for share in (0.3, 1.0):
        faulty = drive(LAPS, sensor=SensorFaults(colourless=share))
        before, after = (np.concatenate([c.labels for c in log.cycles]) for log in (clean, faulty))
        lost = after == UNKNOWN
        assert np.mean(lost) == pytest.approx(share, abs=0.03)
        np.testing.assert_array_equal(after[~lost], before[~lost])
        np.testing.assert_array_equal(
            np.concatenate([c.points_vehicle for c in faulty.cycles]),
            np.concatenate([c.points_vehicle for c in clean.cycles]),
        )


def test_a_dropout_takes_the_cycles_of_its_time_and_no_others(clean: Log) -> None:
    faulty = drive(LAPS, sensor=SensorFaults(dropout=3.0, dropout_at=0.5))
    assert same_cycles(faulty, clean)
    missing = sorted({c.t for c in clean.cycles} - {c.t for c in faulty.cycles})
    assert len(missing) == 30
    assert missing[0] == pytest.approx(halfway(clean, 0.5), abs=0.2)
    assert missing[-1] == pytest.approx(missing[0] + 2.9)


@pytest.mark.parametrize(("side", "label"), [("left", LEFT), ("right", RIGHT)])
def test_one_side_is_unseen_along_a_stretch(clean: Log, side: str, label: int) -> None:
    faulty = drive(LAPS, sensor=SensorFaults(blind=20.0, blind_at=0.5, blind_side=side))  # type: ignore[arg-type]
    lap = bean_track().centre_line.length
    begin, end = halfway(clean, 0.5), halfway(clean, 0.5 + 20.0 / lap)
    gone = set(seen(clean)) - set(seen(faulty))
    cones = np.array([cone for _, cone in gone])
    assert len(gone) > 20
    assert np.all(truth_of(clean).cone_labels[cones] == label)
    assert all(begin - 0.1 <= t <= end + 0.1 for t, _ in gone)
    assert not any(
        t in {t for t, _ in gone} and cone >= 0 and truth_of(clean).cone_labels[cone] == label
        for t, cone in seen(faulty)
    )


# --- the odometry ----------------------------------------------------------------------------------------


def test_a_yaw_rate_bias_is_added_and_is_part_of_the_true_calibration(clean: Log) -> None:
    faulty = drive(LAPS, odometry=OdometryFaults(yaw_rate_bias=0.02))
    difference = faulty.odometry.twist - clean.odometry.twist
    np.testing.assert_allclose(difference, np.broadcast_to([0.0, 0.0, 0.02], difference.shape), atol=1e-12)
    found, expected = truth_of(faulty).calibration, truth_of(clean).calibration
    assert found is not None and expected is not None
    np.testing.assert_allclose(found - expected, [0.0, 0.02], atol=1e-15)
    assert same_cycles(faulty, clean)


def measured(twists: np.ndarray, faults: OdometryFaults, scale: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Measured twists without white noise, 0.02 s apart, and the true calibration."""
    driven = Trajectory(0.02 * np.arange(len(twists)), np.zeros((len(twists), 3)), twists)
    noise = OdometryNoise(white=(1e-12, 1e-12, 1e-12), scale=scale, gyro_bias=0.0)
    odometry, calibration = measure_odometry(driven, 1.0, noise, faults, np.random.default_rng(1))
    return odometry.twist, calibration


def test_a_fault_scales_what_the_wheels_turn_and_not_the_drawn_errors() -> None:
    """`wheels (1 + drawn + fault)`: the product of both scales is in no reading."""
    t = 0.02 * np.arange(50)
    twists = np.column_stack([5.0 + np.sin(t), 0.1 * np.cos(t), 0.3 * np.sin(2.0 * t)])
    found, calibration = measured(twists, OdometryFaults(speed_scale=0.05), scale=0.1)
    assert abs(calibration[0] - 0.05) > 0.01
    np.testing.assert_allclose(found, twists * [*[1.0 + calibration[0]] * 2, 1.0], atol=1e-9)


def test_slipping_wheels_measure_too_much_for_1_s_every_8_s() -> None:
    still = replace(LAPS, odometry=OdometryNoise(scale=0.0))
    clean, faulty = drive(still), drive(still, odometry=OdometryFaults(slip=0.5))
    t, difference = clean.odometry.t, faulty.odometry.twist - clean.odometry.twist
    slips = (t >= 8.0) & (t % 8.0 < 1.0)
    assert slips.sum() > 50
    assert not difference[~slips].any()
    assert not difference[:, 2].any()
    truth = truth_of(clean)
    at = np.searchsorted(truth.pose_t, t[slips][:-1])
    steps = np.linalg.norm(truth.poses[at + 1, :2] - truth.poses[at, :2], axis=1)
    np.testing.assert_allclose(difference[slips][:-1, 0], 0.5 * steps / 0.02, rtol=0.01)


def test_zeros_and_gaps_take_1_s_of_the_odometry_and_leave_the_rest(clean: Log) -> None:
    begin, odometry = halfway(clean, 1.5), clean.odometry
    zeros = drive(LAPS, odometry=OdometryFaults(zero=1.0, zero_at=1.5)).odometry
    inside = (odometry.t >= begin - 1e-6) & (odometry.t < begin + 1.0 - 1e-6)
    assert np.sum(~zeros.twist.any(axis=1)) == 50
    np.testing.assert_array_equal(zeros.t, odometry.t)
    kept = zeros.twist.any(axis=1)
    np.testing.assert_array_equal(zeros.twist[kept], odometry.twist[kept])
    assert np.mean(kept[inside]) < 0.05
    gap = drive(LAPS, odometry=OdometryFaults(gap=1.0, gap_at=1.5)).odometry
    assert len(gap.t) == len(odometry.t) - 50
    np.testing.assert_array_equal(gap.t, odometry.t[kept])
    np.testing.assert_array_equal(gap.twist, odometry.twist[kept])


def test_a_slow_start_is_missed_only_after_a_standstill() -> None:
    """A log may begin on a vehicle that creeps, whose odometry has not stood."""
    for first in (0.4, 0.0):
        twists = np.array([first, 0.5, 0.8, 1.2, 0.7, 0.6])[:, None] * [1.0, 0.0, 0.0]
        found, _ = measured(twists, OdometryFaults(dead_band=1.0))
        missed = [0.0] * 3 + [1.2, 0.7, 0.6] if first == 0.0 else twists[:, 0]
        np.testing.assert_allclose(found[:, 0], missed, atol=1e-9)


def test_false_travel_goes_on_for_its_time_while_the_vehicle_stands() -> None:
    twists = np.array([2.0, 1.0, 0.3, 0.0, 0.0, 0.0, 0.0])[:, None] * [1.0, 0.0, 0.0]
    found, _ = measured(twists, OdometryFaults(false_travel=0.5, false_travel_time=0.04))
    np.testing.assert_allclose(found[:, 0], [2.0, 1.0, 0.5, 0.5, 0.5, 0.0, 0.0], atol=1e-9)


def test_a_log_that_begins_with_a_gap_still_has_its_first_stamp() -> None:
    odometry = drive(LAPS, odometry=OdometryFaults(gap=1.0, gap_at=0.0)).odometry
    assert odometry.t[0] == 0.0
    assert odometry.t[1] == 1.0


# --- the vehicle -----------------------------------------------------------------------------------------


def test_a_vehicle_that_is_put_down_goes_on_farther_along_the_track(clean: Log) -> None:
    faulty = drive(LAPS, vehicle=VehicleFaults(put_down=10.0, put_down_at=1.5))
    truth, before = truth_of(faulty), truth_of(clean)
    steps = np.linalg.norm(np.diff(truth.poses[:, :2], axis=0), axis=1)
    jump = int(np.argmax(steps))
    assert 8.0 < steps[jump] < 10.5
    assert np.delete(steps, jump).max() < 0.3
    assert truth.pose_t[jump] == pytest.approx(halfway(clean, 1.5), abs=0.05)
    np.testing.assert_array_equal(truth.poses[:jump], before.poses[:jump])
    left_out = len(before.poses) - len(truth.poses)
    np.testing.assert_array_equal(truth.poses[jump + 1 :], before.poses[jump + 1 + left_out :])
    assert np.abs(faulty.odometry.twist[:, 0]).max() < 15.0, "the odometry knows nothing of it"


def test_the_wrong_way_round_blue_is_on_the_right() -> None:
    base = replace(LAPS, sensor=EXACT)
    log, clean = drive(base, vehicle=VehicleFaults(wrong_way=True)), drive(base)
    labels, points = log.cycles[0].labels, log.cycles[0].points_vehicle
    beside = np.linalg.norm(points, axis=1) < 5.0
    assert beside.sum() >= 2
    np.testing.assert_array_equal(labels[beside], np.where(points[beside, 1] > 0.0, RIGHT, LEFT))
    truth = truth_of(log)
    near = np.linalg.norm(truth.cones, axis=1) < 5.0
    sides = np.where(truth.cones[near][:, 1] > 0.0, LEFT, RIGHT)
    np.testing.assert_array_equal(truth.cone_labels[near], sides)
    turns = [np.unwrap(truth_of(one).poses[:, 2])[-1] for one in (log, clean)]
    assert turns[0] < 0.0 < turns[1]
    with pytest.raises(SettingsError, match="wrong_way: expected a closed track"):
        drive(STRAIGHT, vehicle=VehicleFaults(wrong_way=True))


# --- all of them -----------------------------------------------------------------------------------------


def test_a_fault_that_comes_too_late_or_has_no_strength_changes_nothing(clean: Log) -> None:
    never = drive(
        LAPS,
        sensor=SensorFaults(dropout=5.0, dropout_at=9.0, blind=50.0, blind_at=9.0),
        odometry=OdometryFaults(zero=1.0, zero_at=9.0, gap=1.0, gap_at=9.0, slip=0.5, slip_every=1e6),
        vehicle=VehicleFaults(put_down=10.0, put_down_at=9.0),
    )
    assert same_cycles(never, clean)
    assert len(never.cycles) == len(clean.cycles)
    np.testing.assert_array_equal(never.odometry.twist, clean.odometry.twist)
    np.testing.assert_array_equal(truth_of(never).poses, truth_of(clean).poses)


def test_a_log_names_its_faults_and_one_without_faults_has_no_such_line(clean: Log, tmp_path: Path) -> None:
    assert clean.source == {"track": "bean", "seed": "2", "laps": "2"}
    faulty = drive(LAPS, sensor=SensorFaults(latency=0.05, dropout=1.0), odometry=OdometryFaults(gap=1.0))
    assert faulty.source["faults.sensor.latency"] == "0.05"
    write_log(faulty, tmp_path / "log")
    again = read_log(tmp_path / "log")
    assert again.source == faulty.source
    assert same_cycles(again, faulty)
