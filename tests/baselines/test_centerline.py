"""A drive mapped as a centre line with a width, and the factors of its graph."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.centerline import (
    NAME,
    CenterlineBatch,
    CenterlineMapper,
    map_of,
    ribbon_keys,
    ribbon_of,
    shape_factors,
)
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import for_map
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.graph.variables import pose_key
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.io.map import Map, SplineBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.centre_line import Ribbon, find_line

from ..scenes.drives import bean_track, lap_log, noisy
from ..scenes.maps import SIGMA, ring_map

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


@pytest.fixture(scope="module")
def log() -> Log:
    return noisy(lap_log(bean_track(), overrun=40.0), 0)


def ring_ribbon(spacing: float = 4.0) -> Ribbon:
    left, right = (ring_map().curve(label, "a test").spline for label in BOUNDARIES)
    return find_line(left, right, True, spacing).ribbon


def test_the_batch_maps_a_lap(log: Log) -> None:
    result = CenterlineBatch(odometry_sigma=log.odometry_sigma, online=FixedLagMapper).solve(log)
    assert log.truth is not None
    assert result.estimator == NAME
    assert result.converged
    assert result.map.closed
    found = lap_metrics(result.map, log.truth, 1)
    assert found.missed == 0.0
    assert found.rmse < 0.3
    line = result.map.centre_line()
    assert np.abs(line.width_left - line.width_right).max() < 0.1  # the edges are equally far from the line


def test_the_online_map_is_that_of_a_ribbon(log: Log) -> None:
    """It is as near to the truth as the boundaries that it comes from, on the open and on the closed map."""
    assert log.truth is not None
    times = [float(log.cycles[k].t) for k in (len(log.cycles) // 2, len(log.cycles) - 1)]
    runs = [
        run_online(log, make(odometry_sigma=log.odometry_sigma), snapshot_times=times)
        for make in (CenterlineMapper, FixedLagMapper)
    ]
    assert np.array_equal(runs[0].trajectory, runs[1].trajectory)
    for ribbon, boundaries in zip(runs[0].snapshots, runs[1].snapshots, strict=True):
        own, other = (lap_metrics(track, log.truth, 1) for track in (ribbon, boundaries))
        assert ribbon.closed == boundaries.closed
        # an open ribbon ends where the shorter boundary does, which leaves cones of the longer one
        assert own.rmse < other.rmse + (0.05 if ribbon.closed else 0.3)
        assert ribbon.joint_covariance is not None


def test_without_two_boundaries_the_map_is_that_of_one(log: Log) -> None:
    """A boundary that is seen alone is mapped alone."""
    only = replace(log, cycles=tuple(left_of(cycle) for cycle in log.cycles))
    mapper = CenterlineMapper(odometry_sigma=log.odometry_sigma)
    online = run_online(only, mapper)
    batch = CenterlineBatch(odometry_sigma=log.odometry_sigma, online=FixedLagMapper).solve(only)
    assert log.truth is not None
    cones = log.truth.cones[log.truth.cone_labels == LEFT]
    for run in (online, batch):
        assert set(run.map.boundaries) == {LEFT}
        distance = run.map.curve(LEFT, "a test").spline.foot_points(cones).distance
        assert np.sqrt(np.mean(distance**2)) < 0.35
    ahead = mapper.boundaries.ahead(10.0)
    assert ahead.length == 0.0
    assert len(ahead.left) > 5


def test_a_ribbon_is_found_again_from_its_own_edges() -> None:
    """Their covariance is that of the edges across themselves."""
    ribbon = ring_ribbon()
    covariance = 0.01**2 * np.eye(3 * ribbon.size)
    track = map_of(ribbon, covariance, SIGMA, {})
    fitted, known, _ = ribbon_of(track, SETTINGS)
    u = np.linspace(0.0, ribbon.tables.high, 100)
    radius = np.hypot(*fitted.centre.evaluate(u).T)
    np.testing.assert_allclose(radius, 20.0, atol=0.01)
    width = fitted.half_width(u)
    np.testing.assert_allclose(width, 2.0, atol=0.01)
    assert known is not None
    again = map_of(fitted, known, 0.0, {})
    for label in BOUNDARIES:
        sigmas = []
        for one in (track, again):
            boundary = one.boundaries[label]
            assert isinstance(boundary, SplineBoundary)
            at = np.linspace(*boundary.spline.domain, 50)
            sigmas.append(boundary.spline.normal_sigma(at, boundary.covariance))
        assert 0.3 < np.median(sigmas[1] / sigmas[0]) < 1.5


def test_an_outline_has_no_covariance() -> None:
    bare = Map(
        True, {b: replace(ring_map().curve(b, "a test"), covariance=np.zeros((0, 0))) for b in BOUNDARIES}
    )
    fitted, covariance, _ = ribbon_of(bare, SETTINGS)
    assert covariance is None
    edges = map_of(fitted, None, SIGMA, {})
    boundary = edges.boundaries[RIGHT]
    assert isinstance(boundary, SplineBoundary)
    assert boundary.covariance.shape == (0, 0)
    at = np.linspace(*boundary.spline.domain, 50)
    np.testing.assert_allclose(np.hypot(*boundary.spline.evaluate(at).T), 22.0, atol=0.01)


def test_the_weak_priors_jacobians() -> None:
    ribbon = ring_ribbon(12.0)
    rng = np.random.default_rng(1)
    poses = np.array([[20.0, 0.0, 1.6], [-20.0, 1.0, -1.5], [0.0, 20.0, 3.1]])
    values = gtsam.Values()
    for k, pose in enumerate(poses + rng.normal(0.0, 0.1, poses.shape)):
        values.insert(pose_key(k), gtsam.Pose2(*pose))
    for key, point in zip(ribbon_keys(ribbon), ribbon.distinct_control_points, strict=True):
        values.insert(key, point + rng.normal(0.0, 0.3, 3))
    factors = list(shape_factors(ribbon, poses, SETTINGS))
    assert len(factors) == 2 * ribbon.size
    for factor in factors:
        columns = []
        for key in list(factor.keys()):
            for step in 1e-6 * np.eye(3):
                ends = [factor.unwhitenedError(moved(values, key, sign * step)) for sign in (1.0, -1.0)]
                columns.append((ends[0] - ends[1]) / 2e-6)
        np.testing.assert_allclose(
            factor.linearize(values).jacobian()[0], np.column_stack(columns), atol=1e-5
        )


def left_of(cycle: Detections) -> Detections:
    """The cycle without its right cones."""
    own = cycle.labels == LEFT
    return Detections(cycle.t, cycle.points_vehicle[own], cycle.covariances[own], cycle.labels[own])


def moved(values: gtsam.Values, key: int, change: Array) -> gtsam.Values:
    """The values with one of them changed."""
    delta = gtsam.VectorValues()
    delta.insert(key, change)
    return values.retract(delta)


def test_the_estimator_for_a_map() -> None:
    assert for_map("fixed-lag", "boundaries") == "fixed-lag"
    assert for_map("fixed-lag", "centerline") == "centerline-fixed-lag"
    assert for_map("spline", "centerline") == "centerline"
    assert for_map("centerline", "centerline") == "centerline"
    with pytest.raises(SettingsError, match="expected --estimator fixed-lag or spline, found ckf"):
        for_map("ckf", "centerline")
