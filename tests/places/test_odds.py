"""The odds of places, over five hundred searches on generated tracks: what is claimed is found."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from pathspace_graph.batch.known_map import KnownMap, map_of_cones
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import compose, inverse, path_lengths, relative, to_vehicle
from pathspace_graph.places.find import MERGE_RANGE, SURE_ODDS, Constellation, KnownRoad, find
from pathspace_graph.sim.track_generator import generate_track

TRACKS, SEARCHES = 25, 10
SIGMA_MAP, SIGMA_SEEN = 0.15, 0.2
"""Standard deviations of the cones of the map and of those that are seen (m)."""
DRIFT = 0.02
"""Error of the heading at the end of 30 m (rad, one sigma)."""


@cache
def known(seed: int) -> tuple[KnownRoad, Array, Array]:
    """Return a surveyed road, its true cones (n, 2) and their labels (n,)."""
    rng = np.random.default_rng(seed)
    track = generate_track(rng)
    rows = [row + SIGMA_MAP * rng.normal(size=row.shape) for row in (track.left, track.right)]
    surveyed = KnownMap.of(map_of_cones(*rows, True, SIGMA_MAP))
    labels = np.repeat([0, 1], [len(track.left), len(track.right)])
    return KnownRoad.of(surveyed.splines, surveyed.cones), np.concatenate([track.left, track.right]), labels


def driven(road: KnownRoad, rng: np.random.Generator) -> Array:
    """Return true poses (P, 3) along 30 to 60 m of a road, up to a metre aside of its middle."""
    first, count = int(rng.integers(len(road.way))), int(rng.integers(15, 30))
    way = np.roll(road.way, -first, axis=0)[: count + 1]
    ahead = np.diff(way, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    poses = np.column_stack([way[:-1], heading])
    return compose(poses, np.tile([0.0, rng.uniform(-1.0, 1.0), 0.0], (count, 1)))


@cache
def searches() -> Array:
    """Return odds, whether it was on the right road, and the error (m) of each best place, (n, 3)."""
    found = list[tuple[float, bool, float]]()
    for seed in range(TRACKS):
        road, cones, labels = known(seed)
        for k in range(SEARCHES):
            rng = np.random.default_rng([seed, k])
            true = driven(road, rng)
            length = path_lengths(true)
            newest = true[length > length[-1] - 30.0]
            near = np.hypot(*(cones[:, None] - newest[:, :2]).transpose(2, 0, 1)).min(axis=1) < MERGE_RANGE
            seen = to_vehicle(cones[near], true[-1:])
            turn = DRIFT * rng.normal() * np.clip(-seen[:, 0], 0.0, None) / 30.0
            seen = seen + np.column_stack([np.zeros(len(seen)), turn * seen[:, 0]])
            seen = seen + SIGMA_SEEN * rng.normal(size=seen.shape)
            variances = np.tile(SIGMA_SEEN**2 / 3.0 * np.eye(2), (len(seen), 1, 1))
            constellation = Constellation(seen, variances, labels[near])
            own = compose(inverse(true[0]), true)
            for is_right, on in ((True, road), (False, known((seed + 1) % TRACKS)[0])):
                best = find(constellation, on.seen, on.along(own))
                off = np.inf if best is None else float(np.hypot(*relative(true[-1], best.pose)[:2]))
                found.append((-np.inf if best is None else best.odds, is_right, off))
    return np.array(found)


def right(found: Array) -> Array:
    return (found[:, 1] == 1.0) & (found[:, 2] < 1.0)


@pytest.mark.slow
def test_of_places_that_are_sure_none_is_wrong() -> None:
    found = searches()
    sure = found[found[:, 0] >= SURE_ODDS]
    assert len(sure) > 150
    assert right(sure).all()


@pytest.mark.slow
def test_most_searches_find_the_place() -> None:
    found = searches()
    own = found[found[:, 1] == 1.0]
    assert (own[:, 0] >= SURE_ODDS).mean() > 0.6


@pytest.mark.slow
def test_a_place_is_right_as_often_as_is_claimed() -> None:
    """Of places with odds p the share 1 / (1 + exp(-p)) is right, or more."""
    found = searches()
    for low, high in ((0.0, 3.0), (3.0, 5.0), (5.0, np.inf)):
        some = found[(found[:, 0] >= low) & (found[:, 0] < high)]
        if len(some) >= 20:
            claimed = 1.0 / (1.0 + np.exp(-np.minimum(some[:, 0], 30.0)))
            spread = np.sqrt((claimed * (1.0 - claimed)).sum()) / len(some)
            assert right(some).mean() > claimed.mean() - 3.0 * spread - 0.02
