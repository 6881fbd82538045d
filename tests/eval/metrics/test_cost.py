"""Bytes of maps and times of cycles, known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.measures import WHOLE, covariance_bytes, map_bytes, stage_times
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.io.results import CycleRecord
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .straight_maps import landmarks, line


def test_bytes_of_a_map() -> None:
    closed = BSpline.periodic_from(np.arange(9.0), np.random.default_rng(0).normal(size=(8, 2)))
    track = Map(True, {LEFT: SplineBoundary(closed, np.eye(16)), RIGHT: landmarks((0, 0), (1, 1), (2, 2))})
    assert map_bytes(track) == 8 * (16 + 9 + 6)
    assert covariance_bytes(track) == 8 * (16 * 17 // 2 + 6 * 7 // 2)
    assert map_bytes(Map(False, {LEFT: line(0.0)})) == 8 * (8 + 8)
    assert map_bytes(Map(False, {})) == covariance_bytes(Map(False, {})) == 0


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
