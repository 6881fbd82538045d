"""What is measured of a run: rows of laps and of the whole, and values of a run known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.eval.metrics.measures import (
    METRICS,
    PAPER,
    WHOLE,
    Metric,
    closes_falsely,
    map_bytes,
    measure,
    stage_times,
)
from pathspace_graph.io.log import Detections, Log, Odometry, Truth
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import BatchRun, CycleRecord, RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line, row, truth

STAMPS = np.arange(0.5, 40.0, 1.0)
"""The cycles are one second apart."""
ANGULAR_SPEED = 0.25
"""A lap of 2 pi / 0.25 s = 25.1 s, at which cycles 0 to 24 are over."""


def circle_truth() -> Truth:
    """One and a half laps of radius 20 m, between straight rows of cones."""
    angle = ANGULAR_SPEED * np.arange(0.0, 40.0, 0.05)
    heading = (angle + np.pi) % (2 * np.pi) - np.pi
    poses = np.stack([20.0 * np.sin(angle), 20.0 * (1.0 - np.cos(angle)), heading], axis=1)
    rows = truth(row(2.0), row(-2.0))
    return Truth(angle / ANGULAR_SPEED, poses, rows.cones, rows.cone_labels)


def log(true: Truth | None) -> Log:
    nothing = np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int)
    odometry = Odometry(np.array([0.0, 40.0]), np.zeros((2, 3)))
    return Log(odometry, tuple(Detections(t, *nothing) for t in STAMPS), np.full(3, 0.1), truth=true)


def run(true: Truth) -> RunResult:
    """The first lap's map 0.4 m off, the last one 0.3 m; poses 1 m to the left in lap 1, then 2 m."""
    before, after = (Map(closed, {LEFT: line(2.0 + by)}) for closed, by in ((False, 0.4), (True, 0.3)))
    cycles = tuple(CycleRecord(k, t, 0.001 * (k + 1), 4, 0, 0, 1) for k, t in enumerate(STAMPS))
    at = [np.searchsorted(true.pose_t, t) for t in STAMPS]
    poses = true.poses[at].copy()
    left = np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1)
    poses[:, :2] += left * np.where(2 * np.pi / ANGULAR_SPEED > STAMPS, 1.0, 2.0)[:, None]
    return RunResult("made", {}, after, STAMPS, poses, cycles, 1, ((1, before),), (before,))


def test_every_lap_has_a_row_and_the_whole_run_is_the_last() -> None:
    true = circle_truth()
    lap, whole = measure(run(true), log(true), (7.0, 6.0))
    assert (lap["lap"], whole["lap"]) == (1, None)
    assert (lap["closed"], whole["closed"], whole["closed_at_end"]) == (False, True, True)
    assert [r["rmse"] for r in (lap, whole)] == [pytest.approx(0.4), pytest.approx(0.3)]
    assert [r["missed"] for r in (lap, whole)] == [0.5, 0.5]  # the right boundary isn't mapped
    assert (whole["size"], whole["size_share"]) == (4, 4 / 6)
    assert whole["rmse_capped"] == pytest.approx(np.sqrt((0.3**2 + 3.0**2) / 2))
    assert whole["mapped_to_truth"] == pytest.approx(0.3, abs=1e-3)
    assert whole["truth_to_mapped"] == np.inf
    assert (whole["inside"], whole["ghost_metres"]) == (0.0, 0.0)
    assert (whole["seconds"], whole["seconds_processor"]) == (7.0, 6.0)
    assert "seconds" not in lap
    assert set(whole) | set(lap) <= {"lap", *METRICS}


def test_poses_and_updates_are_those_of_the_lap() -> None:
    true = circle_truth()
    lap, whole = measure(run(true), log(true))
    assert lap["ate"] == pytest.approx(1.0, abs=0.01) == lap["across"]
    assert lap["along"] == pytest.approx(0.0, abs=0.01)
    assert whole["ate"] == pytest.approx(np.sqrt((25 * 1.0 + 15 * 4.0) / 40), abs=0.01)
    assert lap["ms_mean"] == pytest.approx(13.0) and whole["ms_mean"] == pytest.approx(20.5)


def test_a_batch_has_a_row_of_its_last_lap_and_no_update_times() -> None:
    true = circle_truth()
    made = run(true)
    batch = BatchRun("made", {}, made.map, STAMPS, made.trajectory, made.cycles, 3, converged=False)
    lap, whole = measure(batch, log(true))
    assert (lap["lap"], lap["rmse"]) == (1, pytest.approx(0.3))
    assert whole["converged"] is False and "ms_mean" not in whole
    (own, _) = measure(batch, log(None))
    assert own["lap"] == 3  # without a true path laps are the estimator's own


def test_without_truth_only_what_needs_none_is_measured() -> None:
    true = circle_truth()
    lap, whole = measure(run(true), log(None))
    keys = {"size", "closed", "bytes", "bytes_covariance", "ms_mean", "ms_p99", "ms_processor"}
    keys |= {"lap"}
    assert set(lap) == keys == set(whole) - {"closed_at_end", "crossings", "crossings_own"}
    bare = log(Truth(true.pose_t, true.poses, np.zeros((0, 2)), np.zeros(0, dtype=int)))
    assert set(measure(run(true), bare)[0]) == keys | {"ate", "along", "across"}


def test_marginals_are_measured() -> None:
    true = circle_truth()
    (*_, whole) = measure(run(true), log(true))
    for key in ("inside", "normalized_error"):  # the map's covariance has no cross terms
        assert whole[f"{key}_marginals"] == pytest.approx(whole[key])
    # 0.3 m by 0.1 m at both ends, and by 0.1 sqrt(20 / 64) m in the middle
    assert whole["normalized_error"] == pytest.approx((9.0 + 9.0 + 28.8) / 3)


