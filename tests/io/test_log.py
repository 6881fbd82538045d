"""A log survives a round trip exactly, and every kind of bad input is told with file and row."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pathspace_graph.errors import InputError
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo, Truth
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.parsing import MAX_HELD, MAX_RANGE
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN


def numbers_up_to(largest: float) -> st.SearchStrategy[float]:
    return st.floats(-largest, largest, allow_nan=False)


def small_log() -> Log:
    rng = np.random.default_rng(0)
    cycles = tuple(
        Detections(
            t, rng.normal(size=(3, 2)), np.tile([[0.02, 0.001], [0.001, 0.03]], (3, 1, 1)), np.arange(3)
        )
        for t in (0.0, 0.1, 0.2)
    )
    t = np.arange(11) / 50
    poses = rng.normal(size=(11, 3))
    truth = Truth(
        t,
        poses,
        rng.normal(size=(4, 2)),
        np.array([0, 1, 2, 0]),
        np.array([0, 1, -1] * 3),
        rng.normal(size=2),
        rng.normal(size=5),
        rng.normal(size=6),
    )
    source = {"track": 'a "quoted" \\ name\n', "Umlaut": "Zürich \x7f"}
    sensor = SensorInfo(range_max=15.0, fov=1.9, kind="line", sigma_range_scale=0.001)
    odometry, sigma = Odometry(t, rng.normal(size=(11, 3))), np.array([0.1, 0.2, 1e-5])
    return Log(
        odometry, cycles, sigma, sensor, source, odometry_drift=np.array([0.1, 0.0, 1e-3]), truth=truth
    )


def assert_same(a: Log, b: Log) -> None:
    np.testing.assert_array_equal(a.odometry.t, b.odometry.t)
    np.testing.assert_array_equal(a.odometry.twist, b.odometry.twist)
    np.testing.assert_array_equal(a.odometry_sigma, b.odometry_sigma)
    assert (a.odometry_drift is None) == (b.odometry_drift is None)
    if a.odometry_drift is not None and b.odometry_drift is not None:
        np.testing.assert_array_equal(a.odometry_drift, b.odometry_drift)
    assert a.sensor == b.sensor
    assert dict(a.source) == dict(b.source)
    assert len(a.cycles) == len(b.cycles)
    for one, other in zip(a.cycles, b.cycles, strict=True):
        assert one.t == other.t
        np.testing.assert_array_equal(one.points_vehicle, other.points_vehicle)
        np.testing.assert_array_equal(one.covariances, other.covariances)
        np.testing.assert_array_equal(one.labels, other.labels)
    if a.truth is None or b.truth is None:
        assert a.truth is b.truth
        return
    for name in ("pose_t", "poses", "cones", "cone_labels", "associations", "calibration", "sensor", "noise"):
        np.testing.assert_array_equal(getattr(a.truth, name), getattr(b.truth, name))


def test_round_trip_is_exact(tmp_path: Path) -> None:
    log = small_log()
    write_log(log, tmp_path / "log")
    assert_same(read_log(tmp_path / "log"), log)
    log = replace(log, odometry_drift=None, sensor=SensorInfo())
    write_log(log, tmp_path / "less")
    assert_same(read_log(tmp_path / "less"), log)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    twist=arrays(float, (4, 3), elements=numbers_up_to(0.999 * MAX_HELD)),  # stamps have round-off
    point=arrays(float, (2,), elements=numbers_up_to(MAX_RANGE)),
    t0=numbers_up_to(1e6),
)
def test_round_trip_is_exact_for_any_numbers(
    twist: np.ndarray, point: np.ndarray, t0: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("log") / "log"
    t = t0 + np.arange(4.0)
    cycle = Detections(t0 + 0.3, point[None], np.array([[[0.1, 0.02], [0.02, 0.3]]]), np.array([RIGHT]))
    log = Log(Odometry(t, twist), (cycle,), np.ones(3))
    write_log(log, folder)
    assert_same(read_log(folder), log)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A hand-written log of two odometry rows and two detections, without truth."""
    (tmp_path / "log.toml").write_text('format = "pathspace-log/1"\n[odometry]\nsigma = [0.1, 0.1, 0.01]\n')
    (tmp_path / "odometry.csv").write_text("t,vx,vy,wz\n0,1,0,0\n0.5,1,0,0.1\n")
    (tmp_path / "detections.csv").write_text(
        "t,x,y,label,xx,xy,yy\n0,3,1,left,0.1,0,0.1\n0.1,4,-1,right,0.1,0,0.1\n"
    )
    return tmp_path


