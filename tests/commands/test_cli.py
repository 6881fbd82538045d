"""The command line end to end on a short drive: what it writes, says, refuses, and never leaves behind."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline as ScipyBSpline

from pathspace_graph import __main__ as program
from pathspace_graph.baselines.landmark_graph import LandmarkFixedLag
from pathspace_graph.batch import system
from pathspace_graph.cli import COMMANDS, main
from pathspace_graph.commands import estimate as commands_estimate
from pathspace_graph.io.log import Odometry
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import Map, read_map
from pathspace_graph.io.results import LapBatches, RunResult
from pathspace_graph.labels import LEFT, NAMES, RIGHT
from pathspace_graph.spline.boundary import Crossing

from ..scenes.pretenders import contents

SHORT_TRACK = [
    *("--generator.lap-length", "100", "160"),
    *("--generator.corners", "3", "4"),
    *("--generator.hairpins", "0", "0"),
    *("--generator.cones", "90"),
]


def simulate(out: Path, *options: str) -> int:
    return main(["simulate", "--generate", "4", "--laps", "1", "--out", str(out), *SHORT_TRACK, *options])


@pytest.fixture(scope="module")
def log_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "log"
    assert simulate(folder) == 0
    return folder


@pytest.fixture(scope="module")
def map_folder(log_folder: Path) -> Path:
    folder = log_folder.parent / "map"
    assert main(["online", str(log_folder), "--out", str(folder)]) == 0
    return folder


def test_a_batch_that_is_late_in_a_vehicle_is_told(
    log_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for late, told in ((0, False), (3, True)):
        batches = LapBatches((140,), late)
        run = RunResult("", {}, Map(True, {}), np.zeros(0), np.zeros((0, 3)), (), 1, batches=batches)
        commands_estimate.report(run, read_log(log_folder))
        line = "in a vehicle the batch of the lap would have been 3 cycles late"
        assert (line in capsys.readouterr().out) == told


def beginning_of(log_folder: Path, out: Path, cycles: int = 20) -> Path:
    """A folder with the first cycles of a log; it knows no truth."""
    log = read_log(log_folder)
    odometry, seen = log.odometry, log.odometry.t <= log.cycles[cycles].t
    odometry = Odometry(odometry.t[seen], odometry.twist[seen])
    write_log(replace(log, odometry=odometry, cycles=log.cycles[:cycles], truth=None), out)
    return out


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# --- simulate --------------------------------------------------------------------------------------------


def test_a_log_keeps_the_formats_contract(log_folder: Path) -> None:
    expected = {
        "odometry.csv": "t,vx,vy,wz",
        "detections.csv": "t,x,y,label,xx,xy,yy",
        "truth_poses.csv": "t,x,y,theta",
        "truth_cones.csv": "x,y,label",
    }
    for name, header in expected.items():
        assert (log_folder / name).read_text().splitlines()[0] == header
    assert (log_folder / "log.toml").read_text().startswith('format = "pathspace-log/1"')
    first = (log_folder / "truth_poses.csv").read_text().splitlines()[1]
    assert [float(value) for value in first.split(",")[1:]] == [0.0, 0.0, 0.0]


# --- online ----------------------------------------------------------------------------------------------


def test_a_map_keeps_the_formats_contract(log_folder: Path, map_folder: Path) -> None:
    files = {"map.json", "trajectory.tum", "smoothed.tum", "cycles.csv", "summary.json"}
    assert names(map_folder) == files
    content = json.loads((map_folder / "map.json").read_text())
    assert content["format"] == "pathspace-map/1"
    cones = read_log(log_folder).truth
    assert cones is not None
    for label in (LEFT, RIGHT):
        boundary = content["boundaries"][NAMES[label]]
        spline = ScipyBSpline(boundary["knots"], boundary["control_points"], boundary["degree"])
        low, high = boundary["knots"][boundary["degree"]], boundary["knots"][-boundary["degree"] - 1]
        curve = spline(np.linspace(low, high, 2000))
        own = cones.cones[cones.cone_labels == label]
        away = np.linalg.norm(own[:, None] - curve[None], axis=2).min(axis=1)
        assert np.median(away) < 1.0
        assert np.shape(boundary["covariance"]) == (2 * boundary["size"], 2 * boundary["size"])


def test_the_result_is_printed_as_json_and_drawn(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out, picture = beginning_of(log_folder, tmp_path / "log"), tmp_path / "map", tmp_path / "map.png"
    assert main(["online", str(log), "--out", str(out), "--plot", str(picture), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["written"] == [str(out), str(picture)]
    assert printed["wrong"] == []
    assert printed["settings"] == json.loads((out / "summary.json").read_text())["settings"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["export", str(out), "--as", "points", "--out", "-"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "x,y,label", "only the file is on standard output"


def test_the_summary_says_how_and_how_well(map_folder: Path) -> None:
    summary = json.loads((map_folder / "summary.json").read_text())
    assert summary["estimator"] == "fixed-lag"
    assert summary["settings"]["lag"] == 3.0
    assert {"python", "gtsam", "numpy", "scipy", "pathspace-graph"} <= set(summary["versions"])
    assert summary["lap_count"] == 1
    assert [row["lap"] for row in summary["laps"]] == [1]
    assert {"lap", "rmse", "missed", "size"} <= set(summary["laps"][0])
    assert summary["final"]["size"] == read_map(map_folder).size
    assert 0.0 < summary["ate"] < 5.0
    assert summary["ate"] ** 2 == pytest.approx(summary["rmse_along"] ** 2 + summary["rmse_across"] ** 2)


@pytest.mark.parametrize("command", ["online", "batch"])
def test_a_boundary_across_the_drive_is_told_with_its_place_and_exit_code_3(
    command: str,
    log_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = beginning_of(log_folder, tmp_path / "log")
    found = [Crossing(RIGHT, np.array([12.0, -3.5]), 40.0), Crossing(LEFT, np.zeros(2), 90.0)]
    monkeypatch.setattr("pathspace_graph.plausibility.diagnosis.crossed_boundaries", lambda *_: found)
    assert main([command, str(log), "--out", str(tmp_path / "map")]) == 3
    said = capsys.readouterr().err.splitlines()
    (line,) = [one for one in said if one.startswith("not a map of the drive")]
    assert line.endswith(
        "the right boundary lies across the driven path at x = 12 m, y = -3.5 m, after 40 m, and at 1 more"
    )
    first, _ = json.loads((tmp_path / "map" / "summary.json").read_text())["crossings"]
    assert first == {"boundary": "right", "x": 12.0, "y": -3.5, "driven": 40.0}


@pytest.mark.parametrize("estimator", ["landmark-fixed-lag", "spline"])
def test_an_estimate_that_cannot_be_computed_is_one_line_and_exit_code_3(
    log_folder: Path,
    tmp_path: Path,
    estimator: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not\nconverge")

    monkeypatch.setattr(LandmarkFixedLag, "update", fails)
    monkeypatch.setattr(system, "bayes_net", fails)
    command = "batch" if estimator == "spline" else "online"
    options = (
        ["--estimator", estimator, "--start", "odometry"]
        if command == "batch"
        else ["--estimator", estimator]
    )
    assert main([command, str(log_folder), "--out", str(tmp_path / "map"), *options]) == 3
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.endswith("has failed: LinAlgError: SVD did not converge")
    assert not (tmp_path / "map").exists()


def test_a_log_without_detections_says_what_it_could_not_map(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_log(replace(read_log(log_folder), cycles=(), truth=None), tmp_path / "log")
    assert main(["online", str(tmp_path / "log"), "--out", str(tmp_path / "map")]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "left boundary: not mapped, no left detections; right boundary: not mapped, no right detections"
    ]
    assert read_map(tmp_path / "map").boundaries == {}
    assert (tmp_path / "map" / "trajectory.tum").read_text() == ""
    assert main(["plot", str(tmp_path / "map"), "--out", str(tmp_path / "map.svg")]) == 0


# --- plot and demo ---------------------------------------------------------------------------------------


def test_plot_draws_a_map_with_its_log(log_folder: Path, map_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.png"
    assert main(["plot", str(map_folder), "--log", str(log_folder), "--out", str(out)]) == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert names(tmp_path) == {"map.png"}


@pytest.mark.slow
def test_demo_shows_the_table_and_leaves_log_map_and_picture(
    log_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathspace_graph.commands.studies.simulate", lambda *_: read_log(log_folder))
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == 0
    (tmp_path / "pathspace-demo" / "track.png").write_text("of an earlier demo")
    assert main(["demo"]) == 0
    assert (tmp_path / "pathspace-demo" / "track.png").read_bytes().startswith(b"\x89PNG")
    assert names(tmp_path / "pathspace-demo") == {"log", "map", "track.png"}
    assert read_map(tmp_path / "pathspace-demo" / "map").boundaries
    printed = capsys.readouterr().out
    assert "rmse [m]" in printed
    assert "pathspace-demo" in printed


def test_an_earlier_result_is_replaced_by_force_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path / "log") == 0
    before = contents(tmp_path / "log")
    assert simulate(tmp_path / "log", "--seed", "1") == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and f"{tmp_path / 'log'}: expected no earlier result" in line
    assert contents(tmp_path / "log") == before
    assert simulate(tmp_path / "log", "--seed", "1", "--force") == 0
    assert contents(tmp_path / "log") != before
    assert names(tmp_path) == {"log"}


# --- usage -----------------------------------------------------------------------------------------------


def test_the_output_is_checked_before_the_work(
    log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read = "read_plausible_log"
    monkeypatch.setattr(commands_estimate, read, lambda *_: pytest.fail("read before the check"))
    (tmp_path / "thesis.tex").write_text("mine")
    assert main(["online", str(log_folder), "--out", str(tmp_path)]) == 2
    assert main(["online", str(log_folder), "--out", str(tmp_path / "thesis.tex" / "map")]) == 2
    assert capsys.readouterr().err.count("\n") == 2
    assert names(tmp_path) == {"thesis.tex"}


def test_an_interrupt_before_the_command_line_is_there_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "import_module", interrupt)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert program.main() == 130
    assert capsys.readouterr().err == "pathspace-graph: interrupted\n"


def test_an_interrupt_leaves_nothing_half_written(
    log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    log = beginning_of(log_folder, tmp_path / "log")
    monkeypatch.setattr("pathspace_graph.io.results.write_table", interrupt)
    assert main(["online", str(log), "--out", str(tmp_path / "deep" / "map")]) == 130
    assert capsys.readouterr().err == "pathspace-graph: interrupted\n"
    assert names(tmp_path) == {"log"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_the_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["help", command], [command, "-h"], ["-h", command]):
        assert main(words) == 0
        shown = capsys.readouterr().out
        assert shown.startswith(f"Usage: pathspace-graph {command} ")
        assert ("--html" if command == "view" else "--out") in shown
        assert "Print the result as JSON" in shown


@pytest.mark.parametrize("words", [[], ["help"], ["--help"], ["-h"]])
def test_the_overview_has_every_command(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 0
    shown = capsys.readouterr().out
    for command in COMMANDS.values():
        assert command.summary in shown
