"""The table by track: the laps of a column, means over seeds, failures, and what stands below the tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import Table, track_tables
from pathspace_graph.eval.metrics.metric import METRICS, column_of

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


def table(*columns: str, of: pd.DataFrame | None = None) -> dict[str, tuple[Any, ...]]:
    """The one table's rows by their name."""
    (found,) = track_tables(Study(tracks=(0,), columns=columns), frame() if of is None else of)
    assert found.header[:2] == ("track", "runs")
    return {str(row[0]): row[1:] for row in found.rows}


def test_a_column_is_of_the_last_lap_of_one_of_the_later_ones_or_of_all() -> None:
    found = table("rmse", "rmse@1", "rmse@later", "rmse@all")
    assert found["bean"] == ("1 of 1", "0.500", "0.200", "0.350", "0.300")
    assert found["oval"] == ("2 of 2", "0.200", "0.700", "0.250", "0.400")  # means over two seeds


def test_below_the_tracks_every_run_counts_the_same() -> None:
    found = table("rmse")
    assert list(found) == ["oval", "bean", "all, mean", "all, median", "all, largest"]
    assert found["all, mean"] == ("3 of 3", "0.300")
    assert found["all, median"] == ("3 of 3", "0.300")
    assert found["all, largest"] == ("3 of 3", "0.500")


def test_a_failed_run_is_counted_and_has_no_value() -> None:
    found = table("rmse@1", of=frame(failed=("oval", 1)))
    assert found["oval"] == ("1 of 2", "0.600")
    assert table("rmse", of=frame(failed=("bean", 0)))["bean"] == ("0 of 1", "–")


def test_a_last_lap_without_a_value_is_not_that_of_the_lap_before() -> None:
    runs = frame()
    runs.loc[(runs["track"] == "bean") & (runs["lap"] == 3), "rmse"] = float("nan")
    assert table("rmse", of=runs)["bean"] == ("1 of 1", "–")


def test_a_metric_that_was_not_measured_is_a_dash() -> None:
    assert table("limit")["oval"] == ("2 of 2", "–")


def test_every_combination_has_a_table_of_its_own() -> None:
    both = pd.concat([frame(), frame(variant="lag=1")])
    study = Study(tracks=(0,), columns=("rmse",), grids=({"lag": [1.0]},))
    assert [found.title for found in track_tables(study, both)] == ["default", "lag=1"]
    assert track_tables(Study(tracks=(0,)), both) == []


def test_errors_with_a_sign_have_root_mean_squares_and_magnitudes() -> None:
    turned = frame().rename(columns={"rmse": "turn"})
    turned.loc[turned["track"] == "oval", "turn"] *= -1.0
    factor = METRICS["turn"].factor
    found = {name: float(cells[1]) / factor for name, cells in table("turn", of=turned).items()}
    assert found["oval"] == pytest.approx(np.sqrt((0.1**2 + 0.3**2) / 2), abs=1e-3)
    assert found["all, mean"] == pytest.approx(np.sqrt((0.1**2 + 0.3**2 + 0.5**2) / 3), abs=1e-3)
    assert (found["all, median"], found["all, largest"]) == (
        pytest.approx(0.3, abs=1e-3),
        pytest.approx(0.5, abs=1e-3),
    )


def test_a_slope_is_of_all_runs_together() -> None:
    runs = frame().assign(bias_true=[0.1, 0.1, 0.1, 0.3, 0.3, 0.3, -0.5, -0.5, -0.5])
    found = table("slope(rmse, bias_true)", of=runs)
    assert found["oval"] == ("2 of 2", "1.00")  # 0.1 on 0.1 and 0.3 on 0.3
    assert found["all, mean"] == ("3 of 3", f"{(0.1**2 + 0.3**2 - 0.5**2) / 0.35:.2f}")
    assert found["all, median"] == ("3 of 3", "–")
    assert (
        column_of("slope(bias, bias_true)").title
        == "slope of bias of the yaw rate on bias of the yaw rate, true"
    )
    with pytest.raises(SettingsError, match="columns: expected"):
        column_of("slope(bias, bais)")


@pytest.mark.parametrize("column", ["rmsee", "rmse@", "rmse@0.5", "rmse@last"])
def test_an_unknown_column_is_refused(column: str) -> None:
    if column == "rmse@":
        assert column_of(column).laps == ""
        return
    with pytest.raises(SettingsError, match="columns: expected"):
        Study(tracks=(0,), columns=(column,))


def test_yardsticks_are_true_or_false() -> None:
    with pytest.raises(SettingsError, match="reference_limits: expected true or false, found 1"):
        Study(tracks=(0,), reference_limits=1)  # type: ignore[arg-type]


def test_a_table_keeps_its_units_and_escapes_what_latex_would_take_for_commands() -> None:
    rows = (("x|y", "2σ < 5 %"), ("z", "–"), ("z", "–"))
    table = Table(("name", "rmse [m]"), rows, "50 % of a_b ± 1")
    assert table.rich().columns[1].header.plain == "rmse [m]"  # type: ignore[union-attr]
    latex = table.latex()
    assert r"\caption{50 \% of a\_b $\pm$ 1}" in latex and r"2$\sigma$ \ensuremath{<} 5 \%" in latex
    assert latex.count(r"\midrule") == 2 and "{lr}" in latex and latex.isascii()


def test_names_are_aligned_to_the_left_and_numbers_to_the_right() -> None:
    table = Table(("name", "a", ""), (("x|y", "1.0", ""), ("long name", "12.25", "*")), "Title")
    assert [line.rstrip() for line in table.text().splitlines()] == [
        "Title",
        "",
        "name           a",
        "---------  -----  --",
        "x|y          1.0",
        "long name  12.25   *",
    ]
    lines = table.markdown().split("\n")
    assert lines[:2] == ["Title", ""] and lines[-1] == ""
    assert lines[3] == "|:----------|------:|---:|"
    assert lines[4] == r"| x\|y      |   1.0 |    |"


def test_a_table_too_wide_is_cut_into_parts_that_keep_the_names() -> None:
    table = Table(("metric", "aaaaaaaa", "bbbbbbbb", "cc"), (("rmse", "1", "2", "3"),))
    assert [part.header for part in table.parts(200)] == [table.header]
    parts = table.parts(22)  # 10 for the names and the border, 11 for each wide column
    assert [part.header[1:] for part in parts] == [("aaaaaaaa",), ("bbbbbbbb",), ("cc",)]
    assert [part.rows for part in parts] == [(("rmse", "1"),), (("rmse", "2"),), (("rmse", "3"),)]
    assert [part.header[1:] for part in table.parts(27)] == [("aaaaaaaa",), ("bbbbbbbb", "cc")]
    assert len(table.parts(1)) == 3
