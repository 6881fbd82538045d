"""What a notebook shows of a record: text, HTML, progress, and the metrics of a run."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph import BatchMapper, FixedLagMapper, Log, MapperSettings, RunResult, run_online
from pathspace_graph.eval.experiment.run import make_plan
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.figures.notebook import html, sections, warnings
from pathspace_graph.eval.metrics.measures import METRICS, lap_times, measure, summarize
from pathspace_graph.health import DEGRADED
from pathspace_graph.io.log_files import write_log
from pathspace_graph.plausibility.judge import Hint
from pathspace_graph.settings.mapper import GrowthSettings, SplineSettings

from ...scenes.drives import noisy_lap, short_drive

LONGEST = 400
CHANGED = MapperSettings(lag=2.0, spline=SplineSettings(degree=2))


@cache
def lap() -> tuple[Log, RunResult]:
    log = noisy_lap()
    return log, run_online(log, FixedLagMapper(None, log.odometry_sigma))


def test_the_text_of_settings_makes_them_again() -> None:
    assert repr(MapperSettings()) == "MapperSettings()"
    assert repr(CHANGED) == "MapperSettings(lag=2.0, spline=SplineSettings(degree=2))"
    assert eval(repr(CHANGED)) == CHANGED
    assert repr(GrowthSettings(sightings=9)) == "GrowthSettings(sightings=9)"


def test_long_records_have_short_texts() -> None:
    log = short_drive()
    study = Study(tracks=(0, 1), seeds=(3, 4, 5), laps=1, grids=({"lag": (1.0, 2.0)},), settings=CHANGED)
    for record in (BatchMapper(None, log.odometry_sigma).solve(log), study, make_plan(study).tracks[0]):
        assert len(repr(record)) < LONGEST
    assert len(repr(make_plan(study))) < 10 * LONGEST
    assert repr(study) == "Study(study: 2 tracks x 3 seeds x 1 noises x 1 estimators x 2 variants)"


def cells_of(text: str) -> list[list[str]]:
    rows = re.findall(r"<tr>(.*?)</tr>", text)
    return [re.findall(r"<t[dh]>(.*?)</t[dh]>", row) for row in rows]


def test_settings_show_what_was_changed() -> None:
    rows = cells_of(CHANGED._repr_html_() or "")
    assert ["lag", "2.0", "3.0"] in rows and ["spline.degree", "2", "3"] in rows
    assert [row for row in rows[1:] if row[2]] == [["lag", "2.0", "3.0"], ["spline.degree", "2", "3"]]


def test_records_are_a_picture_with_what_they_say() -> None:
    log, result = lap()
    for record in (log, result, result.map):
        assert (record._repr_html_() or "").startswith(
            '<img style="max-width:700px;width:100%" src="data:image/png'
        )
    rows = cells_of(result._repr_html_() or "")
    assert ["estimator", "fixed-lag"] in rows and ["laps", str(result.laps)] in rows
    assert ["size of the map", str(result.map.size)] in rows
    study = Study(tracks=(0,), question="Is 1 < 2?")
    assert ["question", "Is 1 &lt; 2?"] in cells_of(study._repr_html_())
    assert html(3) == "<code>3</code>"


def test_the_bar_has_the_time_of_each_stretch_that_is_not_good() -> None:
    _, result = lap()
    t, cycles = result.trajectory_t, list(result.cycles)
    cycles[50:76] = [replace(one, health=DEGRADED, reason="a > b") for one in cycles[50:76]]
    text = replace(result, cycles=tuple(cycles))._repr_html_() or ""
    ((left, width, reason),) = re.findall(r'left:([\d.]+)%;width:([\d.]+)%;[^>]*title="([^"]*)"', text)
    assert float(left) == pytest.approx(100.0 * (t[50] - t[0]) / (t[-1] - t[0]), abs=0.01)
    assert float(width) == pytest.approx(100.0 * (t[75] - t[50]) / (t[-1] - t[0]), abs=0.01)
    assert reason.endswith("degraded, a &gt; b") and f"degraded {26 / len(t):.1%}" in text


def test_a_result_in_memory_says_what_its_folder_says() -> None:
    log, result = lap()
    alone, with_log = sections(summarize(result, None)), sections(summarize(result, log))
    assert alone["Calibration at the end"] == with_log["Calibration at the end"]
    assert cells_of(with_log["Result"])[: len(cells_of(alone["Result"]))] == cells_of(alone["Result"])
    assert any(row[0] == "rmse [m]" for row in cells_of(with_log["Result"]))


def test_everything_that_questions_a_result_is_a_warning() -> None:
    hint = Hint("units", "odometry.csv", "vx", "vx is 3.6 times", "km/h", "divide")
    summary: dict[str, Any] = {"hints": [vars(hint)], "converged": False, "objection": "it is bent"}
    summary |= {
        "crossings": [{"boundary": "left", "x": 1.0, "y": -2.0, "driven": 3.0}],
        "diagnosis": ["late"],
    }
    summary |= {"not_mapped": ["right boundary: not mapped"], "left_out": {"b": "it does not fit"}}
    assert warnings(summary) == [
        f"hint: {hint.line}",
        "the left boundary lies across the driven path at x = 1.0 m, y = -2.0 m",
        *("right boundary: not mapped", "late", "the batch has not converged"),
        *("not a map of the drive: it is bent", "b is left out: it does not fit"),
    ]
    assert "Warnings" not in sections({})


def test_metrics_are_those_of_the_tables() -> None:
    log, result = lap()
    assert log.truth is not None
    whole = run_online(log, FixedLagMapper(None, log.odometry_sigma), snapshot_times=lap_times(log))
    for run in (whole, result):
        *laps, of_run = measure(run, log)
        frame = run.metrics(log.truth)
        assert [*frame.index] == [row["lap"] for row in laps] == [1]
        for key in frame:
            source = of_run if METRICS[key].scope == "run" else laps[0]
            np.testing.assert_equal(frame[key].iloc[0], source[key])
        assert {"rmse", "missed", "size", "ate", "closed_at_end"} <= {*frame}
    outlined = run_online(log, FixedLagMapper(None, log.odometry_sigma), outlines=True).metrics(log.truth)
    assert outlined["rmse"].equals(result.metrics(log.truth)["rmse"]) and "nees" not in outlined
    pd.testing.assert_index_equal(whole.metrics(log.truth).columns, result.metrics(log.truth).columns)


def test_a_notebook_shows_records_and_progress(tmp_path: Path) -> None:
    """Without ipywidgets progress is lines, with them a bar."""
    nbclient = pytest.importorskip("nbclient", reason="notebooks are executed by nbclient")
    nbformat = pytest.importorskip("nbformat", reason="notebooks are executed by nbclient")
    pytest.importorskip("ipykernel", reason="notebooks are executed by ipykernel")
    write_log(short_drive(), tmp_path / "log")
    code = f"""
from pathspace_graph import FixedLagMapper, MapperSettings, read_log, run_online
from pathspace_graph.console import progress
log = read_log({str(tmp_path / "log")!r})
with progress("mapping", len(log.cycles)) as advance:
    result = run_online(log, FixedLagMapper(None, log.noise), observers=[lambda _: advance()])
result"""
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    nbclient.NotebookClient(book, kernel_name="python3").execute()
    *progress, shown = book.cells[0].outputs
    assert shown.data["text/html"].startswith("<img") and shown.data["text/plain"].startswith("RunResult(")
    assert progress and ("widget-view" in str(progress) or "mapping: " in progress[-1].data["text/plain"])
