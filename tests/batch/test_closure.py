"""When a loop is tried, and which closed results are believed: courses that are driven again or aren't."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.batch.lap import ClosureEvidence, evidence, is_true_closure, is_worth_trying, objection
from pathspace_graph.batch.mapper import BatchMapper, find_closed_optimum
from pathspace_graph.batch.optimizer import LOOSE_GATE, Convergence, Optimizer
from pathspace_graph.batch.simplification import own_settings
from pathspace_graph.batch.start import Recurrence, find_recurrence, start_odometry
from pathspace_graph.batch.system import BatchSystem, Biweight, Evaluation
from pathspace_graph.front_end.front_end import judge_log
from pathspace_graph.io.log import Log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionTable
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

from ..scenes.batch import COURSE, course_log
from ..scenes.drives import noisy

Array = NDArray[np.float64]

SETTINGS = own_settings(MapperSettings())

BELIEVED = ClosureEvidence(
    closed=True, used=0.95, used_again=0.95, misfit=1.0, gap=6.0, overlap=40.0, sigma=0.05
)


def path_of(laps: float) -> Recurrence:
    """Returns a path that recurs after 100 m, of this number of laps."""
    return Recurrence(np.array([0.0, 100.0 * laps]), 100.0, 2.0 * np.pi, 0.95)


def test_a_loop_is_tried_after_a_good_part_of_the_second_lap() -> None:
    assert is_worth_trying(path_of(1.35), SETTINGS)
    assert not is_worth_trying(path_of(1.25), SETTINGS)
    assert not is_worth_trying(Recurrence(path_of(1.35).driven), SETTINGS)


@pytest.mark.parametrize(
    "against",
    [
        {"closed": False},
        {"used": 0.5, "used_again": 0.5},
        {"used_again": 0.7},
        {"misfit": 2.0},
        {"gap": 40.0},
        {"overlap": 10.0},
        {"sigma": 0.5},
    ],
)
def test_a_closed_result_needs_evidence_in_every_respect(against: dict[str, float]) -> None:
    assert is_true_closure(BELIEVED, SETTINGS)
    assert not is_true_closure(replace(BELIEVED, **against), SETTINGS)  # type: ignore[arg-type]


# --- drives ----------------------------------------------------------------------------------------------


def optimizer_of(log: Log) -> Optimizer:
    """Returns the optimizer of a log's batch."""
    chain = judge_log(log, log.noise, SETTINGS).chain
    system = BatchSystem(DetectionTable.of(log.cycles), chain, SETTINGS, Biweight(LOOSE_GATE))
    return Optimizer(system)


@cache
def driven(laps: float) -> Log:
    """Returns a drive on the course whose measurements have noise."""
    return noisy(course_log(laps), seed=3)


@cache
def closed() -> tuple[BatchSystem, Evaluation, Convergence]:
    """Returns the problem of a closed course, and its optimum."""
    optimizer = optimizer_of(driven(1.4))
    found = find_closed_optimum(optimizer)
    assert found is not None
    return optimizer.system, *found


def test_a_course_that_is_driven_again_is_closed() -> None:
    """The longest gap is that of a few cones, and the overlap is what was driven of the second lap."""
    system, at, convergence = closed()
    found = evidence(at, system.detections, SETTINGS)
    assert convergence.converged
    assert is_true_closure(found, SETTINGS)
    assert found.used > 0.95
    assert found.used_again > 0.95
    assert 0.7 < found.misfit < 1.3
    inner = min(boundary.length for boundary in at.state.boundaries.values())
    np.testing.assert_allclose(found.overlap, 0.4 * inner, atol=2.0)


@pytest.mark.parametrize("around", [0.0, 45.0])
def test_a_hole_across_the_seam_of_a_curve_is_as_long_as_one_elsewhere(around: float) -> None:
    """No detection is used within 15 m of a place of the left boundary: 30 m, and up to two cones."""
    system, state = deepcopy(closed()[0]), closed()[1].state
    detections, length = system.detections, state.boundaries[LEFT].length
    away = np.abs(np.mod(detections.u - around + 0.5 * length, length) - 0.5 * length)
    detections.release(np.flatnonzero((detections.boundary == LEFT) & (away < 15.0)))
    found = evidence(system.evaluate(state), detections, SETTINGS)
    assert found.gap == pytest.approx(33.0, abs=3.0)
    assert not is_true_closure(replace(BELIEVED, gap=found.gap), SETTINGS)


