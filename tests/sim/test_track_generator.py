"""Generated tracks keep the rules of Formula Student, differ, and contain every element."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pathspace_graph.errors import SettingsError
from pathspace_graph.sim.track import Track, fit_centre_line
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track

SEEDS = range(24)
STEP = 0.25


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return [generate_track(np.random.default_rng(seed)) for seed in SEEDS]


def curvature(track: Track) -> np.ndarray:
    line = track.centre_line
    return line.curvatures(np.arange(0.0, line.length, STEP))


def turn_within(track: Track, distance: float) -> np.ndarray:
    """Change of heading over every stretch of this length, rad."""
    bend = curvature(track)
    count = int(distance / STEP)
    total = np.concatenate([[0.0], np.cumsum(np.concatenate([bend, bend[:count]]) * STEP)])
    return total[count:] - total[:-count]


def longest_straight(track: Track) -> float:
    bad = np.flatnonzero(np.abs(curvature(track)) > 1 / 60)
    return float(np.diff(bad, append=bad[0] + len(curvature(track))).max() * STEP)


def weaves(track: Track) -> int:
    """Most bends of alternating sense within 45 m, each tighter than 25 m of radius."""
    bend = curvature(track)
    sense = np.sign(bend) * (np.abs(bend) > 1 / 25)
    places = np.flatnonzero(sense)
    changes = places[np.flatnonzero(np.diff(sense[places]))] * STEP
    return max((int(np.sum((changes >= c) & (changes < c + 45.0))) + 1 for c in changes), default=1)


def test_length_and_count(tracks: list[Track]) -> None:
    for track in tracks:
        assert 200.0 <= track.centre_line.length <= 500.0
        assert track.closed
        assert 190 <= len(track.left) + len(track.right) <= 215


def test_width_and_gaps(tracks: list[Track]) -> None:
    for track in tracks:
        for row, other in ((track.left, track.right), (track.right, track.left)):
            gap = np.linalg.norm(row - np.roll(row, 1, axis=0), axis=1)
            assert gap.max() <= 5.0
            assert gap.min() > 0.8
            assert cKDTree(other).query(row)[0].min() >= 3.0


def test_cones_are_closer_in_corners(tracks: list[Track]) -> None:
    for track in tracks:
        line = track.centre_line
        s = np.arange(0.0, line.length, STEP)
        bend = np.abs(line.curvatures(s))
        # the outer row has the longer way, so that its gaps are the fair ones to compare
        gap = np.concatenate(
            [np.linalg.norm(r - np.roll(r, 1, axis=0), axis=1) for r in (track.left, track.right)]
        )
        middle = np.vstack([(r + np.roll(r, 1, axis=0)) / 2 for r in (track.left, track.right)])
        at = bend[cKDTree(line.points(s)).query(middle)[1]]
        assert np.median(gap[at > 1 / 10]) < 0.75 * np.median(gap[at < 1 / 100])


def test_corners_are_no_tighter_than_a_hairpin(tracks: list[Track]) -> None:
    for track in tracks:
        # outside radius of 4.5 m; the centre line fitted to the cones may cut a little
        assert 1 / np.abs(curvature(track)).max() > 4.5 - 4.2 / 2 - 0.6
        assert longest_straight(track) <= 90.0


def test_stretches_never_cross_nor_nearly_touch(tracks: list[Track]) -> None:
    for track in tracks:
        s = np.arange(0.0, track.centre_line.length, 1.0)
        points = track.centre_line.points(s)
        least = 2 * np.median(track.centre_line.clearance) + 1.5
        pairs = cKDTree(points).query_pairs(least - 0.3, output_type="ndarray")
        apart = np.abs(pairs[:, 0] - pairs[:, 1])
        assert np.minimum(apart, len(s) - apart).max() < 12.0
        # total turn of a closed curve that doesn't cross itself
        assert abs(abs(turn_within(track, track.centre_line.length)[0]) - 2 * np.pi) < 0.2


def test_every_element_occurs_and_both_senses(tracks: list[Track]) -> None:
    hairpins = [np.abs(turn_within(track, 18.0)).max() > np.deg2rad(150) for track in tracks]
    straights = [longest_straight(track) for track in tracks]
    slaloms = [weaves(track) >= 4 for track in tracks]
    chicanes = [weaves(track) >= 3 for track in tracks]
    senses = [turn_within(track, track.centre_line.length)[0] > 0 for track in tracks]
    assert sum(hairpins) >= len(tracks) / 3
    assert sum(slaloms) >= len(tracks) / 6
    assert sum(chicanes) >= len(tracks) / 3
    assert min(straights) > 10.0
    assert max(straights) > 50.0
    assert 5 <= sum(senses) <= len(tracks) - 5
    lengths = np.array([track.centre_line.length for track in tracks])
    assert np.ptp(lengths) > 100.0


def test_start_is_on_the_middle_of_a_straight(tracks: list[Track]) -> None:
    for track in tracks:
        line = track.centre_line
        s = np.array([line.nearest(track.start)])
        assert np.linalg.norm(line.points(s)[0] - track.start[:2]) < 0.2
        tangent = line.tangents(s)[0]
        assert tangent @ [np.cos(track.start[2]), np.sin(track.start[2])] > np.cos(0.05)


def test_the_middle_of_a_straight_road_that_widens_is_straight() -> None:
    """From 4 m to 8 m: each step moves the curve by half the difference of its distances from both rows."""
    x = np.arange(0.0, 60.0, 3.0)
    side = np.where(x < 30.0, 2.0, 4.0)
    line = fit_centre_line(np.column_stack([x, side]), np.column_stack([x, -side]), False, np.zeros(2))
    assert np.abs(line.points(np.arange(0.0, line.length, STEP))[:, 1]).max() < 0.005


@pytest.mark.parametrize("cones", [120, 300, 500])
def test_number_of_cones_can_be_set(cones: int) -> None:
    settings = TrackGeneratorSettings(cones=cones, lap_length=(220.0, 260.0))
    track = generate_track(np.random.default_rng(0), settings)
    assert abs(len(track.left) + len(track.right) - cones) <= 3


def test_settings_that_contradict_are_refused() -> None:
    with pytest.raises(SettingsError, match="no track kept the rules"):
        generate_track(np.random.default_rng(0), TrackGeneratorSettings(lap_length=(10.0, 11.0)))
    for bad in (
        {"lap_length": (400.0, 200.0)},
        {"corners": (2, 5)},
        {"cones": 3},
    ):
        with pytest.raises(SettingsError, match="generator"):
            TrackGeneratorSettings(**bad)  # type: ignore[arg-type]
