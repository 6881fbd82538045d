"""The window's rows of readings: the distance across the curve, and both directions beside it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.fixed_lag import FixedLagMapper
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.linearizer import reading_rows
from pathspace_graph.settings import MapperSettings, SplineSettings
from pathspace_graph.window import POSE, Rows

from .scenes import ODOMETRY_SIGMA, ahead, corridor, exact_log, map_log

Array = NDArray[np.float64]

ACROSS = MapperSettings()
POINT = MapperSettings(spline=SplineSettings(residual="point"))


@pytest.fixture(scope="module")
def mapper() -> FixedLagMapper:
    """After a straight drive without noise, its poses then put 0.6 m aside, beyond Huber's threshold."""
    found, _ = map_log(exact_log(ahead(6.0, 6.0), *corridor(60.0)))
    found.smoother.state.poses[:, :2] += [0.2, 0.6]
    return found


def rows_of(mapper: FixedLagMapper, settings: MapperSettings) -> Rows:
    return reading_rows(mapper.smoother.state, mapper.smoother.readings, settings)[0]


def test_an_offset_is_two_rows_whose_part_across_the_curve_is_the_distance_s(mapper: FixedLagMapper) -> None:
    """Of round readings on a straight curve: by pose, by control points, residual and robust weight."""
    across, point = rows_of(mapper, ACROSS), rows_of(mapper, POINT)
    assert len(across.residual) > 50 and np.abs(across.residual).min() > 1.5
    np.testing.assert_array_equal(point.columns, np.repeat(across.columns, 2, axis=0))
    normal = across.jacobian[:, :2] / np.linalg.norm(across.jacobian[:, :2], axis=1)[:, None]
    jacobian = point.jacobian.reshape(len(normal), 2, -1)
    residual = point.residual.reshape(-1, 2)
    np.testing.assert_allclose(np.einsum("mi,mij->mj", normal, jacobian), across.jacobian, atol=1e-6)
    np.testing.assert_allclose(np.sum(normal * residual, axis=1), across.residual, atol=1e-6)


def test_an_offset_holds_the_vehicle_along_a_straight_curve_and_a_distance_does_not(
    mapper: FixedLagMapper,
) -> None:
    along = np.zeros(POSE)
    along[0] = 1.0
    assert np.abs(rows_of(mapper, ACROSS).jacobian[:, :POSE] @ along).max() < 1e-3
    assert np.linalg.norm(rows_of(mapper, POINT).jacobian[:, :POSE] @ along) > 5.0


def test_a_reading_that_slides_to_where_an_open_map_is_far_brings_all_of_it_back() -> None:
    found, _ = map_log(exact_log(ahead(6.0, 9.0), *corridor(80.0)))
    smoother = found.smoother
    assert not smoother.state.whole
    before = [len(rows.residual) for rows in smoother.linearize()]
    smoother.readings.u[np.flatnonzero(smoother.readings.used)[-1]] = 1.0
    assert [len(rows.residual) for rows in smoother.linearize()] >= before
    assert smoother.state.whole


def test_a_drive_without_noise_is_mapped_with_either() -> None:
    log = exact_log(ahead(6.0, 5.0), *corridor(50.0))
    for settings in (ACROSS, replace(POINT, lag=1.0)):
        found, _ = map_log(log, FixedLagMapper(settings, ODOMETRY_SIGMA))
        for boundary in found.map().boundaries.values():
            curve = boundary.spline.evaluate(np.linspace(*boundary.spline.domain, 50))
            np.testing.assert_allclose(np.abs(curve[:, 1]), 2.0, atol=0.02)
        assert set(found.map().boundaries) == set(BOUNDARIES)
