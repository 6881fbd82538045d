"""The tentative stretch: how far it leads, how it is taken back, what it claims, and that it does no harm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.graph.variables import pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.online.outlook import SIGMA_BEND, Outlook, joint_covariance_of, look_ahead
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import ahead, corridor, detections, exact_lap, exact_log, map_log, mapped

Array = NDArray[np.float64]

SETTINGS = MapperSettings()


@pytest.fixture(scope="module")
def log() -> Log:
    return exact_log(ahead(8.0, 5.0), *corridor(100.0))


@pytest.fixture(scope="module")
def mapper(log: Log) -> FixedLagMapper:
    return map_log(log)[0]


def outlooks(mapper: FixedLagMapper) -> dict[int, Outlook]:
    road = mapper.road
    return look_ahead(road.smoother.map, road.growth.tentative, road.path, road.smoother.times[-1])


def outlook(mapper: FixedLagMapper, label: int = LEFT) -> Outlook:
    return outlooks(mapper)[label]


def test_an_open_map_leads_on_through_all_cones_in_sight(mapper: FixedLagMapper) -> None:
    """The vehicle is at 39.2 m. Cones stand every 4 m, and count up to 12.5 m away."""
    for label, side in ((LEFT, 2.0), (RIGHT, -2.0)):
        found = outlook(mapper, label)
        assert found.tracks[:, 0].max() == pytest.approx(48.0, abs=0.1)
        assert found.confirmed_until == mapper.boundaries[label].confirmed_end
        u = np.linspace(found.confirmed_until, found.boundary.confirmed_end, 20)
        np.testing.assert_allclose(found.spline.evaluate(u)[:, 1], side, atol=0.1)


def test_a_track_is_as_uncertain_as_its_detections_and_the_curve_beside_it(mapper: FixedLagMapper) -> None:
    """Cones stand about 0.1 m from a smooth curve."""
    tracks = mapper.road.growth.tentative
    found = outlook(mapper)
    for place, variance in zip(found.tracks, found.variances, strict=True):
        (row,) = np.flatnonzero(np.hypot(*(tracks.points - place).T) < 1e-9)
        assert variance == pytest.approx(tracks.variances(np.array([row]))[0] + 0.01)


def test_the_confirmed_curve_is_the_same_with_the_stretch_as_without(mapper: FixedLagMapper) -> None:
    u = np.linspace(0.0, mapper.boundaries[LEFT].confirmed_end, 50)
    confirmed = mapper.boundaries[LEFT].evaluate(mapper.control_points(LEFT), u)
    np.testing.assert_allclose(outlook(mapper).spline.evaluate(u), confirmed, atol=1e-9)


def test_asking_for_the_map_changes_no_estimate(log: Log, mapper: FixedLagMapper) -> None:
    asked = FixedLagMapper(odometry_sigma=log.noise)
    for odometry, cycle in split_odometry(log):
        asked.update(odometry, cycle)
        asked.outline()
        asked.map()
    np.testing.assert_array_equal(asked.poses, mapper.poses)
    for label in (LEFT, RIGHT):
        np.testing.assert_array_equal(asked.control_points(label), mapper.control_points(label))
        assert asked.boundaries[label].size == mapper.boundaries[label].size


def test_a_detection_that_is_not_repeated_is_taken_back() -> None:
    """The last cone of the row stands at 24 m; once, one was detected at 28 m."""
    log = exact_log(ahead(4.0, 5.0), *corridor(27.0))
    at = 44
    cycle, x = log.cycles[at], 4.0 * log.cycles[at].t
    ghost = detections(
        cycle.t,
        np.concatenate([cycle.points_vehicle, [[28.0 - x, 2.0]]]),
        np.append(cycle.labels, LEFT).astype(np.intp),
    )
    log = replace(log, cycles=(*log.cycles[:at], ghost, *log.cycles[at + 1 :]))
    mapper, ends = FixedLagMapper(odometry_sigma=log.noise), []
    for odometry, detected in split_odometry(log):
        mapper.update(odometry, detected)
        found = outlooks(mapper).get(LEFT)
        ends.append(found.tracks[-1, 0] if found is not None and len(found.tracks) else 0.0)
    assert max(ends[:at]) < 25.0
    assert [end > 27.0 for end in ends[at : at + 6]] == [True] * 4 + [False] * 2


def test_a_cone_that_the_curve_has_already_is_not_led_through_again(log: Log) -> None:
    """The cone at (48, 2) is one of an earlier stretch, as in a hairpin whose rows are close."""
    mapper, _ = map_log(log)
    assert outlook(mapper).tracks[-1, 0] == pytest.approx(48.0, abs=0.1)
    mapper.boundaries[LEFT].add_cones(np.array([[48.1, 2.1]]), np.array([48.1]))
    assert outlook(mapper).tracks[:, 0].max(initial=0.0) < 45.0


def test_a_boundary_that_has_not_begun_has_a_stretch_that_is_not_confirmed() -> None:
    log = exact_log(ahead(8.0, 5.0), *corridor(100.0))
    mapper, _ = map_log(replace(log, cycles=log.cycles[:1]))
    assert mapper.boundaries == {}
    track = mapper.map()
    for label, side in ((LEFT, 2.0), (RIGHT, -2.0)):
        boundary = track.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        assert boundary.confirmed_until == 0.0
        u = np.linspace(0.0, 6.0, 9)
        np.testing.assert_allclose(boundary.spline.evaluate(u)[:, 1], side, atol=0.1)
        assert np.linalg.eigvalsh(boundary.covariance)[0] > 0.0


def test_a_mapper_that_has_seen_nothing_has_no_outline() -> None:
    mapper = FixedLagMapper()
    assert mapper.outline().boundaries == {}
    assert mapper.map().boundaries == {}


def test_a_closed_map_is_confirmed_as_a_whole() -> None:
    mapper, _ = mapped(exact_lap())
    assert mapper.closed
    track = mapper.map()
    for label, outline in mapper.outline().boundaries.items():
        boundary = track.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        assert isinstance(outline, SplineBoundary)
        assert boundary.confirmed_until == outline.spline.domain[1]
        np.testing.assert_array_equal(boundary.spline.control_points, outline.spline.control_points)


def test_the_covariance_is_that_of_the_fit_by_differences(mapper: FixedLagMapper) -> None:
    """The tracks move with the vehicle; their own errors and the bends are independent of everything."""
    found, state = outlook(mapper), mapper.road.smoother.map.state
    newest = pose_keys(np.array([mapper.road.smoother.next_cycle - 1]))
    joint = mapper.road.smoother.covariance(np.concatenate([state.control_keys(LEFT), newest]))
    assert found.placement is not None
    vehicle, tracks, bend = mapper.poses[-1], found.tracks, SIGMA_BEND

    def placed(offset: Array) -> Array:
        dx, dy, turned = offset[-3:]
        c, s = np.cos(turned), np.sin(turned)
        moved = (tracks - vehicle[:2]) @ np.array([[c, s], [-s, c]]) + vehicle[:2] + [dx, dy]
        known = found.known + offset[:-3].reshape(-1, 2)
        assert found.placement is not None
        return found.placement.place(known, moved).ravel()

    step = 1e-5 * np.eye(len(joint))
    jacobian = np.column_stack([(placed(e) - placed(-e)) / 2e-5 for e in step])
    expected = jacobian @ joint @ jacobian.T
    kept = 2 * found.placement.kept
    by_track, by_bend = found.placement.by_target, found.placement.by_bend
    own = by_track @ np.diag(found.variances) @ by_track.T + bend**2 * by_bend @ by_bend.T
    expected[kept:, kept:] += np.kron(own, np.eye(2))
    covariance, (block,) = joint_covariance_of([found], joint, vehicle)
    assert block == slice(0, len(covariance))
    np.testing.assert_allclose(covariance, expected, atol=1e-8)


def test_the_band_widens_along_the_stretch(mapper: FixedLagMapper) -> None:
    boundary = mapper.map().boundaries[LEFT]
    assert isinstance(boundary, SplineBoundary)
    u = np.array([boundary.confirmed_until, boundary.spline.domain[1]])
    near, far = boundary.spline.normal_sigma(u, boundary.covariance)
    assert far > near
