"""The inactive map: deactivation and reactivation change neither the Gaussian nor the steps."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.gaussian import graph_of, keys_of, normal_equations
from pathspace_graph.graph.inactive import InactiveMap
from pathspace_graph.graph.rows import jacobian_factors
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    CONTROL_LETTERS,
    Layout,
    Variables,
    control_keys,
    pose_keys,
)
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.mapping import smoother as curve_smoother
from pathspace_graph.mapping.smoother import CurveSmoother
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import bean_track, lap_log, map_log
from ..scenes.graph import columns_of, random_graph, rows_in, schur
from ..scenes.linear_drive import LinearDrive

POINTS = control_keys(0, np.arange(4))
OLD, NEW = pose_keys(np.array([5])), pose_keys(np.array([9]))
KEYS = np.concatenate([[CALIBRATION_KEY], POINTS, OLD, NEW])


def two_parts(
    rng: np.random.Generator,
) -> tuple[gtsam.GaussianFactorGraph, gtsam.GaussianFactorGraph, InactiveMap]:
    """Returns the prior on all keys, and the prior and inactive map after points 0 and 1 are deactivated.

    Point 0 has the anchor 5, and point 1 the anchor 9. Pose 9 has a factor with pose 5, which is eliminated
    with point 1.
    """
    first, *_ = random_graph(rng, [np.concatenate([[CALIBRATION_KEY], POINTS, OLD])], KEYS)
    tie, *_ = random_graph(rng, [np.append(OLD, NEW)], KEYS)
    inactive, nobody = InactiveMap(), np.zeros(0, np.intp)
    left = inactive.push(first, POINTS[:1], nobody)
    assert inactive.anchors.tolist() == OLD.tolist()
    left = inactive.push(graph_of(left, tie), POINTS[1:2], OLD)
    assert inactive.anchors.tolist() == NEW.tolist()
    return graph_of(first, tie), left, inactive


def system(graph: gtsam.GaussianFactorGraph, without: IntArray) -> tuple[Layout, Array, Array]:
    """Information form of all keys of a graph but some, by the dense covariance."""
    layout = Layout(keys_of(graph))
    gone = np.intersect1d(without, layout.keys)
    rest = Layout(np.setdiff1d(layout.keys, gone))
    hessian, vector = normal_equations(graph, layout)
    return rest, *schur(hessian, vector, layout.entries(gone))


def test_what_left_comes_back_as_it_was() -> None:
    """The first anchor has been eliminated with the second point."""
    whole, left, inactive = two_parts(np.random.default_rng(0))
    assert len(inactive) == 2 and inactive.keys.tolist() == POINTS[:2].tolist()
    assert np.intersect1d(keys_of(left), [*POINTS[:2], *OLD]).size == 0
    joined = inactive.joint_prior(left)
    rest, information, vector = system(whole, OLD)
    found, found_vector = normal_equations(joined, rest)
    np.testing.assert_allclose(found, information, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(found_vector, vector, atol=1e-9 * np.abs(information).max())


def test_what_stays_is_the_marginal() -> None:
    whole, left, _ = two_parts(np.random.default_rng(1))
    rest, information, vector = system(whole, np.append(OLD, POINTS[:2]))
    found, found_vector = normal_equations(left, rest)
    np.testing.assert_allclose(found, information, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(found_vector, vector, atol=1e-9 * np.abs(information).max())


def test_the_inactive_part_follows_the_active_part_to_the_joint_mean() -> None:
    """This holds after another measurement has moved the active variables, too."""
    rng = np.random.default_rng(2)
    whole, _, inactive = two_parts(rng)
    more, *_ = random_graph(rng, [np.append(POINTS[2:], NEW)], KEYS)
    rest, information, vector = system(graph_of(whole, more), OLD)
    mean = np.linalg.solve(information, vector)
    variables = Variables()
    variables.insert(rest.keys, rng.normal(size=rest.size))
    active = np.setdiff1d(rest.keys, POINTS[:2])
    entries = variables.layout.entries(active)
    variables.values[entries] = variables.reference[entries] + mean[columns_of(active, rest.keys)]
    variables.values[variables.layout.entries(POINTS[:2])] = np.nan
    inactive.refresh(variables)
    np.testing.assert_allclose(variables.values - variables.reference, mean, atol=1e-9)


def test_an_empty_inactive_map_changes_nothing() -> None:
    inactive, variables = InactiveMap(), Variables()
    graph, *_ = random_graph(np.random.default_rng(3), [POINTS], POINTS)
    inactive.refresh(variables)
    assert inactive.joint_prior(graph) is graph
    assert len(inactive) == 0 and len(inactive.anchors) == 0


# --- in a window -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [1, 2])
def test_a_drive_with_inactive_points_is_that_without_and_that_of_the_batch(lag: int) -> None:
    """Points are deactivated four times: mean and covariance of all variables are the same."""
    drive, whole = LinearDrive(lag), LinearDrive(lag)
    leaving = {5: 2, 7: 3, 8: 5, 11: 7}
    for cycle in range(15):
        drive.drive(1)
        whole.drive(1)
        if cycle in leaving:
            drive.deactivate(leaving[cycle])
        smoother = drive.smoother
        known = whole.smoother.variables.keys
        active = np.intersect1d(smoother.layout.keys, known)
        np.testing.assert_allclose(
            smoother.variables.of(active), whole.smoother.variables.of(active), atol=1e-8
        )
        if cycle in (6, 9, 14):
            expected = whole.smoother.covariance(known)
            np.testing.assert_allclose(smoother.covariance(known), expected, atol=1e-9 * expected.max())
            np.testing.assert_allclose(drive.covariance(known), expected, atol=1e-9 * expected.max())
            np.testing.assert_allclose(smoother.variables.of(known), drive.mean(known), atol=1e-8)
    assert len(smoother.inactive) == 4
    assert smoother.layout.size < whole.smoother.layout.size
    assert len(smoother.variables.keyframes) == 1


def test_after_reactivation_the_prior_is_that_without_inactive_points() -> None:
    """The drive goes on as if nothing had been deactivated, also a second time."""
    drive, whole = LinearDrive(2), LinearDrive(2)
    for leaving in ((1, 4), (3, 6)):
        for before in leaving:
            drive.drive(4)
            whole.drive(4)
            drive.deactivate(before)
        drive.drive(1)
        whole.drive(1)
        drive.smoother.reactivate()
        ours, theirs = drive.smoother, whole.smoother
        np.testing.assert_array_equal(ours.variables.keys, theirs.variables.keys)
        np.testing.assert_allclose(ours.variables.values, theirs.variables.values, atol=1e-8)
        layout = Layout(keys_of(theirs.prior))
        expected = normal_equations(theirs.prior, layout)
        found = normal_equations(ours.prior, layout)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(expected[0]).max())
        assert len(ours.inactive) == 0 and ours.layout is ours.variables.layout
    np.testing.assert_allclose(ours.variables.values, drive.mean(ours.variables.keys), atol=1e-8)


def test_the_active_variables_are_all_others_also_when_more_become_known() -> None:
    drive = LinearDrive(2)
    drive.drive(8)
    smoother = drive.smoother
    inactive, layout = smoother.inactive, smoother.variables.layout
    assert inactive.active(layout)[0] is layout
    drive.deactivate(3)
    active, _ = inactive.active(smoother.variables.layout)
    np.testing.assert_array_equal(
        active.keys, np.setdiff1d(smoother.variables.keys, control_keys(0, np.arange(3)))
    )
    assert inactive.active(smoother.variables.layout)[0] is active
    new = control_keys(1, np.arange(2))
    smoother.variables.insert(new, np.zeros(4))
    found, _ = inactive.active(smoother.variables.layout)
    np.testing.assert_array_equal(found.keys, np.union1d(active.keys, new))
    drive.deactivate(5)
    assert not np.isin(control_keys(0, np.arange(5)), smoother.layout.keys).any()


# --- in the mapper ---------------------------------------------------------------------------------------


@pytest.fixture
def eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Control points are deactivated early and often."""
    monkeypatch.setattr(curve_smoother, "FAR_STRETCH", 5.0)
    monkeypatch.setattr(curve_smoother, "FAR_ROOM", 3.0)


