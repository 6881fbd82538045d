"""The figures are those of the run; never how fast."""

from __future__ import annotations

import io
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from rich.console import Console

from pathspace_graph.eval.benchmark.measurement import (
    Measurement,
    Metric,
    ToldLandmarks,
    measure,
    metrics,
    metrics_table,
)
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.drives import ahead, bean_track, beginning, corridor, exact_log
from .timing import record


def test_a_short_run_gives_every_figure() -> None:
    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 70)
    measurement = measure(log, MapperSettings(lag=1.0))
    assert len(measurement.cycles) == 70
    assert measurement.closing is None
    figures = {metric.key: metric.value for metric in metrics(measurement)}
    assert np.isfinite(figures["mean_by_isam2"])
    assert len(measurement.rival) == len(measurement.isam2) == 70
    assert figures["landmark"] > 0.0 and figures["isam2"] > 0.0
    assert np.isnan(figures["closing"])
    assert np.isnan(figures["last_lap_by_lap_2"])


def test_figures_by_hand() -> None:
    """Three laps of 100 cycles: 2, 3 and 4 ms, one closing cycle of 40 ms; ISAM2 takes 2 ms, the rival 8."""
    cycles = [record(k, 0.002 + 0.001 * (k // 100), 1 + k // 100) for k in range(300)]
    cycles[99] = record(99, 0.040, 1, closed=True)
    measurement = Measurement(cycles, 3, (0.008,) * 300, (0.002,) * 300)
    figures = {metric.key: metric for metric in metrics(measurement)}
    mean_later = (49 * 2.0 + 40.0 + 100 * 3.0 + 100 * 4.0) / 250
    assert figures["mean_by_landmark"].value == pytest.approx(mean_later / 8.0)
    assert figures["mean_by_isam2"].value == pytest.approx(mean_later / 2.0)
    assert figures["p99_by_isam2"].value == pytest.approx(2.0)
    assert figures["mean"].value == pytest.approx((99 * 2.0 + 40.0 + 700.0) / 300)
    assert figures["median"].value == pytest.approx(3.0)
    assert figures["p99"].value == pytest.approx(4.0)
    assert (figures["closing"].value, figures["slowest_other"].value) == pytest.approx((40.0, 4.0))
    assert figures["mean_lap_2"].value == pytest.approx(3.0)
    assert figures["last_lap_by_lap_2"].value == pytest.approx(4.0 / 3.0)
    assert figures["mean_update"].value == pytest.approx(0.5 * figures["mean"].value)
    assert {key for key, metric in figures.items() if not metric.holds} == {"last_lap_by_lap_2"}


def test_the_swap_is_compared_with_the_cycles_around_it() -> None:
    """It closes in cycle 99 and swaps in cycle 120; the 20 updates between take 3 ms, 2 before, 4 after."""
    cycles = [record(k, 0.002 if k < 99 else 0.003 if k < 120 else 0.004, 1) for k in range(200)]
    cycles[99] = replace(cycles[99], closed=True)
    unswapped = Measurement(tuple(cycles), 1, (0.008,) * 200, (0.002,) * 200, 1.2)
    cycles[120] = replace(record(120, 0.050, 1), jump=(0.1, 0.0, 0.0))
    figures = {metric.key: metric for metric in metrics(replace(unswapped, cycles=cycles))}
    assert (figures["swap"].value, figures["solve"].value) == (pytest.approx(50.0), 1.2)
    assert figures["meanwhile_by_before"].value == pytest.approx(1.5)
    assert figures["meanwhile_by_after"].value == pytest.approx(0.75)
    assert not figures["meanwhile_by_before"].holds and figures["swap"].holds
    assert "swap" not in {metric.key for metric in metrics(unswapped)}


def test_a_bound_is_kept_or_not() -> None:
    assert Metric("a", 2.0, "", bound=2.0).holds
    assert not Metric("a", 2.1, "", bound=2.0).holds
    assert not Metric("a", float("nan"), "", bound=2.0).holds
    assert Metric("a", float("nan"), "").holds


def test_a_table_shows_each_figure_beside_its_bound() -> None:
    figures = [Metric("mean_by_isam2", 1.234, "", bound=2.0), Metric("closing", float("nan"), "ms")]
    console = Console(width=100, file=io.StringIO(), record=True)
    console.print(metrics_table(figures).rich())
    lines = console.export_text().splitlines()
    assert any("mean_by_isam2" in line and "1.23" in line and "<= 2" in line for line in lines)


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
