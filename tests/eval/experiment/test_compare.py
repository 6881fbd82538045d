"""Comparisons of estimators whose maps are known: what is told, drawn, and survives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph import estimators as registry
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.experiment.compare import (
    Comparison,
    NamedLog,
    choose,
    choose_reference,
    compare,
    final_table,
    paired_frame,
    paper_frame,
    paper_table,
    read_logs,
    side_by_side,
    tables,
)
from pathspace_graph.eval.experiment.plots import find_blind_spot, plot_maps
from pathspace_graph.eval.metrics.accuracy import LapMetrics
from pathspace_graph.io.log import Truth, read_log
from pathspace_graph.io.map import Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

from ...scenes.rings import CENTRE, Gaps, Rings, register, write_logs

pytestmark = pytest.mark.usefixtures("png_only")


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_logs(tmp_path_factory.mktemp("drives") / "round")


@pytest.fixture(scope="module")
def logs(folder: Path) -> list[NamedLog]:
    """Both logs, as they are read and judged."""
    return read_logs(folder)


@pytest.fixture(scope="module")
def compared(logs: list[NamedLog]) -> Comparison:
    """Two estimators on both logs."""
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        return compare(logs, ["rings", "gaps"], reference="gaps")


# --- choice ----------------------------------------------------------------------------------------------


def test_estimators_are_those_named_or_all_that_are_known() -> None:
    assert choose(()) == ("rings", "gaps", "broken", "rings-batch")
    assert choose(("gaps", "rings", "gaps")) == ("gaps", "rings")
    with pytest.raises(SettingsError, match=r"a known estimator, found 'nothing'$"):
        choose(("nothing",))
    assert choose_reference(None, ("gaps", "rings")) == "gaps"
    assert choose_reference(None, ("gaps", registry.DEFAULT_ONLINE)) == registry.DEFAULT_ONLINE
    with pytest.raises(SettingsError, match="--reference"):
        choose_reference("rings", ("gaps",))


def test_logs_of_a_folder(logs: list[NamedLog], folder: Path, tmp_path: Path) -> None:
    assert [named.name for named in logs] == ["a", "b"]
    assert [named.name for named in read_logs(folder / "a")] == ["a"]
    with pytest.raises(InputError, match="found neither"):
        read_logs(tmp_path)
    with pytest.raises(InputError):
        read_logs(tmp_path / "nowhere")


# --- results ---------------------------------------------------------------------------------------------


def test_rows_are_of_each_lap_and_of_the_log(logs: list[NamedLog]) -> None:
    frame = compare(logs[:1], ["rings", "rings-batch"]).frame
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


def test_a_failure_is_told_and_the_rest_goes_on(logs: list[NamedLog]) -> None:
    told: list[int] = []
    found = compare(logs, ["broken", "rings"], on_run=lambda done, _: told.append(done))
    assert [tuple(o.names.values()) for o in found.failures] == [("a", "broken"), ("b", "broken")]
    assert found.failures[0].failure == "ValueError: lost the way"
    assert told == [0, 1, 2, 3, 4] and len(found.frame) == 6
    assert set(found.times()["stage"]) == {"whole", "guess"}
    table = paper_table(found)
    assert table.rows[0][:2] == ("broken", "failed")


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
    assert paper_table(compared).header == ("estimator", "lap", "logs", "rmse [m]", "missed [%]", "size")
    assert paper_table(compared).groups == (2,)
    assert paper_table(compared).rows[0][3:] == ("0.100 ± 0.000", "0.0 ± 0.0", "32 ± 0")


def test_differences_are_paired_over_logs(compared: Comparison) -> None:
    found = paired_frame(compared)
    size = found[found["metric"] == "size"].iloc[0]
    assert (size["estimator"], size["reference"], size["pairs"]) == ("rings", "gaps", 2)
    assert (size["mean"], size["low"], size["high"]) == (-4.0, -4.0, -4.0)


def test_without_truth_only_what_needs_none_is_told(folder: Path) -> None:
    log = replace(read_log(folder / "a"), truth=None)
    found = compare([NamedLog("bare", log)], ["rings"])
    assert not {"rmse", "missed", "ate", "nees"} & set(found.frame)
    table = tables(found)["table"]
    assert "no true cones" in table.title
    assert dict(table.rows).keys() == {
        *(
            "size",
            "loop closed at the end of the log [%]",
            "crossings of the boundaries",
            "update, mean [ms]",
        ),
    }
    assert table.rows[0] == ("size", "32")
    assert {row[0] for row in final_table(found).rows} >= {"size", "map [kB]", "update, mean [ms]"}


# --- blind spot ------------------------------------------------------------------------------------------


def test_the_blind_spot_is_where_most_cones_are_missed_on_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathspace_graph.eval.experiment.plots.HALF_SIZE", np.array([6.0, 5.0]))
    truth = read_log(folder / "a").truth
    assert truth is not None
    settings, log = MapperSettings(), read_log(folder / "a")
    spot = find_blind_spot(truth, Rings(settings, log).map(), Gaps(settings, log).map())
    assert spot is not None
    angle = 2 * np.pi * np.array([3, 4, 5]) / 20
    expected = CENTRE + 12.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert [len(missed) for missed in spot.missed] == [0, 3]
    np.testing.assert_allclose(np.sort(spot.missed[1], axis=0), np.sort(expected, axis=0), atol=1e-3)
    assert find_blind_spot(truth, Rings(settings, log).map(), Rings(settings, log).map()) is None


def test_a_blind_spot_needs_a_spline_that_passes_there() -> None:
    cones = np.array([[0.0, 0.0], [20.0, 0.0]])
    truth = Truth(np.zeros(0), np.zeros((0, 3)), cones, np.array([LEFT, LEFT]))
    line = BSpline.clamped_from(np.array([0.0, 5.0]), np.column_stack([np.linspace(0, 5, 4), np.zeros(4)]))
    spline = Map(False, {LEFT: SplineBoundary(line, np.zeros((8, 8)))})
    nothing = Map(False, {LEFT: PointBoundary(np.array([[50.0, 0.0]]), np.eye(2))})
    spot = find_blind_spot(truth, spline, nothing)
    assert spot is not None
    np.testing.assert_array_equal(spot.centre, [0.0, 0.0])


# --- tables and figures ----------------------------------------------------------------------------------


def test_side_by_side_has_a_row_per_lap_and_dashes_where_one_has_fewer() -> None:
    ours = [LapMetrics(1, 0.3, 0.0, 90), LapMetrics(2, 0.2, 0.0, 80)]
    table = side_by_side({"ours": ours, "theirs": [LapMetrics(1, 0.5, 0.125, 160)]})
    assert [name.split("\n")[0] for name in table.header] == ["lap", "ours", "theirs"]
    assert [row[0] for row in table.rows] == ["1", "2"]
    assert table.rows[0][2].split() == ["0.500", "12.5", "160"]
    assert table.rows[1][2].split() == ["–", "–", "–"]
    assert side_by_side({"ours": []}).rows == ()


@pytest.mark.slow
def test_maps_are_drawn_over_one_stretch_with_what_they_reach(folder: Path) -> None:
    named = read_logs(folder / "a")
    found = compare(named, ["rings", "broken", "gaps"])
    figure = plot_maps(found.outcomes, named[0].log)
    used = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left").split("\n")[0] for axes in used] == ["rings", "gaps"]
    assert used[0].get_xlim() == used[1].get_xlim() and used[0].get_aspect() == 1.0
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    named_labels = [label for label in labels if label]
    assert len(named_labels) == len(set(named_labels))
    assert {"left boundary", "right landmarks", "true cones"} <= set(labels)
    assert figure.get_tightbbox().height <= figure.get_size_inches()[1] <= figure.get_tightbbox().height + 0.4
    bare = plot_maps(found.outcomes, replace(named[0].log, truth=None))
    assert bare.axes[0].get_xlim()[1] > 12.0