class Checked(CurveSmoother):
    """A smoother that compares every step on a closed map with a dense solution of the whole system."""

    worst = 0.0
    checked = 0

    def step(self, sigma_step: float | None = None) -> None:
        variables = self.variables
        self.refresh()
        before = {key: variables.of(np.array([key])) for key in variables.keys.tolist()}
        super().step(sigma_step)
        if len(self.inactive) == 0 or self.chain is not None:
            return
        assert sigma_step is not None
        kept = jacobian_factors(rows_in(self.window.measured), self.variables.layout)
        graph = graph_of(self.prior, self.inactive.net, *kept.values())
        whole = Layout(keys_of(graph))
        hessian, vector = normal_equations(graph, whole)
        own = np.setdiff1d(self.layout.keys, self.inactive.keys)
        points = [key for key in own.tolist() if chr(key >> 56) in CONTROL_LETTERS]
        entries = columns_of(np.array(points), whole.keys)
        start = np.concatenate([before[key] for key in points])
        start = start - variables.reference[variables.layout.entries(np.array(points))]
        hessian[entries, entries] += sigma_step**-2
        vector[entries] += sigma_step**-2 * start
        expected = np.linalg.solve(hessian, vector)[whole.entries(variables.keys)]
        self.refresh()
        self.worst = max(self.worst, float(np.abs(variables.values - variables.reference - expected).max()))
        self.checked += 1


