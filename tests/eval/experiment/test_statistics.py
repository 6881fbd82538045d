"""Means, paired differences and their tests: by hand, beside scipy, and in studies that are made up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pathspace_graph.eval.experiment.run import add_batch
from pathspace_graph.eval.experiment.study import Baseline, Published, Study, find_study, read_study_file
from pathspace_graph.eval.experiment.tables import (
    RUN,
    TextTable,
    beside_published,
    by_track,
    caption,
    contrasts,
    estimate,
    holm,
    joined,
    paired_p,
    plot_differences,
    plot_published,
    summary_tables,
    track_tables,
    wilcoxon_p,
    write_study,
)
from pathspace_graph.eval.figures.drawing import Picture
from pathspace_graph.eval.metrics.measures import METRICS


def test_the_interval_of_few_and_p_are_those_of_scipy() -> None:
    assert estimate(np.ones(2)) == (1.0, 0.0)
    np.testing.assert_equal([estimate([-2.0]), estimate([])], [(-2.0, np.nan), (np.nan, np.nan)])
    values = np.random.default_rng(1).normal(0.3, 1.0, 7)
    mean, half = estimate([*values, np.nan])  # what isn't known doesn't count
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert mean - half == pytest.approx(low)
    assert mean + half == pytest.approx(high)
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


def test_drives_of_a_track_are_one_sample_and_of_a_single_track_each_is_one() -> None:
    index = pd.MultiIndex.from_product([["a", "b"], [0, 1]], names=["track", "seed"])
    values = pd.Series([1.0, 3.0, 5.0, 9.0], index)
    assert by_track(values).to_dict() == {"a": 2.0, "b": 7.0}
    assert len(by_track(values.loc[["a"]])) == 2


def test_wilcoxon_by_hand() -> None:
    """Five positive differences: one of 2^5 orders of signs on each side, p = 2 / 32."""
    assert wilcoxon_p(np.array([0.1, 0.2, 0.3, 0.4, 0.5])) == pytest.approx(2.0 / 32.0)
    assert np.isnan(wilcoxon_p(np.zeros(3)))


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
                    rmse = 5.0 * int(str(track)) + seed + by + 0.01 * rng.standard_normal() + 9.0 * (lap == 1)
                    figures = {"rmse": rmse, "missed": 0.0, "size": 80, "ms_mean": 3.0 + by}
                    made.append(shared | {"lap": lap, "failure": ""} | figures)
    return pd.DataFrame(made)


def of_nominal(frame: pd.DataFrame) -> Any:
    """The contrasts of the rmse of the default, and of lags of 1 s and 2 s."""
    found = contrasts(STUDY, frame, "rmse")
    return found[found["noise"] == "nominal"].itertuples()


def test_differences_are_paired() -> None:
    """Tracks differ by metres, variants by a tenth: only pairs can tell."""
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0})
    base, worse, same = of_nominal(frame)
    assert (base.is_baseline, worse.is_baseline) == (True, False) and np.isnan(base.difference)
    assert worse.difference == pytest.approx(0.1, abs=0.02)
    assert worse.half > 1.0
    assert worse.difference_half < 0.05
    assert worse.significant
    assert not same.significant


def test_a_failed_run_is_left_out_with_its_pair() -> None:
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}, failed=(3, 1))
    _, worse, _ = of_nominal(frame)
    assert (worse.runs, len(worse.differences)) == (7, 4)
    assert worse.difference == pytest.approx(0.1, abs=0.02)
    assert "(2 failed)" in caption(STUDY, frame)


def test_each_noise_has_its_own_baseline() -> None:
    loud = rows({"default": 3.0, "lag=1": 3.5, "lag=2": 3.0}, noise="loud_one")
    frame = pd.concat([rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}), loud])
    by = contrasts(STUDY, frame, "rmse").set_index(["noise", "variant"])["difference"]
    assert by["nominal", "lag=1"] == pytest.approx(0.1, abs=0.02)
    assert by["loud_one", "lag=1"] == pytest.approx(0.5, abs=0.02)


def test_one_estimator_can_be_the_baseline_of_all() -> None:
    names = ("fixed-lag", "landmark-fixed-lag")
    made = Study(tracks=(0,), seeds=(0, 1), estimators=names, baseline=Baseline(estimator="fixed-lag"))
    frame = pd.DataFrame(
        {"track": "generated 0", "seed": seed, "noise": "nominal", "estimator": name, "variant": "default"}
        | {"lap": 1, "failure": "", "rmse": value + seed}
        for seed in (0, 1)
        for name, value in zip(names, (1.0, 3.0), strict=True)
    )
    assert contrasts(made, frame, "rmse")["differences"].tolist() == [(), (2.0, 2.0)]


# --- what is found, and what is not -----------------------------------------------------------------------


def test_what_is_the_same_and_wall_times_are_not_tested() -> None:
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0})
    same = frame["variant"] == "lag=2"
    frame.loc[same, "rmse"] = frame.loc[frame["variant"] == "default", "rmse"].to_numpy()
    _, worse, equal = of_nominal(frame)
    assert np.isnan(equal.p) and np.isnan(equal.wilcoxon) and not equal.significant
    assert worse.p == pytest.approx(paired_p(np.array(worse.differences))), "it is the only hypothesis"
    frame["ms_mean"] += frame["rmse"]
    assert contrasts(STUDY, frame, "ms_mean")["p"].isna().all()
    frame["ms_processor"] = frame["ms_mean"]
    assert contrasts(STUDY, frame, "ms_processor")["significant"].any()


# --- text and figures ------------------------------------------------------------------------------------


@pytest.fixture
def frame() -> pd.DataFrame:
    loud = rows({"default": 3.0, "lag=1": 3.5, "lag=2": 3.0}, noise="loud_one")
    return pd.concat([rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0}), loud])


def test_tables_tell_the_same_in_every_form(frame: pd.DataFrame) -> None:
    tables, told = summary_tables(STUDY, frame), caption(STUDY, frame)
    assert [table.title for table in tables] == ["rmse [m]", "missed [%]", "size"]
    assert len(tables[0].frame) == 6
    assert tables[0].records()[1]["Wilcoxon"] == "0.125"  # of four tracks that differ alike: 2 / 2^4
    assert "Holm" in told
    assert "paired" in told
    text, markdown, latex = (joined(tables, told, form) for form in ("txt", "md", "tex"))
    worse = contrasts(STUDY, frame, "rmse")["difference"][1]
    for written in (text, markdown, latex):
        assert "lag=1" in written
        assert f"{worse:+.3f}" in written
    assert r"100 \%" in latex and r"loud\_one" in latex and latex.count(r"\begin{table}") == 3
    significant = [line for line in text.splitlines() if line.endswith("*")]
    assert len(significant) == 2
    assert all("lag=1" in line for line in significant)


def test_figures_of_what_differs(frame: pd.DataFrame) -> None:
    drawn = plot_differences(STUDY, frame)
    assert isinstance(drawn, Picture)  # which a notebook shows
    (panel,) = drawn.axes
    assert panel.get_title("left") == "rmse [m]"
    assert [label.get_text() for label in panel.get_yticklabels()] == [
        "nominal, lag=1",
        "nominal, lag=2",
        "loud_one, lag=1",
        "loud_one, lag=2",
    ]


def test_a_study_without_a_comparison_has_its_means_drawn() -> None:
    drawn = plot_differences(replace(STUDY, grids=(), noise={"nominal": {}}), rows({"default": 0.0}))
    assert [axes.get_title("left") for axes in drawn.axes] == ["rmse [m]", "missed [%]", "size"]
    (mean,) = drawn.axes[0].containers[0].lines[0].get_xdata()
    assert mean == pytest.approx(8.0, abs=0.05)


def test_rows_of_all_panels_are_the_same_where_one_metric_lacks_some() -> None:
    frame = rows({"default": 0.0, "lag=1": 0.1, "lag=2": 0.0})
    frame.loc[frame["variant"] == "lag=1", "missed"] = np.nan
    frame.loc[frame["variant"] == "lag=2", "missed"] = 0.5
    drawn = plot_differences(STUDY, frame)
    first, second = drawn.axes
    assert [label.get_text() for label in first.get_yticklabels()] == ["lag=1", "lag=2"]
    means = [container.lines[0].get_ydata().tolist() for container in second.containers]
    assert means == [[1]]


def row(estimator: str, seed: int = 0, variant: str = "default", **values: float) -> dict[str, Any]:
    names = {"track": "oval", "seed": seed, "noise": "nominal", "estimator": estimator, "variant": variant}
    return names | values


def test_every_lap_is_compared_with_the_batch_of_its_own_log_and_settings() -> None:
    rows = [
        row("fixed-lag", turn=0.003, rmse=0.4),
        row("fixed-lag", turn=0.002, rmse=0.3),
        row("spline", turn=0.001, rmse=0.2),
        row("fixed-lag", seed=1, turn=0.003, rmse=0.4),
        row("fixed-lag", variant="other", turn=0.003, rmse=0.4),
        row("spline", variant="other", turn=0.004, rmse=0.4),
        row("fixed-lag", variant="failed", turn=0.003, rmse=0.4),
        row("spline", variant="failed"),
    ]
    add_batch(rows, (*RUN, "noise", "variant"))
    found = [(row.get("turn_from_batch"), row.get("rmse_by_batch")) for row in rows]
    assert found[:2] == [
        (pytest.approx(0.002), pytest.approx(2.0)),
        (pytest.approx(0.001), pytest.approx(1.5)),
    ]
    assert {found[k] for k in (2, 3, 5, 6)} == {(None, None)}  # the batch itself, and without one that worked
    assert found[4] == (pytest.approx(-0.001), pytest.approx(1.0))


# --- beside a publication --------------------------------------------------------------------------------


def published(*estimators: str) -> tuple[Study, pd.DataFrame]:
    """Two tracks of two laps, with an rmse of 1 and 2 m on the first track and half on the second."""
    laps = {name: {"missed": [10.0 * (k + 1), 0.0], "rmse": [1.0, 4.0]} for k, name in enumerate(estimators)}
    about = Published("a paper", laps, {"rmse": "other track"})
    study = Study(tracks=(0, 1), estimators=estimators, laps=2, published=about)
    same = {"study": "made up", "seed": 0, "noise": "nominal", "variant": "default"}
    rows = [
        same
        | {"track": track, "estimator": name}
        | {"lap": lap, "failure": "", "rmse": lap * (k + 1) / (1 + i), "missed": 0.1 * (k + 1)}
        for i, track in enumerate(("a", "b"))
        for k, name in enumerate(estimators)
        for lap in (1, 2)
    ]
    return study, pd.DataFrame(rows)


def test_published_values_stand_beside_ours_of_the_same_lap_in_the_same_unit() -> None:
    found = beside_published(*published("ckf", "landmark-ckf")).set_index(["metric", "estimator", "lap"])
    first = found.loc[("rmse [m]", "landmark-ckf", 2)]
    assert first[["published", "here", "difference"]].tolist() == [4.0, 3.0, -1.0]
    assert first["compared"] == "other track"
    low, high = stats.ttest_1samp([4.0, 2.0], 0.0).confidence_interval(0.95)
    assert first["interval"] == pytest.approx(0.5 * (high - low))
    missed = found.loc[("missed [%]", "ckf", 1)]
    assert missed[["published", "here", "difference"]].tolist() == pytest.approx([10.0, 10.0, 0.0])
    ratio = found.loc[("rmse", "ckf / landmark-ckf", 2)]
    assert ratio[["published", "here", "compared"]].tolist() == [1.0, 0.5, "ratio"]
    assert ("missed", "ckf / landmark-ckf", 2) not in found.index  # nothing was missed there


def test_a_lap_that_was_not_driven_is_left_out() -> None:
    study, frame = published("ckf")
    found = beside_published(study, frame[frame["lap"] == 1])
    assert found["lap"].tolist() == [1, 1] and len(plot_published(found).axes) == 2
    assert len(beside_published(study, frame.drop(columns=["rmse", "missed"]))) == 0


def test_what_is_shown_beside_a_publication_is_written_and_without_it_nothing(tmp_path: Path) -> None:
    study, frame = published("ckf", "landmark-ckf")
    text = write_study(study, frame, tmp_path / "out")
    assert "Beside a paper" in text and "other track" in text
    assert (tmp_path / "out" / "published.csv").is_file()
    assert (tmp_path / "out" / "figures" / "published.png").is_file()
    text = write_study(replace(study, published=Published()), frame, tmp_path / "none")
    assert "Beside" not in text and not (tmp_path / "none" / "published.csv").exists()


def test_the_table_of_the_paper_is_shipped() -> None:
    """The text says that it has 16.8 % less rmse, and 44 % of the size after lap 5."""
    laps = read_study_file(find_study(Path("paper"))).published.laps
    ratio = {key: np.divide(laps["ckf"][key], laps["landmark-ckf"][key]) for key in ("rmse", "size")}
    assert 1.0 - ratio["rmse"].mean() == pytest.approx(0.168, abs=3e-3)
    assert ratio["size"][-1] == pytest.approx(0.44, abs=1e-3)
    for of_laps in laps.values():
        np.testing.assert_allclose(of_laps["size_share"], np.array(of_laps["size"]) / 2.0)


# --- tables by track, and the forms of any table -----------------------------------------------------------

RUNS = {  # rmse (m) of laps 1, 2 and 3
    ("oval", 0): (0.6, 0.2, 0.1),
    ("oval", 1): (0.8, 0.4, 0.3),
    ("bean", 0): (0.2, 0.2, 0.5),
}


def runs_of(failed: tuple[str, int] | None = None, variant: str = "default") -> pd.DataFrame:
    """The results of the runs above."""
    rows = []
    for (track, seed), values in RUNS.items():
        shared = {
            "track": track,
            "seed": seed,
            "noise": "nominal",
            "estimator": "fixed-lag",
            "variant": variant,
        }
        if (track, seed) == failed:
            rows.append(shared | {"lap": None, "rmse": None, "failure": "ValueError: no"})
        else:
            laps = enumerate(values, start=1)
            rows += [shared | {"lap": lap, "rmse": value, "failure": ""} for lap, value in laps]
    return pd.DataFrame(rows).astype({"lap": "Int64"})


def table(of: pd.DataFrame, metric: str = "rmse") -> dict[str, tuple[str, ...]]:
    """The one table's rows by their name."""
    (found,) = track_tables(Study(tracks=(0,), metrics=(metric,)), of)
    assert tuple(found.frame) == ("track", "runs", METRICS[metric].heading)
    return {str(row[0]): row[1:] for row in found.frame.itertuples(index=False, name=None)}


