"""The mapper on GTSAM's own fixed-lag smoother: the same factors, and a map that stays near the truth."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.fixed_lag import FixedLagMapper
from pathspace_graph.incremental import IncrementalFixedLag
from pathspace_graph.incremental_smoother import IncrementalSmoother
from pathspace_graph.linearizer import normal_equations
from pathspace_graph.log import Log
from pathspace_graph.run import split_odometry

from .scenes import ahead, corridor, exact_log

Array = NDArray[np.float64]


def straight(seconds: float) -> Log:
    cones, labels = corridor(80.0)
    return exact_log(ahead(6.0, seconds), cones, labels)


def information(smoother: IncrementalSmoother) -> Array:
    """Of GTSAM's factors at the state."""
    window, values, ordering = smoother._window(), gtsam.Values(), gtsam.Ordering()
    stops = np.cumsum(window.dims)
    for key, stop, dim in zip(window.keys, stops, window.dims, strict=True):
        entry = smoother.state.vector[stop - dim : stop]
        values.insert(key, gtsam.Pose2(*entry) if dim == 3 else entry.copy())
        ordering.push_back(key)
    graph, factors = gtsam.NonlinearFactorGraph(), smoother._gtsam.getFactors()
    for index in range(factors.size()):
        if factors.exists(index) and factors.at(index).size() > 1:  # anchors are GTSAM's only
            graph.add(factors.at(index))
    return np.asarray(graph.linearize(values).hessian(ordering)[0])


def test_the_factors_are_those_of_the_window() -> None:
    """Before anything leaves: the control points' information, without prior and anchor."""
    log = straight(1.5)
    mapper = IncrementalFixedLag(odometry_sigma=log.odometry_sigma)
    for odometry, cycle in split_odometry(log):
        mapper.update(odometry, cycle)
    smoother = mapper.smoother
    assert isinstance(smoother, IncrementalSmoother)
    size, state = smoother.state.map_size, smoother.state
    expected = normal_equations(smoother.linearize(), smoother.prior, state, state.vector)[0][:size, :size]
    expected = expected - np.eye(size) * mapper.settings.gauge.sigma_anchor**-2
    assert size > 10
    found = information(smoother)[:size, :size]
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_a_straight_drive_is_that_of_the_mapper() -> None:
    """Exact readings: where the linearization stands doesn't matter, also after poses have left."""
    log = straight(4.5)
    estimates = []
    for kind in (FixedLagMapper, IncrementalFixedLag):
        mapper = kind(odometry_sigma=log.odometry_sigma)
        for odometry, cycle in split_odometry(log):
            result = mapper.update(odometry, cycle)
        estimates.append((result.pose, result.sizes))
    np.testing.assert_allclose(estimates[1][0], estimates[0][0], atol=0.05)
    assert estimates[1][1] == estimates[0][1]


def test_a_new_smoother_begins_where_an_end_is_taken_back() -> None:
    """What it had of the control points that are placed anew, GTSAM's smoother couldn't forget."""
    log = straight(3.0)
    mapper = IncrementalFixedLag(odometry_sigma=log.odometry_sigma)
    cycles = list(split_odometry(log))
    for odometry, cycle in cycles[:-5]:
        mapper.update(odometry, cycle)
    smoother = mapper.smoother
    assert isinstance(smoother, IncrementalSmoother)
    old = smoother._gtsam
    smoother.forget(0, 3)
    for odometry, cycle in cycles[-5:]:
        result = mapper.update(odometry, cycle)
    assert smoother._gtsam is not old
    np.testing.assert_allclose(result.pose, [6.0 * cycles[-1][1].t, 0.0, 0.0], atol=0.05)
