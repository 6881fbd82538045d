"""Bags of all three kinds become logs, and what is wrong with them is told in a line."""

from __future__ import annotations

import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pathspace_graph.cli import main
from pathspace_graph.convert.recording import with_yaw_rate
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.io.log_files import read_log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from .bags import (
    CONE,
    CONES,
    DEFINITIONS,
    EPOCH,
    KINDS,
    Kind,
    Messages,
    Written,
    colour_of,
    of_log,
    write_bag,
)

TOPICS = ["--odometry", "/odom", "--detections", "/cones"]


@pytest.fixture(scope="module")
def long_drive() -> Log:
    """The first six seconds of a simulated drive, in which its noise can be measured."""
    return beginning_of(simulate(generate_track(np.random.default_rng(3)), SimulationSettings(laps=1), 3), 60)


@pytest.fixture(scope="module")
def drive(long_drive: Log) -> Log:
    return beginning_of(long_drive, 20)


def beginning_of(log: Log, cycles: int) -> Log:
    kept = log.cycles[:cycles]
    return Log(log.odometry.between(0.0, kept[-1].t), kept, log.odometry_sigma, log.sensor)


def convert(bag: Path, out: Path, *options: str) -> Log:
    assert main(["convert", str(bag), "--out", str(out), *TOPICS, *options]) == 0
    return read_log(out)


