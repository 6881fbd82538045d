"""Where a drive is on the map of another one: wherever it began, and not where it has not been."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pathspace_graph.batch.joint import (
    OTHER_START,
    OTHER_TRACK,
    OTHER_WAY,
    TWO_PLACES,
    Driven,
    NotPlacedError,
    find_place,
)
from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.batch import course_log
from .several import backwards, cut, driven_alone, lap, track, true_start


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
