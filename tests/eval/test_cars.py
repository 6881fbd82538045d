"""Whole cars: known and joint maps of simulated ones, logs of a real one; what is driven, and the tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial import KDTree

from pathspace_graph.cli import main
from pathspace_graph.eval.cars import (
    OTHER,
    OWN,
    begun_later,
    drive_on,
    joint_of_track,
    joint_table,
    known_table,
    metrics_of_group,
    odds_of_track,
    odds_table,
    real_tables,
    surveyed,
)
from pathspace_graph.eval.metrics.alignment import motion_onto
from pathspace_graph.eval.metrics.measures import UNKNOWN
from pathspace_graph.eval.metrics.reference import truth_of
from pathspace_graph.factors.se2 import compose, move_points
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.places.find import SURE_ODDS
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track import to_map_frame
from pathspace_graph.sim.track_generator import generate_track

from ..batch.joint.several import alone, lap
from ..convert.recorded import SHORT, write_recorded
from ..scenes.kidnapped import laps_log, pear_track

LOG = laps_log(pear_track())


def test_points_are_moved_onto_others_by_least_squares() -> None:
    rng = np.random.default_rng(3)
    points, motion = rng.normal(size=(9, 2)) * 20.0, np.array([3.0, -1.0, 2.5])
    np.testing.assert_allclose(motion_onto(points, move_points(motion, points)), motion, atol=1e-9)
    np.testing.assert_allclose(compose(motion, np.zeros(3)), motion)


def test_a_drive_that_begins_later_has_what_came_then_and_no_truth() -> None:
    """A share of 0.4 of half the log is a fifth of it."""
    later, t = begun_later(LOG, 0.4), LOG.odometry.t
    begin = t[0] + 0.2 * (t[-1] - t[0])
    assert later.odometry.t[0] == pytest.approx(begin, abs=0.11)
    assert begin <= later.cycles[0].t < begin + 0.3
    assert later.truth is None


def test_of_a_surveyed_map_some_neighbours_on_the_left_stood_elsewhere() -> None:
    truth, track = truth_of(LOG), to_map_frame(pear_track())
    curves = surveyed(truth, np.random.default_rng(1), moved=7).splines
    feet = {
        label: curves[label].foot_points(cones) for label, cones in ((LEFT, track.left), (RIGHT, track.right))
    }
    off, right = {label: np.abs(foot.distance) for label, foot in feet.items()}, KDTree(track.right)
    moved = off[LEFT] > 1.0
    assert (right.query(feet[LEFT].position[moved])[0] > right.query(track.left[moved])[0]).all(), "outwards"
    assert 4 <= (off[LEFT] > 1.0).sum() <= 9
    assert off[LEFT].max() < 3.5
    assert off[RIGHT].max() < 0.6


def test_a_vehicle_is_held_against_its_true_place_on_the_map() -> None:
    known = surveyed(truth_of(LOG), np.random.default_rng(1))
    found = drive_on(known, LOG, 0.5, np.zeros(3))
    assert (found["found"], found["soon"], found["wrong"]) == (1.0, 1.0, 0.0)
    assert found["error"] < 0.2
    displaced = drive_on(known, LOG, 0.5, np.array([5.0, 0.0, 0.0]))
    assert displaced["wrong"] == 1.0
    assert displaced["error"] == pytest.approx(5.0, abs=0.3)


def test_the_table_has_a_row_for_each_kind_of_map_over_tracks() -> None:
    rest = {"car": "plain", "soon": 1.0, "wrong": 0.0, "map": 0.1}
    rows = [
        {**rest, "track": track, "kind": kind, "found": found, "error": error}
        for kind in (OWN, OTHER)
        for track, found, error in ((0, 1.0, 0.1), (0, 0.0, np.nan), (1, 1.0, 0.3))
    ]
    table = known_table(pd.DataFrame(rows))
    assert next(iter(table.frame)) == "cars, known map"
    every = table.records()
    assert [row["cars, known map"] for row in every] == [f"plain, {kind} (3 drives)" for kind in (OWN, OTHER)]
    assert every[0]["found [%]"].startswith("75 ±")  # not two thirds: each track counts once
    assert every[0]["pose error [m]"].startswith("0.20 ±")


LOGS = {"first": lap(0), "elsewhere": lap(1, 9.0), "other": lap(0, 0.0, 5)}


def test_the_metrics_are_those_of_the_drives_that_are_in_the_map() -> None:
    results = {name: alone(log) for name, log in LOGS.items()}
    one = metrics_of_group({"first": LOGS["first"]}, results)
    both = metrics_of_group(LOGS, results)
    assert (one["mapped"], both["mapped"]) == (1, 2)
    assert 0.0 < both["shape"] < one["shape"] < 0.2
    assert both["ate"] < 0.35 and both["inside"] > 0.7


def test_the_table_compares_each_number_with_half_of_it_track_by_track() -> None:
    """The mean of the ratios of two tracks is not the ratio of the means."""
    shapes = {(0, 1): (0.2, 0.4), (1, 1): (0.1, 0.1), (0, 2): (0.1, 0.2), (1, 2): (0.08, 0.08)}
    rest = {"car": "plain", "nees": 1.0, "inside": 0.95, "ate": 0.1}
    rows = [
        {**rest, "track": track, "drives": count, "shape": shape}
        for (track, count), both in shapes.items()
        for shape in both
    ]
    alone, together = joint_table(pd.DataFrame(rows)).records()
    assert together["cars, drives of a track"] == "plain, 2 drives"
    assert alone["rmse of the shape [m]"].startswith("0.200 ±") and alone["by half as many"] == "–"
    assert together["by half as many"].startswith("0.65 ±")
    assert together["within 2σ [%]"].startswith("95.0 ±")


def test_there_is_a_row_for_each_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four drives there are four maps of one, two of two, and one of all."""
    monkeypatch.setattr("pathspace_graph.eval.cars.metrics_of_group", lambda logs, _: {"logs": [*logs]})
    monkeypatch.setattr("pathspace_graph.eval.cars.solve_alone", lambda log: log)
    monkeypatch.setattr("pathspace_graph.eval.cars.simulated", lambda car, track, seed: seed)
    rows = joint_of_track("plain", 4, 4)
    assert [row["drives"] for row in rows] == [1, 1, 1, 1, 2, 2, 4]
    assert [row["logs"] for row in rows[4:]] == [["0", "1"], ["2", "3"], ["0", "1", "2", "3"]]


