"""Scaling: logs that are what they say, slopes by hand, a slow estimator stopped; never how fast."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph import cli
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.scaling import lanes as scaling_run
from pathspace_graph.eval.scaling.lanes import Lane, LaneTimes, run_lanes
from pathspace_graph.eval.scaling.output import MARKER, scaling_table, stops, write_scaling
from pathspace_graph.eval.scaling.points import CONES, LAPS, READINGS, Point, binned, fit_slope
from pathspace_graph.eval.scaling.roads import (
    closed_road,
    cones_seen,
    drive_log,
    make_drives,
    open_road,
    thinned,
)
from pathspace_graph.eval.scaling.scaling import measure_scaling
from pathspace_graph.eval.scaling.settings import RoadSettings, ScalingSettings
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings

ROAD = RoadSettings()
SMALL = ScalingSettings(
    cones_min=20.0,
    cones_max=60.0,
    bins=4,
    fit_from=20.0,
    readings=(2, 6, 12),
    readings_cones=60,
    warm_up=5,
    laps=2,
    laps_cones=40,
    budget=10.0,
)


@pytest.fixture(scope="module")
def log() -> Log:
    return drive_log(open_road(60, ROAD.gap, ROAD), ROAD, seed=0)


@dataclass
class Pretender:
    """An estimator that only notes when it was called."""

    name: str
    calls: list[str]
    settings: MapperSettings = field(default_factory=MapperSettings)
    fails_at: int = 10**9

    def update(self, odometry: object, detections: object) -> Pretender:
        if self.calls.count(self.name) >= self.fails_at:
            raise ValueError("no\nmore")
        self.calls.append(self.name)
        return self

    sizes = (3, 4)


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Puts pretenders in place of the estimators; gives the list of calls."""

    def put(**fails_at: int) -> list[str]:
        calls: list[str] = []

        def make(name: str, settings: MapperSettings, log: Log) -> Any:
            return Pretender(name, calls, fails_at=fails_at.get(name, 10**9))

        monkeypatch.setattr(scaling_run, "make_online", make)
        return calls

    return put


def test_roads_have_their_gaps_and_width() -> None:
    for track, gap in ((open_road(100, 5.0, ROAD), 5.0), (closed_road(100, ROAD), 5.0)):
        for row in (track.left, track.right):
            np.testing.assert_allclose(np.linalg.norm(np.diff(row, axis=0), axis=1), gap, rtol=0.06)
        nearest = np.linalg.norm(track.left[:, None] - track.right[None], axis=-1).min(axis=1)
        assert np.all(nearest >= ROAD.width - 0.2)
        assert np.all(nearest < np.hypot(ROAD.width, gap / 2) + 0.5)
    assert len(closed_road(100, ROAD).cones) == pytest.approx(100, abs=3)


def test_cones_seen_counts_each_once(log: Log) -> None:
    assert log.truth is not None
    assert log.truth.associations is not None
    seen = cones_seen(log)
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    for k in (0, 5, len(seen) - 1):
        so_far = set(log.truth.associations[: ends[k]].tolist()) - {-1}
        assert seen[k] == len(so_far)


