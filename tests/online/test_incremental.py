"""The mapper on GTSAM's own fixed-lag smoother: the same factors, and a map that stays near the truth."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.gaussian import normal_equations
from pathspace_graph.graph.keys import CONTROL_LETTERS
from pathspace_graph.io.log import Log
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.online.incremental import IncrementalSolver, incremental_fixed_lag
from pathspace_graph.run import split_odometry

from ..scenes.drives import ahead, corridor, exact_log

Array = NDArray[np.float64]


def straight(seconds: float) -> Log:
    cones, labels = corridor(80.0)
    return exact_log(ahead(6.0, seconds), cones, labels)


def solver_of(mapper: FixedLagMapper) -> IncrementalSolver:
    assert isinstance(mapper.solver, IncrementalSolver)
    return mapper.solver


def information(mapper: FixedLagMapper) -> Array:
    """Of GTSAM's factors at the estimate."""
    graph, factors = gtsam.NonlinearFactorGraph(), solver_of(mapper)._gtsam.getFactors()
    for index in range(factors.size()):
        if factors.exists(index) and factors.at(index).size() > 1:  # anchors are GTSAM's only
            graph.add(factors.at(index))
    ordering = mapper.smoother.layout.ordering
    return np.asarray(graph.linearize(mapper.values()).hessian(ordering)[0])


def test_the_factors_are_those_of_the_window() -> None:
    """Before anything leaves: the control points' information, without prior and anchor."""
    log = straight(1.5)
    mapper = incremental_fixed_lag(odometry_sigma=log.odometry_sigma)
    for odometry, cycle in split_odometry(log):
        mapper.update(odometry, cycle)
    smoother = mapper.smoother
    blocks = [smoother.layout.block(letter) for letter in CONTROL_LETTERS]
    own = np.concatenate([np.arange(block.start, block.stop) for block in blocks])
    points = np.ix_(own, own)
    expected = normal_equations(smoother.linear_graph(), smoother.layout)[0][points]
    expected = expected - np.eye(len(own)) * mapper.settings.gauge.sigma_anchor**-2
    assert len(own) > 10
    np.testing.assert_allclose(information(mapper)[points], expected, atol=1e-6 * np.abs(expected).max())


def test_a_straight_drive_is_that_of_the_mapper() -> None:
    """Exact readings: where the linearization stands doesn't matter, also after poses have left."""
    log = straight(4.5)
    estimates = []
    for make in (FixedLagMapper, incremental_fixed_lag):
        mapper = make(odometry_sigma=log.odometry_sigma)
        for odometry, cycle in split_odometry(log):
            result = mapper.update(odometry, cycle)
        estimates.append((result.pose, result.sizes))
    np.testing.assert_allclose(estimates[1][0], estimates[0][0], atol=0.05)
    assert estimates[1][1] == estimates[0][1]


def test_a_new_smoother_begins_where_an_end_is_taken_back() -> None:
    """What it had of the control points that are placed anew, GTSAM's smoother couldn't forget."""
    log = straight(3.0)
    mapper = incremental_fixed_lag(odometry_sigma=log.odometry_sigma)
    cycles = list(split_odometry(log))
    for odometry, cycle in cycles[:-5]:
        mapper.update(odometry, cycle)
    old = solver_of(mapper)._gtsam
    mapper.smoother.remove_information(np.array(mapper.control_keys(0)[3:]))
    for odometry, cycle in cycles[-5:]:
        result = mapper.update(odometry, cycle)
    assert solver_of(mapper)._gtsam is not old
    np.testing.assert_allclose(result.pose, [6.0 * cycles[-1][1].t, 0.0, 0.0], atol=0.05)
