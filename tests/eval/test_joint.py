"""The study of several drives in one map: its metrics in each drive's frame, and its table."""

from __future__ import annotations

import pandas as pd
import pytest

from pathspace_graph.eval.cars import joint_of_track, joint_table, metrics_of_group

from ..batch.joint.several import alone, lap

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
    monkeypatch.setattr("pathspace_graph.eval.cars.drive", lambda car, track, seed: seed)
    rows = joint_of_track("plain", 4, 4)
    assert [row["drives"] for row in rows] == [1, 1, 1, 1, 2, 2, 4]
    assert [row["logs"] for row in rows[4:]] == [["0", "1"], ["2", "3"], ["0", "1", "2", "3"]]