def test_a_track_has_the_mean_of_its_last_laps_and_every_run_counts_the_same_in_all() -> None:
    assert table(runs_of()) == {
        "oval": ("2 of 2", "0.200"),
        "bean": ("1 of 1", "0.500"),
        "all": ("3 of 3", "0.300"),
    }


def test_a_failed_run_is_counted_and_has_no_value() -> None:
    assert table(runs_of(failed=("oval", 1)))["oval"] == ("1 of 2", "0.100")
    assert table(runs_of(failed=("bean", 0)))["bean"] == ("0 of 1", "–")


def test_a_last_lap_without_a_value_is_not_that_of_the_lap_before() -> None:
    runs = runs_of()
    runs.loc[(runs["track"] == "bean") & (runs["lap"] == 3), "rmse"] = float("nan")
    assert table(runs)["bean"] == ("1 of 1", "–")


def test_every_combination_has_a_table_of_its_own() -> None:
    both = pd.concat([runs_of(), runs_of(variant="lag=1")])
    study = Study(tracks=(0,), grids=({"lag": [1.0]},))
    assert [found.title for found in track_tables(study, both)] == ["default", "lag=1"]


def test_a_table_keeps_its_units_and_escapes_what_latex_would_take_for_commands() -> None:
    rows = (("x|y", "2σ < 5 %"), ("z", "–"), ("z", "–"))
    table = TextTable.of(("name", "rmse [m]"), rows, "50 % of a_b ± 1")
    assert table.rich().columns[1].header.plain == "rmse [m]"  # type: ignore[union-attr]
    latex = table.latex()
    assert r"\caption{50 \% of a\_b $\pm$ 1}" in latex and r"2$\sigma$ < 5 \%" in latex
    assert latex.count(r"\midrule") == 1 and "{lr}" in latex and latex.isascii()


def test_names_are_aligned_to_the_left_and_numbers_to_the_right() -> None:
    table = TextTable.of(("name", "a", ""), (("x|y", "1.0", ""), ("long name", "12.25", "*")), "Title")
    assert [line.rstrip() for line in table.text().splitlines()] == [
        "Title",
        "",
        "name           a",
        "---------  -----  --",
        "x|y          1.0",
        "long name  12.25   *",
    ]
    lines = table.text("md").split("\n")
    assert lines[:2] == ["Title", ""] and lines[-1] == ""
    assert lines[3] == "|:----------|------:|---:|"
    assert lines[4] == r"| x\|y      |   1.0 |    |"