def refused(bag: Path, out: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """The one line with which a conversion is refused, which leaves nothing."""
    assert main(["convert", str(bag), "--out", str(out), *options]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert not out.exists()
    return line


def assert_same_readings(log: Log, drive: Log, *, covariances: bool = True, atol: float = 1e-9) -> None:
    """The log is the drive at a later time, to the nanosecond of the messages."""
    np.testing.assert_allclose(log.odometry.t - EPOCH, drive.odometry.t, atol=1e-6)
    np.testing.assert_array_equal(log.odometry.twist, drive.odometry.twist)
    assert len(log.cycles) == len(drive.cycles)
    for cycle, made in zip(log.cycles, drive.cycles, strict=True):
        assert cycle.t - EPOCH == pytest.approx(made.t, abs=1e-6)
        order, other = (np.lexsort(c.points_vehicle.T) for c in (cycle, made))
        np.testing.assert_allclose(cycle.points_vehicle[order], made.points_vehicle[other], atol=atol)
        np.testing.assert_array_equal(cycle.labels[order], made.labels[other])
        if covariances:
            np.testing.assert_allclose(cycle.covariances[order], made.covariances[other], atol=atol)


def markers(messages: Messages, cycle: Detections) -> Any:
    """The message of a cycle as coloured markers, which have no covariances."""
    rows = zip(cycle.points_vehicle, cycle.labels.tolist(), strict=True)
    return messages.markers([messages.marker(cycle.t, point, colour_of(label)) for point, label in rows])


# --- the three kinds -------------------------------------------------------------------------------------


def test_a_folder_is_a_bag_of_rosbag2_whatever_its_name(drive: Log, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, "mcap", of_log(drive, Messages.cloud_of)).rename(tmp_path / "drive.bag")
    assert_same_readings(convert(bag, tmp_path / "log"), drive)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("message", [Messages.cloud_of, Messages.cones])
def test_a_drive_comes_back_from_a_bag(
    kind: Kind, message: Callable[[Messages, Detections], Any], drive: Log, tmp_path: Path
) -> None:
    bag = write_bag(tmp_path, kind, of_log(drive, message))
    log = convert(bag, tmp_path / "log")
    assert_same_readings(log, drive)
    assert log.detections_stated and not log.odometry_stated
    assert log.measured is not None
    np.testing.assert_array_equal(log.noise.twist.white, log.measured.odometry)
    np.testing.assert_array_equal(log.noise.twist.drift, log.measured.drift)
    assert log.source["odometry"] == "/odom (nav_msgs/msg/Odometry)"


def test_noise_that_is_not_stated_is_measured_and_the_log_says_so(long_drive: Log, tmp_path: Path) -> None:
    """Markers have no covariances: they get those of single detections, by the measured noise."""
    bag = write_bag(tmp_path, "mcap", of_log(long_drive, markers))
    log = convert(bag, tmp_path / "log")
    header = (tmp_path / "log" / "log.toml").read_text()
    assert '[noise]\nodometry = "measured"\ndetections = "measured"\n' in header
    assert not log.odometry_stated and not log.detections_stated
    assert log.measured is not None and log.measured.along is not None
    np.testing.assert_array_equal(log.noise.twist.white, log.measured.odometry)
    np.testing.assert_array_equal(log.noise.twist.drift, log.measured.drift)
    for cycle in log.cycles:
        expected = log.measured.covariances(cycle.points_vehicle, inflated=False)
        assert expected is not None
        np.testing.assert_allclose(cycle.covariances, expected, rtol=1e-12, atol=1e-15)


def test_an_old_bag_without_definitions_is_read_by_those_handed_over(
    drive: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, "sqlite3", of_log(drive, Messages.cones))
    forget_definitions(bag)
    line = refused(bag, tmp_path / "log", capsys, *TOPICS)
    assert CONES in line
    assert "--definition" in line
    files = []
    for name in (CONE, CONES):
        file = tmp_path / "ws" / f"{name}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(DEFINITIONS[name])
        files.append(str(file))
    log = convert(bag, tmp_path / "log", "--definition", *files)
    assert_same_readings(log, drive)
    named = convert(
        bag,
        tmp_path / "other",
        "--definition",
        f"{CONE}={files[0]}",
        f"eufs_msgs/ConeArrayWithCovariance={files[1]}",
    )
    assert_same_readings(named, drive)


def forget_definitions(bag: Path) -> None:
    """Makes a bag one of before 2023, which has no definitions of its messages."""
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as base:
        base.execute("DELETE FROM message_definitions")
    base.close()


# --- odometry --------------------------------------------------------------------------------------------


def one_cone(messages: Messages, t: float | None, written: float | None = None, **more: Any) -> Written:
    """A message with one cone 5 m ahead and 1.5 m to the left."""
    columns = {"x": ("f4", [5.0]), "y": ("f4", [1.5]), "label": ("u1", [0])}
    return (written if written is not None else (t or 0.0)), "/cones", messages.cloud(t, columns, **more)


def written(
    tmp_path: Path,
    odometry: Callable[[Messages, float], Any],
    extra: Callable[[Messages], list[Written]] | None = None,
) -> Path:
    """A bag of one second with odometry at 10 Hz and one cone."""

    def make(messages: Messages) -> list[Written]:
        twists = [(t, "/odom", odometry(messages, t)) for t in np.arange(11) / 10.0]
        return [*twists, one_cone(messages, 0.5), *(extra(messages) if extra else [])]

    return write_bag(tmp_path, "mcap", make)


TWIST = np.array([3.0, 0.1, 0.5])


def twist_with_covariance(messages: Messages, t: float) -> Any:
    name = "geometry_msgs/msg/TwistWithCovariance"
    twist = messages.make(name, twist=messages.twist(TWIST))
    return messages.make(f"{name}Stamped", header=messages.header(t), twist=twist)


@pytest.mark.parametrize(
    "make",
    [
        lambda messages, t: messages.odometry(t, TWIST),
        lambda messages, t: messages.twist_stamped(t, TWIST),
        twist_with_covariance,
    ],
)
def test_each_type_with_a_twist_is_read(make: Callable[[Messages, float], Any], tmp_path: Path) -> None:
    log = convert(written(tmp_path, make), tmp_path / "log")
    np.testing.assert_allclose(log.odometry.twist, np.tile(TWIST, (11, 1)))
    np.testing.assert_allclose(log.odometry.t - EPOCH, np.arange(11) / 10.0, atol=1e-6)


def drive_stamped(messages: Messages, t: float) -> Any:
    speed = messages.make("ackermann_msgs/msg/AckermannDrive", speed=3.0)
    return messages.make("ackermann_msgs/msg/AckermannDriveStamped", header=messages.header(t), drive=speed)


@pytest.mark.parametrize(
    "make",
    [
        lambda messages, t: messages.make("std_msgs/msg/Float64", data=3.0),
        lambda messages, t: messages.make("std_msgs/msg/Float32", data=3.0),
        drive_stamped,
    ],
)
def test_a_wheel_speed_goes_with_the_yaw_rate_of_an_imu(
    make: Callable[[Messages, float], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def imu(messages: Messages) -> list[Written]:
        return [(t, "/imu", messages.imu(t, 0.2 + t)) for t in np.arange(-5, 106) / 100.0]

    bag = written(tmp_path, make, imu)
    assert "expected --imu TOPIC for the yaw rate" in refused(bag, tmp_path / "log", capsys, *TOPICS)
    log = convert(bag, tmp_path / "log", "--imu", "/imu")
    np.testing.assert_allclose(log.odometry.twist[:, :2], np.tile([3.0, 0.0], (11, 1)))
    # the mean of the held yaw rate over 0.1 s, which is that in the middle less half a sample
    expected = 0.2 + np.arange(10) / 10.0 + 0.05 - 0.005
    np.testing.assert_allclose(log.odometry.twist[:-1, 2], expected, atol=1e-5)


def steered(messages: Messages, t: float) -> Any:
    motion = messages.make("ackermann_msgs/msg/AckermannDrive", speed=3.0, steering_angle=0.2)
    return messages.make("ackermann_msgs/msg/AckermannDriveStamped", header=messages.header(t), drive=motion)


def test_speed_and_steering_angle_give_the_yaw_rate_by_the_wheelbase(tmp_path: Path) -> None:
    log = convert(written(tmp_path, steered), tmp_path / "log", "--wheelbase", "1.5")
    expected = np.tile([3.0, 0.0, 3.0 * np.tan(0.2) / 1.5], (11, 1))
    np.testing.assert_allclose(log.odometry.twist, expected, rtol=1e-6)


def test_a_slow_imu_gives_its_heading_all_the_same() -> None:
    t, imu_t = np.arange(21) / 20.0, np.array([0.0, 0.5, 1.0])
    stamps, twists = with_yaw_rate(t, np.ones((21, 3)), imu_t, np.array([1.0, 3.0, 0.0]))
    np.testing.assert_allclose(twists[:10, 2], 1.0)
    np.testing.assert_allclose(twists[10:20, 2], 3.0)
    assert twists[:-1, 2] @ np.diff(stamps) == pytest.approx(2.0)


# --- what real bags hold ---------------------------------------------------------------------------------


def test_disorder_repetitions_and_nonsense_are_told_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(messages: Messages) -> list[Written]:
        stamps = [0.0, 0.2, 0.1, 0.3, 0.3, 0.5]
        received = enumerate(stamps)
        twists = [(0.01 * at, "/odom", messages.twist_stamped(t, TWIST)) for at, t in received]
        twists.append((0.6, "/odom", messages.twist_stamped(0.6, [np.nan, 0.0, 0.0])))
        twists.append((0.7, "/odom", messages.twist_stamped(None, TWIST)))
        empty = {"x": ("f4", []), "y": ("f4", []), "label": ("u1", [])}
        hollow = {"x": ("f4", [np.nan, 4.0]), "y": ("f4", [1.0, 1.0]), "label": ("u1", [0, 1])}
        other = {"x": ("f4", [6.0]), "y": ("f4", [-1.5]), "label": ("u1", [1])}
        clouds = [messages.cloud(t, columns) for t, columns in [(0.4, hollow), (0.45, empty), (0.2, other)]]
        return [
            *twists,
            *((0.1, "/cones", cloud) for cloud in clouds),
            *(one_cone(messages, t, written=0.2) for t in (0.2, 0.2, -0.5, 9.0)),
        ]

    log = convert(write_bag(tmp_path, "sqlite3", make), tmp_path / "log")
    np.testing.assert_allclose(log.odometry.t - EPOCH, [0.0, 0.1, 0.2, 0.3, 0.5], atol=1e-6)
    assert [round(cycle.t - EPOCH, 3) for cycle in log.cycles] == [0.2, 0.4]
    assert log.cycles[0].labels.tolist() == [RIGHT, LEFT]
    np.testing.assert_array_equal(log.cycles[1].points_vehicle, [[4.0, 1.0]])
    said = capsys.readouterr().out
    for line in (
        "1 odometry samples that are not finite",
        "1 messages of /odom without a stamp",
        "1 odometry samples were out of order",
        "1 odometry samples had the stamp of another one",
        "1 detections that are not finite",
        "1 messages without any detection",
        "2 messages with detections outside the time",
        "1 messages with detections were repetitions",
        "1 messages with detections are at most 1 ms after another one",
        "3 detections had no covariance",
    ):
        assert line in said


def test_zero_stamps_give_way_to_the_time_of_receipt(tmp_path: Path) -> None:
    def make(messages: Messages) -> list[Written]:
        twists = [(t, "/odom", messages.odometry(None, TWIST)) for t in (0.0, 0.1, 0.2)]
        return [*twists, one_cone(messages, None, written=0.1)]

    log = convert(write_bag(tmp_path, "mcap", make), tmp_path / "log")
    np.testing.assert_allclose(log.odometry.t - EPOCH, [0.0, 0.1, 0.2], atol=1e-6)
    assert log.cycles[0].t - EPOCH == pytest.approx(0.1, abs=1e-6)


def test_clocks_that_differ_are_told_and_mended_by_the_time_of_receipt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(messages: Messages) -> list[Written]:
        twists = [(t, "/odom", messages.odometry(t, TWIST)) for t in (0.0, 0.1, 0.2)]
        return [*twists, one_cone(messages, 500.0, written=0.1)]

    bag = write_bag(tmp_path, "rosbag1", make)
    assert "do both have the same clock?" in refused(bag, tmp_path / "log", capsys, *TOPICS)
    assert len(convert(bag, tmp_path / "log", "--received").cycles) == 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.3, 0.6, 0.99])
@pytest.mark.parametrize("folder", [False, True])
def test_a_recording_that_was_cut_off_is_refused(
    kind: Kind, share: float, folder: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(messages: Messages) -> list[Written]:
        return [(0.01 * k, "/odom", messages.odometry(0.01 * k, TWIST)) for k in range(100)]

    bag = write_bag(tmp_path, kind, make)
    file = next(one for one in (bag, *bag.glob("*.*")) if one.suffix in (".bag", ".mcap", ".db3"))
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    said = refused(bag if folder else file, tmp_path / "log", capsys, *TOPICS)
    assert "cut off" in said or "damaged" in said


def test_a_bag_that_was_indexed_again_is_read_under_its_name(drive: Log, tmp_path: Path) -> None:
    bag = write_bag(tmp_path, "rosbag1", of_log(drive, Messages.cloud_of))
    log = convert(bag.rename(tmp_path / "drive.bag.active"), tmp_path / "log")
    assert len(log.cycles) == len(drive.cycles)


def test_a_sensor_of_another_frame_is_told_until_its_mounting_is_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(frame: str) -> Callable[[Messages], list[Written]]:
        return lambda messages: [
            *((t, "/odom", messages.odometry(t, TWIST)) for t in (0.0, 0.1, 0.2)),
            one_cone(messages, 0.1, frame=frame),
        ]

    bag = write_bag(tmp_path, "mcap", make("lidar"))
    convert(bag, tmp_path / "log")
    assert "in frame lidar, the odometry is of base_link: --mounting" in capsys.readouterr().out
    convert(bag, tmp_path / "other", "--mounting", "1", "2", "0.3")
    assert "--mounting" not in capsys.readouterr().out
    (tmp_path / "map").mkdir()
    line = refused(write_bag(tmp_path / "map", "mcap", make("odom")), tmp_path / "new", capsys, *TOPICS)
    assert "found them in odom, the frame of its pose" in line


def transform(
    messages: Messages,
    parent: str,
    child: str,
    x: float,
    y: float,
    yaw: float,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Any:
    """Returns a child's pose in its parent; yaw, pitch and roll (rad) are turned by in this order."""
    quaternion = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat().tolist()
    turned = messages.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion, strict=True)))
    moved = messages.make(
        "geometry_msgs/msg/Transform", translation=messages.vector(x=x, y=y), rotation=turned
    )
    stamped = "geometry_msgs/msg/TransformStamped"
    header = messages.header(0.0, parent)
    return messages.make(stamped, header=header, child_frame_id=child, transform=moved)


def test_the_transforms_of_a_bag_say_where_the_sensor_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The sensor is on a roof 1 m ahead of the body, whose transform is given the other way round."""

    def make(messages: Messages) -> list[Written]:
        tree = [
            transform(messages, "roof", "base_link", -1.0, 0.0, 0.0),
            transform(messages, "roof", "lidar", 0.5, 0.2, np.pi / 2),
        ]
        static = messages.make("tf2_msgs/msg/TFMessage", transforms=tree)
        twists = [(t, "/odom", messages.odometry(t, TWIST)) for t in (0.0, 0.1, 0.2)]
        return [(0.0, "/tf_static", static), *twists, one_cone(messages, 0.1, frame="lidar")]

    bag = write_bag(tmp_path, "mcap", make)
    log = convert(bag, tmp_path / "log")
    assert "/tf_static puts at 1.5 0.2 1.57" in capsys.readouterr().out
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [[1.5 - 1.5, 0.2 + 5.0]], atol=1e-9)
    log = convert(bag, tmp_path / "stated", "--mounting", "0", "0", "0")
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [[5.0, 1.5]])


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll", "is_level"),
    [
        (30.0, 5.0, -5.0, True),
        (0.0, 11.0, 0.0, True),
        (0.0, 12.0, 0.0, False),
        (30.0, 0.0, -12.0, False),
        (90.0, 9.0, 9.0, False),  # 12.7 degrees together
        (-90.0, 0.0, -90.0, False),  # a camera's frame: z ahead, x to the right
        (0.0, 0.0, 180.0, False),  # upside down
    ],
)
def test_only_a_level_sensor_is_placed_by_the_transforms_of_a_bag(
    yaw: float, pitch: float, roll: float, is_level: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two coordinates say nothing of a height, so that others are told until their mounting is stated."""

    def make(messages: Messages) -> list[Written]:
        angles = np.deg2rad([yaw, pitch, roll]).tolist()
        static = messages.make(
            "tf2_msgs/msg/TFMessage",
            transforms=[transform(messages, "base_link", "camera", 1.0, 0.0, *angles)],
        )
        twists = [(t, "/odom", messages.odometry(t, TWIST)) for t in (0.0, 0.1, 0.2)]
        return [(0.0, "/tf_static", static), *twists, one_cone(messages, 0.1, frame="camera")]

    log = convert(write_bag(tmp_path, "mcap", make), tmp_path / "log")
    said = capsys.readouterr().out
    assert ("/tf_static puts at 1 0" in said) is is_level
    assert ("in frame camera, the odometry is of base_link: --mounting" in said) is not is_level
    turn = np.deg2rad(yaw) * is_level
    expected = [is_level + 5.0 * np.cos(turn) - 1.5 * np.sin(turn), 5.0 * np.sin(turn) + 1.5 * np.cos(turn)]
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [expected], atol=0.1)


