"""Logs with hints: a refusal names its likely cause, the commands tell hints, and `summary.json` has them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph import hints
from pathspace_graph.cli import main
from pathspace_graph.errors import InputError
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.io.log_files import write_log
from pathspace_graph.plausibility.judge import read_plausible_log, refused_hints
from pathspace_graph.settings.mapper import LimitSettings

from ..scenes.drives import short_drive
from .mistakes import MISTAKES


def written(log: Log, folder: Path) -> Path:
    write_log(log, folder, force=True)
    return folder


@pytest.mark.parametrize(
    ("mistake", "file", "likely"),
    [
        ("stamps in nanoseconds", "odometry.csv", "the stamps are in nanoseconds"),
        ("stamps of the detections in nanoseconds", "detections.csv", "the stamps are in nanoseconds"),
        ("all lengths in millimetres", "odometry.csv", "the speeds are in mm/s"),
        ("speeds in mm/s", "odometry.csv", "the speeds are in mm/s"),
        ("yaw rate in degrees per second", "odometry.csv", "the yaw rate is in degrees per second"),
        ("covariances of zero", "detections.csv", "the covariances are too small, as in another unit"),
    ],
)
def test_a_refusal_names_its_likely_cause_in_one_line(
    mistake: str, file: str, likely: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = written(MISTAKES[mistake](short_drive()), tmp_path / "log")
    assert main(["online", str(folder), "--out", str(tmp_path / "map")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"pathspace-graph: {folder / file}, row ")
    assert f"likely cause: {likely}" in said or f"; {likely}" in said
    assert not (tmp_path / "map").exists()


def test_a_refusal_without_a_likely_cause_is_as_it_was(tmp_path: Path) -> None:
    folder = written(short_drive(), tmp_path / "log")
    lines = (folder / "odometry.csv").read_text().splitlines()
    lines[5] = "0.08,fast,0,0"
    (folder / "odometry.csv").write_text("\n".join(lines))
    with pytest.raises(InputError) as error:
        read_plausible_log(folder, LimitSettings())
    expected = "row 6: expected a number in column 'vx', found 'fast'"
    assert str(error.value) == f"{folder / 'odometry.csv'}, {expected}"
    assert refused_hints(folder) == []


def test_a_refusal_of_a_stamp_does_not_blame_the_labels(tmp_path: Path) -> None:
    """All cones are left here, which would be told were the log not refused for a gap of a minute."""
    log = MISTAKES["all labels left"](short_drive())
    assert [hint.cause for hint in hints(log)] == ["labels"]
    cycles = tuple(replace(cycle, t=cycle.t + 60.0 * (cycle.t > 5.0)) for cycle in log.cycles)
    t = log.odometry.t + 60.0 * (log.odometry.t > 5.0)
    folder = written(replace(log, cycles=cycles, odometry=replace(log.odometry, t=t)), tmp_path / "log")
    with pytest.raises(InputError, match="at most 30 s after") as error:
        read_plausible_log(folder, LimitSettings())
    assert "label" not in str(error.value)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e30])
def test_a_log_in_memory_with_what_no_file_may_have_is_judged_as_its_files_are(
    wrong: float, tmp_path: Path
) -> None:
    log = short_drive()
    points = np.full_like(log.cycles[9].points_vehicle, wrong)
    cycles = (*log.cycles[:9], replace(log.cycles[9], points_vehicle=points), *log.cycles[10:])
    twists = log.odometry.twist.copy()
    twists[7, 2] = wrong
    for bad in (replace(log, cycles=cycles), replace(log, odometry=replace(log.odometry, twist=twists))):
        folder = written(bad, tmp_path / "log")
        with pytest.raises(InputError, match=r"expected a (finite number|number of at most)"):
            read_plausible_log(folder, LimitSettings())
        assert hints(bad) == refused_hints(folder) == []


@pytest.mark.parametrize(("command", "code"), [("online", 3), ("batch", 3)])
def test_a_hint_is_told_and_the_log_is_mapped(
    command: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = MISTAKES["positions in centimetres"](short_drive())
    t, twist = log.odometry.t, log.odometry.twist
    shown = t <= log.cycles[60].t
    short = Log(Odometry(t[shown], twist[shown]), log.cycles[:60], log.odometry_sigma)
    folder, out = written(short, tmp_path / "log"), tmp_path / "map"
    assert main([command, str(folder), "--out", str(out)]) == code
    lines = capsys.readouterr().err.splitlines()
    assert "not a map of the drive: the positions are in centimetres, not in metres" in lines
    assert [line for line in lines if line.startswith("hint: ")] == lines[:1]
    assert "the positions are in centimetres" in lines[0]
    (hint,) = json.loads((out / "summary.json").read_text())["hints"]
    assert (hint["cause"], hint["file"], hint["columns"]) == ("positions", "detections.csv", "columns x, y")


def test_labels_of_a_detector_are_told(tmp_path: Path) -> None:
    folder = written(short_drive(), tmp_path / "log")
    text = (folder / "detections.csv").read_text()
    (folder / "detections.csv").write_text(text.replace("left", "cone_b").replace("right", "cone_y"))
    _, (hint,) = read_plausible_log(folder, LimitSettings())
    assert hint.found in ("the labels are 'cone_b', 'cone_y'", "the labels are 'cone_y', 'cone_b'")
    (folder / "detections.csv").write_text(text.replace("left", "unknown").replace("right", ""))
    assert read_plausible_log(folder, LimitSettings())[1] == []
