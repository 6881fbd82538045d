"""What the mappers say about the newest detections: which were used, and where they lie on the map."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.estimators import make_online
from pathspace_graph.io.log import Log
from pathspace_graph.labels import BOUNDARIES, UNKNOWN
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import ahead, corridor, exact_log


@pytest.fixture(scope="module")
def log() -> Log:
    return exact_log(ahead(8.0, 5.0), *corridor(60.0))


@pytest.mark.parametrize("name", ["fixed-lag", "landmark-fixed-lag"])
def test_the_readings_used_lie_at_their_foot_points(name: str, log: Log) -> None:
    mapper = make_online(name, MapperSettings(), log)
    assert hasattr(mapper, "readings") and hasattr(mapper, "window_poses")
    for odometry, detections in split_odometry(log):
        result = mapper.update(odometry, detections)
        readings = mapper.readings()
        assert len(readings.points) == len(detections.labels)
        assert readings.used.sum() == result.readings
        assert (np.isfinite(readings.feet).all(axis=1) == readings.used).all()
        assert np.isin(readings.labels, [*BOUNDARIES, UNKNOWN]).all()
        away = np.linalg.norm(readings.points - readings.feet, axis=1)[readings.used]
        assert (away < 0.1).all()  # nothing is noisy here
    assert readings.used.any()
    assert len(mapper.window_poses()) > 1


def test_foot_points_lie_on_the_curve_of_their_label(log: Log) -> None:
    mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    for odometry, detections in split_odometry(log):
        mapper.update(odometry, detections)
    readings = mapper.readings()
    for label, boundary in mapper.outline().boundaries.items():
        feet = readings.feet[readings.used & (readings.labels == label)]
        nearest = boundary.spline.foot_points(feet).position
        np.testing.assert_allclose(feet, nearest, atol=1e-6)


def test_before_the_first_cycle_there_are_no_readings(log: Log) -> None:
    readings = FixedLagMapper(odometry_sigma=log.odometry_sigma).readings()
    assert readings.points.shape == readings.feet.shape == (0, 2)
    assert len(readings.labels) == len(readings.used) == 0


def test_a_mapper_that_is_looked_at_goes_on_to_the_same_estimate(log: Log) -> None:
    looked_at, alone = (FixedLagMapper(odometry_sigma=log.odometry_sigma) for _ in range(2))
    for number, (odometry, detections) in enumerate(split_odometry(log)):
        ours, theirs = looked_at.update(odometry, detections), alone.update(odometry, detections)
        before = looked_at.road.smoother.variables.values.copy()
        looks = (looked_at.map, looked_at.outline, looked_at.readings, looked_at.vehicle_state)
        for look in looks if number % 4 == 0 else ():
            with looked_at.looked_at():
                look()
            np.testing.assert_array_equal(looked_at.road.smoother.variables.values, before)
        np.testing.assert_array_equal(ours.pose, theirs.pose)
