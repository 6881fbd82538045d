"""Recorded logs in a study: their tracks, metrics that need no truth, and drives that can be had again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import InputError, OutputError, SettingsError
from pathspace_graph.eval.experiment.run import locked, make_plan, run_study
from pathspace_graph.eval.experiment.study import Study, read_study_file, study_from
from pathspace_graph.eval.experiment.tables import results_table, write_study
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import read_map

from ...scenes.paths import ROOT
from ...scenes.pretenders import Pretender, contents, register, write_round_track
from ...scenes.rings import write_logs
from ...test_docs import file_blocks


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the logs a and b, one of them without truth."""
    register(monkeypatch)
    folder = write_logs(tmp_path / "rings")
    write_log(replace(read_log(folder / "b"), truth=None), tmp_path / "b")
    for file in (folder / "b").iterdir():
        file.unlink()
    (folder / "b").rmdir()
    (tmp_path / "b").rename(folder / "b")
    return folder


def test_logs_are_of_tracks_of_their_own_or_of_those_that_are_named(logs: Path) -> None:
    assert study_from({"drives": {"logs": ["logs"]}}, logs.parent).logs == {
        "a": (logs / "a",),
        "b": (logs / "b",),
    }
    named = study_from({"drives": {"logs": {"ring": ["logs"]}}}, logs.parent)
    assert named.logs == {"ring": (logs / "a", logs / "b")} and named.noises == ["recorded"]
    for wrong in ({"drives": {"log": []}}, {"drives": {"logs": [0]}}, {}):
        with pytest.raises(SettingsError):
            study_from(wrong)
    with pytest.raises(InputError, match="expected a log"):
        study_from({"drives": {"logs": ["none"]}}, logs)


def test_a_study_of_logs_and_tracks(logs: Path, tmp_path: Path) -> None:
    track = write_round_track(tmp_path)
    study = Study(
        tracks=(track,),
        logs={"ring": (logs / "a", logs / "b")},
        estimators=("pretender",),
        laps=2,
        grids=({"lag": [1.0]},),
        metrics=("rmse", "size", "crossings"),
    )
    frame = run_study(study, tmp_path / "out")
    recorded = frame[frame["noise"] == "recorded"]
    assert [*recorded["drive"].unique()] == ["a", "b"] and set(recorded["track"]) == {"ring"}
    assert recorded.groupby("drive")["rmse"].count().to_dict() == {"a": 4, "b": 0}
    assert recorded[recorded["drive"] == "b"]["crossings"].notna().all()
    assert "recorded" in write_study(study, frame, tmp_path / "out")
    calls = Pretender.calls
    run_study(study, tmp_path / "out")
    assert Pretender.calls == calls
    (logs / "b" / "odometry.csv").write_text((logs / "a" / "odometry.csv").read_text())
    run_study(study, tmp_path / "out")
    assert Pretender.calls == calls + 2, "another log of the same name"


def test_simulate_makes_the_drive_of_a_study_to_the_byte(logs: Path, tmp_path: Path) -> None:
    track = write_round_track(tmp_path)
    study = Study(tracks=(track,), seeds=(4,), estimators=("pretender",), laps=1)
    seed = run_study(study)["drive"].iloc[0]
    command = ["-q", "simulate", "--track", str(track), "--laps", "1", "--seed", seed]
    assert main([*command, "--out", str(tmp_path / "again")]) == 0
    drive = make_plan(study).cells[0].drive
    write_log(drive.load()[0], tmp_path / "drive")
    assert contents(tmp_path / "again") == contents(tmp_path / "drive")


def test_what_each_run_has_made_is_kept_where_it_is_asked_for(logs: Path, tmp_path: Path) -> None:
    study = Study(logs={"ring": (logs / "a", logs / "b")}, estimators=("pretender", "fragile"))
    run_study(study, tmp_path / "out")
    calls = Pretender.calls
    frame = run_study(study, tmp_path / "out", keep=True)
    assert Pretender.calls == calls + 2, "they have to be made once more"
    run_study(study, tmp_path / "out", keep=True)
    assert Pretender.calls == calls + 2
    for cell in frame["cell"]:
        run = tmp_path / "out" / "cells" / cell
        assert read_map(run).size == 4
        assert {"trajectory.tum", "cycles.csv", "summary.json"} <= {file.name for file in run.iterdir()}
    assert set(frame["agreement"]) == {0.0}, "both drives have the same map"


