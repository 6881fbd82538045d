"""The figures are those of the run; never how fast."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest

from pathspace_graph.eval import benchmark
from pathspace_graph.eval.benchmark import SPEED, ToldLandmarks, speed_on
from pathspace_graph.io.log import Log
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ..scenes.drives import ahead, bean_track, beginning, corridor, exact_log


def test_a_short_run_gives_what_it_is_long_enough_for() -> None:
    log = beginning(simulate(bean_track(), SimulationSettings(laps=1), 0), 70)
    found = speed_on(log, MapperSettings(lag=1.0))
    assert set(found) == set(SPEED) - {"closing", "swap", "solve"}
    assert np.isfinite(found["mean_by_isam2"])


def test_figures_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2, 3 and 4 ms, a closing cycle of 40 ms, a swap of 50; ISAM2 takes 2 ms, the rival 8."""
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
        "timed_update": lambda *_: (None, None, 0.008),
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
