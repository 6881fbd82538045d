"""Comparisons end to end with estimators whose maps are known: what is told, written, survives."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from pathspace_graph import estimators as registry
from pathspace_graph.cli import main
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.blind_spot import find_blind_spot
from pathspace_graph.eval.comparison import NamedLog, choose, choose_reference, compare, read_logs
from pathspace_graph.eval.comparison_plot import plot_maps
from pathspace_graph.eval.comparison_table import final_table, paper_frame, paper_table, side_by_side
from pathspace_graph.eval.metrics import LapMetrics
from pathspace_graph.eval.paired import paired_frame
from pathspace_graph.eval.text_table import TextTable, latex_text
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.log import Detections, Log, Odometry, Truth, read_log, write_log
from pathspace_graph.map import Map, PointBoundary, SplineBoundary, read_map
from pathspace_graph.run import BatchRun
from pathspace_graph.settings import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.spline import BSpline

from .pretenders import write_round_track

Array = NDArray[np.float64]

RADII = {LEFT: 8.0, RIGHT: 12.0}
CENTRE = np.array([0.0, 10.0])
NAMES = ("rings", "gaps", "rings-batch", "broken")


@dataclass(frozen=True)
class Step:
    """Of every cycle: at the origin."""

    pose: Array = field(default_factory=lambda: np.zeros(3))
    sizes: tuple[int, int] = (16, 16)
    readings: int = 1
    stages: dict[str, float] = field(default_factory=lambda: {"guess": 1e-6})


class Rings:
    """Both boundaries as closed splines through the truth, 0.1 m too wide."""

    def __init__(self, settings: MapperSettings, log: Log) -> None:
        self.settings = settings

    def update(self, odometry: Odometry, detections: Detections) -> Step:
        return Step()

    def map(self) -> Map:
        angle = 2 * np.pi * np.arange(16) / 16
        circle = np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        # control points of a uniform cubic lie outside of the circle that it runs along
        out = 3.0 / (2.0 + np.cos(2 * np.pi / 16))
        return Map(
            True,
            {
                label: SplineBoundary(
                    BSpline.periodic_from(np.arange(17.0), CENTRE + out * (radius + 0.1) * circle),
                    0.01 * np.eye(32),
                )
                for label, radius in RADII.items()
            },
        )


class Gaps(Rings):
    """Every cone as a landmark, but three of the right row on end and one of the left."""

    def map(self) -> Map:
        angle = 2 * np.pi * np.arange(20) / 20
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        left, right = (CENTRE + radius * circle for radius in RADII.values())
        kept = {LEFT: np.delete(left, 10, axis=0), RIGHT: np.delete(right, [3, 4, 5], axis=0)}
        return Map(True, {label: PointBoundary(p, 0.01 * np.eye(2 * len(p))) for label, p in kept.items()})


class Broken(Rings):
    """Fails at once."""

    def update(self, odometry: Odometry, detections: Detections) -> Step:
        raise ValueError("lost\nthe way")


class RingsBatch(Rings):
    """The rings as a batch that does not converge."""

    def solve(self, log: Log) -> BatchRun:
        t = np.array([cycle.t for cycle in log.cycles])
        nothing = np.zeros((len(t), 3))
        return BatchRun("rings-batch", {}, self.map(), t, nothing, (), 2, converged=False)


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    online = {"rings": Rings, "gaps": Gaps, "broken": Broken}
    monkeypatch.setattr(registry, "ONLINE", online)
    monkeypatch.setattr(registry, "BATCH", {"rings-batch": RingsBatch})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two logs of two laps, a and b."""
    folder = tmp_path_factory.mktemp("logs")
    track = read_track(write_round_track(tmp_path_factory.mktemp("track")))
    for seed, name in enumerate("ab"):
        write_log(simulate(track, SimulationSettings(laps=2), seed), folder / "logs" / name)
    return folder / "logs"


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures as PNG only."""
    monkeypatch.setattr("pathspace_graph.eval.comparison_output._SUFFIXES", (".png",))


def without_truth(folder: Path, out: Path) -> Path:
    write_log(replace(read_log(folder), truth=None), out)
    return out


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


# --- choice ----------------------------------------------------------------------------------------------


def test_estimators_are_those_named_or_all_that_are_known() -> None:
    assert choose(()) == ("rings", "gaps", "broken", "rings-batch")
    assert choose(("gaps", "rings", "gaps")) == ("gaps", "rings")
    with pytest.raises(SettingsError, match=r"known ones .*rings-batch.*'nothing'"):
        choose(("nothing",))
    assert choose_reference(None, ("gaps", "rings")) == "gaps"
    assert choose_reference(None, ("gaps", registry.DEFAULT)) == registry.DEFAULT
    with pytest.raises(SettingsError, match="--reference"):
        choose_reference("rings", ("gaps",))


def test_logs_of_a_folder(folder: Path, tmp_path: Path) -> None:
    assert [named.name for named in read_logs(folder)] == ["a", "b"]
    assert [named.name for named in read_logs(folder / "a")] == ["a"]
    with pytest.raises(InputError, match="found neither"):
        read_logs(tmp_path)
    with pytest.raises(InputError):
        read_logs(tmp_path / "nowhere")


# --- results ---------------------------------------------------------------------------------------------


def test_rows_are_of_each_lap_and_of_the_log(folder: Path) -> None:
    frame = compare(read_logs(folder / "a"), ["rings", "rings-batch"]).frame()
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


def test_a_failure_is_told_and_the_rest_goes_on(folder: Path) -> None:
    told: list[None] = []
    found = compare(read_logs(folder), ["broken", "rings"], on_run=lambda: told.append(None))
    assert [(o.log, o.estimator) for o in found.failures] == [("a", "broken"), ("b", "broken")]
    assert found.failures[0].failure == "ValueError: lost the way"
    assert len(told) == 4 and len(found.frame()) == 6
    assert set(found.times()["stage"]) == {"whole", "guess"}
    table = paper_table(found)
    assert table.rows[0][:2] == ("broken", "failed")


def test_the_paper_s_table_is_the_mean_over_logs(folder: Path) -> None:
    found = compare(read_logs(folder), ["rings", "gaps"])
    frame = paper_frame(found)
    assert frame[["estimator", "lap", "logs"]].values.tolist() == [
        ["rings", 1, 2],
        ["rings", 2, 2],
        ["gaps", 1, 2],
        ["gaps", 2, 2],
    ]
    assert frame["size"].tolist() == [32, 32, 36, 36]
    # of 40 cones the middle one of three on end is more than 3 m away
    assert frame["missed"].tolist() == pytest.approx([0.0, 0.0, 0.075, 0.075])
    assert paper_table(found).header == ("estimator", "lap", "logs", "rmse [m]", "missed [%]", "size")
    assert paper_table(found).groups == (2,)


def test_differences_are_paired_over_logs(folder: Path) -> None:
    found = paired_frame(compare(read_logs(folder), ["rings", "gaps"], reference="gaps"))
    size = found[found["metric"] == "size"].iloc[0]
    assert (size["estimator"], size["reference"], size["pairs"]) == ("rings", "gaps", 2)
    assert (size["mean"], size["low"], size["high"]) == (-4.0, -4.0, -4.0)


def test_without_truth_only_what_needs_none_is_told(folder: Path) -> None:
    log = replace(read_log(folder / "a"), truth=None)
    found = compare([NamedLog("bare", log)], ["rings"])
    assert not {"rmse", "missed", "ate", "nees"} & set(found.frame())
    table = paper_table(found)
    assert "no true cones" in table.title
    assert table.rows == (("rings", "end", "32"),)
    assert {row[0] for row in final_table(found).rows} >= {"size", "map [kB]", "update, mean [ms]"}


# --- blind spot ------------------------------------------------------------------------------------------


def test_the_blind_spot_is_where_most_cones_are_missed_on_end(folder: Path) -> None:
    truth = read_log(folder / "a").truth
    assert truth is not None
    settings, log = MapperSettings(), read_log(folder / "a")
    spot = find_blind_spot(truth, Rings(settings, log).map(), Gaps(settings, log).map(), (6.0, 5.0))
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


def test_a_table_keeps_its_units_and_escapes_what_latex_would_take_for_commands() -> None:
    table = TextTable("50 % of a_b", ("name", "rmse [m]"), (("x|y", "1.0"), ("z", "–")), groups=(1,))
    assert table.rich().columns[1].header.plain == "rmse [m]"  # type: ignore[union-attr]
    assert "| x\\|y | 1.0 |" in table.markdown()
    latex = table.latex()
    assert "\\caption{50 \\% of a\\_b}" in latex and "z & -- \\\\" in latex
    assert latex.count("\\midrule") == 2 and "{lr}" in latex
    assert latex_text("2σ & 5 % {x}") == "2$\\sigma$ \\& 5 \\% \\{x\\}"


def test_side_by_side_has_a_row_per_lap_and_dashes_where_one_has_fewer() -> None:
    ours = [LapMetrics(1, 0.3, 0.0, 90), LapMetrics(2, 0.2, 0.0, 80)]
    table = side_by_side({"ours": ours, "theirs": [LapMetrics(1, 0.5, 0.125, 160)]})
    assert [name.split("\n")[0] for name in table.header] == ["lap", "ours", "theirs"]
    assert [row[0] for row in table.rows] == ["1", "2"]
    assert table.rows[0][2].split() == ["0.500", "12.5", "160"]
    assert table.rows[1][2].split() == ["–", "–", "–"]
    assert side_by_side({"ours": []}).rows == ()


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
    bare = plot_maps(found.outcomes, replace(named[0].log, truth=None))
    assert bare.axes[0].get_xlim()[1] > 12.0


# --- command ---------------------------------------------------------------------------------------------


def test_the_command_writes_tables_figures_and_maps(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(folder / "a"), "--out", str(out), "--estimators", *NAMES[:3]]
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "rmse [m]" in printed.out and "ghost curve [m]" in printed.out
    assert printed.err == "rings-batch on a: not converged\n"
    files = {f"{name}.{suffix}" for name in ("table", "metrics") for suffix in ("csv", "md", "tex")}
    figures = {f"{name}.{suffix}" for name in ("maps", "blind_spot") for suffix in ("png", "pdf")}
    assert {path.name for path in out.iterdir()} == files | figures | {
        "times.csv",
        "comparison.json",
        *NAMES[:3],
    }
    assert read_map(out / "gaps").size == 36
    assert json.loads((out / "rings" / "summary.json").read_text())["laps"][1]["size"] == 32
    table = rows(out / "table.csv")
    assert [row["lap"] for row in table] == ["1", "2", "1", "2", "2"]
    assert {"log", "estimator", "scope", "lap", "rmse", "two_way"} <= set(rows(out / "metrics.csv")[0])
    assert json.loads((out / "comparison.json").read_text())["failures"] == []


def test_a_second_comparison_keeps_the_first_and_a_failure_ends_in_3(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], quick: None
) -> None:
    out = tmp_path / "out"
    command = ["compare", str(folder / "a"), "--out", str(out), "--estimators", "broken", "rings"]
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 3
    assert "broken on a: failed, ValueError: lost the way" in capsys.readouterr().err
    assert (out / "rings" / "map.json").exists() and not (out / "broken").exists()
    with pytest.raises(SystemExit):
        main(command)
    assert (tmp_path / "out.~1~" / "comparison.json").exists()


def test_several_logs_have_folders_of_their_own_and_intervals(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], quick: None
) -> None:
    out = tmp_path / "out"
    assert main(["compare", str(folder), "--out", str(out), "--estimators", "rings", "gaps"]) == 0
    assert "Difference from rings" in capsys.readouterr().out
    assert {path.name for path in out.iterdir() if path.is_dir()} == {"a", "b"}
    assert {path.name for path in (out / "b").iterdir()} >= {"rings", "gaps", "maps.png", "blind_spot.png"}
    paired = pd.read_csv(out / "paired.csv")
    assert set(paired["estimator"]) == {"gaps"} and (paired["pairs"] <= 2).all()
    assert (out / "paired.tex").exists()


def test_without_truth_the_command_says_so_and_draws_the_maps(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], quick: None
) -> None:
    log, out = without_truth(folder / "a", tmp_path / "bare"), tmp_path / "out"
    assert main(["compare", str(log), "--out", str(out), "--estimators", "rings", "gaps"]) == 0
    assert "no true cones" in capsys.readouterr().out
    assert (out / "maps.png").exists() and not (out / "blind_spot.png").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--estimators", "nothing"], "'nothing'"),
        (["--estimators", "rings", "--reference", "gaps"], "--reference"),
        (["--jobs", "0"], "jobs"),
        (["--ghosts.distance", "-1"], "distance"),
        (["--lag", "nan"], "lag"),
    ],
)
def test_bad_usage_is_one_line_and_leaves_nothing(
    options: list[str], expected: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["compare", str(folder / "a"), "--out", str(tmp_path / "out"), *options]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["compare", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 2
    assert "found neither" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"empty"}