def test_a_study_becomes_a_table_of_a_paper(logs: Path, tmp_path: Path) -> None:
    made = tuple(write_round_track(folder(tmp_path / name)) for name in "xyz")
    study = Study(tracks=made, seeds=(0, 1), laps=1, estimators=("pretender",), grids=({"lag": [1.0]},))
    frame = run_study(study)
    frame.loc[frame["variant"] == "default", "rmse"] = [0.1, 0.3, 0.1, 0.3, 0.2, 0.2]  # 0.2 on each track
    table = results_table(study, frame, ("rmse", "nees"), label="tab:lag")
    assert tuple(table.frame) == ("variant", "rmse [m]", "NEES per degree of freedom")
    assert table.records()[0]["rmse [m]"] == "0.200 ± 0.000"
    assert table.best is not None
    assert table.best.values.tolist() == [[False, True, False], [False] * 3], "a NEES has no best"
    latex = table.latex()
    assert r"\label{tab:lag}" in latex and r"\textbf{0.200 $\pm$ 0.000}" in latex and latex.isascii()


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_the_page_goes_from_a_study_to_its_table_and_figures(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    track = write_round_track(tmp_path)
    file = tmp_path / "study.toml"
    drives = f'tracks = ["{track}"]\nseeds = [0, 1]\nlaps = 1'
    file.write_text(f'{drives}\nestimators = ["pretender"]\ngrid.lag = [1.0]')
    study = read_study_file(file)
    write_study(study, run_study(study, tmp_path / "out", keep=True), tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    code = file_blocks(ROOT / "docs" / "ablate.md")["paper.py"]
    assert sum(bool(line) for line in code.splitlines()) <= 20
    exec(compile(code, "paper.py", "exec"), {})
    assert r"\label{tab:lag}" in (tmp_path / "table.tex").read_text()
    assert (tmp_path / "differences.pdf").stat().st_size > 1000
    assert (tmp_path / "worst.pdf").stat().st_size > 1000
    assert "lag=1" in capsys.readouterr().out


def test_a_folder_in_which_a_study_runs_is_refused(logs: Path, tmp_path: Path) -> None:
    study = Study(logs={"ring": (logs / "a",)}, estimators=("pretender",))
    run_study(study, tmp_path / "out")
    with locked(tmp_path / "out"), pytest.raises(OutputError, match="no study that runs there"):
        run_study(study, tmp_path / "out")
    run_study(study, tmp_path / "out")
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"study.json", "cells"}


def test_agreement_is_the_mean_distance_from_the_other_drives(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three drives whose maps are 1, 2 and 4 m apart: (1 + 2) / 2, (1 + 4) / 2 and (2 + 4) / 2."""
    write_log(read_log(logs / "a"), logs / "c")
    apart = iter([1.0, 2.0, 4.0])
    monkeypatch.setattr("pathspace_graph.eval.experiment.run.aligned_distance", lambda *_: next(apart))
    ring = tuple(logs / name for name in ("a", "b", "c"))
    for count, folder in enumerate(ring):  # logs of other contents, or they would be one cell
        log = read_log(folder)
        short = replace(log, cycles=log.cycles[: len(log.cycles) - count], truth=None)
        write_log(short, tmp_path / "own" / folder.name)
    own = {"ring": tuple(tmp_path / "own" / folder.name for folder in ring)}
    frame = run_study(Study(logs=own, estimators=("pretender",)), tmp_path / "out", keep=True)
    assert frame.groupby("drive")["agreement"].last().to_dict() == {"a": 1.5, "b": 2.5, "c": 3.0}
