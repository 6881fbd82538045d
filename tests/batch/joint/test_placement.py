"""Where a drive is on the map of another one: wherever it began, and not where it has not been."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from pathspace_graph.batch.placement import (
    APART,
    OTHER_START,
    OTHER_TRACK,
    OTHER_WAY,
    TWO_PLACES,
    Driven,
    NotPlacedError,
    beside,
    find_place,
)
from pathspace_graph.factors.se2 import inverse, move_points
from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.batch import course_log
from .several import backwards, cut, driven_alone, lap, track, true_start


def test_a_way_is_laid_on_the_loop_where_it_belongs() -> None:
    """A third of a loop is found at its place, the best first."""
    phi = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    radius = 20.0 + 6.0 * np.cos(2.0 * phi) + 3.0 * np.sin(phi)
    loop, motion = radius[:, None] * np.column_stack([np.cos(phi), np.sin(phi)]), np.array([5.0, -3.0, 1.0])
    found = beside(loop, move_points(inverse(motion), loop[20:55]))
    np.testing.assert_allclose(found[0], motion, atol=1e-9)


def test_the_places_of_a_way_are_apart() -> None:
    """A loop that is the same after half a turn has two that are as good, and no neighbours of them."""
    phi = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    loop = (20.0 + 6.0 * np.cos(2.0 * phi))[:, None] * np.column_stack([np.cos(phi), np.sin(phi)])
    way = loop[20:55]
    begins = np.array([move_points(motion, way[:1])[0] for motion in beside(loop, way)])
    np.testing.assert_allclose(begins[0], -begins[1], atol=1e-9)
    assert pdist(begins).min() > APART


@pytest.mark.parametrize("begin", [0.0, 4.0, 9.0])
def test_a_drive_is_placed_wherever_it_began(begin: float) -> None:
    motion = find_place(driven_alone(lap(0)), driven_alone(lap(1, begin)))
    whole = simulate(track(4), SimulationSettings(laps=2), 1)
    off = motion - true_start(whole, begin)
    assert np.hypot(*off[:2]) < 0.5
    assert abs(np.sin(off[2])) < 0.03


def test_half_a_lap_is_placed_on_half_a_lap_by_its_cones() -> None:
    """Both began at the same start; each map alone is turned by up to a degree and a half."""
    motion = find_place(driven_alone(lap(0, 0.0, 4, 9.0)), driven_alone(lap(1, 0.0, 4, 8.0)))
    assert np.hypot(*motion[:2]) < 0.9
    assert abs(motion[2]) < 0.04


def course(laps: float) -> Driven:
    """Returns a drive on a track that is the same after half a turn."""
    return driven_alone(course_log(laps))


@pytest.mark.parametrize(
    ("known", "drive", "why"),
    [
        (lambda: lap(0), lambda: lap(0, 0.0, 5), OTHER_TRACK),
        (lambda: lap(0), backwards, OTHER_WAY),
        (lambda: lap(0), lambda: cut(lap(1), 0.0, 3.0), "it is shorter than 30 m"),
        (lambda: course_log(1.4), lambda: course_log(1.3), TWO_PLACES),
        (lambda: lap(0, 0.0, 4, 9.0), lambda: lap(0, 0.0, 5, 9.0), OTHER_START),
    ],
)
def test_what_has_no_certain_place_is_refused(
    known: Callable[[], Log], drive: Callable[[], Log], why: str
) -> None:
    with pytest.raises(NotPlacedError) as error:
        find_place(driven_alone(known()), driven_alone(drive()))
    assert str(error.value) == why
