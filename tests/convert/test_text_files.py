"""CSV files with columns and units of their own, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN


def write(folder: Path, odometry: str, detections: str) -> Path:
    (folder / "odometry.csv").write_text(odometry)
    (folder / "detections.csv").write_text(detections)
    return folder


def convert(folder: Path, *options: str) -> Log:
    assert (
        main(["convert", str(folder), "--from", "csv", "--out", str(folder / "log"), "--force", *options])
        == 0
    )
    return read_log(folder / "log")


def refused(folder: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["convert", str(folder), "--from", "csv", "--out", str(folder / "log"), *options]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert not (folder / "log").exists()
    return line


ODOMETRY = "stamp,speed,yaw\n1000000000,2000,90\n1100000000,2000,-90\n1200000000,2000,0\n"
DETECTIONS = (
    "stamp,cone_x,cone_y,colour,xx,xy,yy\n1050000000,5000,1500,7,20000,-10000,30000\n"
    "1050000000,4000,-1500,8,40000,0,10000\n1150000000,3000,0,9,10000,0,10000\n"
)
RENAMED = ["--columns", "t=stamp", "vx=speed", "wz=yaw", "x=cone_x", "y=cone_y", "label=colour"]
UNITS = ["--units", "length=mm", "angle=deg", "time=ns"]
LABELS = ["--labels", "left=7", "right=8"]


def test_columns_units_and_labels_are_as_they_were_named(tmp_path: Path) -> None:
    log = convert(write(tmp_path, ODOMETRY, DETECTIONS), *RENAMED, *UNITS, *LABELS)
    np.testing.assert_allclose(log.odometry.t, [1.0, 1.1, 1.2])
    quarter = np.pi / 2
    np.testing.assert_allclose(log.odometry.twist, [[2, 0, quarter], [2, 0, -quarter], [2, 0, 0]])
    assert [cycle.t for cycle in log.cycles] == pytest.approx([1.05, 1.15])
    np.testing.assert_allclose(log.cycles[0].points_vehicle, [[5.0, 1.5], [4.0, -1.5]])
    in_square_metres = [[[0.02, -0.01], [-0.01, 0.03]], [[0.04, 0.0], [0.0, 0.01]]]
    np.testing.assert_allclose(log.cycles[0].covariances, in_square_metres)
    assert log.cycles[0].labels.tolist() == [LEFT, RIGHT]
    assert log.cycles[1].labels.tolist() == [UNKNOWN]


def test_a_log_of_ours_needs_no_option_and_comes_back(tmp_path: Path) -> None:
    odometry = "t,vx,vy,wz\n0.0,1.0,0.1,0.2\n0.5,1.5,0.0,-0.1\n"
    detections = "t,x,y,label,xx,xy,yy\n0.1,4.0,1.0,left,0.02,0.01,0.03\n0.1,5.0,-1.0,yellow,0.02,0.0,0.03\n"
    log = convert(write(tmp_path, odometry, detections))
    np.testing.assert_array_equal(log.odometry.twist, [[1.0, 0.1, 0.2], [1.5, 0.0, -0.1]])
    np.testing.assert_array_equal(log.cycles[0].covariances[0], [[0.02, 0.01], [0.01, 0.03]])
    assert log.cycles[0].labels.tolist() == [LEFT, RIGHT]


def test_y_to_the_right_changes_the_signs_of_all_that_turns(tmp_path: Path) -> None:
    odometry = "t,vx,vy,wz\n0.0,1.0,0.1,0.2\n0.5,1.0,0.1,0.2\n"
    detections = "t,x,y,label,xx,xy,yy\n0.1,4.0,1.0,right,0.02,0.01,0.03\n"
    log = convert(write(tmp_path, odometry, detections), "--y", "right")
    np.testing.assert_array_equal(log.odometry.twist[0], [1.0, -0.1, -0.2])
    np.testing.assert_array_equal(log.cycles[0].points_vehicle, [[4.0, -1.0]])
    np.testing.assert_array_equal(log.cycles[0].covariances[0], [[0.02, -0.01], [-0.01, 0.03]])
    log = convert(tmp_path, "--y", "right", "--y-odometry", "left")
    np.testing.assert_array_equal(log.odometry.twist[0], [1.0, 0.1, 0.2])
    log = convert(tmp_path, "--columns", "wz=-wz")
    np.testing.assert_array_equal(log.odometry.twist[0], [1.0, 0.1, -0.2])


def test_range_and_bearing_take_the_place_of_x_and_y(tmp_path: Path) -> None:
    detections = "time,r,b\n0.1,2000,30\n0.1,2000,-90\n"
    folder = write(tmp_path, "t,vx,wz\n0,1,0\n1,1,0\n", detections)
    names = ["--columns", "detections.t=time", "range=r", "bearing=b"]
    units = ["--units", "length=mm", "angle=deg", "speed=km/h", "yaw_rate=rad/s"]
    log = convert(folder, *names, *units)
    points = [[np.sqrt(3.0), 1.0], [0.0, -2.0]]
    np.testing.assert_allclose(log.cycles[0].points_vehicle, points, atol=1e-12)
    assert log.odometry.twist[0, 0] == pytest.approx(1 / 3.6)
    log = convert(folder, *names, *units, "--y", "right")
    np.testing.assert_allclose(log.cycles[0].points_vehicle, points * np.array([1, -1]), atol=1e-12)


# --- as other tools export it ----------------------------------------------------------------------------

BEGIN = 1_714_557_600  # 2024-05-01 10:00:00 UTC, s since 1970
NANOSECONDS = [0, 500_000_000, 20_000_000, 999_000_000]
STAMPS = [BEGIN, BEGIN + 0.5, BEGIN + 1.02, BEGIN + 1.999]
COLUMNS = "sec,nsec,vx,wz\n", "sec,nsec,x,y,label\n"


def in_two_columns(fractions: list[int] = NANOSECONDS) -> tuple[str, str]:
    stamps = [f"{BEGIN + k // 2},{fraction}" for k, fraction in enumerate(fractions)]
    odometry = "".join(f"{stamp},{k},0.1\n" for k, stamp in enumerate(stamps))
    detections = "".join(
        f"{stamp},{4 + k},1.5,left\n{stamp},{4 + k},-1.5,right\n" for k, stamp in enumerate(stamps)
    )
    return COLUMNS[0] + odometry, COLUMNS[1] + detections


def test_stamps_in_two_columns_are_seconds_and_nanoseconds(tmp_path: Path) -> None:
    log = convert(write(tmp_path, *in_two_columns()), "--columns", "t=sec+nsec")
    np.testing.assert_allclose(log.odometry.t, STAMPS, rtol=0.0, atol=3e-7)
    np.testing.assert_allclose([cycle.t for cycle in log.cycles], STAMPS, rtol=0.0, atol=3e-7)
    assert [len(cycle.labels) for cycle in log.cycles] == [2, 2, 2, 2]


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ("t=sec", "stamps of their own, found the stamp of another one in 45 of 60"),
        ("t=nsec", "stamps of their own, found the stamp of another one in 56 of 60"),
        ("t=nsec+sec", "expected nanoseconds from 0 to 999999999 in column 'sec'"),
        ("t=sec+nanosec", "expected a column 'nanosec'"),
        ("vx=vx", "expected a column 't', or t=SECONDS+NANOSECONDS (--columns t=NAME)"),
    ],
)
def test_a_wrong_choice_of_the_stamps_is_refused(
    columns: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Four samples in each of 15 seconds; of whole seconds, all but one of each second would be lost."""
    times = [f"{BEGIN + k // 4},{250_000_000 * (k % 4)}" for k in range(60)]
    odometry = "".join(f"{t},{1 + 0.01 * k},0\n" for k, t in enumerate(times))
    detections = "".join(f"{t},4,1\n" for t in times)
    folder = write(tmp_path, f"sec,nsec,vx,wz\n{odometry}", f"sec,nsec,x,y\n{detections}")
    units = ["--units", "time=ns"] if columns == "t=nsec" else []
    assert said in refused(folder, capsys, "--columns", columns, *units)


