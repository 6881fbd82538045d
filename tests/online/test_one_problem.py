"""Window and batch are one problem: a window of all cycles is the batch of an open road."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.system import BatchSystem, Evaluation, Optimizer
from pathspace_graph.graph.gaussian import normal_equations
from pathspace_graph.loop.open import open_map
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import map_log, short_drive
from ..scenes.graph import dense_rows

Array = NDArray[np.float64]


@cache
def both() -> tuple[FixedLagMapper, BatchSystem, Evaluation]:
    """Return a mapper whose window holds a whole open drive, and the batch of it at the same estimate.

    The batch has the associations and the weak priors of the window.
    """
    log, settings = short_drive(), MapperSettings(lag=60.0, max_poses=1000)
    mapper, results = map_log(log, FixedLagMapper(settings, log.odometry_sigma))
    assert not mapper.closed and len(mapper.poses) == len(results)
    road, record = mapper.road, mapper.drive.record
    road.smoother.reactivate()
    start = open_map(road, record.with_window(road))
    lap = record.lap(len(results) - 1, start, (), mapper.drive.priors, mapper.front_end.noise)
    system, state = BatchSystem(lap.detections.copy(), [lap.chain], [lap.settings]), start.state(lap.settings)
    known = road.smoother.map.detections
    used = np.flatnonzero(known.used)
    system.begin(state)
    system.weak = road.smoother.map.weak
    system.detections.take(used, known.boundary[used], known.u[used])
    return mapper, system, system.evaluate(state, hold=True)


def test_a_window_of_all_cycles_has_the_information_and_gradient_of_the_batch() -> None:
    mapper, system, at = both()
    smoother = mapper.road.smoother
    assert (np.abs(at.across.whitened) > system.settings.gate.huber).sum() > 5  # these weigh less than one
    J, r, _ = dense_rows([rows for rows in system.rows(at) if len(rows)], smoother.variables.keys)
    information, vector = normal_equations(smoother.linear_graph(), smoother.variables.layout)
    gradient = information @ (smoother.variables.values - smoother.variables.reference) - vector
    scale = np.sqrt(np.diagonal(information))
    np.testing.assert_allclose(
        J.T @ J / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-5
    )
    np.testing.assert_allclose(J.T @ r / scale, gradient / scale, atol=1e-5)  # foot points are that exact


def test_a_window_of_all_cycles_has_the_optimum_of_the_batch() -> None:
    mapper, system, at = both()
    optimizer, smoother = Optimizer(system), mapper.road.smoother.copy()
    for damped in [True] * 5 + [False] * 20:
        at = optimizer._step(system.evaluate(at.state, hold=True))[0]
        smoother.step(mapper.settings.sigma_step if damped else None)
    assert np.abs(at.state.poses - both()[2].state.poses).max() > 0.05  # where both began
    np.testing.assert_allclose(smoother.variables.poses, at.state.poses, atol=1e-5)
    np.testing.assert_allclose(smoother.map.state.map_points, at.state.map_points, atol=1e-3)
