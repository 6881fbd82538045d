"""The figures of the pages: as data, as tables, and as the pages show them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import InputError
from pathspace_graph.eval import report
from pathspace_graph.eval.experiment.faults import at_strength, suite
from pathspace_graph.eval.experiment.study import Baseline, Study
from pathspace_graph.eval.report import (
    COMPARED,
    PAGES,
    README,
    MeasuredTable,
    read_figures,
    render,
    render_pages,
    sources_digest,
    to_json,
)
from pathspace_graph.eval.views import (
    Figure,
    camera_table,
    difference_table,
    faults_table,
    lap_columns,
    laps_table,
    lines_table,
    metrics_table,
    skidpad_table,
    study_table,
    tracks_table,
)
from pathspace_graph.io.files import write_json

ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "docs" / "figures.json"
TABLE = MeasuredTable(
    command="pathspace-graph report",
    commit="abc1234",
    date="2026-11-24",
    sources="old",
    header=("mean", "lap 1"),
    rows=(("rmse [m]", (Figure(0.5, 0.1),)), ("reach", (Figure(None),))),
)


def test_a_figure_is_a_mean_with_its_interval_of_the_known_values() -> None:
    """Of 1, 2, 3 the sample's deviation is 1, and Student's t of 2 degrees is 4.303."""
    figure = Figure.of(np.array([1.0, np.nan, 2.0, 3.0]), 1, 100.0)
    assert figure.value == pytest.approx(200.0)
    assert figure.half == pytest.approx(100.0 * 4.302653 / np.sqrt(3.0), rel=1e-6)
    assert figure.text == "200.0 ± 248.4"
    assert Figure.of(np.array([2.0])).text == "2.000"
    assert Figure.of(np.array([np.nan])).text == ""


def frame(estimator: str, laps: int, rmse: float) -> pd.DataFrame:
    rows = [
        {"track": "t", "seed": seed, "noise": "n", "estimator": estimator, "variant": "v", "failure": ""}
        | {"lap": lap, "rmse": rmse / lap, "missed": 0.01, "reach_median": 10.0, "ate": float(lap)}
        for seed in (0, 1)
        for lap in range(1, laps + 1)
    ]
    return pd.DataFrame(rows)


def test_the_table_of_accuracy_has_the_laps_and_the_batch() -> None:
    both = pd.concat([frame("fixed-lag", 3, 0.6), frame("spline", 3, 0.3)], ignore_index=True)
    header, rows = lap_columns(both, (1, 2, 3), README)
    assert header == ("mean over 2 drives, at the end of", "lap 1", "lap 2", "lap 3", "batch")
    label, figures = rows[0]
    assert label == "rmse [m]"
    assert [figure.value for figure in figures] == pytest.approx([0.6, 0.3, 0.2, 0.1])
    assert rows[1][1][0].text.startswith("1.0")  # in percent


def test_the_tables_of_the_results_have_tracks_laps_and_metrics() -> None:
    both = pd.concat([frame("fixed-lag", 3, 0.6), frame("spline", 1, 0.3)], ignore_index=True)
    both = pd.concat([both, both.assign(track="other", rmse=2.0 * both["rmse"])], ignore_index=True)
    header, rows = tracks_table(both)
    assert header[1:4] == ("rmse, lap 1 [m]", "rmse, last lap [m]", "rmse, batch [m]")
    assert [label for label, _ in rows] == ["t", "other"]
    assert [figure.value for figure in rows[1][1][:3]] == pytest.approx([1.2, 0.4, 0.6])
    assert rows[0][1][0].half is None
    header, rows = laps_table(both)
    assert header == ("rmse after lap [m]", "`fixed-lag`")
    assert [rows[lap][1][0].value for lap in range(3)] == pytest.approx([0.9, 0.45, 0.3])
    header, rows = metrics_table(both, COMPARED)
    assert header == ("last lap", "`fixed-lag`", "`spline`")
    assert [label for label, _ in rows][:1] == ["missed at 2 m [%]"]


def test_a_study_s_table_has_paired_differences_from_its_baseline() -> None:
    """On seeds 0 and 1 the variant is worse by 0.1 and 0.2: 0.15 ± 12.706 x 0.05."""
    metrics = ("rmse", "ms_mean", "missed")
    study = Study(tracks=(0,), seeds=(0, 1), grids=({"lag": [1.0]},), metrics=metrics)
    runs = frame("fixed-lag", 1, 0.3).assign(noise="nominal", variant="default", ms_mean=1.0)
    worse = runs.assign(variant="lag=1", rmse=runs["rmse"] + 0.1 * (1 + runs["seed"]))
    header, rows = study_table(study, pd.concat([runs, worse], ignore_index=True))
    assert header == ("variant", "rmse [m]", "difference", "p", "missed [%]")
    assert [label for label, _ in rows] == ["default", "lag=1"]
    assert [figure.value for figure in rows[0][1][:3]] == [0.3, None, None]
    assert rows[1][1][1].text == "0.150 ± 0.635"
    assert rows[1][1][2].value == pytest.approx(0.2048, abs=1e-3)


def test_two_estimators_are_compared_by_pairs_in_each_metric() -> None:
    base = Baseline(estimator="fixed-lag")
    study = Study(tracks=(0,), seeds=(0, 1), estimators=("fixed-lag", "ckf"), baseline=base)
    both = pd.concat([frame("fixed-lag", 1, 0.3), frame("ckf", 1, 0.5)], ignore_index=True)
    both = both.assign(noise="nominal", variant="default")
    header, rows = difference_table(study, both, "ckf", ("rmse", "ate"))
    assert header == ("lap 1", "`fixed-lag`", "`ckf`", "difference")
    assert [figure.value for figure in rows[0][1]] == pytest.approx([0.3, 0.5, 0.2])
    assert rows[1][1][2].value == 0.0


def test_the_skidpad_s_trajectory_error_is_over_all_rounds() -> None:
    _, rows = skidpad_table(frame("fixed-lag", 2, 0.6))
    assert rows[0][1][0].value == pytest.approx(np.sqrt((1.0 + 4.0) / 2.0))


def test_the_table_of_the_camera_has_each_estimator_and_the_landmarks_that_are_told_all() -> None:
    parts = [
        frame(estimator, 2, rmse).assign(nees=1.5, l=0.2, reported_degraded=0.25, map_scale_nees=0.8)
        for estimator, rmse in (("fixed-lag", 0.6), ("spline", 0.4))
    ]
    header, rows = camera_table(pd.concat(parts, ignore_index=True))
    assert header[:3] == ("estimator", "rmse [m]", "rmse without turn and scale [m]")
    assert [label for label, _ in rows] == ["`fixed-lag`", "`spline`", "landmarks, given all"]
    assert [figures[0].value for _, figures in rows] == pytest.approx([0.3, 0.2, 0.2])
    assert rows[0][1][-1].value == pytest.approx(25.0) and rows[2][1][-1].value is None
    assert all(len(figures) == len(header) - 1 for _, figures in rows)


def test_the_table_of_lines_has_each_estimator_at_each_spacing() -> None:
    parts = [
        frame(estimator, 2, rmse).assign(noise=noise, nees=1.5)
        for noise in ("1 m", "4 m")
        for estimator, rmse in (("fixed-lag", 0.6), ("spline", 0.4))
    ]
    header, rows = lines_table(pd.concat([*parts, parts[0].assign(estimator="landmark-fixed-lag")]))
    assert header[:2] == ("points, estimator", "rmse [m]")
    assert [label for label, _ in rows] == [
        "1 m, `fixed-lag`",
        "1 m, `spline`",
        "4 m, `fixed-lag`",
        "4 m, `spline`",
        "1 m, `landmark-fixed-lag`",
    ]
    assert [figures[0].value for _, figures in rows] == pytest.approx([0.3, 0.2, 0.3, 0.2, 0.3])


def test_the_table_of_faults_is_relative_to_the_clean_run_of_the_middle_strength() -> None:
    study = at_strength(suite(), 0.5)
    assert list(study.noise)[:2] == ["clean", "latency of detections: 50 ms"]
    late = list(study.noise)[1]
    runs = [
        frame("fixed-lag", 2, rmse).assign(
            noise=noise, size=50.0, closed_at_end=True, lost_at_end=False, notices=said
        )
        for noise, rmse, said in (("clean", 0.2, ""), (late, 0.3, "late"))
    ]
    pair = replace(study, noise={noise: study.noise[noise] for noise in ("clean", late)})
    header, rows = faults_table(pair, pd.concat(runs, ignore_index=True).assign(error_max=2.0))
    assert [label for label, _ in rows] == ["clean", late]
    assert [figures[0].text for _, figures in rows] == ["1.00", "1.50"]
    assert rows[1][1][header.index("reported [%]") - 1].text == "100"
    assert all(len(figures) == len(header) - 1 for _, figures in rows)


def test_figures_come_back_from_their_file(tmp_path: Path) -> None:
    write_json(tmp_path / "figures.json", to_json({"one": TABLE}))
    assert read_figures(tmp_path / "figures.json") == {"one": TABLE}
    write_json(tmp_path / "other.json", {"format": "pathspace-figures/0"})
    with pytest.raises(InputError, match=r"other\.json: expected pathspace-figures/1"):
        read_figures(tmp_path / "other.json")


def test_a_page_has_its_tables_between_the_markers_and_says_how_old_they_are() -> None:
    page = "before\n<!-- report: one -->\nanything\n<!-- end report -->\nafter\n"
    now = render(Path("page.md"), page, {"one": TABLE}, "old")
    assert now.startswith("before\n<!-- report: one -->\n\n| mean")
    assert now.endswith("|\n\n<!-- end report -->\nafter\n") and "0.500 ± 0.100" in now
    later = render(Path("page.md"), page, {"one": TABLE}, "new")
    assert "*Measured at commit abc1234, 2026-11-24; the estimators have changed since.*" in later
    assert render(Path("page.md"), later, {"one": TABLE}, "old") == now
    with pytest.raises(InputError, match=r"page\.md: expected a table of the report, found one"):
        render(Path("page.md"), page, {}, "old")
    new = render(Path("page.md"), page.replace("one", "skidpad"), {}, "old")
    assert "-->\n\n*Not measured yet.*\n\n<!--" in new


def test_the_pages_show_the_committed_figures() -> None:
    """`report --only pages --pages .` writes them anew after a change of the estimators."""
    if not FIGURES.exists():
        pytest.skip("there are no pages beside an installed package")
    tables = read_figures(FIGURES)
    assert set(tables) <= {name for names in PAGES.values() for name in names}
    for page, names in PAGES.items():
        for name in names:
            assert f"<!-- report: {name} -->" in (ROOT / page).read_text(), f"{page}: no {name}"
    for page, text in render_pages(ROOT, tables).items():
        assert page.read_text() == text, f"{page} does not show the figures of {FIGURES.name}"


def test_the_digest_is_that_of_the_sources() -> None:
    assert len(sources_digest()) == 16
    assert sources_digest() == sources_digest()


def test_a_quick_report_goes_with_no_pages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--out", str(tmp_path / "r"), "--quick", "--pages", str(tmp_path)]) == 2
    assert "--pages: expected none with --quick" in capsys.readouterr().err


@pytest.mark.slow
def test_a_report_writes_its_figures_and_the_pages_and_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the online estimator alone."""
    monkeypatch.setattr(report, "ESTIMATORS", ("fixed-lag",))
    (tmp_path / "docs").mkdir()
    for page in PAGES:
        (tmp_path / page).write_text("<!-- report: skidpad -->\n<!-- end report -->\n")
    run = ["report", "--out", str(tmp_path / "r"), "--only", "skidpad", "--jobs", "1", "--quick"]
    assert main(run) == 0
    found = read_figures(tmp_path / "r" / "figures.json")["skidpad"]
    assert [label for label, _ in found.rows] == ["`fixed-lag`"]
    assert found.sources == sources_digest()
    assert all(figure.value is not None and figure.value < 1.0 for figure in found.rows[0][1])
    cells = {file: file.stat().st_mtime_ns for file in (tmp_path / "r").rglob("cells/*")}
    assert main(run) == 0
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "r").rglob("cells/*")} == cells
