"""The benchmark: roads, lanes, means of cycles, power laws and figures of a run; never how fast."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pandas as pd
import pytest
from scipy.spatial import KDTree

from pathspace_graph import cli
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval import benchmark
from pathspace_graph.eval.benchmark import (
    CONES,
    DENSE_LINE,
    DENT,
    DENTS,
    GAP,
    JUDGED,
    LAPS,
    LINE_POINTS,
    MARKER,
    READINGS,
    ROAD_WIDTH,
    SPARE,
    SPEED,
    SWING,
    WAVELENGTH,
    Lane,
    Part,
    Scaling,
    ToldLandmarks,
    binned,
    closed_road,
    cones_seen,
    drive_log,
    fit_slope,
    make_drives,
    measure_scaling,
    open_road,
    run_lanes,
    scaling_table,
    speed_on,
    stops,
    thinned,
    write_scaling,
)
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import ahead, bean_track, beginning, corridor, exact_log

SMALL: ScalingSettings = ScalingSettings(
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
    return drive_log(open_road(60, GAP), seed=0)


def test_roads_have_their_gaps_and_width() -> None:
    for track, gap in ((open_road(100, 5.0), 5.0), (closed_road(100), 5.0)):
        for row in (track.left, track.right):
            np.testing.assert_allclose(np.linalg.norm(np.diff(row, axis=0), axis=1), gap, rtol=0.06)
        nearest = np.linalg.norm(track.left[:, None] - track.right[None], axis=-1).min(axis=1)
        assert np.all(nearest >= ROAD_WIDTH - 0.2)
        assert np.all(nearest < np.hypot(ROAD_WIDTH, gap / 2) + 0.5)
    assert len(closed_road(100).cones) == pytest.approx(100, abs=3)


def test_an_open_road_has_cones_to_spare_and_swings_about_its_direction() -> None:
    """It heads for x, by at most 0.9 rad to either side, and has a whole swing every 300 m."""
    track = open_road(400, GAP)
    assert len(track.cones) == pytest.approx(SPARE * 400, abs=4)
    steps = np.diff(track.left, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    assert np.abs(headings).max() == pytest.approx(SWING, abs=0.01)
    crossings = np.flatnonzero((headings[:-1] < 0.0) & (headings[1:] >= 0.0))
    np.testing.assert_allclose(np.diff(crossings) * GAP, WAVELENGTH, atol=GAP)


def test_an_open_road_never_comes_near_itself() -> None:
    track = open_road(2000, GAP)
    for pair in KDTree(track.left).query_pairs(20.0):
        assert abs(pair[0] - pair[1]) < 6


def test_a_closed_road_is_a_dented_circle() -> None:
    """Its distance from the middle swings by 12 % about the mean, three times around."""
    track = closed_road(400)
    middle = 0.5 * (track.left + track.right[KDTree(track.right).query(track.left)[1]])
    radius = np.linalg.norm(middle, axis=1)
    assert track.closed
    assert radius.max() / radius.min() == pytest.approx((1.0 + DENT) / (1.0 - DENT), rel=0.02)
    around = np.append(radius, radius[:1]) > radius.mean()
    assert np.sum(around[:-1] != around[1:]) == 2 * DENTS


def test_cones_seen_counts_each_once(log: Log) -> None:
    assert log.truth is not None
    assert log.truth.associations is not None
    seen = cones_seen(log)
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    for k in (0, 5, len(seen) - 1):
        so_far = set(log.truth.associations[: ends[k]].tolist()) - {-1}
        assert seen[k] == len(so_far)


def test_thinned_keeps_detections_of_the_cycle(log: Log) -> None:
    thin = thinned(log, 4, np.random.default_rng(0))
    for before, after in zip(log.cycles, thin.cycles, strict=True):
        assert len(after.labels) == min(4, len(before.labels))
        kept = [np.flatnonzero((before.points_vehicle == p).all(axis=1))[0] for p in after.points_vehicle]
        assert len(set(kept)) == len(kept)
        np.testing.assert_array_equal(before.covariances[kept], after.covariances)
        np.testing.assert_array_equal(before.labels[kept], after.labels)
    again = thinned(log, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(again.cycles[7].points_vehicle, thin.cycles[7].points_vehicle)


def test_the_long_drive_ends_when_the_last_cone_is_seen() -> None:
    drives = make_drives(SMALL)
    (cones,), (laps,), (line,) = (drives[name].parts for name in ("cones", "laps", "line"))
    assert len(cones.at) == len(cones.log.cycles)
    assert cones.at[-1] >= SMALL.cones_max > cones.at[-2]
    assert [part.name for part in drives["readings"].parts] == [f"{k} readings: " for k in SMALL.readings]
    assert {*np.unique(laps.at)} >= {1.0, 2.0} and len(drives["laps"].edges) == SMALL.laps + 1
    points = [len(cycle.labels) for cycle in line.log.cycles]
    assert np.mean(points) == pytest.approx(LINE_POINTS, rel=0.1)


def empty(cycles: int) -> Part:
    """A log without detections."""
    t = 0.1 * np.arange(cycles + 1)
    nothing = (np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int))
    seen = tuple(Detections(s, *nothing) for s in t[1:])
    return Part(Log(Odometry(t, np.zeros((cycles + 1, 3))), seen, np.ones(3)), np.ones(cycles))


@dataclass
class Pretender:
    """An estimator that only notes when it was called."""

    name: str
    calls: list[str]
    settings: MapperSettings = field(default_factory=MapperSettings)
    fails_at: int = 10**9
    sizes = (3, 4)
    closed = False

    def update(self, odometry: object, detections: object) -> Pretender:
        if self.calls.count(self.name) >= self.fails_at:
            raise ValueError("no\nmore")
        self.calls.append(self.name)
        return self


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Puts pretenders in place of the estimators; gives the list of calls."""

    def put(**fails_at: int) -> list[str]:
        calls: list[str] = []

        def make(name: str, settings: MapperSettings, log: Log) -> Any:
            return Pretender(name, calls, fails_at=fails_at.get(name, 10**9))

        monkeypatch.setattr(benchmark, "make_online", make)
        return calls

    return put


