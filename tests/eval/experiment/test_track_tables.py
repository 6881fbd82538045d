"""The table by track: means over seeds and failures; and the forms of any table."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import TextTable, track_tables
from pathspace_graph.eval.metrics.measures import METRICS

RUNS = {  # rmse (m) of laps 1, 2 and 3
    ("oval", 0): (0.6, 0.2, 0.1),
    ("oval", 1): (0.8, 0.4, 0.3),
    ("bean", 0): (0.2, 0.2, 0.5),
}


def frame(failed: tuple[str, int] | None = None, variant: str = "default") -> pd.DataFrame:
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
    assert table(frame()) == {
        "oval": ("2 of 2", "0.200"),
        "bean": ("1 of 1", "0.500"),
        "all": ("3 of 3", "0.300"),
    }


def test_a_failed_run_is_counted_and_has_no_value() -> None:
    assert table(frame(failed=("oval", 1)))["oval"] == ("1 of 2", "0.100")
    assert table(frame(failed=("bean", 0)))["bean"] == ("0 of 1", "–")


def test_a_last_lap_without_a_value_is_not_that_of_the_lap_before() -> None:
    runs = frame()
    runs.loc[(runs["track"] == "bean") & (runs["lap"] == 3), "rmse"] = float("nan")
    assert table(runs)["bean"] == ("1 of 1", "–")


def test_every_combination_has_a_table_of_its_own() -> None:
    both = pd.concat([frame(), frame(variant="lag=1")])
    study = Study(tracks=(0,), grids=({"lag": [1.0]},))
    assert [found.title for found in track_tables(study, both)] == ["default", "lag=1"]


def test_errors_with_a_sign_have_root_mean_squares() -> None:
    turned = frame().rename(columns={"rmse": "turn"})
    turned.loc[turned["track"] == "oval", "turn"] *= -1.0
    expected = METRICS["turn"].factor * np.sqrt((0.1**2 + 0.3**2) / 2)
    assert float(table(turned, "turn")["oval"][1]) == pytest.approx(expected, abs=0.005)


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