def test_landmarks_have_no_band() -> None:
    true = circle_truth()
    points = Map(False, {LEFT: landmarks((0, 2.1), (5, 2)), RIGHT: landmarks((0, -2))})
    (*_, whole) = measure(replace(run(true), map=points), log(true))
    assert np.isnan(whole["inside"]) and np.isnan(whole["normalized_error"])
    assert whole["nees"] == pytest.approx(1 / 6)


@pytest.mark.parametrize(
    ("closed_at", "false"), [(None, False), (5.0, True), (18.0, True), (20.0, False), (30.0, False)]
)
def test_a_loop_closes_falsely_before_the_drive_is_back(closed_at: float | None, false: bool) -> None:
    """A lap of 125.7 m at 5 m/s ends after 25.1 s; the sensor sees the start some 30 m before."""
    true = circle_truth()
    made = run(true)
    cycles = tuple(
        replace(record, closed=closed_at is not None and record.t >= closed_at) for record in made.cycles
    )
    closed = Map(closed_at is not None, made.map.boundaries)
    assert closes_falsely(replace(made, cycles=cycles, map=closed), true) is false
    batch = BatchRun("made", {}, closed, STAMPS, made.trajectory, made.cycles, 0)  # which closes at its end
    open_drive = replace(true, pose_t=true.pose_t[:400], poses=true.poses[:400])
    assert not closes_falsely(batch, true) and closes_falsely(batch, open_drive) is (closed_at is not None)
    assert measure(batch, log(open_drive))[-1]["false_closing"] is (closed_at is not None)


def test_the_jump_is_that_of_the_cycle_that_replaced_the_map() -> None:
    true = circle_truth()
    made = run(true)
    (*_, plain) = measure(made, log(true))
    assert "jump" not in plain
    cycles = (*made.cycles[:30], replace(made.cycles[30], jump=(0.3, -0.4, 0.1)), *made.cycles[31:])
    (*_, whole) = measure(replace(made, cycles=cycles), log(true))
    assert whole["jump"] == pytest.approx(0.5)


def test_a_signed_error_has_a_root_mean_square() -> None:
    assert METRICS["turn"].over([3.0, -4.0, float("nan")]) == pytest.approx(np.sqrt(12.5))
    assert METRICS["rmse"].over([3.0, float("nan"), 5.0]) == 4.0
    assert np.isnan(METRICS["rmse"].over([float("nan")]))
    assert METRICS["turn"].text(np.deg2rad(0.3)) == "0.30" and METRICS["bias"].text(0.002) == "2.00"


def test_a_metric_is_shown_in_its_unit() -> None:
    assert [metric.key for metric in PAPER] == ["rmse", "missed", "size"]
    assert METRICS["missed"].heading == "missed [%]" and METRICS["size"].heading == "size"
    assert METRICS["missed"].text(0.125) == "12.5" and METRICS["bytes"].text(1640.0) == "1.64"
    assert Metric("k", "t").text(float("nan")) == "–"
    of_the_wall = {key for key, metric in METRICS.items() if metric.time == "wall"}
    assert of_the_wall == {"ms_mean", "ms_p99", "seconds"}


# --- what a run says of itself ---------------------------------------------------------------------------


def test_the_health_of_the_cycles_is_counted_where_it_is_told() -> None:
    true = circle_truth()
    made = run(true)
    assert not any(name.startswith("reported") for name in measure(made, log(true))[-1])
    told = ["good"] * 20 + ["degraded"] * 12 + ["lost"] * 8
    cycles = tuple(CycleRecord(k, t, 0.001, 4, 0, 0, 1, health=told[k]) for k, t in enumerate(STAMPS))
    whole = measure(replace(made, cycles=cycles), log(true))[-1]
    assert (whole["reported_degraded"], whole["reported_lost"]) == (0.3, 0.2)


def test_bytes_of_a_map() -> None:
    closed = BSpline.periodic_from(np.arange(9.0), np.random.default_rng(0).normal(size=(8, 2)))
    track = Map(True, {LEFT: SplineBoundary(closed, np.eye(16)), RIGHT: landmarks((0, 0), (1, 1), (2, 2))})
    covariance = 8 * (16 * 17 // 2 + 6 * 7 // 2)
    assert map_bytes(track) == {"bytes": 8 * (16 + 9 + 6), "bytes_covariance": covariance}
    assert map_bytes(Map(False, {LEFT: line(0.0)}))["bytes"] == 8 * (8 + 8)
    assert map_bytes(Map(False, {})) == {"bytes": 0, "bytes_covariance": 0}


def test_times_of_cycles_and_their_stages() -> None:
    cycles = [
        CycleRecord(k, 0.1 * k, 0.001 * (k + 1), 0, 0, 0, 1, {"predict": 0.0005, **extra})
        for k, extra in enumerate([{}, {}, {"close": 0.002}])
    ]
    whole, predict, close = stage_times(cycles)
    assert (whole["stage"], predict["stage"], close["stage"]) == (WHOLE, "predict", "close")
    assert (whole["mean"], whole["median"]) == (pytest.approx(0.002), pytest.approx(0.002))
    assert whole["p99"] == pytest.approx(0.00298)
    assert (predict["share"], close["mean"], close["median"]) == (0.25, pytest.approx(0.002 / 3), 0.0)
    assert stage_times([]) == []
