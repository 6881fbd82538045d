"""`faults` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.cli import main
from pathspace_graph.io.log_files import read_log

from ..scenes.pretenders import Fragile, contents, register, write_round_track


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_round_track(tmp_path_factory.mktemp("tracks"))


@pytest.fixture(autouse=True)
def pretenders(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


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


def test_simulate_takes_faults(track: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["simulate", "--track", str(track), "--laps", "1", "--out", str(tmp_path / "log")]
    faults = ["--faults.sensor.latency", "0.05", "--faults.vehicle.wrong-way"]
    assert main([*arguments, *faults]) == 0
    source = read_log(tmp_path / "log").source
    assert source["faults.sensor.latency"] == "0.05" and source["faults.vehicle.wrong_way"] == "True"
    assert main([*arguments, "--faults.sensor.colourless", "2"]) == 2
    assert "faults.sensor.colourless: expected a number in [0, 1]" in capsys.readouterr().err
