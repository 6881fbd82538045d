"""The benchmark: roads, updates in turn, power laws and figures of a run; never how fast."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pandas as pd
import pytest
from scipy.spatial import KDTree

from pathspace_graph import cli
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval import benchmark
from pathspace_graph.eval.benchmark import (
    CAUSES,
    CONES,
    DENSE_LINE,
    GAP,
    JUDGED,
    LAPS,
    LINE_POINTS,
    READINGS,
    ROAD_WIDTH,
    SPEED,
    ToldLandmarks,
    closed_road,
    drives_table,
    figures_of,
    measure_scaling,
    measure_speed,
    open_road,
    scaling_table,
    seconds_at,
    shares_of,
    slopes_of,
    speed_on,
    sweep_drives,
    update_times,
    write_scaling,
)
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.settings.mapper import MapperSettings, ScalingSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import ahead, bean_track, beginning, corridor, exact_log

pytestmark = pytest.mark.usefixtures("png_only")

SMALL: ScalingSettings = ScalingSettings(
    cones_max=100.0,
    bins=4,
    fit_from=50.0,
    readings=(2, 6, 12),
    readings_cones=60,
    warm_up=5,
    laps=2,
    laps_cones=40,
    budget=10.0,
)


@pytest.mark.parametrize("track", [open_road(2000, GAP), closed_road(100)])
def test_roads_have_their_gaps_and_width_and_never_come_near_themselves(track: Any) -> None:
    for row in (track.left, track.right):
        np.testing.assert_allclose(np.linalg.norm(np.diff(row, axis=0), axis=1), GAP, rtol=0.06)
    nearest = KDTree(track.right).query(track.left)[0]
    assert np.all((nearest >= ROAD_WIDTH - 0.2) & (nearest < np.hypot(ROAD_WIDTH, GAP / 2) + 0.5))
    apart = np.array([abs(i - j) for i, j in KDTree(track.left).query_pairs(20.0)])
    assert np.all(np.minimum(apart, len(track.left) - apart if track.closed else apart) < 6)


def test_the_long_drive_ends_when_the_last_cone_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is detected of no cone does not count."""
    drives = list[Log]()
    monkeypatch.setattr(benchmark, "simulate", lambda *given: drives.append(simulate(*given)) or drives[-1])
    ((log, at),) = sweep_drives(CONES, SMALL)
    truth, detected = drives[0].truth, np.cumsum([len(cycle.labels) for cycle in log.cycles])
    assert truth is not None and truth.associations is not None
    cones = [{*truth.associations[:count].tolist()} for count in detected[-2:]]
    assert -1 in cones[-1]
    assert len(cones[0] - {-1}) < SMALL.cones_max <= len(cones[1] - {-1})
    ((whole, _),) = sweep_drives(CONES, ScalingSettings(cones_max=100.0, bins=1))
    assert len(at) == len(log.cycles) == len(whole.cycles)
    middles = 50.0 * (101.0 / 50.0) ** ((np.arange(4) + 0.5) / 4)  # of four intervals from 50 to 101 cones
    np.testing.assert_allclose(np.unique(at[~np.isnan(at)]), middles)
    assert np.isnan(at[0]) and at[-1] == at[~np.isnan(at)].max()


def test_updates_have_as_many_detections_and_laps_as_they_say() -> None:
    for (log, at), wanted in zip(sweep_drives(READINGS, SMALL), SMALL.readings, strict=True):
        counts = np.array([len(cycle.labels) for cycle in log.cycles])
        assert np.isnan(at[: SMALL.warm_up]).all() and (counts <= wanted).all()
        assert (counts[~np.isnan(at)] == wanted).all() and (at[~np.isnan(at)] == wanted).all()
    ((_, at),) = sweep_drives(LAPS, SMALL)
    assert {*at[~np.isnan(at)]} == {1.0, 2.0}
    ((log, at),) = sweep_drives(DENSE_LINE, SMALL)
    assert np.mean([len(cycle.labels) for cycle in log.cycles]) == pytest.approx(LINE_POINTS, rel=0.1)


class Pretender:
    """An estimator that only notes when it was called, and closes its loop in some cycle."""

    sizes = (3, 4)

    def __init__(self, name: str, calls: list[str]) -> None:
        self.name, self.calls = name, calls

    @property
    def closed(self) -> bool:
        return self.calls.count(self.name) >= 5

    def update(self, odometry: object, detections: object) -> Pretender:
        self.calls.append(self.name)
        return self