def test_every_lane_gets_each_cycle_and_the_first_one_changes(pretend: Callable[..., list[str]]) -> None:
    calls = pretend()
    times = [Lane(name, empty(5)) for name in "abc"]
    run_lanes(times, MapperSettings(), budget=10.0)
    assert "".join(calls) == "abcbcacababcbca"
    assert all(len(t.seconds) == len(t.sizes) == 5 and not t.stopped for t in times)
    assert all(t.sizes == [7] * 5 for t in times)


def test_a_lane_ends_with_its_log(pretend: Callable[..., list[str]]) -> None:
    calls, told = pretend(), []
    short, long = Lane("a", empty(2)), Lane("b", empty(4))
    run_lanes([short, long], MapperSettings(), 10.0, lambda: told.append(1))
    assert (len(short.seconds), len(long.seconds), len(told)) == (2, 4, 4)
    assert "".join(calls) == "abbabb"
    assert not short.stopped


def test_one_that_is_too_slow_or_fails_stops_alone(pretend: Callable[..., list[str]]) -> None:
    pretend(b=4)
    log = empty(20)
    good, bad, slow = Lane("a", log), Lane("b", log), Lane("a", log)
    run_lanes([good, bad], MapperSettings(), budget=10.0)
    assert len(good.seconds) == 20
    assert not good.stopped
    assert len(bad.seconds) == 4
    assert bad.stopped == "ValueError: no more"
    run_lanes([slow], MapperSettings(), budget=1e-12)
    assert len(slow.seconds) == JUDGED
    assert "over 1e-12 s" in slow.stopped


NO_LOG = Log(Odometry(np.zeros(1), np.zeros((1, 3))), (), np.ones(3))


def points(*found: tuple[float, float], sweep: str = CONES) -> pd.DataFrame:
    """Points at abscissas, with their times (s)."""
    frame = pd.DataFrame(found, columns=["at", "seconds"])
    return frame.assign(sweep=sweep, estimator="any", cycles=1, size=1.0)


