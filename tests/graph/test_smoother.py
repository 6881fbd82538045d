"""The fixed-lag smoother: its functions one by one, its estimate against a batch, and its covariances."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.gaussian import factorize, keys_of, normal_equations, upper_root
from pathspace_graph.graph.rows import Rows, calibrated_delta
from pathspace_graph.graph.smoother import FixedLagSmoother, merge_points, restart, set_prior
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE, Layout, control_keys, pose_key, pose_keys
from pathspace_graph.graph.window import SmootherSettings
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings, RelinearizeSettings

from ..scenes.drives import ODOMETRY_SIGMA, bean_track, lap_log
from ..scenes.graph import columns_of, rows_in
from ..scenes.linear_drive import LinearDrive, LinearTrack

# --- poses that come and go ------------------------------------------------------------------------------

SETTINGS = SmootherSettings(lag=2.0, tolerances=(1e-9, 1e-9), sigmas_calibrations=(0.25, 0.5))
ODOMETRY = integrate_twists(np.full(4, 0.25), np.tile([8.0, 0.1, 0.4], (4, 1)), np.array([0.2, 0.1, 0.05]))


def test_a_new_smoother_knows_the_calibration_as_its_settings_say() -> None:
    smoother = FixedLagSmoother(SETTINGS, LinearTrack(0))
    information, vector = normal_equations(smoother.prior, smoother.layout)
    np.testing.assert_allclose(information, np.diag([16.0, 4.0]))
    np.testing.assert_array_equal(vector, 0.0)
    assert (smoother.first_cycle, smoother.next_cycle) == (0, 0)


def test_the_first_pose_is_predicted_from_the_start_with_both_uncertainties() -> None:
    smoother = FixedLagSmoother(SETTINGS, LinearTrack(0))
    pose = smoother.predict(3.0, ODOMETRY, (0.1, 0.2, 0.3))
    np.testing.assert_allclose(pose, ODOMETRY.delta, atol=1e-12)
    expected = ODOMETRY.covariance + np.diag([0.01, 0.04, 0.09])
    found = factorize(smoother.prior, smoother.layout).covariance(pose_keys(np.array([0])))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert smoother.times == [3.0]
    assert len(smoother.window.odometry) == 0


def test_the_next_pose_is_predicted_by_the_calibrated_odometry() -> None:
    smoother = FixedLagSmoother(SETTINGS, LinearTrack(0))
    first = smoother.predict(0.0, ODOMETRY, (0.1, 0.2, 0.3))
    smoother.variables.calibration[:] = 0.02, -0.1
    second = smoother.predict(1.0, ODOMETRY, (0.1, 0.2, 0.3))
    expected = compose(first, calibrated_delta(ODOMETRY, np.array([0.02, -0.1])))
    np.testing.assert_allclose(second, expected, atol=1e-12)
    np.testing.assert_array_equal(smoother.variables.poses, [first, second])
    assert (smoother.times, smoother.next_cycle, len(smoother.window.odometry)) == ([0.0, 1.0], 2, 1)


@pytest.mark.parametrize(("late", "first"), [(0.0, 3), (1e-10, 3), (1e-6, 4), (1.0, 4), (100.0, 5)])
def test_a_pose_leaves_when_it_is_older_than_the_lag_and_the_newest_stays(late: float, first: int) -> None:
    """Cycles 3, 4 and 5 are in a window of two seconds; the newest stamp is `late` by that much."""
    drive = LinearDrive(2)
    drive.drive(6)
    smoother = drive.smoother
    smoother.times[-1] += late
    smoother.marginalize()
    assert smoother.first_cycle == first
    assert len(smoother.times) == len(smoother.variables.poses) == smoother.next_cycle - first
    assert len(smoother.window.odometry) == len(smoother.times) - 1
    assert not (smoother.layout.positions(pose_keys(np.arange(first))) >= 0).any()


def test_merged_points_are_known_as_well_as_both_together() -> None:
    """The merged prior at any values has the old prior's error where both points are at the same place."""
    drive = LinearDrive(2)
    drive.drive(8)
    smoother, rng = drive.smoother, np.random.default_rng(0)
    gone, kept = control_keys(0, np.array([4])), control_keys(0, np.array([5]))
    old = Layout(keys_of(smoother.prior))
    before, variables = normal_equations(smoother.prior, old), smoother.variables.copy()
    at_kept = variables.of(kept)
    merge_points(smoother, gone, kept)
    assert (smoother.variables.layout.positions(gone) < 0).all()
    np.testing.assert_array_equal(smoother.variables.of(kept), at_kept)
    new = Layout(keys_of(smoother.prior))
    after, errors = normal_equations(smoother.prior, new), []
    for _ in range(4):
        variables.values = rng.normal(size=len(variables.values))
        variables.values[variables.layout.entries(gone)] = variables.of(kept)
        at = [variables.change(variables.layout.entries(layout.keys)) for layout in (old, new)]
        errors.append([0.5 * d @ H @ d - g @ d for d, (H, g) in zip(at, (before, after), strict=True)])
    lost = np.diff(errors, axis=1)[:, 0]
    np.testing.assert_allclose(lost, lost[0], atol=1e-8 * np.abs(errors).max())