@pytest.fixture
def timed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[pd.DataFrame, list[str]]]:
    """Times pretenders over empty cycles, each of which takes the seconds of its estimator."""

    def run(cycles: int, budget: float, **seconds: float) -> tuple[pd.DataFrame, list[str]]:
        calls, t = list[str](), 0.1 * np.arange(cycles + 1)
        nothing = (np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int))
        log = Log(
            Odometry(t, np.zeros((cycles + 1, 3))), tuple(Detections(s, *nothing) for s in t[1:]), np.ones(3)
        )
        monkeypatch.setattr(benchmark, "make_online", lambda name, *_: Pretender(name, calls))
        monkeypatch.setattr(benchmark, "timed_update", lambda of, *_: (of.update(*_), 0.0, seconds[of.name]))
        at = np.repeat([np.nan, 1.0, 2.0], [1, cycles // 2, cycles - 1 - cycles // 2])
        return update_times([(log, at)], [*seconds], MapperSettings(), budget), calls

    return run


def test_every_estimator_gets_each_cycle_and_the_first_one_changes(timed: Any) -> None:
    """Of the first cycle, which has no abscissa, and of the fifth, in which all close, nothing is kept."""
    frame, calls = timed(6, 10.0, a=0.1, b=0.2, c=0.3)
    assert "".join(calls) == "abcbcacababcbcacab"
    assert frame.groupby("estimator")["seconds"].agg(["size", "mean"]).to_numpy().tolist() == [
        [4, pytest.approx(0.1)],
        [4, pytest.approx(0.2)],
        [4, pytest.approx(0.3)],
    ]
    assert set(frame["size"]) == {7} and sorted(frame["at"]) == [1.0] * 9 + [2.0] * 3


def test_one_that_is_too_slow_stops_alone_and_without_its_last_point(timed: Any) -> None:
    frame, calls = timed(20, 0.5, good=0.4, slow=0.6)
    assert (calls.count("good"), calls.count("slow")) == (20, JUDGED)
    assert {*frame["estimator"]} == {"good"} and {*frame["at"]} == {1.0, 2.0}


def points(*found: tuple[float, float], sweep: str = CONES) -> pd.DataFrame:
    """Points at abscissas, with their times (s)."""
    frame = pd.DataFrame(found, columns=["at", "seconds"])
    return frame.assign(sweep=sweep, estimator="any", cycles=1, size=1.0)


def test_slope_of_a_power_law_is_its_exponent() -> None:
    found = points(*((at, 1e-6 * at**2.5) for at in (10.0, 100.0, 300.0, 1000.0, 2000.0)))
    (slope,) = slopes_of(found, ScalingSettings(fit_from=100.0)).to_dict("records")
    assert slope["slope"] == pytest.approx(2.5)
    assert slope["error"] == pytest.approx(0.0, abs=1e-6)
    assert (slope["points"], slope["low"], slope["high"]) == (4, 100.0, 2000.0)


def test_standard_error_of_a_slope_by_hand() -> None:
    """Abscissas -1, 0, 1 and ordinates 0, 3, 0 in logarithms: slope 0, squares 6, error sqrt(6 / 2)."""
    three = points(
        *((float(np.exp(x)), float(np.exp(y))) for x, y in ((-1, 0), (0, 3), (1, 0))), sweep=READINGS
    )
    (slope,) = slopes_of(three, SMALL).to_dict("records")
    assert slope["slope"] == pytest.approx(0.0, abs=1e-12)
    assert slope["error"] == pytest.approx(np.sqrt(3.0))
    assert np.isnan(slopes_of(three[:2], SMALL)["slope"]).all(), "two points leave nothing to estimate"


def test_times_between_two_points_follow_the_power_law_through_them() -> None:
    """From 100 to 400 cones the time grows from 1 to 4 ms, so at 200 cones it is 2 ms."""
    found = points((100.0, 0.001), (400.0, 0.004))
    assert seconds_at(found, 200.0) == pytest.approx(0.002)
    assert np.isnan([seconds_at(found, 50.0), seconds_at(found, 500.0), seconds_at(found[:0], 200.0)]).all()
    one = points((1.0, 0.001), (2.0, 0.003), sweep=LAPS)
    (row,) = scaling_table(pd.concat([found, one]), ScalingSettings(laps=10)).records()
    assert row["ms at 200 cones"] == "2.0" and row["most cones"] == "400"
    assert (row["ms, lap 2"], row["ms, lap 10"]) == ("3.0", "–")


@pytest.mark.slow
def test_a_small_measurement_end_to_end(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    found = measure_scaling(["fixed-lag"], SMALL, None, kept)
    pd.testing.assert_frame_equal(measure_scaling(["fixed-lag"], SMALL, None, kept), found)  # it is kept
    at = {sweep: of["at"].tolist() for sweep, of in found.groupby("sweep")}
    assert (at[LAPS], at[READINGS], at[DENSE_LINE]) == ([1.0, 2.0], [2.0, 6.0, 12.0], [LINE_POINTS])
    assert len(at[CONES]) == 4
    write_scaling(tmp_path / "out", found, SMALL, MapperSettings())
    content = json.loads((tmp_path / "out" / "scaling.json").read_text())
    assert {s["sweep"] for s in content["slopes"]} == {CONES, READINGS, LAPS, DENSE_LINE}
    assert len(pd.read_csv(tmp_path / "out" / "points.csv")) == len(found)
    assert {"scaling.png", "table.md"} <= {file.name for file in (tmp_path / "out").iterdir()}


def test_bad_requests_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "new")]
    assert cli.main(["scale", *out, "--estimators", "nobody"]) == cli.BAD_INPUT
    assert "nobody" in capsys.readouterr().err
    assert cli.main(["scale", *out, "--quick", "--scaling.laps", "3"]) == cli.BAD_INPUT
    assert not (tmp_path / "new").exists()
    with pytest.raises(SettingsError, match="cones_max: expected more than 50, found 50"):
        ScalingSettings(cones_max=50.0)


def test_a_short_run_gives_what_it_is_long_enough_for() -> None:
    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 70)
    found = speed_on(log, MapperSettings(lag=1.0))
    assert set(found) == {metric.key for metric in SPEED} - {"closing", "swap", "solve"}
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
        "batch_seconds": lambda *_: 0.9,
    }.items():
        monkeypatch.setattr(benchmark, name, value)
    monkeypatch.setattr(benchmark.time, "sleep", lambda _: None)
    found = speed_on(log, MapperSettings())
    later = times[50:].mean()
    assert found["mean_by_landmark"] == pytest.approx(later / 8.0)
    assert found["mean_by_isam2"] == pytest.approx(later / 2.0)
    assert found["p99_by_isam2"] == pytest.approx(np.quantile(times, 0.99) / 2.0)
    assert found["mean"] == pytest.approx(times.mean())
    single = ("closing", "swap", "slowest_other", "solve", "batch")
    assert [found[name] for name in single] == pytest.approx([40.0, 50.0, 4.0, 1.2, 0.9])