def test_slope_of_a_power_law_is_its_exponent() -> None:
    slope = fit_slope(points(*((at, 1e-6 * at**2.5) for at in (10.0, 100.0, 300.0, 1000.0, 2000.0))), 100.0)
    assert slope["slope"] == pytest.approx(2.5)
    assert slope["error"] == pytest.approx(0.0, abs=1e-6)
    assert (slope["points"], slope["low"], slope["high"]) == (4, 100.0, 2000.0)


def test_standard_error_of_a_slope_by_hand() -> None:
    """Abscissas -1, 0, 1 and ordinates 0, 3, 0 in logarithms: slope 0, squares 6, error sqrt(6 / 2)."""
    three = points(*((float(np.exp(x)), float(np.exp(y))) for x, y in ((-1, 0), (0, 3), (1, 0))))
    slope = fit_slope(three)
    assert slope["slope"] == pytest.approx(0.0, abs=1e-12)
    assert slope["error"] == pytest.approx(np.sqrt(3.0))


def test_two_points_have_no_slope_and_none_have_no_range() -> None:
    assert np.isnan(fit_slope(points((1.0, 1.0), (2.0, 2.0)))["slope"])
    nothing = fit_slope(points())
    assert nothing["points"] == 0
    assert np.isnan(nothing["low"]) and np.isnan(nothing["high"])


def test_bins_are_means_of_their_cycles() -> None:
    at = np.array([1.0, 10.0, 12.0, 40.0, 90.0])  # the last cycle wasn't reached
    lane = Lane("any", Part(NO_LOG, at), [1.0, 2.0, 3.0, 5.0], [2, 2, 4, 6])
    found = binned(lane, np.array([5.0, 20.0, 30.0, 80.0, 100.0]))
    means = found[["at", "seconds", "cycles", "size"]].values.tolist()
    assert means == [[11.0, 2.5, 2, 3.0], [40.0, 5.0, 1, 6.0]]


def test_times_between_two_points_follow_the_power_law_through_them() -> None:
    """From 100 to 400 cones the time grows from 1 to 4 ms, so at 200 cones it is 2 ms."""
    found = pd.concat([points((100.0, 0.001), (400.0, 0.004)), points((200.0, 9.0), sweep=LAPS)])
    scaling = Scaling(ScalingSettings(), {}, found, pd.DataFrame())
    assert scaling.seconds_at(200.0, "any") == pytest.approx(0.002)
    assert np.isnan(scaling.seconds_at(50.0, "any"))
    assert np.isnan(scaling.seconds_at(500.0, "any"))
    assert np.isnan(scaling.seconds_at(200.0, "other"))


pytestmark = pytest.mark.usefixtures("png_only")


@pytest.mark.slow
def test_a_small_measurement_end_to_end(tmp_path: Path) -> None:
    drives = make_drives(SMALL)
    cycles = sum(sweep.cycles for sweep in drives.values())
    told: list[tuple[int, int]] = []
    kept = tmp_path / "kept"
    scaling = measure_scaling(["fixed-lag"], drives, SMALL, None, kept, lambda *of: told.append(of))
    assert told == [(k, cycles) for k in range(1, cycles + 1)]
    again = measure_scaling(["fixed-lag"], drives, SMALL, None, kept, lambda *of: told.append(of))
    assert len(told) == cycles, "what was measured is kept"
    pd.testing.assert_frame_equal(again.points, scaling.points)
    pd.testing.assert_frame_equal(again.slopes, scaling.slopes)
    assert scaling.of(LAPS, "fixed-lag")["at"].tolist() == [1.0, 2.0]
    assert scaling.of(READINGS, "fixed-lag")["at"].tolist() == [2.0, 6.0, 12.0]
    assert len(scaling.of(CONES, "fixed-lag")) == 4
    (on_line,) = scaling.of(DENSE_LINE, "fixed-lag").to_dict("records")
    assert on_line["at"] == LINE_POINTS
    assert on_line["cycles"] == drives[DENSE_LINE].cycles
    assert not stops(scaling)
    write_scaling(tmp_path / "out", scaling)
    content = json.loads((tmp_path / "out" / MARKER).read_text())
    assert content["seconds_compared"] == {"fixed-lag": None}  # 200 cones weren't reached
    assert {s["sweep"] for s in content["slopes"]} == {CONES, READINGS, LAPS, DENSE_LINE}
    assert len(pd.read_csv(tmp_path / "out" / "points.csv")) == len(scaling.points)
    names = {"scaling.png", "table.md"}
    assert names <= {file.name for file in (tmp_path / "out").iterdir()}
    assert scaling_table(scaling).records()[0]["estimator"] == "fixed-lag"


