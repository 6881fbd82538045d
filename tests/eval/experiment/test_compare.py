"""Comparisons of estimators whose maps are known: what is told, drawn, and survives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.compare import (
    Comparison,
    compare,
    final_table,
    paper_frame,
    paper_table,
    plan_of,
    side_by_side,
    tables,
    write_comparison,
)
from pathspace_graph.eval.figures.drawing import plot_maps
from pathspace_graph.eval.metrics.accuracy import LapMetrics
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.rings import Gaps, Rings, register, write_logs

pytestmark = pytest.mark.usefixtures("png_only")


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_logs(tmp_path_factory.mktemp("drives") / "round")


@pytest.fixture(scope="module")
def compared(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Two estimators on both logs."""
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        return compare(plan_of(folder, ("rings", "gaps")), tmp_path_factory.mktemp("cells"))


# --- choice ----------------------------------------------------------------------------------------------


def test_estimators_are_those_named_or_all_that_are_known(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = plan_of(folder / "a").study
    assert found.estimators == ("rings", "gaps", "broken", "rings-batch")
    assert plan_of(folder, ("gaps", "rings", "gaps")).study.estimators == ("gaps", "rings")
    with pytest.raises(SettingsError, match=r"a known estimator, found 'nothing'$"):
        plan_of(folder, ("nothing",))


# --- results ---------------------------------------------------------------------------------------------


def test_rows_are_of_each_lap_and_of_the_log(folder: Path, tmp_path: Path) -> None:
    frame = compare(plan_of(folder / "a", ("rings", "rings-batch")), tmp_path).frame
    own = frame[frame["estimator"] == "rings"]
    assert own["scope"].tolist() == ["lap", "lap", "log"]
    assert own["lap"].tolist()[:2] == [1, 2]
    assert np.allclose(own["rmse"], 0.1, atol=0.02) and (own["missed"] == 0.0).all()
    assert np.allclose(own["mapped_to_truth"], 0.1, atol=0.02)
    assert (own["ghost_metres"] == 0.0).all() and (own["size"] == 32).all()
    assert (own["ms_mean"] > 0.0).all() and own["seconds"].notna().tolist() == [False, False, True]
    batch = frame[frame["estimator"] == "rings-batch"]
    assert batch["scope"].tolist() == ["lap", "log"] and batch["ms_mean"].isna().all()
    # the pretenders stand at the origin while the truth drives round
    assert own["ate"].iloc[-1] == pytest.approx(np.sqrt(2) * 10.0, rel=0.1)
    assert own["ate"].iloc[-1] ** 2 == pytest.approx((own["along"] ** 2 + own["across"] ** 2).iloc[-1])


def test_a_failure_is_told_and_the_rest_goes_on(folder: Path, tmp_path: Path) -> None:
    told: list[int] = []
    plan = plan_of(folder, ("broken", "rings"))
    found = compare(plan, tmp_path / "cells", on_cell=lambda done, _: told.append(done))
    assert [tuple(of.values()) for of in found.failures] == [
        ("a", "broken", "ValueError: lost the way"),
        ("b", "broken", "ValueError: lost the way"),
    ]
    assert told == [0, 1, 2, 3, 4] and len(found.frame) == 6
    write_comparison(tmp_path / "out", found, 1)
    times = pd.read_csv(tmp_path / "out" / "times.csv")
    assert set(times["stage"]) == {"whole", "guess"}
    table = paper_table(found)
    assert [*table.frame.iloc[0, :2]] == ["broken", "failed"]


def test_the_paper_s_table_is_the_mean_over_logs(compared: Comparison) -> None:
    frame = paper_frame(compared)
    assert frame[["estimator", "lap", "logs"]].values.tolist() == [
        ["rings", 1, 2],
        ["rings", 2, 2],
        ["gaps", 1, 2],
        ["gaps", 2, 2],
    ]
    assert frame["size"].tolist() == [32, 32, 36, 36]
    # of 40 cones the middle one of three on end is more than 3 m away
    assert frame["missed"].tolist() == pytest.approx([0.0, 0.0, 0.075, 0.075])
    assert tuple(paper_table(compared).frame) == (
        "estimator",
        "lap",
        "logs",
        "rmse [m]",
        "missed [%]",
        "size",
    )
    assert [*paper_table(compared).frame.iloc[0, 3:]] == ["0.100 ± 0.000", "0.0 ± 0.0", "32 ± 0"]


def test_without_truth_only_what_needs_none_is_told(folder: Path, tmp_path: Path) -> None:
    write_log(replace(read_log(folder / "a"), truth=None), tmp_path / "bare")
    found = compare(plan_of(tmp_path / "bare", ("rings",)), tmp_path / "cells")
    assert not {"rmse", "missed", "ate", "nees"} & set(found.frame)
    table = tables(found)["table"]
    assert "no true cones" in table.title
    assert [*table.frame["metric"]] == [
        *("size", "loop closed at the end of the log [%]", "crossings of the boundaries"),
        "update, mean [ms]",
    ]
    assert table.records()[0] == {"metric": "size", "rings": "32"}
    assert {*final_table(found).frame["metric"]} >= {"size", "map [kB]", "update, mean [ms]"}


# --- tables and figures ----------------------------------------------------------------------------------


def test_side_by_side_has_a_row_per_lap_and_dashes_where_one_has_fewer() -> None:
    ours = [LapMetrics(1, 0.3, 0.0, 90), LapMetrics(2, 0.2, 0.0, 80)]
    table = side_by_side({"ours": ours, "theirs": [LapMetrics(1, 0.5, 0.125, 160)]})
    assert [name.split("\n")[0] for name in table.frame] == ["lap", "ours", "theirs"]
    assert [*table.frame["lap"]] == ["1", "2"]
    assert table.frame.iloc[0, 2].split() == ["0.500", "12.5", "160"]
    assert table.frame.iloc[1, 2].split() == ["–", "–", "–"]
    assert side_by_side({"ours": []}).frame.empty


def test_maps_are_drawn_over_one_stretch_below_their_titles(folder: Path) -> None:
    truth, of = read_log(folder / "a").truth, {"rings": Rings, "gaps": Gaps}
    maps = {name: (make(MapperSettings(), np.ones(3)).map(), np.zeros((2, 3))) for name, make in of.items()}
    figure = plot_maps(maps, truth)
    first, second = figure.axes
    assert [axes.get_title(loc="left") for axes in (first, second)] == ["rings", "gaps"]
    assert first.get_xlim() == second.get_xlim() and first.get_aspect() == second.get_aspect() == 1.0
    assert first.get_xlim()[1] > 12.0 and plot_maps(maps, None).axes[0].get_xlim()[1] > 12.0
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"left boundary", "right landmarks", "true cones", "trajectory"} <= set(labels)
    assert len(labels) == len(set(labels))
