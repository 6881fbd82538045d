"""What a study says of differences, held against results made by hand and against scipy."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pathspace_graph.eval.study import Baseline, Study
from pathspace_graph.eval.study_frame import last_laps
from pathspace_graph.eval.study_plot import figures
from pathspace_graph.eval.study_statistics import compare, estimate, holm, paired_p
from pathspace_graph.eval.study_table import as_latex, as_markdown, as_text, caption, summary_tables

STUDY = Study(
    tracks=(0, 1, 2, 3),
    seeds=(0, 1),
    laps=2,
    question="Which, at 100 %?",
    noise={"nominal": {}, "loud_one": {"sensor.bearing_sigma": 1.0}},
    grids=({"lag": [1.0, 2.0]},),
    metrics=("rmse", "missed", "size"),
)


def rows(
    shift: dict[str, float], noise: str = "nominal", failed: tuple[int, int] | None = None
) -> pd.DataFrame:
    """Runs whose rmse is their track's and seed's own, plus a shift of the variant's and a little noise."""
    rng, made = np.random.default_rng(0), []
    for track in STUDY.tracks:
        for seed in STUDY.seeds:
            for variant, by in shift.items():
                names = {"track": f"generated {track}", "seed": seed, "noise": noise}
                shared = names | {"estimator": "fixed-lag", "variant": variant}
                if variant != "default" and (track, seed) == failed:
                    made.append(shared | {"lap": None, "failure": "ValueError: lost"})
                    continue
                for lap in (1, 2):
                    rmse = (
                        5.0 * int(str(track))
                        + seed
                        + by
                        + 0.01 * rng.standard_normal()
                        + (9.0 if lap == 1 else 0.0)
                    )
                    figures = {"rmse": rmse, "missed": 0.0, "size": 80, "ms_mean": 3.0 + by}
                    made.append(shared | {"lap": lap, "failure": ""} | figures)
    return pd.DataFrame(made)


def test_the_last_lap_of_each_run_that_finished() -> None:
    last = last_laps(rows({"default": 0.0, "lag=1": 0.0}, failed=(0, 0)))
    assert len(last) == 15
    assert set(last["lap"]) == {2}


def test_differences_are_paired() -> None:
    """Tracks differ by metres, variants by a tenth: only pairs can tell."""
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0})
    nominal = [c for c in compare(STUDY, frame, "rmse") if c.noise == "nominal"]
    base, worse, same = nominal
    assert base.difference is None
    assert worse.difference is not None and same.difference is not None
    assert worse.difference.mean == pytest.approx(0.1, abs=0.02)
    assert worse.value.half > 1.0
    assert worse.difference.half < 0.05
    assert worse.significant
    assert not same.significant


def test_a_failed_run_is_left_out_with_its_pair() -> None:
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}, failed=(3, 1))
    _, worse, _ = (c for c in compare(STUDY, frame, "rmse") if c.noise == "nominal")
    assert worse.value.count == 7
    assert worse.difference is not None
    assert worse.difference.count == 7
    assert worse.difference.mean == pytest.approx(0.1, abs=0.02)
    assert "(2 failed)" in caption(STUDY, frame)


def test_each_noise_has_its_own_baseline() -> None:
    loud = rows({"default": 3.0, "lag=1": 3.5, "lag=2": 3.0}, noise="loud_one")
    frame = pd.concat([rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}), loud])
    by = {(c.noise, c.variant): c.difference for c in compare(STUDY, frame, "rmse") if c.difference}
    assert by["nominal", "lag=1"].mean == pytest.approx(0.1, abs=0.02)
    assert by["loud_one", "lag=1"].mean == pytest.approx(0.5, abs=0.02)


def test_one_estimator_can_be_the_baseline_of_all() -> None:
    names = ("fixed-lag", "landmark-fixed-lag")
    made = Study(tracks=(0,), seeds=(0, 1), estimators=names, baseline=Baseline(estimator="fixed-lag"))
    frame = pd.DataFrame(
        {"track": "generated 0", "seed": seed, "noise": "nominal", "estimator": name, "variant": "default"}
        | {"lap": 1, "failure": "", "rmse": value + seed}
        for seed in (0, 1)
        for name, value in zip(names, (1.0, 3.0), strict=True)
    )
    first, second = compare(made, frame, "rmse")
    assert first.difference is None
    assert second.differences == (2.0, 2.0)