def test_bad_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "new")]
    assert cli.main(["scale", *out, "--estimators", "nobody"]) == cli.BAD_INPUT
    assert "nobody" in capsys.readouterr().err
    assert cli.main(["scale", *out, "--quick", "--scaling.laps", "3"]) == cli.BAD_INPUT
    assert not (tmp_path / "new").exists()
    with pytest.raises(SettingsError, match="cones_min"):
        ScalingSettings(cones_min=300.0, cones_max=200.0)


def test_a_short_run_gives_what_it_is_long_enough_for() -> None:
    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 70)
    found = speed_on(log, MapperSettings(lag=1.0))
    assert set(found) == set(SPEED) - {"closing", "swap", "solve"}
    assert np.isfinite(found["mean_by_isam2"])


def test_figures_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2, 3 and 4 ms, a closing cycle of 40 ms, a swap of 50; ISAM2 takes 2 ms, the rival 8.

    The update of 500 ms in which the rival closes does not count.
    """
    rivals = iter([(SimpleNamespace(closed=k >= 80), None, 0.5 if k == 80 else 0.008) for k in range(300)])
    times = np.repeat([2.0, 3.0, 4.0], 100)
    times[[99, 120]] = 40.0, 50.0

    def run(log: Log, mapper: Any, observers: list[Any]) -> None:
        for k, taken in enumerate(times):
            result = SimpleNamespace(closed=k >= 99, t=0.0 if k < 99 else 100.0)
            record = SimpleNamespace(jump=(0.1, 0.0, 0.0) if k == 120 else None)
            observers[0](SimpleNamespace(result=result, record=record, processor=1e-3 * taken))

    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 5)
    for name, value in {
        "run_online": run,
        "timed_update": lambda *_: next(rivals),
        "split_odometry": lambda _: iter([(None, None)] * 300),
        "ToldLandmarks": lambda _: SimpleNamespace(advance=lambda: 0.002),
        "FixedLagMapper": lambda *_: SimpleNamespace(lap_seconds=1.2),
    }.items():
        monkeypatch.setattr(benchmark, name, value)
    monkeypatch.setattr(benchmark.time, "sleep", lambda _: None)
    found = speed_on(log, MapperSettings())
    later = times[50:].mean()
    assert found["mean_by_landmark"] == pytest.approx(later / 8.0)
    assert found["mean_by_isam2"] == pytest.approx(later / 2.0)
    assert found["p99_by_isam2"] == pytest.approx(np.quantile(times, 0.99) / 2.0)
    assert found["mean"] == pytest.approx(times.mean())
    single = ("closing", "swap", "slowest_other", "solve")
    assert [found[name] for name in single] == pytest.approx([40.0, 50.0, 4.0, 1.2])


def test_the_landmarks_are_the_detected_cones() -> None:
    log = simulate(bean_track(), SimulationSettings(laps=2), 0)
    told = ToldLandmarks(log)
    assert all(told.advance() > 0.0 for _ in log.cycles)
    assert log.truth is not None and log.truth.associations is not None
    cones, estimate = sorted(set(np.unique(log.truth.associations)) - {-1}), told.isam.calculateEstimate()
    points = [estimate.atPoint2(gtsam.symbol("l", cone)) for cone in cones]
    assert estimate.size() == len(log.cycles) + len(cones)
    errors = np.linalg.norm(np.array(points) - log.truth.cones[cones], axis=1)
    assert np.sqrt(np.mean(np.square(errors))) < 0.3


def test_a_log_without_associations_is_refused() -> None:
    with pytest.raises(ValueError, match="associations"):
        ToldLandmarks(exact_log(ahead(8.0, 1.0), *corridor(20.0)))
