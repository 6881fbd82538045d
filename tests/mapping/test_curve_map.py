"""Rows of the curves: detections across the curve, and the weak priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.graph.rows import Rows
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import ODOMETRY_SIGMA, ahead, corridor, exact_log, map_log

Array = NDArray[np.float64]

ACROSS = MapperSettings()


@pytest.fixture(scope="module")
def mapper() -> FixedLagMapper:
    """After a straight drive without noise, its poses then put 0.6 m aside, beyond Huber's threshold."""
    found, _ = map_log(exact_log(ahead(6.0, 6.0), *corridor(60.0)))
    found.poses[:, :2] += [0.2, 0.6]
    return found


def rows_of(mapper: FixedLagMapper, settings: MapperSettings) -> Rows:
    smoother = mapper.road.smoother
    track = CurveMap(settings, smoother.map.state)
    track.detections = smoother.map.detections
    return track.rows(np.arange(smoother.first_cycle, smoother.next_cycle))[0]


def test_a_reading_that_slides_to_where_an_open_map_is_inactive_brings_that_back() -> None:
    found, _ = map_log(exact_log(ahead(6.0, 9.0), *corridor(80.0)))
    smoother, state = found.road.smoother, found.road.smoother.map.state
    detections = smoother.map.detections
    assert not state.whole and len(smoother.inactive) > 0
    rows, size = int(detections.used.sum()), smoother.layout.size
    newest = np.flatnonzero(detections.used)[-1:]
    detections.take(newest, detections.boundary[newest], np.ones(1))
    smoother.step(found.settings.sigma_step)
    assert {int(active[0]) for active in state.active_stretch.values()} == {0}
    assert len(smoother.inactive) == 0
    assert smoother.layout.size > size
    cycles = np.arange(smoother.first_cycle, smoother.next_cycle)
    assert len(smoother.map.rows(cycles)[0]) == rows


def test_rows_are_the_derivatives_of_the_distances(mapper: FixedLagMapper) -> None:
    """By every variable of the map at once; 0.6 m aside Huber's weight is not 1, so it is held."""
    free = replace(ACROSS, gate=replace(ACROSS.gate, huber=1e9))
    variables, layout = mapper.road.smoother.variables, mapper.road.smoother.variables.layout
    rows = rows_of(mapper, free)
    dense = np.zeros((len(rows), layout.size))
    np.put_along_axis(dense, rows.columns(layout), rows.jacobian, axis=1)
    rng, x = np.random.default_rng(0), variables.values.copy()
    for _ in range(5):
        along = rng.normal(size=layout.size)
        sides = []
        for step in (1e-5, -1e-5):
            variables.values[:] = x + step * along
            sides.append(rows_of(mapper, free).residual)
        variables.values[:] = x
        numeric = (sides[0] - sides[1]) / 2e-5
        np.testing.assert_allclose(dense @ along, numeric, atol=1e-4 * np.abs(numeric).max())


def test_rows_of_some_cycles_are_those_of_the_whole_window(mapper: FixedLagMapper) -> None:
    smoother = mapper.road.smoother
    every = smoother.map.rows(np.arange(smoother.first_cycle, smoother.next_cycle))[0]
    some = np.array([smoother.first_cycle, smoother.first_cycle + 3, smoother.next_cycle - 1])
    rows, own = smoother.map.rows(some)[0], np.isin(every.owner, some)
    assert 0 < own.sum() < len(own)
    np.testing.assert_array_equal(rows.keys, every.keys[own])
    np.testing.assert_allclose(rows.jacobian, every.jacobian[own], atol=1e-12)
    np.testing.assert_allclose(rows.residual, every.residual[own], atol=1e-12)


def test_a_drive_without_noise_is_mapped() -> None:
    log = exact_log(ahead(6.0, 5.0), *corridor(50.0))
    for settings in (ACROSS, replace(ACROSS, lag=1.0)):
        found, _ = map_log(log, FixedLagMapper(settings, ODOMETRY_SIGMA))
        for boundary in found.map().boundaries.values():
            curve = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, 50))
            np.testing.assert_allclose(np.abs(curve[:, 1]), 2.0, atol=0.02)
        assert set(found.map().boundaries) == set(BOUNDARIES)


def test_the_cones_of_a_curve_move_with_the_map() -> None:
    """A quarter turn and a shift."""
    found, _ = map_log(exact_log(ahead(6.0, 4.0), *corridor(40.0)))
    curves = found.road.smoother.map
    before = {label: np.array(boundary.observed) for label, boundary in curves.state.boundaries.items()}
    curves.move(np.array([2.0, -1.0, 0.5 * np.pi]))
    for label, boundary in curves.state.boundaries.items():
        x, y = before[label].T
        np.testing.assert_allclose(boundary.observed, np.column_stack([2.0 - y, x - 1.0]), atol=1e-12)
