"""The measuring script: one tiny run for real, and the tables held against runs made by hand."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.eval.metrics.table1 import LapMetrics
from pathspace_graph.eval.tables.cases import Case, measure
from pathspace_graph.eval.tables.online_table import (
    TRACK_HEADER,
    OnlineTable,
    Outcome,
    evaluate,
    run_case,
    summary_rows,
    track_rows,
    write_csv,
)
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

SHORT = TrackGeneratorSettings(lap_length=(100.0, 160.0), corners=(3, 4), hairpins=(0, 0), cones=90)


def outcome(track: int, seed: int, rmse: float, missed: float = 0.0, closed: bool = True) -> Outcome:
    laps = (LapMetrics(1, 2 * rmse, missed, 150), LapMetrics(2, rmse, missed / 2, 40))
    return Outcome(
        Case(track, seed, 2),
        closed=closed,
        laps=laps,
        cones=100,
        inside=90 if track == 0 else 80,
        landmark_rmse=0.3,
        fit_rmse=0.4,
        milliseconds=(2.0, 4.0),
        milliseconds_p99=9.0,
    )


def failed(track: int, seed: int) -> Outcome:
    return Outcome(Case(track, seed, 2), failure="RuntimeError: lost")


def value(rows: list[tuple[str, ...]], name: str) -> str:
    (found,) = [row[1] for row in rows if row[0] == name]
    return found


def test_one_short_lap_for_real() -> None:
    track = generate_track(np.random.default_rng(4), SHORT)
    log = simulate(track, SimulationSettings(laps=1), 0)
    done = evaluate(Case(4, 0, 1), log)
    assert len(done.laps) == 1
    assert done.cones == len(track.left) + len(track.right)
    assert 0.0 < done.laps[0].rmse < 2.0
    assert 0.0 < done.landmark_rmse < 1.0
    assert done.limit == pytest.approx(np.hypot(done.landmark_rmse, done.fit_rmse))
    assert 0 <= done.inside <= done.cones
    assert len(done.milliseconds) == 1
    assert done.milliseconds_p99 >= done.milliseconds[0] > 0.0


def test_a_run_that_fails_is_an_outcome() -> None:
    cases = [Case(Path(f"none-{number}.yaml"), 0, 1) for number in range(3)]
    outcomes = measure(run_case, cases, jobs=1)
    assert [outcome.case for outcome in outcomes] == cases
    assert all("InputError: none-" in outcome.failure for outcome in outcomes)
    assert value(summary_rows(outcomes), "runs finished") == "0 of 3"
    assert value(summary_rows(outcomes), "loop closed") == "0.0 %"
    assert len(track_rows(outcomes)) == 3


def test_the_summary_is_over_all_runs() -> None:
    worst_open = replace(outcome(1, 1, 3.0, closed=False), cones=300)
    rows = summary_rows([outcome(0, 0, 0.4), outcome(0, 1, 0.6, missed=0.3), worst_open, failed(1, 2)])
    assert value(rows, "runs finished") == "3 of 4"
    assert value(rows, "loop closed") == "50.0 %"
    assert value(rows, "missed at the end of lap 1, median run") == "0.00 %"
    assert value(rows, "missed at the end of lap 1, mean") == "10.00 %"
    assert value(rows, "missed in later laps, mean") == "5.00 %"
    assert value(rows, "rmse at the last lap, mean") == f"{4 / 3:.3f} m"
    assert value(rows, "rmse at the last lap, largest of a closed loop") == "0.600 m"
    assert value(rows, "limit, mean") == "0.500 m"
    assert value(rows, "rmse by limit, ratio of the means") == f"{8 / 3:.2f}"
    assert value(rows, "size by true cones, largest of a closed loop") == "40.0 %"
    assert value(rows, "true cones within the 2σ band") == "52.0 %"
    assert value(rows, "mean update, last lap by lap 2, median run") == "1.00"


def test_a_track_has_the_means_of_its_seeds() -> None:
    rows = track_rows([outcome(0, 0, 0.4), outcome(0, 1, 0.6, closed=False), outcome(1, 0, 0.2)])
    assert [row[0] for row in rows] == ["generated 0", "generated 1"]
    named = dict(zip(TRACK_HEADER, rows[0], strict=True))
    assert named["closed"] == "1 of 2"
    assert named["rmse last lap [m]"] == "0.500"
    assert named["rmse lap 1 [m]"] == "1.000"
    assert named["within 2σ [%]"] == "90.0"
    assert named["update [ms]"] == "3.00"


def test_the_csv_has_a_row_for_each_run_and_lap(tmp_path: Path) -> None:
    write_csv(tmp_path / "runs.csv", [outcome(0, 0, 0.4), failed(0, 1)])
    with (tmp_path / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["seed"], row["lap"]) for row in rows] == [("0", "1"), ("0", "2"), ("1", "")]
    assert float(rows[1]["rmse"]) == 0.4
    assert rows[2]["failure"] == "RuntimeError: lost"


@pytest.mark.parametrize("markdown", [False, True])
def test_the_script_prints_both_tables(
    markdown: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = [outcome(0, 0, 0.4), failed(0, 1)]
    monkeypatch.setattr("pathspace_graph.eval.tables.online_table.measure", lambda *_: made)
    OnlineTable(generated=1, seeds=2, out=tmp_path / "runs.csv", markdown=markdown).run()
    printed = capsys.readouterr()
    assert "generated 0" in printed.out
    assert "over all runs" in printed.out
    assert printed.err == "generated 0, seed 1: RuntimeError: lost\n"
    assert (tmp_path / "runs.csv").is_file()