def test_thinned_keeps_readings_of_the_cycle(log: Log) -> None:
    thin = thinned(log, 4, np.random.default_rng(0))
    for before, after in zip(log.cycles, thin.cycles, strict=True):
        assert len(after.labels) == min(4, len(before.labels))
        kept = [np.flatnonzero((before.points_vehicle == p).all(axis=1))[0] for p in after.points_vehicle]
        assert len(set(kept)) == len(kept)
        np.testing.assert_array_equal(before.covariances[kept], after.covariances)
        np.testing.assert_array_equal(before.labels[kept], after.labels)
    again = thinned(log, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(again.cycles[7].points_vehicle, thin.cycles[7].points_vehicle)


def test_every_lane_gets_each_cycle_and_the_first_one_changes(
    log: Log, pretend: Callable[..., list[str]]
) -> None:
    calls = pretend()
    short = replace(log, cycles=log.cycles[:5])
    times = run_lanes([Lane(name, short) for name in "abc"], MapperSettings(), budget=10.0)
    assert "".join(calls) == "abcbcacababcbca"
    assert all(len(t.seconds) == len(t.sizes) == 5 and not t.stopped for t in times)
    assert all((t.sizes == 7.0).all() for t in times)


def test_one_that_is_too_slow_or_fails_stops_alone(log: Log, pretend: Callable[..., list[str]]) -> None:
    pretend(b=4)
    short = replace(log, cycles=log.cycles[:20])
    good, bad = run_lanes([Lane("a", short), Lane("b", short)], MapperSettings(), budget=10.0)
    assert len(good.seconds) == 20
    assert not good.stopped
    assert len(bad.seconds) == 4
    assert bad.stopped == "ValueError: no more"
    (slow,) = run_lanes([Lane("a", short)], MapperSettings(), budget=1e-12)
    assert len(slow.seconds) == scaling_run.JUDGED
    assert "over 1e-12 s" in slow.stopped


def point(at: float, seconds: float) -> Point:
    return Point(CONES, "any", at, seconds, 1, 1.0)


def test_slope_of_a_power_law_is_its_exponent() -> None:
    points = [point(at, 1e-6 * at**2.5) for at in (10.0, 100.0, 300.0, 1000.0, 2000.0)]
    slope = fit_slope(CONES, "any", points, fit_from=100.0)
    assert slope.slope == pytest.approx(2.5)
    assert slope.error == pytest.approx(0.0, abs=1e-6)
    assert (slope.points, slope.low, slope.high) == (4, 100.0, 2000.0)


def test_standard_error_of_a_slope_by_hand() -> None:
    """Abscissas -1, 0, 1 and ordinates 0, 3, 0 in logarithms: slope 0, squares 6, error sqrt(6 / 2)."""
    points = [point(float(np.exp(x)), float(np.exp(y))) for x, y in ((-1, 0), (0, 3), (1, 0))]
    slope = fit_slope(CONES, "any", points)
    assert slope.slope == pytest.approx(0.0, abs=1e-12)
    assert slope.error == pytest.approx(np.sqrt(3.0))


def test_two_points_have_no_slope() -> None:
    assert np.isnan(fit_slope(CONES, "any", [point(1.0, 1.0), point(2.0, 2.0)]).slope)


def test_bins_are_means_of_their_cycles(log: Log) -> None:
    times = LaneTimes(Lane("any", log), np.array([1.0, 2.0, 3.0, 5.0]), np.array([2.0, 2.0, 4.0, 6.0]))
    at = np.array([1.0, 10.0, 12.0, 40.0, 90.0])  # the last cycle wasn't reached
    points = binned(CONES, times, at, np.array([5.0, 20.0, 30.0, 80.0, 100.0]))
    assert [(p.at, p.seconds, p.cycles, p.size) for p in points] == [(11.0, 2.5, 2, 3.0), (40.0, 5.0, 1, 6.0)]


def test_a_small_measurement_end_to_end(tmp_path: Path) -> None:
    drives = make_drives(SMALL)
    told: list[int] = []
    scaling = measure_scaling(["fixed-lag"], drives, SMALL, on_cycle=lambda: told.append(1))
    assert len(told) == drives.cycles
    assert drives.seen[-1] >= SMALL.cones_max > drives.seen[-2]
    assert [p.at for p in scaling.of(LAPS, "fixed-lag")] == [1.0, 2.0]
    assert [p.at for p in scaling.of(READINGS, "fixed-lag")] == [2.0, 6.0, 12.0]
    assert len(scaling.of(CONES, "fixed-lag")) == 4
    assert scaling.memory["fixed-lag"] > 0.01
    assert not stops(scaling)
    write_scaling(tmp_path / "out", scaling)
    content = json.loads((tmp_path / "out" / MARKER).read_text())
    assert content["seconds_compared"] == {"fixed-lag": None}  # 200 cones weren't reached
    assert {s["sweep"] for s in content["slopes"]} == {CONES, READINGS, LAPS}
    assert len(pd.read_csv(tmp_path / "out" / "points.csv")) == len(scaling.points)
    names = {"scaling.png", "scaling.pdf", "laps.png", "laps.pdf", "table.md"}
    assert names <= {file.name for file in (tmp_path / "out").iterdir()}
    assert scaling_table(scaling).rows[0][0] == "fixed-lag"


def test_bad_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "new")]
    assert cli.main(["scale", *out, "--estimators", "nobody"]) == cli.BAD_INPUT
    assert "nobody" in capsys.readouterr().err
    assert cli.main(["scale", *out, "--quick", "--scaling.laps", "3"]) == cli.BAD_INPUT
    assert not (tmp_path / "new").exists()
    with pytest.raises(SettingsError, match="cones_min"):
        ScalingSettings(cones_min=300.0, cones_max=200.0)
