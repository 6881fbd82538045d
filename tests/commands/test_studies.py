"""`ablate` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.cli import main

from ..scenes.pretenders import Fragile, contents, register, write_round_track

pytestmark = pytest.mark.usefixtures("png_only")


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_round_track(tmp_path_factory.mktemp("tracks"))


@pytest.fixture(autouse=True)
def pretenders(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


TEXT = """
tracks = ["{track}"]
seeds = [0, 1]
laps = 1
estimators = ["pretender", "fragile"]
grid.lag = [1.0]
"""


@pytest.fixture
def file(track: Path, tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(TEXT.format(track=track))
    return tmp_path / "small.toml"


def test_the_command_leaves_tables_and_figures(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["ablate", str(file), "--out", str(out), "--jobs", "1"]) == 3
    printed = capsys.readouterr()
    assert "8 runs (2 failed)" in printed.out
    assert "ValueError: lost" in printed.err
    assert "2 of 8 cells failed" in printed.err
    assert "left" in printed.err
    files = set(contents(out)) - {f"cells/{name.name}" for name in (out / "cells").iterdir()}
    assert files == {
        *(
            "study.json",
            "results.csv",
            "times.csv",
            "summary.txt",
            "summary.md",
            "summary.tex",
            "table.tex",
        ),
        "figures/differences.png",
    }
    before = contents(out)
    assert main(["ablate", str(file), "--out", str(out), "--jobs", "1"]) == 3
    assert contents(out) == before
    for baseline, said in (
        ("lag=1", "difference from lag=1"),
        ("fragile", "difference from fragile: default"),
    ):
        assert main(["ablate", str(file), "--out", str(out), "--jobs", "1", "--baseline", baseline]) == 3
        assert said in capsys.readouterr().out
    assert {name: text for name, text in contents(out).items() if name.startswith("cells/")} == {
        name: text for name, text in before.items() if name.startswith("cells/")
    }


@pytest.mark.slow
def test_the_command_takes_other_tracks_seeds_and_laps(
    file: Path, tmp_path: Path, track: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Fragile, "broken", False)
    options = ["--tracks", "0", str(track), "--seeds", "5", "--laps", "2", "--jobs", "1"]
    assert main(["ablate", str(file), "--out", str(tmp_path / "out"), *options]) == 0
    frame = pd.read_csv(tmp_path / "out" / "results.csv")
    assert set(frame["track"]) == {"generated 0", "round"}
    assert set(frame["seed"]) == {5}
    assert frame["lap"].max() == 2


def test_the_command_refuses_the_folder_of_another_study(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "study.json").write_text('{"name": "another"}')
    assert main(["ablate", str(file), "--out", str(out), "--jobs", "1"]) == 2
    assert "expected the study small, found 'another'" in capsys.readouterr().err
    assert [*contents(out)] == ["study.json"]


# --- the suite of faults ---------------------------------------------------------------------------------


def options(track: Path, out: Path, estimator: str) -> list[str]:
    drives = ["--tracks", str(track), "--seeds", "0", "--laps", "1", "--jobs", "1"]
    faults = ["--only", "latency of detections", "no colours"]
    return ["faults", "--out", str(out), *drives, *faults, "--estimator", estimator]


def test_the_command_leaves_a_table_and_all_values(
    track: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(options(track, out, "pretender")) == 0
    printed = capsys.readouterr().out
    assert "latency of detections" in printed and f"written to {out}" in printed
    files = {name for name in contents(out) if not name.startswith("cells/")}
    forms = {f"faults.{suffix}" for suffix in ("txt", "md", "tex", "csv", "json")}
    assert files == forms | {"study.json", "results.csv", "times.csv"}
    rows = json.loads((out / "faults.json").read_text())["faults"]
    assert [row["fault"] for row in rows] == ["clean", *["latency of detections"] * 3, *["no colours"] * 3]
    results = pd.read_csv(out / "results.csv")
    assert set(results["simulation.faults.sensor.latency"]) == {0.0, 0.02, 0.05, 0.1}
    before = contents(out)
    assert main(options(track, out, "pretender")) == 0, "nothing is left to run"
    assert contents(out) == before


def test_runs_that_fail_are_counted(
    track: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("lost")

    monkeypatch.setattr(Fragile, "update", fail)
    assert main(options(track, tmp_path / "out", "fragile")) == 3
    assert "7 of 7 cells failed, the first of ValueError: lost" in capsys.readouterr().err
    found = json.loads((tmp_path / "out" / "faults.json").read_text())["faults"]
    assert [(row["runs"], row["failed"]) for row in found] == [(0, 1)] * 7
