"""Each fault does to a log what its setting says, by hand, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import SettingsError
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


def test_a_latency_of_50_ms_at_10_m_per_s_shifts_a_cone_by_half_a_metre(clean_straight: Log) -> None:
    late, prompt = pairs(drive(STRAIGHT, sensor=SensorFaults(latency=0.05)), clean_straight, after=2.0)
    np.testing.assert_allclose(late - prompt, np.broadcast_to([0.5, 0.0], late.shape), atol=2e-3)


def test_before_the_start_a_late_sensor_sees_what_it_sees_at_the_start(clean_straight: Log) -> None:
    late = drive(STRAIGHT, sensor=SensorFaults(latency=0.2))
    np.testing.assert_allclose(late.cycles[1].points_vehicle, late.cycles[0].points_vehicle, atol=1e-9)


def test_early_stamps_show_what_is_seen_later_until_the_drive_ends(clean_straight: Log) -> None:
    early = drive(STRAIGHT, sensor=SensorFaults(latency=-0.12))
    newer, prompt = pairs(early, clean_straight, after=2.0)
    np.testing.assert_allclose(newer - prompt, np.broadcast_to([-1.2, 0.0], newer.shape), atol=4e-3)
    laps = drive(LAPS, sensor=SensorFaults(latency=-0.12))
    end = laps.odometry.t[-1]
    assert end - 0.22 - 1e-9 < laps.cycles[-1].t <= end - 0.12


def test_cones_seen_by_a_sensor_turned_to_the_left_seem_to_be_more_to_the_right(clean_straight: Log) -> None:
    yaw = np.deg2rad(2.0)
    turned, straight_ahead = pairs(drive(STRAIGHT, sensor=SensorFaults(yaw=yaw)), clean_straight)
    rotation = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(turned, straight_ahead @ rotation.T, atol=1e-6)
    assert np.all(turned[:, 1] < straight_ahead[:, 1])


def test_cones_seen_by_a_sensor_on_the_left_seem_to_be_more_to_the_right(clean_straight: Log) -> None:
    shifted, centred = pairs(drive(STRAIGHT, sensor=SensorFaults(lateral=0.2)), clean_straight)
    np.testing.assert_allclose(shifted - centred, np.broadcast_to([0.0, -0.2], shifted.shape), atol=1e-6)


def test_ranges_are_scaled_and_shifted_and_bearings_stay(clean_straight: Log) -> None:
    faulty = drive(STRAIGHT, sensor=SensorFaults(range_scale=0.02, range_bias=0.4))
    wrong, right = pairs(faulty, clean_straight)
    ranges = np.linalg.norm(right, axis=1)
    np.testing.assert_allclose(np.linalg.norm(wrong, axis=1), 1.02 * ranges + 0.4, atol=1e-6)
    np.testing.assert_allclose(np.arctan2(*wrong.T), np.arctan2(*right.T), atol=1e-9)


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


def test_a_fault_scales_what_the_wheels_turn_and_not_the_drawn_errors() -> None:
    """`wheels (1 + drawn + fault)`: the product of both scales is in no reading."""
    t = 0.02 * np.arange(50)
    twists = np.column_stack([5.0 + np.sin(t), 0.1 * np.cos(t), 0.3 * np.sin(2.0 * t)])
    driven, rng = Trajectory(t, np.zeros((50, 3)), twists), np.random.default_rng(1)
    noise = OdometryNoise(white=(1e-12, 1e-12, 1e-12), scale=0.1, gyro_bias=0.0)
    found, calibration = measure_odometry(driven, 1.0, noise, OdometryFaults(speed_scale=0.05), rng)
    assert abs(calibration[0] - 0.05) > 0.01
    np.testing.assert_allclose(found.twist[:, :2], (1.0 + calibration[0]) * twists[:, :2], atol=1e-9)
    np.testing.assert_allclose(found.twist[:, 2], twists[:, 2], atol=1e-9)


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


def test_a_start_below_the_dead_band_is_missed_and_nothing_else() -> None:
    """From rest with 3 m/s^2 to 1.5 m/s: half a second, in which the vehicle moves by 0.375 m."""
    vehicle = VehicleSettings(rest=1.0, stand=1.0)
    quiet = OdometryNoise(white=(1e-9, 1e-9, 1e-9), scale=0.0, gyro_bias=0.0)
    settings = SimulationSettings(laps=1, vehicle=vehicle, odometry=quiet)
    whole = simulate(bean_track(), settings, seed=0)
    dead = replace(settings, faults=Faults(odometry=OdometryFaults(dead_band=1.5)))
    missed = simulate(bean_track(), dead, seed=0)
    differs = np.abs(whole.odometry.twist - missed.odometry.twist).max(axis=1) > 1e-6
    assert whole.odometry.t[differs].min() == pytest.approx(1.0, abs=0.05)
    assert whole.odometry.t[differs].max() == pytest.approx(1.5, abs=0.05)
    assert np.abs(missed.odometry.twist[differs]).max() < 1e-6
    way = 0.02 * whole.odometry.twist[differs, 0].sum()
    assert way == pytest.approx(0.375, abs=0.05)


def test_a_slow_start_is_missed_only_after_a_standstill() -> None:
    """A log may begin on a vehicle that creeps, whose odometry has not stood."""
    t = 0.02 * np.arange(6)
    for first in (0.4, 0.0):
        twists = np.array([first, 0.5, 0.8, 1.2, 0.7, 0.6])[:, None] * [1.0, 0.0, 0.0]
        noise = OdometryNoise(white=(1e-12, 1e-12, 1e-12), scale=0.0, gyro_bias=0.0)
        driven, rng = Trajectory(t, np.zeros((6, 3)), twists), np.random.default_rng(1)
        found, _ = measure_odometry(driven, 1.0, noise, OdometryFaults(dead_band=1.0), rng)
        missed = [0.0] * 3 + [1.2, 0.7, 0.6] if first == 0.0 else twists[:, 0]
        np.testing.assert_allclose(found.twist[:, 0], missed, atol=1e-9)


def test_false_travel_goes_on_for_its_time_while_the_vehicle_stands() -> None:
    t = 0.02 * np.arange(7)
    twists = np.array([2.0, 1.0, 0.3, 0.0, 0.0, 0.0, 0.0])[:, None] * [1.0, 0.0, 0.0]
    noise = OdometryNoise(white=(1e-12, 1e-12, 1e-12), scale=0.0, gyro_bias=0.0)
    faults, rng = OdometryFaults(false_travel=0.5, false_travel_time=0.04), np.random.default_rng(1)
    found, _ = measure_odometry(Trajectory(t, np.zeros((7, 3)), twists), 1.0, noise, faults, rng)
    np.testing.assert_allclose(found.twist[:, 0], [2.0, 1.0, 0.5, 0.5, 0.5, 0.0, 0.0], atol=1e-9)


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