def test_the_slowest_update_of_a_drive_has_causes_within_its_stage() -> None:
    """A road of 50 m is open to its end: its curves grow, and no batch replaces the map."""
    found = figures_of("road", 20, 1)
    assert found["slowest"] >= found["p99"] > found["mean"] > 0.0 < found["batch"]
    assert found["stage"] in {"predict", "classify", "expand", "update", "loop", "marginalize"}
    causes = found["causes"]
    assert {*causes} == {*CAUSES.values(), "garbage collection"}
    assert 0.5 < sum(causes.values()) <= 1.0 and causes["growth"] > 0.0 == causes["swap of the map"]
    assert not found["libraries"] or sum(found["libraries"].values()) == pytest.approx(1.0)


def test_a_collection_within_an_update_is_a_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    update = benchmark.FixedLagMapper.update

    def collecting(mapper: Any, *cycle: Any) -> Any:
        result = update(mapper, *cycle)
        if mapper.road.next_cycle == 7:
            kept = [[] for _ in range(300_000)]
            gc.collect()
            del kept
        return result

    monkeypatch.setattr(benchmark.FixedLagMapper, "update", collecting)
    assert next(iter(figures_of("road", 20, 1)["causes"])) == "garbage collection"


@pytest.mark.slow
def test_speed_is_measured_beside_rivals_and_of_single_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "QUICK_DRIVES", {"a road": ("road", 20, 1)})
    found = measure_speed(True)
    assert len(found[""].frame) == len(SPEED)
    assert [row["drive"] for row in found["drives"].records()] == ["a road"]
    with pytest.raises(InputError, match="expected a log folder"):  # before anything is driven
        measure_speed(True, [tmp_path / "none"])


def test_a_drive_s_row_names_what_took_over_a_fifth_of_its_slowest_update() -> None:
    causes = {"growth": 0.41, "swap of the map": 0.3, "association": 0.1}
    row = {"mean": 4.04, "p99": 10.0, "slowest": 21.56, "stage": "expand", "causes": causes}
    (found,) = drives_table({"a road": row | {"memory": 261.4, "batch": np.nan}}).records()
    assert [*found.values()] == [
        *("a road", "4.0", "10.0", "21.6", "expand"),
        *("growth 41%, swap of the map 30%", "261", "–"),
    ]


def test_samples_are_summed_by_library() -> None:
    report = """# Samples: 8
 50.00% ;libpython3.11.so.1.0      ;[.] _PyEval_EvalFrameDefault ;- -
 20.00% ;_multiarray_umath.cpython-311-x86_64-linux-gnu.so;[.] array_dealloc
 10.00% ;libscipy_openblas64_-32a.so;[.] dgemm_kernel
 6.00%  ;libc.so.6                 ;[.] _int_malloc
 4.00%  ;libc.so.6                 ;[.] __memmove_avx
 7.00%  ;_kernels.cpython-311-x86_64-linux-gnu.so;[.] kernels::summed
 3.00%  ;libgtsam.so.4             ;[.] Eigen::gebp
"""
    assert shares_of(report) == pytest.approx(
        {
            "Python": 0.5,
            "kernels": 0.07,
            "BLAS": 0.1,
            "GTSAM": 0.03,
            "numpy": 0.2,
            "malloc": 0.06,
            "rest": 0.04,
        }
    )
    assert shares_of("") == {}


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
