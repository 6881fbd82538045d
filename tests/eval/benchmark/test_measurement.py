"""The figures are those of the run; never how fast."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pathspace_graph.eval.benchmark.measurement import (
    Measurement,
    ToldLandmarks,
    figures,
    measure,
)
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.drives import ahead, bean_track, beginning, corridor, exact_log
from .timing import record


def test_a_short_run_gives_what_it_is_long_enough_for() -> None:
    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 70)
    run = measure(log, MapperSettings(lag=1.0))
    assert len(run.cycles) == len(run.rival) == len(run.isam2) == 70
    found = figures(run)
    assert np.isfinite(found["mean_by_isam2"])
    assert {"closing", "swap", "solve"}.isdisjoint(found)


def test_figures_by_hand() -> None:
    """Three laps of 100 cycles: 2, 3 and 4 ms, one closing cycle of 40 ms; ISAM2 takes 2 ms, the rival 8."""
    cycles = [record(k, 0.002 + 0.001 * (k // 100), 1 + k // 100) for k in range(300)]
    cycles[99] = record(99, 0.040, 1, closed=True)
    run = Measurement(cycles, (0.008,) * 300, (0.002,) * 300, solve=1.2)
    found = figures(run)
    mean_later = (49 * 2.0 + 40.0 + 100 * 3.0 + 100 * 4.0) / 250
    assert found["mean_by_landmark"] == pytest.approx(mean_later / 8.0)
    assert found["mean_by_isam2"] == pytest.approx(mean_later / 2.0)
    assert found["p99_by_isam2"] == pytest.approx(2.0)
    assert found["mean"] == pytest.approx((99 * 2.0 + 40.0 + 700.0) / 300)
    assert (found["p99"], found["closing"], found["slowest_other"]) == pytest.approx((4.0, 40.0, 4.0))
    assert "swap" not in found
    cycles[120] = replace(record(120, 0.050, 1), jump=(0.1, 0.0, 0.0))
    swapped = figures(replace(run, cycles=cycles))
    assert (swapped["swap"], swapped["solve"]) == (pytest.approx(50.0), 1.2)


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