def test_claims_are_counted_beside_those_that_their_odds_expect() -> None:
    odds = [np.nan, np.nan, 1.0, 1.0, 20.0]
    kinds, wrong = [OWN, OTHER, OWN, OWN, OTHER], [True, True, True, False, True]
    table = odds_table(pd.DataFrame({"odds": odds, "kind": kinds, "wrong": wrong}))
    rows = {
        name: figures for name, *figures in table.frame.to_numpy().tolist() if set(figures) - {"0", "0.0"}
    }
    assert rows == {
        "no place": ["1", "1", UNKNOWN, UNKNOWN],
        "0 to 2": ["2", "0", "1", "0.5"],  # two at e to 1: 0.27 each
        "15 to 100": ["0", "1", "1", "0.0"],
    }


def test_a_place_on_the_map_of_another_drive_is_held_against_the_truth() -> None:
    rows = pd.DataFrame(odds_of_track("plain", 60))
    own = rows[rows["kind"] == OWN]
    assert len(own) == len(rows) / 2 > 20
    assert not own["wrong"][own["odds"] > SURE_ODDS].any()
    assert (own["odds"] > SURE_ODDS).mean() > 0.5
    assert not (rows["odds"][rows["kind"] == OTHER] > SURE_ODDS).any()


# --- logs of a real car ------------------------------------------------------------------------------------

CONVERT = ["--from", "csv", "--columns", "label=colour", "--labels", "left=1", "right=0", "--y", "right"]


def standing_drive() -> Log:
    """One lap of a short track by a car with cameras that stands before it and after."""
    settings = replace(preset({"sensor": "camera", "odometry": "ins"}), laps=1)
    vehicle = replace(settings.vehicle, rest=4.0, stand=5.0)
    return simulate(generate_track(np.random.default_rng(4), SHORT), replace(settings, vehicle=vehicle), 4)


def test_real_logs_are_mapped_and_held_against_each_other(tmp_path: Path) -> None:
    for name in ("first", "second"):
        recorded = write_recorded(standing_drive(), tmp_path / "recorded" / name)
        assert main(["-q", "convert", str(recorded), *CONVERT, "--out", str(tmp_path / name)]) == 0
    logs, cells = [tmp_path / name for name in ("first", "second")], list[int]()
    real_tables(logs, tmp_path / "out")
    tables = real_tables(logs, tmp_path / "out", on_cell=lambda _, remaining: cells.append(remaining))
    assert cells == [0], "what was mapped is kept"
    online = tables["runs"].records()[0]
    assert online["track, estimator"] == "first, fixed-lag"
    assert online["closed [%]"] == "100"
    assert float(online["end off by [m]"]) < 1.0
    assert tables["maps"].records()[0] | {"landmark-fixed-lag [m]": ""} == {
        "maps": "first, second",
        "fixed-lag [m]": "0.00",
        "spline [m]": "0.00",
        "landmark-fixed-lag [m]": "",
    }
    first, second, both = tables["measured"].records()
    assert [row["log"] for row in (first, second, both)] == ["first", "second", "all drives"]
    assert both["scale [%]"].partition(" ")[0] == first["scale [%]"].partition(" ")[0]


def test_a_report_of_real_logs_needs_some(tmp_path: Path) -> None:
    assert main(["report", "--out", str(tmp_path), "--only", "real"]) == 2
