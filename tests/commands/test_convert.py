"""`convert` of a recording that states no noise, and what the runs on its log say of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph import read_log
from pathspace_graph.cli import main

from ..convert.recorded import camera_drive, write_recorded

OPTIONS = ["--from", "csv", "--columns", "label=colour", "--labels", "left=1", "right=0", "--y", "right"]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recorded(camera_drive(), tmp_path_factory.mktemp("drive") / "recorded")


def run(*arguments: object, code: int = 0) -> None:
    assert main([str(argument) for argument in arguments]) == code


def test_what_was_measured_is_said(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("convert", recorded, *OPTIONS, "--out", tmp_path / "log")
    printed = capsys.readouterr().out
    (line,) = (line for line in printed.splitlines() if line.startswith("measured: "))
    assert "m along and" in line
    assert "ms newer than their stamps" in line
    assert "degrees to the right" in line
    assert "% too long" in line
    run("online", tmp_path / "log", "--out", tmp_path / "map")
    printed = capsys.readouterr().out
    assert "measured: odometry" in printed
    assert "the map's size is the odometry's (--calibration.trust ranges reverses that)" in printed
    summary = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert (summary["noise"]["odometry"], summary["noise"]["detections"]) == ("measured", "measured")
    assert summary["noise"]["stated"] == {}
    assert set(summary["noise"]["measured"]["along"]) == {"sigma", "growth", "share", "time"}
    assert summary["notes"][1].startswith("ranges and speeds disagree by")
    run("online", tmp_path / "log", "--out", tmp_path / "map", "--calibration.trust", "ranges", "--force")
    assert "the map's size is the ranges'" in capsys.readouterr().out


def test_far_detections_are_left_out_and_stamps_are_moved(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moves = ["--range-max", "12", "--time-offset", "0.125"]
    run("convert", recorded, *OPTIONS, *moves, "--out", tmp_path / "log")
    assert "detections farther from the sensor than 12 m were left out" in capsys.readouterr().out
    log, drive = read_log(tmp_path / "log"), camera_drive()
    ranges = np.concatenate([np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles])
    assert ranges.max() <= 12.0
    stamps = np.array([cycle.t for cycle in drive.cycles]) + 0.125
    assert all(np.abs(stamps - cycle.t).min() < 1e-6 for cycle in log.cycles)


@pytest.mark.parametrize(
    ("kind", "options", "expected"),
    [
        ("csv", ["--imu", "/imu"], "--imu: expected --from bag, found csv"),
        ("csv", ["--received"], "--received: expected --from bag, found csv"),
        ("csv", ["--label-field", "class"], "--label-field: expected --from bag, found csv"),
        ("jsonl", ["--units", "length=mm"], "--units: expected --from csv, found jsonl"),
        ("jsonl", ["--odometry", "/odom"], "--odometry: expected --from bag or csv, found jsonl"),
        ("bag", ["--columns", "vx=speed"], "--columns: expected --from csv, found bag"),
        ("bag", ["--units", "angle=deg"], "--units: expected --from csv, found bag"),
    ],
)
def test_an_option_that_a_kind_of_record_would_ignore_is_refused(
    kind: str,
    options: list[str],
    expected: str,
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run("convert", recorded, "--from", kind, *options, "--out", tmp_path / "log", code=2)
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "log").exists()


def test_hints_at_units_name_the_option(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "recorded"
    folder.mkdir()
    (folder / "detections.csv").write_text((recorded / "detections.csv").read_text())
    header, *rows = (recorded / "odometry.csv").read_text().splitlines()
    table = np.array([[float(value) for value in row.split(",")] for row in rows])
    table[:, 1:3] *= 3.6
    text = "\n".join([header, *(",".join(f"{value:.9g}" for value in row) for row in table), ""])
    (folder / "odometry.csv").write_text(text)
    run("convert", folder, *OPTIONS, "--out", tmp_path / "log")
    assert (
        "the speeds are in km/h, not in m/s; multiply vx and vy by 0.27778, or convert with --units"
        in capsys.readouterr().err
    )


def test_times_of_a_run_count_from_its_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], recorded: Path
) -> None:
    """Stamps of a bag count from 1970; what is printed does not."""
    folder = tmp_path / "recorded"
    folder.mkdir()
    for name in ("odometry.csv", "detections.csv"):
        header, *rows = (recorded / name).read_text().splitlines()
        moved = (f"{float(row.partition(',')[0]) + 1.7e9:.9f},{row.partition(',')[2]}" for row in rows)
        (folder / name).write_text("\n".join([header, *moved, ""]))
    run("convert", folder, *OPTIONS, "--out", tmp_path / "log")
    run("online", tmp_path / "log", "--out", tmp_path / "map")
    printed = capsys.readouterr().out
    assert "at " in printed and "17000000" not in printed
    assert read_log(tmp_path / "log").odometry.t[0] >= 1.7e9