def test_columns_may_be_in_any_order_with_more_of_them_and_in_any_dress(folder: Path) -> None:
    text = 'label,extra, yy ,xy,xx,y,x,t\r\n"blue",?,0.1,0,0.2, 1 ,"3",0\r\nYellow,,0.1,0,0.2,-1,3,0\r\n\r\n'
    text += "cone?,,0.1,0,0.2,-1,3,0.1\r\n"
    (folder / "detections.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    log = read_log(folder)
    assert [cycle.labels.tolist() for cycle in log.cycles] == [[LEFT, RIGHT], [UNKNOWN]]
    np.testing.assert_array_equal(log.cycles[0].points_vehicle, [[3, 1], [3, -1]])
    np.testing.assert_array_equal(log.cycles[0].covariances[0], [[0.2, 0], [0, 0.1]])


@pytest.mark.parametrize("name", ["log.toml", "odometry.csv", "detections.csv"])
def test_missing_or_empty_file(folder: Path, name: str) -> None:
    (folder / name).write_text("")
    with pytest.raises(InputError, match=f"{name}.*expected"):
        read_log(folder)
    (folder / name).unlink()
    with pytest.raises(InputError, match=f"{name}: expected a file, found none"):
        read_log(folder)


HEADER = 'format = "pathspace-log/1"\n[odometry]\nsigma = [1, 1, 1]\n'
ODOMETRY = "t,vx,vy,wz\n"
DETECTIONS = "t,x,y,label,xx,xy,yy\n"
BAD_ROWS = [  # what no single cell shows
    ("odometry.csv", ODOMETRY, 2, "at least one row"),
    ("odometry.csv", "t,vx,vy\n0,1,0\n", 1, "column 'wz'"),
    ("odometry.csv", "t,vx,vy,wz,t\n0,1,0,0,0\n", 1, "more than one"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n\n1,1,0\n", 4, "expected 4 fields, found 3"),
    ("truth_cones.csv", "x,y,label\n0,1,left\n\n0,2\n", 4, "expected 3 fields, found 2"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n1,1,0,0,7\n", 3, "expected 4 fields, found more"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n1,1,0,0,7,8\n", 3, "expected 4 fields, found 6"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n1,1,0,0\n1,1,0,0\n", 4, "later than the row before"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n1,5,0,0\n1e9,5,0,0\n", 3, "at most 1000 m until the next row"),
    ("odometry.csv", ODOMETRY + "".join(f"{k},-999,0,0\n" for k in range(1003)), 1003, "at most 1e+06 m"),
    ("odometry.csv", f"{ODOMETRY}0,1,0,0\n0.1,1e5,0,0\n", 3, "1000 m/s in size in column 'vx', found 100000"),
    ("detections.csv", f"{DETECTIONS}0,3,-1e5,left,1,0,1\n", 2, "10000 m in size in column 'y'"),
    ("detections.csv", f"{DETECTIONS}0,3,1,left,1e9,0,1\n", 2, "1e+08 m^2 in size in column 'xx'"),
    ("detections.csv", DETECTIONS + 10001 * "0,3,1,left,1,0,1\n", 2, "10000 detections"),
    ("detections.csv", f"{DETECTIONS}0.2,3,1,left,1,0,1\n0.1,3,1,left,1,0,1\n", 3, "not earlier"),
    ("detections.csv", f"{DETECTIONS}0,3,1,left,1,0,1\n0,3,1,left,1,2,1\n", 3, "positive definite"),
    ("detections.csv", f"{DETECTIONS}0,3,1,left,1,1,1\n", 2, "positive definite"),
    ("detections.csv", f"{DETECTIONS}-0.1,3,1,left,1,0,1\n", 2, "before the first odometry"),
    ("detections.csv", f"{DETECTIONS}0,3,1,left,1,0,1\n1.6,3,1,left,1,0,1\n", 3, "after the last"),
    ("truth_poses.csv", "t,x,y,theta\n0,0,0,1e9\n", 2, "at most 1e+06 rad in size in column 'theta'"),
    ("truth_poses.csv", "t,x,y,theta\n0,0,0,0\n0,0,0,0\n", 3, "later than the row before"),
    ("truth_cones.csv", "x,y,label\n0,9.2e18,left\n", 2, "at most 1e+08 m in size in column 'y'"),
    ("truth_associations.csv", "cone\n-1\n0\n", 3, "-1 or the index"),
    ("truth_associations.csv", "cone\n-1\n-1.5\n", 3, "-1 or the index"),
    ("truth_associations.csv", "cone\n-1\n", None, "each of 2 detections"),
    ("log.toml", 'format = "pathspace-log/1"\n[odometry\n', 2, "expected TOML"),
    ("log.toml", HEADER.replace("/1", "/2"), None, "pathspace-log/1"),
    ("log.toml", HEADER.replace("[odometry]", "[sensor]"), None, "odometry: expected, but missing"),
    ("log.toml", HEADER.replace("1, 1, 1", "1, 1"), None, "odometry.sigma: expected array of length 3"),
    ("log.toml", HEADER.replace("1, 1, 1", "1, 0, 1"), None, "odometry.sigma[1]: expected float > 0.0"),
    ("log.toml", HEADER.replace("1, 1, 1", "1, nan, 1"), None, "odometry.sigma[1]: expected float"),
    ("log.toml", HEADER.replace("1, 1, 1", '1, "a", 1'), None, "odometry.sigma[1]: expected float, got str"),
    ("log.toml", f"{HEADER}[truth]\nscale = 0.1\n", None, "truth.bias: expected, but missing"),
    ("log.toml", f"{HEADER}[truth]\nscale = 0\nbias = 0\nyaw = 1\n", None, "truth.lateral: expected, but"),
    ("log.toml", f'{HEADER}[sensor]\nkind = "wall"\n', None, "sensor.kind: expected one of cones|line"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "text", "row", "message"), BAD_ROWS)
def test_bad_content_is_told_with_file_and_row(
    folder: Path, name: str, text: str, row: int | None, message: str
) -> None:
    (folder / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_log(folder)
    assert caught.value.file == folder / name
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    if row is not None:
        assert caught.value.row == row


def test_last_twist_is_held_for_a_while(folder: Path) -> None:
    (folder / "detections.csv").write_text("t,x,y,label,xx,xy,yy\n1.4,3,1,left,1,0,1\n")
    assert read_log(folder).cycles[0].t == 1.4


def test_a_log_that_cannot_be_read_is_not_written_where_it_is_checked(tmp_path: Path) -> None:
    odometry = Odometry(np.array([0.0, 1.0]), np.array([[2e3, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    log = Log(odometry, (), np.ones(3))
    with pytest.raises(InputError, match="row 2"):
        write_log(log, tmp_path / "log", check=True)
    assert not list(tmp_path.iterdir())
    write_log(log, tmp_path / "log")
    assert (tmp_path / "log").is_dir()


def test_a_log_of_arrays_is_the_one_that_is_read_from_files() -> None:
    log = small_log()
    cycles = log.cycles
    stamps = np.repeat([cycle.t for cycle in cycles], 3)
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    covariances = np.concatenate([cycle.covariances for cycle in cycles])
    labels = ["left", "yellow", UNKNOWN] * 3
    noise = {"covariances": covariances, "odometry_sigma": log.odometry_sigma}
    noise["odometry_drift"] = log.odometry_drift
    made = Log.from_arrays(
        log.odometry.t, log.odometry.twist, stamps, points, labels=labels, kind="line", **noise
    )
    assert made.odometry_stated and made.detections_stated
    assert_same(made, replace(log, truth=None, source={}, sensor=SensorInfo(kind="line")))


def test_arrays_without_noise_state_none() -> None:
    log = Log.from_arrays([0.0, 1.0], np.zeros((2, 3)), [0.5], [[3.0, 1.0]])
    assert (log.odometry_stated, log.detections_stated) == (False, False)
    assert log.cycles[0].labels.tolist() == [UNKNOWN]
    assert np.linalg.eigvalsh(log.cycles[0].covariances[0]).min() > 0.0


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"t": [0.0, 0.0]}, "odometry, row 2: expected a time later than the row before"),
        ({"t": [0.0, 1.0, 2.0]}, "odometry: expected arrays of numbers with a row each"),
        ({"twist": np.zeros((2, 2))}, "odometry: expected the columns t, vx, vy, wz, found 3"),
        ({"twist": [[0.0, np.nan, 0.0]] * 2}, "odometry, row 1: expected a finite number in column 'vy'"),
        ({"points": [[3.0, 1e5]]}, "detections, row 1: expected a number of at most 10000 m in size"),
        ({"labels": [7]}, "detections, row 1: expected a number of at most 4 in size in column 'label'"),
        ({"covariances": [[[1.0, 2.0], [2.0, 1.0]]]}, "detections, row 1: expected a positive definite"),
        ({"detection_t": [-1.0]}, "detections, row 1: expected a time not before the first odometry"),
    ],
)
def test_an_array_that_is_wrong_is_named_with_its_row(changed: dict[str, Any], says: str) -> None:
    good = {"t": [0.0, 1.0], "twist": np.zeros((2, 3)), "detection_t": [0.5], "points": [[3.0, 1.0]]}
    with pytest.raises(InputError) as caught:
        Log.from_arrays(**{**good, **changed})
    assert str(caught.value).startswith(says)


def test_a_stamp_that_both_parts_have_is_kept_once_with_the_earlier_twist() -> None:
    stamps = np.array([0.0, 0.1, 0.2])
    first, second = Odometry(stamps, np.ones((3, 3))), Odometry(stamps + 0.2, np.full((3, 3), 2.0))
    both = first.followed_by(second)
    np.testing.assert_allclose(both.t, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(both.twist[:, 0], [1.0, 1.0, 1.0, 2.0, 2.0])


# --- the noise of a header -------------------------------------------------------------------------------


MEASURED = {
    "odometry": "[0.1, 0.2, 0.01]",
    "drift": "[0.012, 0.006, 0.0017]",
    "interval": "0.02",
    "along": "[0.1, 0.02, 0.5, 2.0]",
    "across": "[0.0, 0.01, 0.8, 1.0]",
    "count": "17",
    "period": "0.1",
    "per_cycle": "8.5",
    "yaw": "[0.01, 0.001]",
    "lateral": "[-0.2, 0.02]",
    "latency": "[-0.05, 0.004]",
    "range_scale": "[0.07, 0.003]",
    "range_bias": "[0.1, 0.02]",
    "seconds": "40.0",
}


def measured() -> MeasuredNoise:
    rng = np.random.default_rng(0)
    return MeasuredNoise(
        odometry=rng.uniform(size=3),
        drift=rng.uniform(size=3) / 3.0,
        interval=1.0 / 70.0,
        along=RayNoise(rng.uniform(size=2), 1.0 / 3.0, 0.7),
        across=RayNoise(np.array([0.0, 1e-3 / 7.0]), 0.9, 16.0),
        count=23,
        period=1.0 / 9.0,
        per_cycle=11.0 / 7.0,
        sensor=rng.normal(size=5),
        sensor_sigma=rng.uniform(size=5),
        range_bend=-1e-3 / 3.0,
        seconds=100.0 / 3.0,
    )


def assert_same_noise(ours: MeasuredNoise, theirs: MeasuredNoise) -> None:
    for one in fields(MeasuredNoise):
        first, second = getattr(ours, one.name), getattr(theirs, one.name)
        if isinstance(first, RayNoise):
            np.testing.assert_array_equal(first.sigma, second.sigma)
            assert (first.share, first.time) == (second.share, second.time)
        else:
            np.testing.assert_array_equal(first, second, err_msg=one.name)


def header(folder: Path, text: str) -> Log:
    """The log of a folder with more text in its header."""
    with (folder / "log.toml").open("a") as out:
        out.write(text)
    return read_log(folder)


def section(**changed: str) -> str:
    entries = {name: value for name, value in (MEASURED | changed).items() if value}
    return "[noise.measured]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("detections", [True, False])
def test_measured_noise_comes_back_to_the_bit(odometry: bool, detections: bool, tmp_path: Path) -> None:
    stated = {"odometry_stated": odometry, "detections_stated": detections}
    log = replace(small_log(), **stated, measured=measured())
    write_log(log, tmp_path / "log")
    found = read_log(tmp_path / "log")
    assert_same(found, log)
    assert (found.odometry_stated, found.detections_stated) == (odometry, detections)
    assert found.measured is not None
    assert_same_noise(found.measured, measured())
    known = found.noise
    assert (known.odometry_stated, known.detections_stated) == (odometry, detections)
    assert known.measured is found.measured
    np.testing.assert_array_equal(known.odometry, log.odometry_sigma)


def test_noise_of_the_odometry_alone_comes_back_too(tmp_path: Path) -> None:
    """Where too few cones were seen, nothing is known of detections and sensor: their sigmas are infinite."""
    own = MeasuredNoise(np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03]), 0.02, seconds=3.0)
    log = replace(small_log(), odometry_stated=False, detections_stated=False, measured=own)
    write_log(log, tmp_path / "log")
    text = (tmp_path / "log" / "log.toml").read_text()
    assert '[noise]\nodometry = "measured"\ndetections = "assumed"\n' in text
    found = read_log(tmp_path / "log")
    assert found.measured is not None and found.measured.along is None and not found.detections_stated
    assert_same_noise(found.measured, own)


def test_noise_that_is_neither_stated_nor_measured_is_assumed(tmp_path: Path) -> None:
    write_log(replace(small_log(), odometry_stated=False), tmp_path / "log")
    text = (tmp_path / "log" / "log.toml").read_text()
    assert '[noise]\nodometry = "assumed"\ndetections = "stated"\n' in text
    found = read_log(tmp_path / "log")
    assert not found.odometry_stated and found.detections_stated and found.measured is None


def test_a_log_without_the_section_has_stated_its_noise(folder: Path, tmp_path: Path) -> None:
    write_log(small_log(), tmp_path / "log")
    assert "noise" not in (tmp_path / "log" / "log.toml").read_text().split("[source]")[0]
    for log in (read_log(tmp_path / "log"), header(folder, ""), header(folder, "[noise]\n")):
        assert log.odometry_stated and log.detections_stated and log.measured is None


@pytest.mark.parametrize(
    "text",
    [
        '[noise]\nodometry = "known"\n',
        *(section(**{name: value}) for name in MEASURED if name != "along" for value in ("", "nan")),
        section(along="[0.0, 0.0, 0.5, 2.0]"),
        section(along="[0.1, 0.02, 1.5, 2.0]"),
        section(odometry="[0.0, 0.2, 0.01]", drift="[0.0, 0.006, 0.0017]"),
        section(count="2.5"),
        section(yaw="[0.01, -0.001]"),
    ],
)
def test_a_value_that_no_estimator_can_use_is_refused(text: str, folder: Path) -> None:
    """No number, no noise at all, a share above one, no time between cycles, or a sigma below zero."""
    with pytest.raises(InputError, match=r"log\.toml.*expected") as refused:
        header(folder, text)
    assert "\n" not in str(refused.value)