def test_an_odometry_that_is_repeated_beside_each_detection_counts_once(tmp_path: Path) -> None:
    table = "t,vx,wz,x,y\n" + "".join(f"{0.1 * (k // 4)},{k // 4},0,{4 + k},1\n" for k in range(40))
    log = convert(write(tmp_path, table, table))
    np.testing.assert_array_equal(log.odometry.twist[:, 0], np.arange(10.0))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize(
    ("delimiter", "point"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")]
)
def test_the_delimiter_is_found(delimiter: str, point: str, encoding: str, tmp_path: Path) -> None:
    odometry = "t,vx,wz\n0.0,1.5,-0.25\n0.5,-2.5e-1,1\n"
    detections = "t,x,y,label,note\n0.25,4.125,-.5,left,a b\n"
    for name, text in (("odometry", odometry), ("detections", detections)):
        exported = text.replace(",", delimiter).replace(".", point)
        (tmp_path / f"{name}.csv").write_bytes(exported.encode(encoding))
    log = convert(tmp_path)
    np.testing.assert_array_equal(log.odometry.t, [0.0, 0.5])
    np.testing.assert_array_equal(log.odometry.twist, [[1.5, 0.0, -0.25], [-0.25, 0.0, 1.0]])
    np.testing.assert_array_equal(log.cycles[0].points_vehicle, [[4.125, -0.5]])


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "inf", "null", "None", "N/A", " "])
@pytest.mark.parametrize("header", ["t,x,y", "t,range,bearing", "t,y,x"])
def test_a_missing_detection_is_left_out_and_counted(
    missing: str, header: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detections = f"{header}\n0.1,4,1\n0.1,{missing},1\n0.3,4,{missing}\n0.3,5,1\n"
    log = convert(write(tmp_path, GOOD_ODOMETRY, detections))
    assert [len(cycle.labels) for cycle in log.cycles] == [1, 1]
    assert "2 detections that are not finite were left out" in capsys.readouterr().out


def test_a_missing_twist_is_left_out_and_a_missing_covariance_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odometry = "t,vx,wz\n0,1,0\n0.2,,0\n0.4,1,nan\n1,2,0\n"
    detections = "t,x,y,xx,xy,yy\n0.1,4,1,0.1,0,0.1\n0.1,5,1,,,\n"
    log = convert(write(tmp_path, odometry, detections))
    np.testing.assert_array_equal(log.odometry.twist[:, 0], [1.0, 2.0])
    said = capsys.readouterr().out
    assert "2 odometry samples that are not finite were left out" in said
    assert "1 detections had no covariance that can be used" in said


GOOD_ODOMETRY = "t,vx,wz\n0,1,0\n1,1,0\n"
GOOD_DETECTIONS = "t,x,y,label\n0.1,4,1,left\n0.3,4,1,left\n"


@pytest.mark.parametrize(
    ("odometry", "detections", "options", "said"),
    [
        ("", GOOD_DETECTIONS, [], "odometry.csv"),
        ("t,vx,wz\n", GOOD_DETECTIONS, [], "odometry.csv, row 2: expected at least one row"),
        ("t,v,wz\n0,1,0\n", GOOD_DETECTIONS, [], "(--columns vx=NAME), found the columns t, v, wz"),
        (GOOD_ODOMETRY, "t,x,z\n0,1,0\n", [], "expected a column 'y', or range and bearing"),
        (GOOD_ODOMETRY, "t,z\n0,1\n", [], "detections.csv, row 1: expected a column 'x'"),
        (GOOD_ODOMETRY, "t,x,y\n0,1,a\n", [], "csv, row 2: expected a number in column 'y', found 'a'"),
        (GOOD_ODOMETRY, "t,x,y\n0,1,\n", [], "can be used, found 1 messages without any; 1 detections that"),
        ("t,vx,wz\n,1,0\n", GOOD_DETECTIONS, [], "row 2: expected a number in column 't', found ''"),
        (GOOD_ODOMETRY, "t,range\n0.1,1\n", [], "expected a column 'bearing' (--columns bearing=NAME)"),
        (GOOD_ODOMETRY, "t,x,y,xx\n0,1,1,1\n", [], "expected a column 'xy'"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--columns", "speed=v"], "expected one of t, vx, vy, wz, x"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--columns", "vx"], "--columns: expected QUANTITY=COLUMN"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--columns", "odometry.xx=v"], "expected one of t, vx, vy, wz, x,"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--columns", "vx=v"], "expected a column 'v' for vx"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--columns", "vy=v"], "expected a column 'v' for vy"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--units", "time=h"], "expected time= one of s, ms, us, ns"),
        (GOOD_ODOMETRY, GOOD_DETECTIONS, ["--units", "length:mm"], "--units: expected one of time, length"),
        (GOOD_ODOMETRY, "t,range,bearing\n0.1,-3,1\n", [], "expected ranges of at least 0"),
        ("t,vx,wz\n1700000000000000000,1,0\n", GOOD_DETECTIONS, [], "in s, at most 1e+10, found 1.7e+18"),
        ("t,vx,wz\n0,5000,0\n1,1,0\n", GOOD_DETECTIONS, [], "first vx = 5000 m/s in odometry.csv, row 2"),
        (GOOD_ODOMETRY, "t,x,y\n7,1,1\n", [], "expected detections in the time of the odometry"),
        ("t,vx,wz\n0,1,0\n1,1,0\n40,1,0\n41,1,0\n", "t,x,y\n1,4,1\n41,4,1\n", [], "(odometry.csv, row 4)"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_in_one_line(
    odometry: str,
    detections: str,
    options: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert said in refused(write(tmp_path, odometry, detections), capsys, *options)


def test_files_of_other_names_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "wheels.csv").write_text(GOOD_ODOMETRY)
    (tmp_path / "cones.csv").write_text(GOOD_DETECTIONS)
    assert "odometry.csv: expected a file, found none" in refused(tmp_path, capsys)
    assert len(convert(tmp_path, "--odometry", "wheels.csv", "--detections", "cones.csv").cycles) == 2


# --- JSON lines ------------------------------------------------------------------------------------------


LINES = """{"t": 0.0, "twist": [1.0, 0.0, 0.1]}
{"t": 0.5, "twist": [1.5, 0.1, 0.2], "detections": [{"x": 4.0, "y": 1.0, "label": "blue_cone"}]}

{"t": 1.0, "detections": [{"range": 5.0, "bearing": 0.5, "covariance": [[0.04, 0.01], [0.01, 0.02]]}]}
{"t": 1.0, "twist": [1.0, 0.0, 0.0]}
"""


def test_json_lines_become_a_log(tmp_path: Path) -> None:
    (tmp_path / "drive.jsonl").write_text(LINES)
    assert (
        main(["convert", str(tmp_path / "drive.jsonl"), "--from", "jsonl", "--out", str(tmp_path / "log")])
        == 0
    )
    log = read_log(tmp_path / "log")
    np.testing.assert_array_equal(log.odometry.twist, [[1.0, 0.0, 0.1], [1.5, 0.1, 0.2], [1.0, 0.0, 0.0]])
    assert [cycle.t for cycle in log.cycles] == [0.5, 1.0]
    assert [cycle.labels.tolist() for cycle in log.cycles] == [[LEFT], [UNKNOWN]]
    np.testing.assert_allclose(log.cycles[1].points_vehicle, [[5.0 * np.cos(0.5), 5.0 * np.sin(0.5)]])
    np.testing.assert_allclose(log.cycles[1].covariances, [[[0.04, 0.01], [0.01, 0.02]]])


@pytest.mark.parametrize(
    "line",
    [
        *(
            "{",
            "[]",
            '{"twist": [1, 2, 3]}',
            '{"t": 0, "twist": [1, 2]}',
            '{"t": 0, "detections": [{"x": 1}]}',
        ),
        '{"t": 0, "detections": [{"bearing": 0.1}]}',
        '{"t": 0, "scan": {"ranges": [1.0]}}',
        '{"t": 0, "scan": {"angle_min": 0.0, "angle_increment": "x", "ranges": [1.0]}}',
        '{"t": 0, "scan": [1.0]}',
        '{"t": 0, "polylines": [[[0.0, 1.0]]]}',
        '{"t": 0, "polylines": [{"points": [[0.0, 1.0, 2.0]]}]}',
    ],
)
def test_a_bad_line_is_named(line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "drive.jsonl").write_text(f"{LINES}{line}\n")
    assert (
        main(["convert", str(tmp_path / "drive.jsonl"), "--from", "jsonl", "--out", str(tmp_path / "log")])
        == 2
    )
    told = capsys.readouterr().err
    assert "drive.jsonl" in told and "6" in told and told.count("\n") == 1
    assert not (tmp_path / "log").exists()


def test_a_line_with_one_cycle_has_no_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "drive.jsonl"
    file.write_text('{"t": 1, "twist": [1, 0, 0], "detections": [{"x": 4, "y": 1}]}\n')
    assert main(["convert", str(file), "--from", "jsonl", "--out", str(tmp_path / "log")]) == 0
    said = capsys.readouterr().out
    assert "odometry at an unknown rate, up to 1 m/s" in said
    assert "Hz" not in said
