"""Which closed results are believed: courses that are driven again or aren't."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import are_of_cones, objection, share_used
from pathspace_graph.batch.mapper import BatchMapper, find_closed_optimum
from pathspace_graph.batch.simplification import own_settings
from pathspace_graph.batch.start import find_revisits
from pathspace_graph.batch.system import BatchSystem, Optimizer
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

from ..scenes.batch import COURSE, course_log
from ..scenes.drives import noisy

Array = NDArray[np.float64]

SETTINGS = own_settings(MapperSettings())

USED = 0.95
"""This share of the detections lies on the curves."""


# --- drives ----------------------------------------------------------------------------------------------


@cache
def driven(laps: float) -> Log:
    """Returns a drive on the course whose measurements have noise."""
    return noisy(course_log(laps), seed=3)


def test_a_course_that_is_driven_again_is_closed() -> None:
    """The detections of both laps lie on its curves."""
    judged = judge_log(driven(1.4), driven(1.4).noise, SETTINGS)
    detections = DetectionTable.of(judged.cycles, twists=judged.chain.twists)
    system = BatchSystem(detections, [judged.chain], [SETTINGS], find_revisits(judged))
    found = find_closed_optimum(Optimizer(system))
    assert found is not None
    at = found.at
    assert found.convergence.converged
    assert all(boundary.periodic for boundary in at.state.boundaries.values())
    assert share_used(at, detections) > 0.95
    later = np.flatnonzero(path_lengths(at.state.poses)[detections.cycle] > 1.05 * COURSE)
    assert len(later) > 0.1 * len(detections)
    released = replace(detections, used=detections.used.copy())
    released.release(later)
    assert share_used(at, released) > 0.95  # only the first lap counts
    release = np.flatnonzero(detections.boundary == LEFT)
    detections.release(release)
    assert share_used(at, detections) == pytest.approx(0.5, abs=0.05)


def test_a_course_that_ends_before_the_line_stays_open() -> None:
    log = driven(0.9)
    result = BatchMapper(None, log.odometry_sigma).solve(log, "odometry")
    assert not result.map.closed


# --- what speaks against a closing -----------------------------------------------------------------------


def ring(radius: float, centre: float = 0.0) -> BSpline:
    """A closed curve about a circle around (centre, 0)."""
    phi = np.arange(12) * np.pi / 6.0
    points = radius * np.column_stack([np.cos(phi), np.sin(phi)]) + [centre, 0.0]
    return BSpline(np.arange(-3.0, 16.0), np.concatenate([points, points[:3]]), 3, True)


def circle(radius: float, centre: float = 0.0, begin: float = 0.0) -> Array:
    """Poses once around, from an angle on (rad)."""
    phi = begin + np.linspace(0.0, 2.0 * np.pi, 60)
    return np.column_stack([centre + radius * np.cos(phi), radius * np.sin(phi), phi + 0.5 * np.pi])


def test_nothing_speaks_against_a_road_around_its_drive() -> None:
    assert objection({LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0), USED) == ""


def test_boundaries_that_cross_are_no_road() -> None:
    against = objection({LEFT: ring(18.0), RIGHT: ring(24.0, 8.0)}, circle(15.0), USED)
    assert against == "its boundaries cross"


def test_a_vehicle_crosses_no_boundary() -> None:
    against = objection({LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0, 4.0), USED)
    assert "boundary lies across the driven path" in against


def test_a_vehicle_has_driven_beside_all_of_a_boundary() -> None:
    """A quarter of the circle was never driven: the curves only bridge it."""
    driven = circle(20.0)[:45]
    against = objection({LEFT: ring(18.0), RIGHT: ring(24.0)}, driven, USED)
    assert against.startswith("a boundary has a stretch ")
    assert against.endswith(" times as far from the drive as one driven along")


@pytest.mark.parametrize("begin", [0.0, np.pi])
def test_where_cycles_are_missing_nothing_is_asked_of_the_boundaries(begin: float) -> None:
    """The drive's step over a quarter of the circle crosses the inner boundary, but the vehicle did not.

    Where it begins opposite to the curves' seam, that lies in the quarter.
    """
    curves = {LEFT: ring(18.0), RIGHT: ring(24.0)}
    whole = circle(20.0, begin=begin)
    without = np.delete(whole, np.arange(20, 35), axis=0)
    assert objection(curves, without, USED) == ""
    narrow = {LEFT: ring(18.0), RIGHT: ring(24.0, 8.0)}
    assert objection(narrow, np.delete(circle(15.0), np.arange(20, 35), axis=0), USED) != ""


def test_the_detections_of_a_lap_lie_on_its_boundaries() -> None:
    against = objection({LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0), 0.62)
    assert against == "only 62 % of the detections lie on its boundaries"


def test_false_detections_say_nothing_of_a_map_but_cones_beside_it_do() -> None:
    """Forty cones are seen by ten cycles each, and as many scattered points once."""
    rng = np.random.default_rng(0)
    cones = np.repeat(rng.uniform(0.0, 200.0, (40, 2)), 10, axis=0) + 0.05 * rng.normal(size=(400, 2))
    points = np.concatenate([cones, rng.uniform(0.0, 200.0, (400, 2))])
    table = DetectionTable.of([Detections(0.0, points, np.tile(np.eye(2), (800, 1, 1)), np.zeros(800, int))])
    table.used[:200] = True  # the map has every other cone
    of_cones = are_of_cones(table, points)
    assert of_cones[:400].all()
    assert of_cones[400:].mean() < 0.05


def test_both_boundaries_of_a_lap_are_closed() -> None:
    left, right = ring(18.0), ring(24.0)
    arc = replace(right, periodic=False)
    for curves in ({LEFT: left}, {LEFT: left, RIGHT: arc}):
        assert objection(curves, circle(20.0), USED) == "not both of its boundaries are closed"
