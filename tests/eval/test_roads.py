"""Roads have the shape that their settings say, and logs hold what they are said to hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from pathspace_graph.eval.benchmark import (
    DENT,
    DENTS,
    GAP,
    LINE_POINTS,
    ROAD_WIDTH,
    SPARE,
    SWING,
    WAVELENGTH,
    closed_road,
    cones_seen,
    drive_log,
    make_drives,
    open_road,
    thinned,
)
from pathspace_graph.io.log import Log

from .timing import SMALL


@pytest.fixture(scope="module")
def log() -> Log:
    return drive_log(open_road(60, GAP), seed=0)


def test_roads_have_their_gaps_and_width() -> None:
    for track, gap in ((open_road(100, 5.0), 5.0), (closed_road(100), 5.0)):
        for row in (track.left, track.right):
            np.testing.assert_allclose(np.linalg.norm(np.diff(row, axis=0), axis=1), gap, rtol=0.06)
        nearest = np.linalg.norm(track.left[:, None] - track.right[None], axis=-1).min(axis=1)
        assert np.all(nearest >= ROAD_WIDTH - 0.2)
        assert np.all(nearest < np.hypot(ROAD_WIDTH, gap / 2) + 0.5)
    assert len(closed_road(100).cones) == pytest.approx(100, abs=3)


def test_an_open_road_has_cones_to_spare_and_swings_about_its_direction() -> None:
    """It heads for x, by at most 0.9 rad to either side, and has a whole swing every 300 m."""
    track = open_road(400, GAP)
    assert len(track.cones) == pytest.approx(SPARE * 400, abs=4)
    steps = np.diff(track.left, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    assert np.abs(headings).max() == pytest.approx(SWING, abs=0.01)
    crossings = np.flatnonzero((headings[:-1] < 0.0) & (headings[1:] >= 0.0))
    np.testing.assert_allclose(np.diff(crossings) * GAP, WAVELENGTH, atol=GAP)


def test_an_open_road_never_comes_near_itself() -> None:
    track = open_road(2000, GAP)
    for pair in KDTree(track.left).query_pairs(20.0):
        assert abs(pair[0] - pair[1]) < 6


def test_a_closed_road_is_a_dented_circle() -> None:
    """Its distance from the middle swings by 12 % about the mean, three times around."""
    track = closed_road(400)
    middle = 0.5 * (track.left + track.right[KDTree(track.right).query(track.left)[1]])
    radius = np.linalg.norm(middle, axis=1)
    assert track.closed
    assert radius.max() / radius.min() == pytest.approx((1.0 + DENT) / (1.0 - DENT), rel=0.02)
    around = np.append(radius, radius[:1]) > radius.mean()
    assert np.sum(around[:-1] != around[1:]) == 2 * DENTS


def test_cones_seen_counts_each_once(log: Log) -> None:
    assert log.truth is not None
    assert log.truth.associations is not None
    seen = cones_seen(log)
    ends = np.cumsum([len(cycle.labels) for cycle in log.cycles])
    for k in (0, 5, len(seen) - 1):
        so_far = set(log.truth.associations[: ends[k]].tolist()) - {-1}
        assert seen[k] == len(so_far)


def test_thinned_keeps_detections_of_the_cycle(log: Log) -> None:
    thin = thinned(log, 4, np.random.default_rng(0))
    for before, after in zip(log.cycles, thin.cycles, strict=True):
        assert len(after.labels) == min(4, len(before.labels))
        kept = [np.flatnonzero((before.points_vehicle == p).all(axis=1))[0] for p in after.points_vehicle]
        assert len(set(kept)) == len(kept)
        np.testing.assert_array_equal(before.covariances[kept], after.covariances)
        np.testing.assert_array_equal(before.labels[kept], after.labels)
    again = thinned(log, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(again.cycles[7].points_vehicle, thin.cycles[7].points_vehicle)


def test_the_long_drive_ends_when_the_last_cone_is_seen() -> None:
    drives = make_drives(SMALL)
    (cones,), (laps,), (line,) = (drives[name].parts for name in ("cones", "laps", "line"))
    assert len(cones.at) == len(cones.log.cycles)
    assert cones.at[-1] >= SMALL.cones_max > cones.at[-2]
    assert [part.name for part in drives["readings"].parts] == [f"{k} readings: " for k in SMALL.readings]
    assert {*np.unique(laps.at)} >= {1.0, 2.0} and len(drives["laps"].edges) == SMALL.laps + 1
    points = [len(cycle.labels) for cycle in line.log.cycles]
    assert np.mean(points) == pytest.approx(LINE_POINTS, rel=0.1)
