"""Outcomes of faults, and their table, from a frame that is known by hand."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.faults import (
    CLEAN,
    Fault,
    at_strength,
    beside_clean,
    fault_of,
    fault_table,
    kinds,
    only,
    outcomes,
    suite,
    write_suite,
)
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.settings.checked import leaves
from pathspace_graph.sim.faults import Faults
from pathspace_graph.sim.simulate import SimulationSettings

from ...scenes.paths import ROOT

NOISE = {
    "clean": {},
    "latency: 20 ms": {"faults.sensor.latency": 0.02},
    "latency: 50 ms": {"faults.sensor.latency": 0.05},
}
STUDY = Study(name="faults", tracks=(0,), seeds=(0, 1), laps=2, noise=NOISE)


def row(noise: str, seed: int, lap: int, **values: Any) -> dict[str, Any]:
    usual = {"track": "round", "estimator": "fixed-lag", "variant": "default", "failure": "", "notices": ""}
    usual |= {"rmse": 0.2, "size": 40, "missed": 0.0, "closed_at_end": True, "lost_at_end": False}
    usual |= {"error_max": 0.5, "scale_by_prior": 0.1}
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
    assert [mild[f"ratio_{how}"] for how in ("mean", "min", "max")] == pytest.approx([2.5, 1.5, 3.5])
    assert mild["size_ratio"] == pytest.approx(1.25)
    assert (mild["missed"], mild["closed"], mild["lost"]) == (pytest.approx(0.05), 2, 1)
    assert (mild["notices"], mild["reported"]) == ({"a notice": 1}, 1)
    assert mild["calibration"] == {"scale error of the speeds": pytest.approx(-4.0)}
    assert (strong["runs"], strong["failed"], strong["with_map"]) == (1, 1, 0)
    assert np.isnan([mild["reported_lost"], strong["ratio_mean"]]).all()
    assert (strong["closed"], strong["error_max"], strong["calibration"]) == (0, 80.0, {})


def test_what_a_run_calls_itself_is_told_where_it_judges_its_health(frame: pd.DataFrame) -> None:
    frame["reported_degraded"], frame["reported_lost"] = 0.1, np.where(frame["noise"] == "clean", 0.0, 0.2)
    clean, mild, _ = outcomes(STUDY, frame)
    assert mild["reported_lost"] == pytest.approx(0.2)
    assert (clean["reported"], mild["reported"]) == (0, 2)


def test_the_table_has_the_cost_of_each_fault_and_what_was_said(frame: pd.DataFrame) -> None:
    frame["divergence_time"], frame["divergence_distance"] = np.arange(7.0), 10.0 * np.arange(7.0)
    found = outcomes(STUDY, frame)
    clean, mild, strong = fault_table(STUDY, found, notices=True).records()
    cost = ("rmse by clean", "least", "most", "size by clean", "missed [%]", "closed [%]")
    assert [clean[name] for name in cost] == ["1.00", "1.00", "1.00", "1.00", "0.0", "100"]
    assert [mild[name] for name in cost] == ["2.50", "1.50", "3.50", "1.25", "5.0", "100"]
    assert [strong[name] for name in (*cost, "failed")] == ["–", "–", "–", "1.00", "100.0", "0", "1"]
    assert (mild["lost at the end [%]"], mild["called lost [%]"]) == ("50", "–")
    longest = ("longest time over 1 m off [s]", "longest way over 1 m off [m]")
    assert [mild[name] for name in longest] == ["4.0", "40"]  # of the worst run
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


# --- the suite -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "fault"),
    [
        ("latency: 20 ms", Fault("latency", 20.0, "ms")),
        ("false positives a cycle: 0.5", Fault("false positives a cycle", 0.5, "")),
        ("yaw-rate bias: 0.01 rad/s", Fault("yaw-rate bias", 0.01, "rad/s")),
        (CLEAN, Fault(CLEAN, 0.0, "")),
    ],
)
def test_a_noise_says_the_fault_and_its_strength(noise: str, fault: Fault) -> None:
    assert fault_of(noise) == fault


@pytest.mark.parametrize("noise", ["latency", "latency: much", "latency: 1.2.3 s", ": 1 s"])
def test_any_other_name_is_refused(noise: str) -> None:
    with pytest.raises(SettingsError, match="expected a name such as"):
        fault_of(noise)


def test_every_fault_has_up_to_three_rising_strengths_of_one_unit_and_is_no_other_run() -> None:
    study = suite()
    assert next(iter(study.noise)) == CLEAN
    assert study.simulation(CLEAN).faults == Faults()
    faults = [fault_of(noise) for noise in study.noise]
    for kind in kinds(study):
        strengths = [fault.value for fault in faults if fault.kind == kind]
        assert strengths == sorted(set(strengths))
        assert len(strengths) == 3
        assert len({fault.unit for fault in faults if fault.kind == kind}) == 1
    simulations = [study.simulation(noise) for noise in study.noise]
    assert len({repr(one) + repr(one.faults) for one in simulations}) == len(simulations)
    assert simulations[0] == SimulationSettings(laps=study.laps)


def test_the_strength_in_the_name_is_that_of_the_settings() -> None:
    study = suite()
    faults = {noise: study.simulation(noise).faults for noise in study.noise}
    assert faults["latency of detections: 50 ms"].sensor.latency == 0.05
    assert faults["sensor turned: 2 °"].sensor.yaw == pytest.approx(0.0349, abs=1e-4)
    assert faults["range bias: 0.4 m"].sensor.range_bias == 0.4
    assert faults["odometry missing in lap 2: 1 s"].odometry.gap == 1.0
    assert faults["odometry missing in lap 2: 1 s"].odometry.gap_at == 1.5
    assert faults["put down farther on in lap 2: 30 m"].vehicle.put_down == 30.0


def test_only_some_faults_are_chosen_beside_the_clean_run() -> None:
    study = suite()
    assert list(only(study, ["range bias"]).noise) == [
        CLEAN,
        *(f"range bias: {strength} m" for strength in ("0.1", "0.2", "0.4")),
    ]
    assert only(study, []) == study
    with pytest.raises(SettingsError, match=r"--only: expected a known fault.*the nearest is 'range bias'"):
        only(study, ["range bia"])


def test_a_quick_suite_has_the_greatest_or_the_middle_strength_of_each_fault() -> None:
    study = suite()
    quick = at_strength(study, 1.0)
    assert kinds(quick) == kinds(study)
    assert len(quick.noise) == 1 + len(kinds(study))
    assert "range bias: 0.4 m" in quick.noise and "range bias: 0.2 m" not in quick.noise
    assert [*only(at_strength(study, 0.5), ["range bias"]).noise] == [CLEAN, "range bias: 0.2 m"]


def test_the_page_names_every_setting_of_a_fault_and_no_other() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text()
    known = set(leaves(SimulationSettings()))
    named = set(re.findall(r"`(faults\.[a-z_.]+|sensor\.[a-z_.]+)`", page))
    assert named <= known
    for setting in leaves(Faults()):
        assert setting.rpartition(".")[2] in page, setting
