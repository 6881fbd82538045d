"""Outcomes of faults, and their table, from a frame that is known by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.eval.experiment.faults import (
    beside_clean,
    fault_table,
    outcomes,
    write_suite,
)
from pathspace_graph.eval.experiment.study import Study

NOISE = {
    "clean": {},
    "latency: 20 ms": {"faults.sensor.latency": 0.02},
    "latency: 50 ms": {"faults.sensor.latency": 0.05},
}
STUDY = Study(name="faults", tracks=(0,), seeds=(0, 1), laps=2, noise=NOISE)


def row(noise: str, seed: int, lap: int, **values: Any) -> dict[str, Any]:
    usual = {
        "track": "round",
        "estimator": "fixed-lag",
        "variant": "default",
        "rmse": 0.2,
        "size": 40,
        "missed": 0.0,
        "closed_at_end": True,
        "lost_at_end": False,
        "error_max": 0.5,
        "scale_by_prior": 0.1,
        "failure": "",
        "notices": "",
    }
    return {"study": "faults", "noise": noise, "seed": seed, "lap": lap} | usual | values


@pytest.fixture
def frame() -> pd.DataFrame:
    """At 20 ms both maps are worse, at 50 ms one has none and one run failed."""
    return pd.DataFrame(
        [
            row("clean", 0, 1, rmse=9.0),
            row("clean", 0, 2, rmse=0.2),
            row("clean", 1, 2, rmse=0.1),
            row("latency: 20 ms", 0, 2, rmse=0.3, size=60, scale_by_prior=-5.0, notices="a notice"),
            row("latency: 20 ms", 1, 2, rmse=0.35, missed=0.1, lost_at_end=True, scale_by_prior=-3.0),
            row("latency: 50 ms", 0, 2, rmse=np.nan, missed=1.0, closed_at_end=False, error_max=80.0),
            row("latency: 50 ms", 1, 2, failure="ValueError: lost", rmse=np.nan),
        ]
    )


def test_a_run_is_compared_with_the_clean_one_of_its_track_and_seed(frame: pd.DataFrame) -> None:
    clean, mild, strong = outcomes(STUDY, frame)
    assert (clean["ratio_min"], clean["ratio_max"]) == pytest.approx((1.0, 1.0))
    np.testing.assert_allclose(beside_clean(frame)["ratio"], [1.0, 1.0, 1.5, 3.5, np.nan])
    values = mild
    assert values["ratio_mean"] == pytest.approx(2.5)
    assert (values["ratio_min"], values["ratio_max"]) == pytest.approx((1.5, 3.5))
    assert values["size_ratio"] == pytest.approx(1.25)
    assert (values["missed"], values["closed"], values["lost"]) == (pytest.approx(0.05), 2, 1)
    assert (values["notices"], values["reported"]) == ({"a notice": 1}, 1)
    assert values["calibration"] == {"scale error of the speeds": pytest.approx(-4.0)}
    assert np.isnan(values["reported_lost"])
    values = strong
    assert (values["runs"], values["failed"], values["with_map"]) == (1, 1, 0)
    assert np.isnan(values["ratio_mean"])
    assert (values["closed"], values["error_max"], values["calibration"]) == (0, 80.0, {})


def test_what_a_run_calls_itself_is_told_where_it_judges_its_health(frame: pd.DataFrame) -> None:
    frame["reported_degraded"], frame["reported_lost"] = 0.1, np.where(frame["noise"] == "clean", 0.0, 0.2)
    clean, mild, _ = outcomes(STUDY, frame)
    assert mild["reported_lost"] == pytest.approx(0.2)
    assert (clean["reported"], mild["reported"]) == (0, 2)


def test_the_longest_way_astray_is_that_of_the_worst_run(frame: pd.DataFrame) -> None:
    frame["divergence_time"], frame["divergence_distance"] = np.arange(7.0), 10.0 * np.arange(7.0)
    mild = fault_table(STUDY, outcomes(STUDY, frame)).records()[1]
    assert mild["longest time over 1 m off [s]"] == "4.0"
    assert mild["longest way over 1 m off [m]"] == "40"


def test_the_table_has_the_cost_of_each_fault_and_what_was_said(frame: pd.DataFrame) -> None:
    found = outcomes(STUDY, frame)
    clean, mild, strong = fault_table(STUDY, found, notices=True).records()
    cost = ("rmse by clean", "least", "most", "size by clean", "missed [%]", "closed [%]")
    assert [clean[name] for name in cost] == ["1.00", "1.00", "1.00", "1.00", "0.0", "100"]
    assert [mild[name] for name in cost] == ["2.50", "1.50", "3.50", "1.25", "5.0", "100"]
    assert [strong[name] for name in (*cost, "failed")] == ["–", "–", "–", "1.00", "100.0", "0", "1"]
    assert (mild["lost at the end [%]"], mild["called lost [%]"]) == ("50", "–")
    assert (clean["notices"], mild["notices"]) == ("nothing", "1 of 2: a notice")
    assert mild["calibration by its prior's sigma"] == "scale error of the speeds -4.0"


def test_the_files_hold_every_value(frame: pd.DataFrame, tmp_path: Path) -> None:
    frame["ms_mean"] = 1.0
    text = write_suite(STUDY, frame, tmp_path)
    assert "latency" in text
    found = json.loads((tmp_path / "faults.json").read_text())
    assert found["format"] == "pathspace-faults/1"
    assert [entry["strength"] for entry in found["faults"]] == [0.0, 20.0, 50.0]
    assert found["faults"][2]["ratio_mean"] is None
    flat = pd.read_csv(tmp_path / "faults.csv")
    expected = outcomes(STUDY, frame)
    assert list(flat) == list(expected[0])
    for entry, row in zip(found["faults"], expected, strict=True):
        known = {name: value for name, value in row.items() if not pd.isna(value)}
        assert entry == dict.fromkeys(row) | known
    for name in flat.select_dtypes("number"):
        np.testing.assert_allclose(flat[name], [row[name] for row in expected], err_msg=name)
    assert json.loads(flat["notices"][1]) == {"a notice": 1}
    written = {file.name for file in tmp_path.iterdir()}
    forms = {f"faults.{suffix}" for suffix in ("txt", "md", "tex", "csv", "json")}
    assert written == forms | {"results.csv", "times.csv"}


def test_an_outcome_without_runs_has_no_figures(frame: pd.DataFrame) -> None:
    failed = frame.assign(failure=np.where(frame["noise"] == "latency: 20 ms", "ValueError", ""))
    values = outcomes(STUDY, failed)[1]
    assert (values["runs"], values["failed"], values["lost"]) == (0, 2, 0)
    assert np.isnan(values["missed"]) and np.isnan(values["error_max"])
