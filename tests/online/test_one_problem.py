"""Window and batch are one problem: a measurement has the same rows in both."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.optimizer import Optimizer
from pathspace_graph.batch.system import BatchSystem, Evaluation
from pathspace_graph.graph.rows import Rows
from pathspace_graph.loop.open import open_map
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import map_log, short_drive
from ..scenes.graph import dense_rows

Array = NDArray[np.float64]


@cache
def both() -> tuple[FixedLagMapper, BatchSystem, Evaluation]:
    """Return a mapper whose window holds a whole open drive, and the batch of it at the same estimate.

    The batch has the associations of the window.
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
    system.detections.take(used, known.boundary[used], known.u[used])
    return mapper, system, system.evaluate(state, hold=True)


def information(groups: list[Rows], mapper: FixedLagMapper) -> tuple[Array, Array]:
    """Return information (n, n) and gradient (n,) of rows, in units of the roots of the diagonal."""
    J, r, _ = dense_rows([rows for rows in groups if len(rows)], mapper.road.smoother.variables.keys)
    scale = np.sqrt(np.maximum((J**2).sum(axis=0), np.finfo(float).tiny))
    return J.T @ J / np.outer(scale, scale), J.T @ r / scale


def test_detections_have_the_same_rows() -> None:
    mapper, system, at = both()
    smoother, width = mapper.road.smoother, at.across.jacobian.shape[1]
    assert (np.abs(at.across.whitened) > system.settings.gate.huber).sum() > 5  # these weigh less than one
    ours = [rows for rows in system.rows(at) if len(rows) and rows.jacobian.shape[1] == width]
    theirs = smoother.map.rows(smoother.cycles)
    found, expected = (information(groups, mapper) for groups in (ours, theirs))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)  # foot points are that exact


def test_the_optimum_is_the_same_but_for_the_gauge() -> None:
    """Control points may not slide in a batch, and have a spacing in the window: open ends differ by it."""
    mapper, system, at = both()
    optimizer, smoother = Optimizer(system), mapper.road.smoother.copy()
    for _ in range(3):
        at = optimizer._step(system.evaluate(at.state, hold=True), 0.0)[0]
    for _ in range(20):
        smoother.step(mapper.settings.sigma_step)
    off = at.state.poses - smoother.variables.poses
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.04
    assert np.abs(off[:, 2]).max() < 0.002
    for label, boundary in at.state.boundaries.items():
        u = np.linspace(5.0, boundary.confirmed_end - 15.0, 50)
        points, known = boundary.evaluate(at.state.control_points(label), u), smoother.map.state
        feet = known.boundaries[label].find(known.control_points(label), points, u - 2.0, u + 2.0)
        assert np.abs(feet.distance).max() < 0.05
