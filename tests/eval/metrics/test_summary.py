"""The summary of a run: the paper's table by laps, when laps end, and what wasn't mapped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.eval.metrics.measures import lap_times, laps_of, not_mapped, summarize
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.io.log import Detections, Log, Odometry, Truth
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import BatchRun, CycleRecord, LapBatches, RunNoise, RunResult, VehicleState
from pathspace_graph.labels import LEFT, RIGHT

from .straight_maps import line, row, truth

ANGLE = np.arange(0.0, 2.5 * 2 * np.pi, 0.02)
"""Two and a half laps are driven on a circle of 25 m, at a third of a radian a second."""


def log(path: bool = True) -> Log:
    """Only left cones are detected."""
    heading = np.arctan2(np.sin(ANGLE), np.cos(ANGLE))
    poses = np.stack([25.0 * np.sin(ANGLE), 25.0 * (1 - np.cos(ANGLE)), heading], axis=1)
    true = truth(row(2.0), row(-2.0))
    if path:
        true = Truth(3.0 * ANGLE, poses, true.cones, true.cone_labels)
    seen = Detections(0.0, np.ones((3, 2)), np.tile(np.eye(2), (3, 1, 1)), np.full(3, LEFT))
    return Log(Odometry(np.array([0.0, 1.0]), np.zeros((2, 3))), (seen,), np.full(3, 0.1), truth=true)


def map_at(offset: float) -> Map:
    return Map(False, {LEFT: line(2.0 + offset)})


RUN = RunResult(
    "made",
    {},
    map_at(0.1),
    np.zeros(0),
    np.zeros((0, 3)),
    (),
    2,
    lap_maps=((1, map_at(0.5)),),
    snapshots=(map_at(0.3), map_at(0.2)),
)


def test_the_health_of_a_run_is_counted_and_its_bad_stretches_are_listed() -> None:
    assert "health" not in summarize(RUN, log())
    words = [("good", ""), ("lost", "why"), ("lost", "still")]
    records = tuple(
        CycleRecord(k, 0.1 * k, 0.0, 1, 1, 1, 1, health=word, reason=reason)
        for k, (word, reason) in enumerate(words)
    )
    assert summarize(replace(RUN, cycles=records), log())["health"] == {
        "good": 1,
        "degraded": 0,
        "lost": 2,
        "stretches": [{"health": "lost", "begin": 0.1, "end": 0.2, "reason": "why"}],
    }


def test_the_summary_says_when_batches_have_ended_and_how_long_the_run_waited_for_them() -> None:
    assert "batches" not in summarize(RUN, log())
    run = replace(RUN, batches=LapBatches((140, 200), 3), waited=0.25)
    assert summarize(run, log())["batches"] == {"ends": (140, 200), "late": 3, "waited_seconds": 0.25}


def test_true_laps_end_where_the_path_comes_round() -> None:
    np.testing.assert_allclose(lap_times(log()), 3.0 * 2 * np.pi * np.array([1.0, 2.0]), atol=0.06)
    assert len(lap_times(log(path=False))) == len(lap_times(replace(log(), truth=None))) == 0


def test_the_paper_s_table_has_a_row_for_each_true_lap_or_else_each_estimated_one() -> None:
    rows = laps_of(RUN, log())
    assert [(r.lap, r.rmse, r.missed, r.size) for r in rows] == [
        (1, pytest.approx(0.3), 0.5, 4),
        (2, pytest.approx(0.2), 0.5, 4),
    ]
    assert [(r.lap, r.rmse) for r in laps_of(RUN, log(path=False))] == [(1, pytest.approx(0.5))]
    assert laps_of(RUN, replace(log(), truth=None)) == []
    batch = BatchRun("made", {}, map_at(0.4), np.zeros(0), np.zeros((0, 3)), (), 2)
    assert [(r.lap, r.rmse) for r in laps_of(batch, log())] == [(2, pytest.approx(0.4))]


def test_a_boundary_that_is_missing_has_a_reason() -> None:
    assert not_mapped(map_at(0.0), log()) == ["right boundary: not mapped, no right detections"]
    missing = not_mapped(Map(False, {RIGHT: line(-2.0)}), log())
    assert missing == ["left boundary: not mapped, 3 left detections were too few or agreed too little"]


def test_the_summary_has_the_final_map_beside_the_laps() -> None:
    summary = summarize(RUN, log())
    assert summary["final"] == {"rmse": pytest.approx(0.1), "missed": 0.5, "size": 4}
    assert [r["lap"] for r in summary["laps"]] == [1, 2]
    assert summary["inside_two_sigma"] == 1.0
    assert (summary["seconds"], summary["closed"], summary["lap_count"]) == (None, False, 2)
    assert "laps" not in summarize(RUN, replace(log(), truth=None))


def test_the_summary_has_the_calibration_with_its_sigmas_where_it_is_known() -> None:
    assert "calibration" not in summarize(RUN, log())
    covariance = np.diag(np.array([1.0, 1.0, 0.3, 0.04, 0.05]) ** 2)
    known = VehicleState(np.zeros(3), np.array([0.01, 0.02]), covariance)
    summary = summarize(replace(RUN, vehicle=known), log())
    assert summary["calibration"] == pytest.approx(
        {"scale": 0.01, "bias": 0.02, "scale_sigma": 0.04, "bias_sigma": 0.05}
    )
    assert summary["heading_sigma"] == pytest.approx(0.3)


def test_the_noise_of_a_run_is_there_as_stated_and_as_measured() -> None:
    assert "noise" not in summarize(RUN, log())
    stated = summarize(replace(RUN, noise=RunNoise("stated", "stated")), log())
    assert "notes" not in stated
    assert stated["noise"] == {
        "odometry": "stated",
        "detections": "stated",
        "stated": {
            "odometry": pytest.approx([0.1, 0.1, 0.1]),
            "detections": pytest.approx({"range": np.sqrt(2.0), "along": 1.0, "across": 1.0}),
        },
    }
    measured = MeasuredNoise(np.full(3, 0.01), np.full(3, 0.02), 0.1, seconds=5.0)
    unstated = replace(log(), odometry_stated=False, detections_stated=False)
    summary = summarize(replace(RUN, noise=RunNoise("measured", "assumed", measured)), unstated)
    assert summary["notes"] == ["measured: odometry 0.01 m/s, 0.01 m/s, 0.01 rad/s from sample to sample"]
    assert summary["noise"]["stated"] == {}
    assert summary["noise"]["measured"] == {"odometry": [0.01] * 3, "drift": [0.02] * 3, "seconds": 5.0}
