"""The report: figures, the tables of each experiment, and the files that it writes."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.cli import main
from pathspace_graph.eval import report
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import TextTable, by_name, contrast_table, last_laps
from pathspace_graph.eval.metrics.measures import METRICS
from pathspace_graph.eval.report import estimators_table, laps_table, rmse_table, skidpad_table, tracks_table


def frame(estimator: str, laps: int, rmse: float) -> pd.DataFrame:
    """Two drives of a track, whose rmse falls with the number of the lap."""
    rows = [
        {"track": "t", "seed": seed, "noise": "n", "estimator": estimator, "variant": "v", "failure": ""}
        | {"lap": lap, "rmse": rmse / lap, "missed": 0.01, "reach_median": 10.0, "ate": float(lap)}
        for seed in (0, 1)
        for lap in range(1, laps + 1)
    ]
    return pd.DataFrame(rows)


RMSE = METRICS["rmse"]
STUDY = Study(tracks=(0,), laps=3, estimators=("fixed-lag", "spline"))
BOTH = pd.concat([frame("fixed-lag", 3, 0.6), frame("spline", 3, 0.3)], ignore_index=True)


def values(table: TextTable, row: int) -> list[float | None]:
    cells = table.frame.iloc[row, 1:]
    return [None if cell == "–" else float(cell.partition(" ± ")[0]) for cell in cells]


def labels(table: TextTable) -> list[object]:
    return [*table.frame.iloc[:, 0]]


def test_the_table_of_laps_has_the_online_map_and_the_batch() -> None:
    found = laps_table(STUDY, BOTH, (1, 2, 3, 10), (RMSE, METRICS["missed"]))
    assert tuple(found.frame) == ("metric", "lap 1", "lap 2", "lap 3", "batch")
    assert labels(found) == ["rmse [m]", "missed [%]"]
    assert values(found, 0) == pytest.approx([0.6, 0.3, 0.2, 0.1])
    assert values(found, 1) == pytest.approx([1.0] * 4)  # in percent


def test_the_tables_of_accuracy_have_tracks_laps_and_metrics() -> None:
    two = pd.concat([BOTH, BOTH.assign(track="other", rmse=2.0 * BOTH["rmse"])], ignore_index=True)
    found = tracks_table(STUDY, two)
    assert tuple(found.frame)[1:4] == ("rmse, lap 1 [m]", "rmse, last lap [m]", "rmse, batch [m]")
    assert labels(found) == ["t", "other"]
    assert values(found, 1)[:3] == pytest.approx([1.2, 0.4, 0.2])
    assert not found.frame.map(lambda cell: "±" in cell).any(axis=None)
    found = rmse_table(STUDY, two)
    assert tuple(found.frame) == ("rmse after lap [m]", "fixed-lag", "spline")
    assert [values(found, lap)[0] for lap in range(3)] == pytest.approx([0.9, 0.45, 0.3])
    found = estimators_table(STUDY, two, (RMSE, METRICS["missed_2m"]))
    assert tuple(found.frame) == ("metric", "fixed-lag", "spline")
    assert values(found, 0) == pytest.approx([0.3, 0.15])
    assert values(found, 1) == [None, None]


def test_a_study_s_table_has_paired_differences_from_its_baseline() -> None:
    """On seeds 0 and 1 the variant is worse by 0.1 and 0.2: 0.15 ± 12.706 x 0.05."""
    metrics = ("rmse", "ms_mean", "missed")
    study = Study(tracks=(0,), seeds=(0, 1), grids=({"lag": [1.0]},), metrics=metrics)
    runs = frame("fixed-lag", 1, 0.3).assign(noise="nominal", variant="default", ms_mean=1.0)
    worse = runs.assign(variant="lag=1", rmse=runs["rmse"] + 0.1 * (1 + runs["seed"]))
    found = contrast_table(study, pd.concat([runs, worse], ignore_index=True))
    assert tuple(found.frame) == ("variant", "rmse [m]", "difference", "p", "missed [%]")
    assert labels(found) == ["default", "lag=1"]
    assert values(found, 0)[:3] == [0.3, None, None]
    assert found.records()[1]["difference"] == "0.150 ± 0.635"
    assert values(found, 1)[2] == pytest.approx(0.2048, abs=1e-3)


def test_the_skidpad_s_trajectory_error_is_over_all_rounds() -> None:
    """Of 1 m and 2 m the rms is that of 2.5 m^2."""
    found = skidpad_table(STUDY, frame("fixed-lag", 2, 0.6), (METRICS["ate"], RMSE))
    assert values(found, 0)[0] == pytest.approx(np.sqrt(2.5), abs=5e-4)


def test_a_table_of_runs_has_a_row_for_each_noise_and_estimator() -> None:
    noises = pd.concat([BOTH.assign(noise=noise) for noise in ("1 m", "4 m")], ignore_index=True)
    found = by_name(last_laps(noises), ("noise", "estimator"), (RMSE, METRICS["nees"]))
    assert tuple(found.frame) == ("noise, estimator", "rmse [m]", "NEES per degree of freedom")
    assert labels(found) == ["1 m, fixed-lag", "1 m, spline", "4 m, fixed-lag", "4 m, spline"]
    assert values(found, 3) == [pytest.approx(0.1), None]


def test_a_tidy_table_has_a_row_for_each_figure() -> None:
    table = TextTable.of(("metric", "lap 1", "batch"), [("rmse [m]", "0.50 ± 0.10", "–")])
    assert table.tidy.to_dict("records") == [
        {"metric": "rmse [m]", "column": "lap 1", "value": "0.50", "half_width": "0.10"},
        {"metric": "rmse [m]", "column": "batch", "value": "", "half_width": ""},
    ]


def test_an_unknown_experiment_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--out", str(tmp_path), "--only", "skidpadd"]) == 2
    assert "the nearest is 'skidpad'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_report_writes_what_it_measured_and_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the online estimator alone."""
    quick = {"quick": {"seeds": [0], "estimators": ["fixed-lag"]}}
    monkeypatch.setitem(report.STUDIES, "skidpad", report.STUDIES["skidpad"] | quick)
    run = ["report", "--out", str(tmp_path), "--only", "skidpad", "--jobs", "1", "--quick"]
    assert main(run) == 0
    with (tmp_path / "skidpad.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    assert [row["column"] for row in rows] == ["trajectory error (ATE) [m]", "rmse [m]", "missed [%]"]
    assert all(row["estimator"] == "fixed-lag" and float(row["value"]) < 1.0 for row in rows)
    assert {row["command"] for row in rows} == {"pathspace-graph report --only skidpad --quick"}
    assert all(row["date"] and row["machine"] for row in rows)
    cells = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("cells/*")}
    assert main(run) == 0
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("cells/*")} == cells