def test_nothing_to_reactivate_changes_nothing() -> None:
    drive = LinearDrive(2)
    drive.drive(5)
    smoother = drive.smoother
    before = smoother.prior, smoother.inactive
    smoother.reactivate()
    smoother.deactivate(np.zeros(0, np.intp))
    smoother.refresh()
    assert (smoother.prior, smoother.inactive) == before


# --- a linear drive --------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [1, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_window_on_a_linear_drive_is_full_batch(lag: int, seed: int) -> None:
    """Mean and joint covariance of all variables agree, however many poses have been marginalized."""
    drive = LinearDrive(lag, seed)
    drive.drive(14)
    smoother, keys = drive.smoother, drive.smoother.variables.keys
    assert len(smoother.times) == lag + 1
    assert keys.tolist() == np.delete(drive.keys, np.arange(13, 13 + 14 - lag - 1)).tolist()
    np.testing.assert_allclose(smoother.variables.values, drive.mean(keys), rtol=1e-8, atol=1e-8)
    expected = drive.covariance(keys)
    np.testing.assert_allclose(smoother.covariance(keys), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("means", [(0.0, 0.0), (0.4, -0.9)])
@pytest.mark.parametrize("sigmas", [(0.7, 3.0), (0.05, 0.1)], ids=["wider", "narrower"])
def test_another_prior_of_the_calibration_is_one_that_was_known_from_the_start(
    means: tuple[float, float], sigmas: tuple[float, float]
) -> None:
    """The window, with poses marginalized before and after, is that of a smoother made with the other prior.

    It is the batch with that prior, too.
    """
    changed, other = LinearDrive(2), LinearDrive(2, means=means, sigmas=sigmas)
    for drive in (changed, other):
        drive.drive(9)
    before = changed.smoother.variables.calibration.copy()
    changed.smoother.set_calibration_priors(np.array(means), np.array(sigmas))
    for drive in (changed, other):
        drive.drive(3)
    ours, theirs = changed.smoother, other.smoother
    assert np.abs(ours.variables.calibration - before).max() > 1e-3
    keys = ours.variables.keys
    np.testing.assert_allclose(ours.variables.values, theirs.variables.values, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(ours.variables.values, other.mean(keys), rtol=1e-7, atol=1e-7)
    expected = theirs.covariance(keys)
    np.testing.assert_allclose(ours.covariance(keys), expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(other.covariance(keys), expected, atol=1e-8 * np.abs(expected).max())


def test_the_prior_of_a_calibration_can_be_changed_several_times_and_back() -> None:
    """Only the newest prior counts; one that is the same changes nothing."""
    changed, other = LinearDrive(2), LinearDrive(2)
    for drive in (changed, other):
        drive.drive(5)
    for means, sigmas in (((0.4, -0.9), (0.7, 3.0)), ((0.1, 0.2), (2.0, 0.2)), ((0.0, 0.0), (0.3, 0.5))):
        changed.smoother.set_calibration_priors(np.array(means), np.array(sigmas))
        prior = changed.smoother.prior
        changed.smoother.set_calibration_priors(np.array(means), np.array(sigmas))
        assert changed.smoother.prior is prior
    for drive in (changed, other):
        drive.drive(3)
    ours, theirs = changed.smoother.variables, other.smoother.variables
    np.testing.assert_allclose(ours.values, theirs.values, rtol=1e-7, atol=1e-7)


def test_covariance_is_in_the_order_of_the_keys() -> None:
    drive = LinearDrive(3)
    drive.drive(6)
    keys = np.array([pose_key(5), control_keys(0, np.array(2)), CALIBRATION_KEY, pose_key(3)])
    np.testing.assert_allclose(drive.smoother.covariance(keys), drive.covariance(keys), rtol=1e-7, atol=1e-10)


def test_marginalization_is_a_schur_complement() -> None:
    """The covariance of all remaining variables is the same before and after."""
    drive = LinearDrive(2)
    drive.drive(3)
    smoother = drive.smoother
    while smoother.times[-1] - smoother.times[0] < 3.0:
        drive.predict()
        smoother.step()
    before = smoother.linear_graph()
    smoother.marginalize()
    layout = smoother.layout
    left = np.setdiff1d(keys_of(before), layout.keys)
    assert left.tolist() == [pose_key(0)]
    whole = Layout(keys_of(before))
    joint = np.linalg.inv(normal_equations(before, whole)[0])
    stay = whole.entries(layout.keys)
    after = np.linalg.inv(normal_equations(smoother.linear_graph(), layout)[0])
    np.testing.assert_allclose(after, joint[np.ix_(stay, stay)], rtol=1e-8, atol=1e-11)


def test_a_damped_step_adds_to_the_diagonal_of_the_map_points_alone() -> None:
    drive = LinearDrive(4)
    drive.drive(4)
    smoother = drive.smoother
    hessian, vector = normal_equations(smoother.linear_graph(), smoother.layout)
    now = smoother.variables.change(np.arange(smoother.layout.size))
    points = np.flatnonzero(np.isin(np.repeat(smoother.layout.keys, smoother.layout.widths), drive.keys[1:7]))
    negative_gradient = smoother.factorize(0.3)
    np.testing.assert_allclose(negative_gradient, vector - hessian @ now, atol=1e-8 * np.abs(vector).max())
    hessian[points, points] += 0.3**-2
    assert smoother.last_step is not None
    lower = np.tril(smoother.last_step.factor)
    np.testing.assert_allclose(lower @ lower.T, hessian, atol=1e-10 * hessian.max())
    keys = np.append(drive.keys[[3, 1]], pose_key(2))
    entries = smoother.layout.entries(keys)
    expected = np.linalg.inv(hessian)[np.ix_(entries, entries)]
    np.testing.assert_allclose(smoother.last_covariance(keys), expected, rtol=1e-7, atol=1e-10)


def test_looking_at_the_graph_changes_nothing() -> None:
    drive, left_alone = LinearDrive(3), LinearDrive(3)
    for one in (drive, left_alone):
        one.drive(6)
    drive.smoother.linear_graph()
    drive.smoother.covariance(pose_keys(np.array([5])))
    for one in (drive, left_alone):
        one.drive(3)
    np.testing.assert_array_equal(drive.smoother.variables.values, left_alone.smoother.variables.values)


def test_a_variable_that_nothing_holds_is_named() -> None:
    drive = LinearDrive(3)
    drive.drive(5)
    drive.smoother.variables.insert(pose_keys(np.array([0])), np.zeros(POSE))
    with pytest.raises(SingularSystemError, match=r"none on x0$"):
        drive.smoother.covariance(pose_keys(np.array([4])))


def test_removing_information_on_a_point_keeps_the_window_and_all_other_points() -> None:
    """The prior no longer holds the point, and the covariance of all other points is the same."""
    drive = LinearDrive(2)
    drive.drive(8)
    smoother, gone = drive.smoother, control_keys(0, np.array([5, 6]))
    layout = Layout(keys_of(smoother.prior))
    assert np.isin(gone, layout.keys).all()
    rest = Layout(np.setdiff1d(layout.keys, gone))
    stay = layout.entries(rest.keys)
    hessian, vector = normal_equations(smoother.prior, layout)
    hessian = hessian + 1e-9 * np.eye(len(hessian))
    joint = np.linalg.inv(hessian)
    smoother.remove_information(gone)
    found, found_vector = normal_equations(smoother.prior, rest)
    found = found + 1e-9 * np.eye(len(found))
    expected = np.linalg.inv(joint[np.ix_(stay, stay)])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    mean = (joint @ vector)[stay]
    np.testing.assert_allclose(found_vector, expected @ mean, atol=1e-4 * np.abs(found_vector).max())
    assert np.isfinite(smoother.covariance(gone)).all()


# --- relinearization in the mapper -----------------------------------------------------------------------


def drive_bean(settings: MapperSettings, cycles: int) -> FixedLagMapper:
    """A mapper somewhere on a lap, with the tolerances that hold after it has closed."""
    mapper = FixedLagMapper(settings, ODOMETRY_SIGMA)
    mapper.road.smoother.window.exact = False
    for _, (odometry, cycle) in zip(range(cycles), split_odometry(lap_log(bean_track(), 0.0)), strict=False):
        mapper.update(odometry, cycle)
    return mapper


def rows_of(mapper: FixedLagMapper) -> dict[int, Array]:
    """The rows of each cycle as they were linearized last."""
    kept = mapper.road.smoother.window.measured
    return {
        owner: np.sort(np.concatenate([rows.residual[rows.owner == owner] for rows in rows_in(kept)]))
        for owner in np.unique(np.concatenate([rows.owner for rows in rows_in(kept)])).tolist()
    }


@pytest.mark.slow
def test_the_tolerance_holds_once_the_loop_has_closed() -> None:
    mapper = FixedLagMapper(odometry_sigma=ODOMETRY_SIGMA)
    for odometry, cycle in split_odometry(lap_log(bean_track(), 45.0)):
        mapper.update(odometry, cycle)
        assert mapper.road.smoother.window.exact is not mapper.closed
    assert mapper.closed


@pytest.mark.parametrize("into_use", [False, True])
def test_a_reading_that_goes_in_or_out_of_use_makes_its_cycle_stale(into_use: bool) -> None:
    mapper = drive_bean(MapperSettings(relinearize=RelinearizeSettings(1e3, 1e3)), 60)
    smoother, detections = mapper.road.smoother, mapper.road.smoother.map.detections
    cycle = smoother.first_cycle + 5
    row = np.flatnonzero(detections.used & (detections.cycle == cycle))[:1]
    where = detections.boundary[row].copy(), detections.u[row].copy()
    smoother.step(0.5)
    if into_use:
        detections.release(row)
        smoother.step(0.5)
    before = rows_of(mapper)
    if into_use:
        detections.take(row, *where)
    else:
        detections.release(row)
    smoother.step(0.5)
    after = rows_of(mapper)
    new = [c for c, rows in before.items() if not np.array_equal(after[c], rows)]
    assert new == [cycle]
    assert len(after[cycle]) == len(before[cycle]) + (1 if into_use else -1)
    smoother.step(0.5)
    again = rows_of(mapper)
    assert all(np.array_equal(again[c], rows) for c, rows in after.items())
    assert not detections.changed.any()


def test_the_steps_system_is_that_of_the_graph_at_the_estimate() -> None:
    """Everything is linearized again here: no factor is stale, missing or counted twice."""
    settings = MapperSettings(relinearize=RelinearizeSettings(1e-12, 1e-12))
    smoother = drive_bean(settings, 25).road.smoother
    assert len(smoother.inactive) == 0
    smoother.factorize()
    assert smoother.last_step is not None
    lower = np.tril(smoother.last_step.factor)
    hessian, _ = normal_equations(smoother.linear_graph(), smoother.layout)
    np.testing.assert_allclose(lower @ lower.T, hessian, atol=1e-9 * hessian.max())


# --- uncertainty -----------------------------------------------------------------------------------------


def numeric_end(mapper: FixedLagMapper) -> tuple[Array, Array, Array]:
    """Derivatives of the newest pose by the one before, by the calibration, and by the odometry's noise."""
    start, odometry = mapper.poses[-2].copy(), mapper.road.smoother.window.odometry
    delta, G = odometry.deltas[-1], odometry.by_calibration[-1]
    b = mapper.calibration.copy()

    def end(x: Array, c: Array, w: Array) -> Array:
        return compose(compose(x, delta), w - G @ c)

    columns = []
    for at, size in ((0, POSE), (1, 2), (2, POSE)):
        inputs, matrix = [start, b, np.zeros(POSE)], np.zeros((POSE, size))
        for j in range(size):
            sides = []
            for step in (1e-6, -1e-6):
                moved = [one.copy() for one in inputs]
                moved[at][j] += step
                sides.append(end(*moved))
            matrix[:, j] = (sides[0] - sides[1]) / 2e-6
        columns.append(matrix)
    return columns[0], columns[1], columns[2]


@pytest.mark.parametrize("together", [1, 2])
def test_predicted_is_that_of_the_dense_joint_covariance_with_the_newest_pose(together: int) -> None:
    """The newest pose was not in the step: its odometry predicts it and adds noise."""
    mapper = drive_bean(MapperSettings(), 59)
    smoother, odometry = mapper.road.smoother, list(split_odometry(lap_log(bean_track(), 0.0)))[59]
    reading = mapper.front_end.update(*odometry)
    mapper.road.predict(reading.motion, reading.orange)
    step = smoother.last_step
    assert step is not None
    lower = np.tril(step.factor)
    joint = np.linalg.inv(lower @ lower.T)
    by_last, by_calibration, by_noise = numeric_end(mapper)
    size = step.layout.size
    reach = np.zeros((POSE, size))
    reach[:, columns_of(pose_keys(np.array([smoother.next_cycle - 2])), step.layout.keys)] = by_last
    reach[:, columns_of(np.array([CALIBRATION_KEY]), step.layout.keys)] = by_calibration
    whitener = smoother.window.odometry.whiteners[-1]
    noise = by_noise @ np.linalg.inv(whitener.T @ whitener) @ by_noise.T
    whole = np.block([[joint, joint @ reach.T], [reach @ joint, reach @ joint @ reach.T + noise]])
    everything = np.append(step.layout.keys, pose_key(smoother.next_cycle - 1))

    rng, newest = np.random.default_rng(0), smoother.next_cycle - 1
    cycles = np.repeat([newest, newest - 1, newest, newest - 12], together)
    points = rng.choice(smoother.map.state.map_keys, (len(cycles), 2), replace=True)
    points[points[:, 0] == points[:, 1], 1] = smoother.map.state.map_keys[0]
    keys = np.column_stack([pose_keys(cycles), points])
    rows = Rows(keys, rng.normal(size=(len(keys), POSE + 4)), np.zeros(len(keys)), cycles)
    J = np.zeros((len(keys), size + POSE))
    for i in range(len(keys)):
        np.add.at(J[i], columns_of(keys[i], everything), rows.jacobian[i])
    dense = J @ whole @ J.T
    found = smoother.predicted_covariance(rows, together)
    assert found.shape == (len(keys) // together, together, together)
    for i, block in enumerate(found):
        own = slice(i * together, (i + 1) * together)
        np.testing.assert_allclose(block, dense[own, own], rtol=1e-5, atol=1e-9)


def test_covariance_is_the_dense_inverse_of_the_graph_at_the_estimate() -> None:
    smoother = drive_bean(MapperSettings(), 60).road.smoother
    smoother.refresh()
    hessian, _ = normal_equations(smoother.linear_graph(), smoother.layout)
    keys = np.append(pose_keys(np.array([59, 45])), smoother.layout.keys[[3, 0]])
    entries = columns_of(keys, smoother.layout.keys)
    expected = np.linalg.inv(hessian)[np.ix_(entries, entries)]
    np.testing.assert_allclose(smoother.covariance(keys), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("far", [[], [1, 4], [0, 2, 3, 5]])
def test_a_prior_whose_far_points_are_inactive_is_the_same_gaussian(far: list[int]) -> None:
    """The joint of active and inactive variables is the given one, and `refresh` gives the mean."""
    rng, smoother = np.random.default_rng(3), FixedLagSmoother(SETTINGS, LinearTrack(0))
    points = control_keys(0, np.arange(6))
    smoother.variables.insert(points, rng.normal(size=12))
    smoother.add_first_pose(0.0, np.zeros(3), np.eye(3))
    variables, layout = smoother.variables, smoother.variables.layout
    restart(smoother, 0)
    A, mean = rng.normal(size=(30, layout.size)), rng.normal(size=layout.size)
    order = layout.entries(np.concatenate([points[far], np.setdiff1d(layout.keys, points[far])]))
    root = upper_root((A.T @ A)[np.ix_(order, order)])
    set_prior(smoother, layout.keys, mean, root, points[far])
    np.testing.assert_array_equal(smoother.layout.keys, np.setdiff1d(layout.keys, points[far]))
    H, g = normal_equations(smoother.inactive.joint_prior(smoother.prior), layout)
    np.testing.assert_allclose(H, A.T @ A, atol=1e-9 * np.abs(H).max())
    np.testing.assert_allclose(g, A.T @ A @ (mean - variables.reference), atol=1e-9 * np.abs(g).max())
    entries = layout.entries(smoother.layout.keys)
    variables.values[entries] = mean[entries]
    smoother.refresh()
    np.testing.assert_allclose(variables.values, mean, atol=1e-9)