def test_the_interval_and_p_are_those_of_scipy() -> None:
    values = np.random.default_rng(1).normal(0.3, 1.0, 12)
    made = estimate(values)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert made.mean - made.half == pytest.approx(low)
    assert made.mean + made.half == pytest.approx(high)
    assert paired_p(values) == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue)


@pytest.mark.parametrize(("values", "p"), [([], None), ([1.0], None), ([0.0, 0.0], 1.0), ([2.0, 2.0], 0.0)])
def test_p_where_there_is_no_spread(values: list[float], p: float | None) -> None:
    found = paired_p(np.array(values))
    assert np.isnan(found) if p is None else found == p


def test_holm_by_hand() -> None:
    """Sorted 0.01, 0.02, 0.03, 0.4 times 4, 3, 2, 1, never falling; what isn't known isn't counted."""
    corrected = holm(np.array([0.03, 0.01, np.nan, 0.4, 0.02]))
    np.testing.assert_allclose(corrected, [0.06, 0.04, np.nan, 0.4, 0.06])
    np.testing.assert_allclose(holm(np.array([0.9, 0.8])), [1.0, 1.0])


def test_holm_keeps_false_alarms_of_a_whole_study_rare() -> None:
    rng, alarms = np.random.default_rng(2), 0
    for _ in range(400):
        alarms += bool((holm(np.array([paired_p(rng.standard_normal(6)) for _ in range(10)])) < 0.05).any())
    assert alarms / 400 < 0.08


# --- text and figures ------------------------------------------------------------------------------------


@pytest.fixture
def frame() -> pd.DataFrame:
    loud = rows({"default": 3.0, "lag=1": 3.5, "lag=2": 3.0}, noise="loud_one")
    return pd.concat([rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}), loud])


def test_tables_tell_the_same_in_every_form(frame: pd.DataFrame) -> None:
    tables, told = summary_tables(STUDY, frame), caption(STUDY, frame)
    assert [table.title for table in tables] == ["rmse [m]", "missed [%]", "size"]
    assert all(len(row) == len(table.header) for table in tables for row in table.rows)
    assert len(tables[0].rows) == 6
    assert "Holm" in told
    assert "paired" in told
    text, markdown, latex = as_text(tables, told), as_markdown(tables, told), as_latex(tables, told)
    worse = compare(STUDY, frame, "rmse")[1].difference
    assert worse is not None
    for written in (text, markdown, latex):
        assert "lag=1" in written
        assert f"{worse.mean:+.3f}" in written
    significant = [line for line in text.splitlines() if line.endswith("*")]
    assert len(significant) == 2
    assert all("lag=1" in line for line in significant)


def test_latex_is_escaped(frame: pd.DataFrame) -> None:
    latex = as_latex(summary_tables(STUDY, frame), caption(STUDY, frame))
    assert r"100 \%" in latex
    assert r"loud\_one" in latex
    assert r"$\pm$" in latex
    assert latex.isascii()
    assert latex.count(r"\begin{table}") == latex.count(r"\end{table}") == 3
    assert {line.count(" & ") for line in latex.splitlines() if line.endswith(r"\\")} == {8}


def test_figures_of_what_differs(frame: pd.DataFrame) -> None:
    drawn = figures(STUDY, frame)
    assert set(drawn) == {"differences", "accuracy_size", "accuracy_time"}
    (panel,) = drawn["differences"].axes
    assert panel.get_title() == "rmse [m]"
    assert [label.get_text() for label in panel.get_yticklabels()] == [
        "nominal, lag=1",
        "nominal, lag=2",
        "loud_one, lag=1",
        "loud_one, lag=2",
    ]
    assert len(drawn["accuracy_time"].axes) == 2
    assert "differences" not in figures(STUDY, rows({"default": 0.0}))