def test_a_loop_that_is_closed_short_of_the_lap_is_not_believed() -> None:
    """The path is said to recur after three quarters of the course."""
    optimizer = optimizer_of(driven(1.4))
    chain, detections = optimizer.system.chain, optimizer.system.detections
    driven_to = find_recurrence(chain.dead_reckoned(np.zeros(2)), SETTINGS).driven
    too_short = Recurrence(driven_to, 0.75 * COURSE, 2.0 * np.pi, 1.0)
    state = start_odometry(chain, detections, SETTINGS, too_short)
    at, _ = optimizer.find(state)
    assert not is_true_closure(evidence(at, detections, SETTINGS), SETTINGS)


def test_a_course_that_ends_before_the_line_stays_open() -> None:
    log = driven(0.9)
    result = BatchMapper(None, log.odometry_sigma).solve(log, "odometry")
    assert not result.map.closed


def test_a_denied_recurrence_gives_open_curves() -> None:
    optimizer = optimizer_of(driven(1.4))
    chain, detections = optimizer.system.chain, optimizer.system.detections
    recurrence = find_recurrence(chain.dead_reckoned(np.zeros(2)), SETTINGS)
    assert recurrence.recurs
    state = start_odometry(chain, detections, SETTINGS, Recurrence(recurrence.driven))
    at = optimizer.system
    at.begin(state)
    assert not any(boundary.periodic for boundary in state.boundaries.values())
    assert not evidence(at.evaluate(state), detections, SETTINGS).closed


# --- what speaks against a closing -----------------------------------------------------------------------


def ring(radius: float, centre: float = 0.0) -> BSpline:
    """A closed curve about a circle around (centre, 0)."""
    phi = np.arange(12) * np.pi / 6.0
    points = radius * np.column_stack([np.cos(phi), np.sin(phi)]) + [centre, 0.0]
    return BSpline(np.arange(-3.0, 16.0), np.concatenate([points, points[:3]]), 3, True)


def circle(radius: float, centre: float = 0.0) -> Array:
    """Poses once around."""
    phi = np.linspace(0.0, 2.0 * np.pi, 60)
    return np.column_stack([centre + radius * np.cos(phi), radius * np.sin(phi), phi + 0.5 * np.pi])


def test_nothing_speaks_against_a_road_around_its_drive() -> None:
    assert objection(BELIEVED, {LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0), SETTINGS) == ""


def test_boundaries_that_cross_are_no_road() -> None:
    against = objection(BELIEVED, {LEFT: ring(18.0), RIGHT: ring(24.0, 8.0)}, circle(15.0), SETTINGS)
    assert against == "its boundaries cross"


def test_a_vehicle_crosses_no_boundary() -> None:
    against = objection(BELIEVED, {LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0, 4.0), SETTINGS)
    assert against == "the vehicle would have crossed a boundary"


def test_a_vehicle_has_driven_beside_all_of_a_boundary() -> None:
    """A quarter of the circle was never driven: the curves only bridge it."""
    driven = circle(20.0)[:45]
    against = objection(BELIEVED, {LEFT: ring(18.0), RIGHT: ring(24.0)}, driven, SETTINGS)
    assert against.startswith("a boundary would be ") and against.endswith(
        " as far from the drive as it is beside it"
    )


def test_where_cycles_are_missing_nothing_is_asked_of_the_boundaries() -> None:
    """The drive's step over a quarter of the circle crosses the inner boundary, but the vehicle did not."""
    curves = {LEFT: ring(18.0), RIGHT: ring(24.0)}
    whole = circle(20.0)
    without = np.delete(whole, np.arange(20, 35), axis=0)
    assert objection(BELIEVED, curves, without, SETTINGS) == ""
    narrow = {LEFT: ring(18.0), RIGHT: ring(24.0, 8.0)}
    assert objection(BELIEVED, narrow, np.delete(circle(15.0), np.arange(20, 35), axis=0), SETTINGS) != ""


def test_the_detections_of_a_lap_lie_on_its_boundaries() -> None:
    few = replace(BELIEVED, used=0.62)
    against = objection(few, {LEFT: ring(18.0), RIGHT: ring(24.0)}, circle(20.0), SETTINGS)
    assert against == "only 62 % of the detections lie on its boundaries"
