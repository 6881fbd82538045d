"""The benchmark: GTSAM solves the mapper's own system, and the figures are the run's; never how fast."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np
import pytest
from rich.console import Console

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.eval.benchmark import benchmark
from pathspace_graph.eval.benchmark.baseline import (
    BASELINE,
    baseline_table,
    compare,
    ratios,
    read_baseline,
    write_baseline,
)
from pathspace_graph.eval.benchmark.benchmark import rich_table
from pathspace_graph.eval.benchmark.gtsam_window import linear_window, marginal_keys, orderings, time_gtsam
from pathspace_graph.eval.benchmark.measurement import Gtsam, Measurement, measure, metrics
from pathspace_graph.eval.benchmark.metric import Metric
from pathspace_graph.io.json_file import write_json
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings

from ...scenes.drives import ahead, bean_track, corridor, exact_log, lap_log, map_log


@pytest.fixture
def mapper() -> FixedLagMapper:
    """In a bend, with a full window, all of the map in it, every factor linearized anew in each step."""
    log = lap_log(bean_track())
    settings = MapperSettings(relinearize=RelinearizeSettings(1e-12, 1e-12))
    own = FixedLagMapper(settings, log.odometry_sigma)
    mapper = map_log(replace(log, cycles=log.cycles[:60]), own)[0]
    mapper.smoother.reactivate()
    return mapper


@pytest.mark.parametrize("number", range(3))
def test_gtsam_solves_the_system_that_the_mapper_solves(mapper: FixedLagMapper, number: int) -> None:
    """In every ordering; the window is left as it is."""
    variables = mapper.smoother.variables
    before = variables.values.copy()
    window = linear_window(mapper)
    np.testing.assert_array_equal(variables.values, before)
    ordering = list(orderings(window).values())[number]
    solution = window.graph.optimize() if ordering is None else window.graph.optimize(ordering)
    mapper.smoother.step(mapper.settings.sigma_step)
    now = variables.change(np.arange(variables.layout.size))
    np.testing.assert_allclose(solution.vector(variables.keys.tolist()), now, atol=1e-7)


def test_the_marginal_is_on_the_map_and_the_next_pose(mapper: FixedLagMapper) -> None:
    window = linear_window(mapper)
    keys, everything = marginal_keys(window), window.layout
    assert len(keys) == len(mapper.smoother.map.state.map_keys) + 2
    assert keys[-1] == gtsam.symbol("x", mapper.smoother.first_cycle + 1)
    hessian, _ = window.graph.hessian(everything.ordering)
    covariance = np.linalg.inv(hessian)
    own = everything.entries(np.array(keys))
    marginal, _ = window.graph.marginal(gtsam.KeyVector(keys)).hessian(gtsam.Ordering(keys))
    expected = np.linalg.inv(covariance[np.ix_(own, own)])
    np.testing.assert_allclose(marginal, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_every_candidate_is_timed(mapper: FixedLagMapper) -> None:
    timings = time_gtsam(linear_window(mapper))
    assert len(timings) == 3
    assert all(optimize > 0.0 and marginal > 0.0 for optimize, marginal in timings.values())


def test_a_short_run_gives_every_figure() -> None:
    measurement = measure(exact_log(ahead(8.0, 7.0), *corridor(80.0)), MapperSettings(lag=1.0), every=10)
    assert len(measurement.cycles) == 70
    assert measurement.gtsam.samples == 2
    assert measurement.closing is None
    figures = {metric.key: metric.value for metric in metrics(measurement)}
    assert figures["gtsam"] == pytest.approx(figures["gtsam_optimize"] + figures["gtsam_marginal"])
    assert np.isfinite(figures["mean_by_gtsam"])
    assert len(measurement.rival) == 70
    assert figures["landmark"] > 0.0
    assert np.isnan(figures["closing"])
    assert np.isnan(figures["last_lap_by_lap_2"])


def record(cycle: int, seconds: float, lap: int) -> CycleRecord:
    return CycleRecord(cycle, 0.1 * cycle, seconds, 5, 5, 4, lap, {"update": 0.5 * seconds})


def test_figures_by_hand() -> None:
    """Three laps of 100 cycles: 2, 3 and 4 ms, one closing cycle of 40 ms; GTSAM takes 2 ms, the rival 8."""
    cycles = [record(k, 0.002 + 0.001 * (k // 100), 1 + k // 100) for k in range(300)]
    cycles[99] = record(99, 0.040, 1)
    measurement = Measurement(tuple(cycles), 3, 99, Gtsam("any", 0.0015, 0.0005, 25), (0.008,) * 300)
    figures = {metric.key: metric for metric in metrics(measurement)}
    mean_later = (49 * 2.0 + 40.0 + 100 * 3.0 + 100 * 4.0) / 250
    assert figures["mean_by_gtsam"].value == pytest.approx(mean_later / 2.0)
    assert figures["mean_by_landmark"].value == pytest.approx(mean_later / 8.0)
    assert figures["mean"].value == pytest.approx((99 * 2.0 + 40.0 + 700.0) / 300)
    assert figures["median"].value == pytest.approx(3.0)
    assert figures["p99"].value == pytest.approx(4.0)
    assert figures["slowest"].value == figures["closing"].value == pytest.approx(40.0)
    assert figures["mean_lap_2"].value == pytest.approx(3.0)
    assert figures["last_lap_by_lap_2"].value == pytest.approx(4.0 / 3.0)
    assert figures["mean_update"].value == pytest.approx(0.5 * figures["mean"].value)
    assert {key for key, metric in figures.items() if not metric.holds} == {"last_lap_by_lap_2"}


def test_a_bound_is_kept_or_not() -> None:
    assert Metric("a", 2.0, "", bound=2.0).holds
    assert not Metric("a", 2.1, "", bound=2.0).holds
    assert Metric("a", 2.1, "", "higher", 2.0).holds
    assert not Metric("a", 1.9, "", "higher", 2.0).holds
    assert not Metric("a", float("nan"), "", bound=2.0).holds
    assert Metric("a", float("nan"), "").holds


def test_output(tmp_path: Path) -> None:
    figures = [Metric("mean_by_gtsam", 1.234, "", bound=2.0), Metric("closing", float("nan"), "ms")]
    write_json(tmp_path / "figures.json", [asdict(metric) for metric in figures])
    rows = json.loads((tmp_path / "figures.json").read_text())
    assert rows[0] == {
        "key": "mean_by_gtsam",
        "value": 1.234,
        "unit": "",
        "direction": "lower",
        "bound": 2.0,
        "tolerance": None,
    }
    assert rows[1]["value"] is None
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(rich_table(figures))
    lines = console.export_text().splitlines()
    assert any("mean_by_gtsam" in line and "1.23" in line and "<= 2" in line for line in lines)


# --- baseline --------------------------------------------------------------------------------------------


def ratio(value: float, key: str = "a", direction: Literal["lower", "higher"] = "lower") -> Metric:
    return Metric(key, value, "", direction, tolerance=0.1)


def test_worse_is_beyond_the_tolerance_in_the_bad_direction() -> None:
    assert not ratio(2.19).worse_than(2.0)
    assert ratio(2.21).worse_than(2.0)
    assert not ratio(0.5).worse_than(2.0)
    assert not ratio(1.81, direction="higher").worse_than(2.0)
    assert ratio(1.79, direction="higher").worse_than(2.0)
    assert not ratio(5.0, direction="higher").worse_than(2.0)
    assert ratio(float("nan")).worse_than(2.0)


def test_only_ratios_are_compared() -> None:
    figures = [ratio(2.5), Metric("time", 9.0, "ms", tolerance=0.1), Metric("b", 1.0, "")]
    assert [metric.key for metric in ratios(figures)] == ["a"]
    found = {c.key: c for c in compare([*figures, ratio(1.0, "new")], {"a": 2.0, "gone": 1.0})}
    assert {key: c.worse for key, c in found.items()} == {"a": True, "new": False, "gone": True}
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(baseline_table(list(found.values())))
    lines = console.export_text().splitlines()
    assert any("a" in line and "+25 %" in line and "WORSE" in line for line in lines)
    assert any("new" in line and "WORSE" not in line for line in lines)


def test_a_baseline_is_read_as_written(tmp_path: Path) -> None:
    file = tmp_path / "baseline.json"
    write_baseline(file, [ratio(1.23456789), Metric("time", 3.0, "ms")])
    assert read_baseline(file) == {"a": 1.2346}
    with pytest.raises(SettingsError, match="found none"):
        write_baseline(file, [ratio(float("nan"))])
    assert read_baseline(file) == {"a": 1.2346}


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"format": "pathspace-benchmark-baseline/1", "ratios": [1]}']
)
def test_what_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(InputError, match="expected"):
        read_baseline(tmp_path / "bad.json")
    with pytest.raises(InputError, match="no file"):
        read_baseline(tmp_path / "none.json")


def test_the_committed_baseline_is_of_this_benchmark() -> None:
    """The same figures as a run gives, all ratios, and within what is asked of them."""
    cycles = tuple(record(k, 0.002, 1 + k // 100) for k in range(300))
    figures = {
        m.key: m
        for m in ratios(metrics(Measurement(cycles, 3, 99, Gtsam("any", 0.001, 0.001, 25), (0.01,) * 300)))
    }
    baseline = read_baseline(BASELINE)
    assert set(baseline) == set(figures)
    assert all(replace(figures[key], value=value).holds for key, value in baseline.items())


@pytest.mark.parametrize(("times", "code"), [(1.0, None), (2.0, 1)])
def test_the_script_ends_with_1_where_it_got_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: float, code: int | None
) -> None:
    def measured(factor: float) -> Measurement:
        cycles = [record(k, 0.002 * factor, 1 + k // 100) for k in range(300)]
        return Measurement(tuple(cycles), 3, 99, Gtsam("any", 0.001, 0.001, 25), (0.01,) * 300)

    def run(factor: float, *options: str) -> None:
        monkeypatch.setattr(benchmark.Benchmark, "measure", lambda self: measured(factor))
        monkeypatch.setattr("sys.argv", ["benchmark", "--baseline", str(tmp_path / "b.json"), *options])
        benchmark.main()

    with pytest.raises(SystemExit) as missing:
        run(1.0, "--compare")
    assert missing.value.code == benchmark.BAD_INPUT
    run(1.0, "--write-baseline")
    if code is None:
        run(times, "--compare")
        return
    with pytest.raises(SystemExit) as end:
        run(times, "--compare")
    assert end.value.code == code