@pytest.mark.slow
@pytest.mark.usefixtures("eager")
def test_steps_of_the_active_variables_are_steps_of_the_whole_system() -> None:
    """The log has two laps: the curves grow, and are closed."""
    log = lap_log(bean_track(), overrun=100.0)
    mapper = FixedLagMapper(None, log.odometry_sigma)
    mapper.road.smoother = smoother = Checked(MapperSettings())
    smoother.attached = [smoother.map, mapper.road.path, mapper.road.growth.tentative, mapper.road.orange]
    map_log(log, mapper)
    assert mapper.closed
    assert smoother.checked > 0.3 * len(log.cycles)
    assert smoother.worst < 1e-8


@pytest.mark.usefixtures("eager")
@pytest.mark.parametrize("cycles", [90, pytest.param(240, marks=pytest.mark.slow)])
def test_reactivation_does_not_change_the_map(cycles: int) -> None:
    """Map, covariance and calibration stay the same, while the loop is open and after it has closed."""
    log = lap_log(bean_track(), overrun=100.0)
    mapper = FixedLagMapper(None, log.odometry_sigma)
    for _, (odometry, cycle) in zip(range(cycles), split_odometry(log), strict=False):
        mapper.update(odometry, cycle)
    assert mapper.closed == (cycles == 240)
    smoother = mapper.road.smoother
    smoother.transform_to_origin()
    assert len(smoother.inactive) >= (1 if mapper.closed else 3)
    size, before, calibration = smoother.layout.size, mapper.map(), mapper.calibration.copy()
    keys = np.append(smoother.map.state.map_keys, pose_keys(np.array([smoother.next_cycle - 1])))
    covariance = smoother.covariance(keys)
    smoother.reactivate()
    assert smoother.layout.size > size and smoother.map.state.whole
    after = mapper.map()
    np.testing.assert_array_equal(mapper.calibration, calibration)
    scale, rtol = np.abs(covariance).max(), 1e-6
    np.testing.assert_allclose(smoother.covariance(keys)[-3:, -3:], covariance[-3:, -3:], rtol=rtol)
    atol = rtol * scale
    for label, boundary in before.boundaries.items():
        other = after.boundaries[label]
        assert isinstance(boundary, SplineBoundary) and isinstance(other, SplineBoundary)
        np.testing.assert_allclose(other.spline.control_points, boundary.spline.control_points, atol=1e-9)
        np.testing.assert_allclose(other.covariance, boundary.covariance, rtol=rtol, atol=atol)