def test_a_folder_of_bags_becomes_a_folder_of_logs_and_bad_ones_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "drives"
    for name, topic in (("one", "/cones"), ("two", "/cones"), ("bad", "/other")):
        (source / name).mkdir(parents=True)

        def make(messages: Messages, topic: str = topic) -> list[Written]:
            twists = [(t, "/odom", messages.odometry(t, TWIST)) for t in np.arange(11) / 10.0]
            return [*twists, (0.5, topic, one_cone(messages, 0.5)[2])]

        write_bag(source / name, "mcap", make).rename(source / f"{name}_bag")
        (source / name).rmdir()
    assert main(["convert", str(source), "--out", str(tmp_path / "logs"), *TOPICS]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "1 of 3 records were refused" in line and "found /cones" in line
    for name in ("one_bag", "two_bag"):
        assert len(read_log(tmp_path / "logs" / name).cycles) == 1
    assert not (tmp_path / "logs" / "bad_bag").exists()


# --- what is refused -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_topic_lists_all_with_types_counts_and_rates(
    kind: Kind, drive: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, kind, of_log(drive, Messages.cones))
    cases = (
        (
            ["--odometry", "/odm", "--detections", "/cones"],
            "--odometry: expected a topic of the bag, found /odm",
        ),
        (["--odometry", "/odom"], "--detections: expected a topic of the bag, found none"),
        (
            ["--odometry", "/cones", "--detections", "/cones"],
            "expected a message with a twist, a speed or a pose",
        ),
        ([*TOPICS, "--imu", "/odom"], "expected a message with an angular_velocity"),
    )
    for options, said in cases:
        line = refused(bag, tmp_path / "log", capsys, *options)
        assert said in line
        assert f"/cones ({CONES}, {len(drive.cycles)} messages, 10." in line
        assert f"/odom (nav_msgs/msg/Odometry, {len(drive.odometry.t)} messages, " in line


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--odometry", "/odom", "--detections", "/odom"], "supported are messages with a point cloud"),
        ([*TOPICS, "--label-field", "klass"], "in the field 'klass', found x, y, label"),
        ([*TOPICS, "--labels", "blue=0"], "--labels: expected LABEL=VALUE"),
        ([*TOPICS, "--mounting", "0", "0", "90"], "mounting: expected a yaw of at most 2 pi rad, found 90"),
        ([*TOPICS, "--definition", "cone.txt"], "cone.txt"),
        (
            [*TOPICS, "--start", "9"],
            "found none; 11 odometry samples outside --start and --end were left out",
        ),
    ],
)
def test_bad_options_are_refused_in_one_line(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = written(tmp_path, lambda messages, t: messages.odometry(t, TWIST))
    assert said in refused(bag, tmp_path / "log", capsys, *options)


def test_labels_may_be_left_out_or_renumbered(tmp_path: Path) -> None:
    bag = written(tmp_path, lambda messages, t: messages.odometry(t, TWIST))
    assert convert(bag, tmp_path / "1", "--label-field", "none").cycles[0].labels.tolist() == [UNKNOWN]
    assert convert(bag, tmp_path / "2", "--labels", "right=0").cycles[0].labels.tolist() == [RIGHT]


def test_without_the_package_one_line_says_how_to_install_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = written(tmp_path, lambda messages, t: messages.odometry(t, TWIST))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    line = refused(bag, tmp_path / "log", capsys, *TOPICS)
    assert "pip install 'pathspace-graph[ros]'" in line


# --- markers ---------------------------------------------------------------------------------------------


def in_namespaces(
    log: Log, names: tuple[str, ...], offset: float = 0.0, second: int = 2
) -> Callable[[Messages], list[Written]]:
    """Markers of a log's cones, in each namespace one; those of all but the first are beside it and grey."""

    def markers(messages: Messages, cycle: Detections) -> Any:
        made = []
        for point, label in zip(cycle.points_vehicle, cycle.labels.tolist(), strict=True):
            for number, name in enumerate(names):
                colour = colour_of(label if number == 0 else 2)
                kind = 3 if number == 0 else second
                made.append(
                    messages.marker(cycle.t, (point[0], point[1] + number * offset), colour, kind=kind)
                )
                made[-1].ns = name
        return messages.markers(made[::-1])  # the grey ones first

    return of_log(log, markers)


@pytest.mark.parametrize("names", [("cones", "covariance"), ("a", "b", "c"), ("same", "same")])
def test_markers_at_one_place_are_one_detection(
    names: tuple[str, ...], drive: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = sum(len(cycle.labels) for cycle in drive.cycles)
    log = convert(write_bag(tmp_path, "mcap", in_namespaces(drive, names)), tmp_path / "log")
    said = capsys.readouterr()
    for found, cycle in zip(log.cycles, drive.cycles, strict=True):
        order = np.argsort(found.points_vehicle[:, 0]), np.argsort(cycle.points_vehicle[:, 0])
        np.testing.assert_allclose(found.points_vehicle[order[0]], cycle.points_vehicle[order[1]])
        assert found.labels[order[0]].tolist() == cycle.labels[order[1]].tolist()
    assert f"{(len(names) - 1) * count} detections were at the place of another one" in said.out
    assert ("namespaces of markers were read together" in said.out) == (len({*names}) > 1)
    assert "Warning" not in said.err


def test_a_namespace_is_chosen(drive: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What was filtered lies half a metre beside what was detected."""
    bag = write_bag(tmp_path, "mcap", in_namespaces(drive, ("raw", "filtered"), 0.5))
    count = sum(len(cycle.labels) for cycle in drive.cycles)
    log = convert(bag, tmp_path / "log", "--namespaces", "raw")
    assert sum(len(cycle.labels) for cycle in log.cycles) == count
    assert {label for cycle in log.cycles for label in cycle.labels.tolist()} == {LEFT, RIGHT}
    assert "namespaces" not in capsys.readouterr().out
    said = refused(bag, tmp_path / "other", capsys, *TOPICS, "--namespaces", "cones")
    assert f"expected one of 'filtered' ({count} markers), 'raw' ({count} markers), found 'cones'" in said


def test_two_detections_of_each_cone_are_merged(
    drive: Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(tmp_path, "mcap", in_namespaces(drive, ("left_camera", "right_camera"), 0.4))
    log = convert(bag, tmp_path / "log")
    assert "detections lie in pairs, 0.4 m apart, and were merged to one a cone" in capsys.readouterr().out
    counts = [len(cycle.labels) for cycle in log.cycles], [len(cycle.labels) for cycle in drive.cycles]
    assert sum(counts[0]) < 1.02 * sum(counts[1])
    assert {label for cycle in log.cycles for label in cycle.labels.tolist()} == {LEFT, RIGHT}
