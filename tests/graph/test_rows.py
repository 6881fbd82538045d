"""Rows and the odometry's rows as factors, and predicted covariances, against dense algebra."""

from __future__ import annotations

import gc

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import odometry_residuals
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.se2 import compose
from pathspace_graph.graph.gaussian import graph_of, normal_equations
from pathspace_graph.graph.rows import (
    OdometryChain,
    Rows,
    at_reference,
    calibrated_delta,
    jacobian_factors,
    odometry_factor,
    odometry_rows,
    stacked_factor,
    through_odometry,
)
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POSE,
    UNKNOWN,
    Layout,
    Variables,
    control_keys,
    pose_key,
    pose_keys,
)

from ..scenes.graph import (
    KEYS,
    LEFT_KEYS,
    POSE_KEYS,
    columns_of,
    dense_rows,
    random_groups,
    random_rows,
    random_variables,
)
from ..scenes.jacobians import assert_jacobians


def rows_of(factor: gtsam.GaussianConditional) -> Array:
    """`[A b]` of a factor, sorted by b: a copy."""
    A, b = gtsam.JacobianFactor(factor).jacobian()
    both = np.column_stack([A, b])
    return both[np.argsort(both[:, -1])]


def expected_rows(A: Array, b: Array) -> Array:
    both = np.column_stack([A, b])
    return both[np.argsort(both[:, -1])]


@pytest.mark.parametrize("seed", range(5))
def test_all_factors_together_are_the_dense_normal_equations(seed: int) -> None:
    """`J'J` and `J'(J d - r)`, d = value - reference: `J x + r` is what it is at any value."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng), random_groups(rng)
    factors = jacobian_factors(at_reference(groups, variables), variables.layout)
    J, r, _ = dense_rows(groups, KEYS)
    hessian, vector = normal_equations(graph_of(*factors.values()), variables.layout)
    moved = variables.values - variables.reference
    np.testing.assert_allclose(hessian, J.T @ J, atol=1e-10)
    np.testing.assert_allclose(vector, J.T @ (J @ moved - r), atol=1e-10)
    step = np.linalg.lstsq(J, -r, rcond=None)[0]
    np.testing.assert_allclose(np.linalg.solve(hessian, vector), moved + step, atol=1e-9)


@given(st.integers(0, 10_000), st.integers(1, 12))
def test_each_owner_s_factor_holds_its_rows_and_no_other(seed: int, owners: int) -> None:
    """On the keys of its rows alone, in ascending order; also where owners' rows are mixed, and many lack."""
    rng = np.random.default_rng(seed)
    variables, groups = random_variables(rng), random_groups(rng, owners)
    J, r, owner = dense_rows(groups, KEYS)
    b = J @ (variables.values - variables.reference) - r
    factors = jacobian_factors(at_reference(groups, variables), variables.layout)
    assert sorted(factors) == np.unique(owner).tolist()
    for number, factor in factors.items():
        own = owner == number
        touched = {int(key) for rows in groups for key in rows.keys[rows.owner == number].ravel()}
        assert list(factor.keys()) == sorted(touched)
        columns = columns_of(np.array(sorted(touched)), KEYS)
        expected = expected_rows(J[np.ix_(own, columns)], b[own])
        np.testing.assert_allclose(rows_of(factor), expected, atol=1e-10)


def test_stacked_factor_is_all_rows() -> None:
    rng = np.random.default_rng(1)
    variables, groups = random_variables(rng), random_groups(rng)
    J, r, _ = dense_rows(groups, KEYS)
    (factor,) = stacked_factor(groups, variables)
    expected = expected_rows(J, J @ (variables.values - variables.reference) - r)
    np.testing.assert_allclose(rows_of(factor), expected, atol=1e-10)
    assert stacked_factor(groups[1:2], variables) == []


def test_no_rows_are_no_factor() -> None:
    variables = random_variables(np.random.default_rng(2))
    assert jacobian_factors([], variables.layout) == {}
    assert jacobian_factors(random_groups(np.random.default_rng(2))[1:2], variables.layout) == {}


@pytest.mark.parametrize(
    ("key", "name"),
    [(int(control_keys(0, np.array(9))), "l9"), (0, "0"), (int(pose_keys(np.array(99))), "x99")],
)
def test_rows_on_an_unknown_variable_are_refused_by_its_name(key: int, name: str) -> None:
    """Between known keys, before the first, and past the last one."""
    rng = np.random.default_rng(3)
    variables = random_variables(rng)
    rows = random_rows(rng, [POSE_KEYS, LEFT_KEYS], 6, 2)
    rows.keys[4, 0 if name == "x99" else 1] = key
    with pytest.raises(ValueError, match=f"known variables, found {name}$"):
        jacobian_factors([rows], variables.layout)


def test_a_factor_outlives_all_that_it_was_made_of() -> None:
    """A block of the buffer is copied into the factor: neither rows nor buffer nor variables stay its own."""
    rng = np.random.default_rng(4)
    variables, groups = random_variables(rng), random_groups(rng)
    factors = [*jacobian_factors(at_reference(groups, variables), variables.layout).values()]
    expected = [rows_of(factor) for factor in factors]
    for rows in groups:
        rows.jacobian[:], rows.residual[:], rows.keys[:] = np.nan, np.nan, 0
    variables.values[:] = np.nan
    del rows, groups, variables
    gc.collect()
    rubbish = [np.full(5000, np.nan) for _ in range(200)]
    for factor, before in zip(factors, expected, strict=True):
        np.testing.assert_array_equal(rows_of(factor), before)
    assert len(rubbish) == 200


def test_a_conditional_on_many_keys_copies_the_block_that_it_is_given() -> None:
    """The memory of the factors depends on this behaviour of the binding."""
    block = np.asfortranarray(np.random.default_rng(5).normal(size=(4, 11)))
    matrix = gtsam.VerticalBlockMatrix([2, 2, 3, 3, 1], block, False)
    factor, before = gtsam.GaussianConditional([1, 2, 3, 4], 1, matrix), block.copy()
    block[:] = np.nan
    del matrix
    gc.collect()
    np.testing.assert_array_equal(np.column_stack(gtsam.JacobianFactor(factor).jacobian()), before)


def test_columns_are_where_the_variables_lie() -> None:
    """UNKNOWN where a key isn't in the layout; a pose has three entries, all others two."""
    rng = np.random.default_rng(6)
    rows = random_rows(rng, [POSE_KEYS, LEFT_KEYS, KEYS[:1]], 20, 3)
    expected = np.stack([columns_of(keys, KEYS) for keys in rows.keys])
    np.testing.assert_array_equal(rows.columns(Layout(KEYS)), expected)
    less = np.delete(KEYS, np.flatnonzero(np.isin(KEYS, [POSE_KEYS[0], LEFT_KEYS[1]])))
    found = rows.columns(Layout(less))
    for i, keys in enumerate(rows.keys):
        gone = np.repeat(np.isin(keys, [POSE_KEYS[0], LEFT_KEYS[1]]), [POSE, 2, 2])
        assert (found[i, gone] == UNKNOWN).all()
        known = keys[np.isin(keys, less)]
        np.testing.assert_array_equal(found[i, ~gone], columns_of(known, less))


def test_where_takes_rows_by_mask_and_by_number() -> None:
    rows = random_rows(np.random.default_rng(7), [POSE_KEYS, LEFT_KEYS], 8, 2)
    chosen = np.array([1, 4, 5])
    for some in (rows.where(chosen), rows.where(np.isin(np.arange(8), chosen))):
        assert len(some) == 3
        np.testing.assert_array_equal(some.jacobian, rows.jacobian[chosen])
        np.testing.assert_array_equal(some.keys, rows.keys[chosen])
        np.testing.assert_array_equal(some.residual, rows.residual[chosen])
        np.testing.assert_array_equal(some.owner, rows.owner[chosen])


def test_the_size_of_a_variable_is_its_letter_s() -> None:
    """So a key can't have two sizes, which GTSAM would take: nobody tells the builder a size."""
    variables = Variables()
    variables.insert(np.append(LEFT_KEYS[:1], pose_keys(np.array([3]))), np.zeros(5))
    rows = Rows(LEFT_KEYS[None, :1], np.ones((1, 3)), np.zeros(1), np.zeros(1, np.intp))
    with pytest.raises(ValueError):
        jacobian_factors([rows], variables.layout)


SIGMA = np.array([0.25, 0.12, 0.035])


def random_interval(rng: np.random.Generator) -> IntegratedOdometry:
    """Returns half a second of a racing car that slides and turns hard."""
    twists = rng.normal(size=(10, POSE)) * [2.0, 0.5, 0.6] + [8.0, 0.0, 0.3]
    return integrate_twists(np.full(10, 0.05), twists, SIGMA)


def straight(length: float) -> IntegratedOdometry:
    """Returns one second straight ahead."""
    return integrate_twists(np.ones(1), np.array([[length, 0.0, 0.0]]), SIGMA)


def scene(seed: int, count: int = 4, first_cycle: int = 7) -> tuple[OdometryChain, Variables]:
    """Returns a chain of random intervals, and poses far from where it leads."""
    rng = np.random.default_rng(seed)
    variables = Variables()
    variables.insert(np.array([CALIBRATION_KEY]), rng.normal(0.0, 0.1, 2))
    variables.insert(pose_keys(first_cycle + np.arange(count + 1)), rng.normal(0.0, 3.0, POSE * (count + 1)))
    variables.first_cycle = first_cycle
    return OdometryChain([random_interval(rng) for _ in range(count)]), variables


def test_intervals_come_in_at_the_end_and_leave_at_the_beginning() -> None:
    rng = np.random.default_rng(0)
    intervals = [random_interval(rng) for _ in range(4)]
    chain = OdometryChain(intervals[:2])
    for interval in intervals[2:]:
        chain.append(interval)
    chain.drop_first()
    assert len(chain) == 3
    for found, expected in zip(chain.intervals, intervals[1:], strict=True):
        np.testing.assert_array_equal(found.delta, expected.delta)
        np.testing.assert_array_equal(found.whitener, expected.whitener)
        np.testing.assert_array_equal(found.calibration_jacobian, expected.calibration_jacobian)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-5, atol=1e-9)


def test_a_chain_of_nothing_has_no_rows() -> None:
    _, variables = scene(0, count=0)
    chain = OdometryChain()
    assert len(chain) == 0
    assert chain.intervals == []
    assert chain.rows(variables, np.array([7])) == []


@pytest.mark.parametrize("seed", range(3))
def test_terms_are_the_whitened_residuals_with_the_calibrations_share(seed: int) -> None:
    chain, variables = scene(seed)
    poses, calibration = variables.poses, variables.calibration
    residual, _ = chain.terms(slice(None), poses, calibration)
    for k, interval in enumerate(chain.intervals):
        off, _, _ = odometry_residuals(poses[k : k + 1], poses[k + 1 : k + 2], interval.delta[None])
        expected = interval.whitener @ (off[0] + interval.calibration_jacobian @ calibration)
        np.testing.assert_allclose(residual[k], expected, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_derivatives_of_the_terms_far_from_zero(seed: int) -> None:
    chain, variables = scene(seed, count=1)

    def function(calibration: Array, pose: Array, following: Array) -> tuple[Array, ...]:
        residual, jacobian = chain.terms(slice(None), np.stack([pose, following]), calibration)
        by_calibration, by_pose, by_following = np.split(jacobian[0], [2, 2 + POSE], axis=1)
        return residual[0], by_calibration, by_pose, by_following

    assert_jacobians(function, [variables.calibration.copy(), *variables.poses.copy()])


def test_rows_are_of_the_cycles_that_are_asked_for_and_the_newest_pose_has_none() -> None:
    chain, variables = scene(1)
    (rows,) = chain.rows(variables, np.array([8, 10, 11]))
    np.testing.assert_array_equal(rows.owner, np.repeat([8, 10], POSE))
    expected = [[CALIBRATION_KEY, pose_key(cycle), pose_key(cycle + 1)] for cycle in (8, 10)]
    np.testing.assert_array_equal(rows.keys, np.repeat(expected, POSE, axis=0))
    terms = chain.terms(np.array([1, 3]), variables.poses, variables.calibration)
    np.testing.assert_array_equal(rows.residual, terms[0].ravel())
    np.testing.assert_array_equal(rows.jacobian, terms[1].reshape(2 * POSE, -1))
    assert chain.rows(variables, np.array([11])) == []


def test_rows_of_terms_belong_to_the_owners_that_are_given() -> None:
    chain, variables = scene(2)
    terms = chain.terms(slice(None), variables.poses, variables.calibration)
    rows = odometry_rows(np.arange(7, 11), terms, np.array([0, 0, 1, 1]))
    np.testing.assert_array_equal(rows.owner, np.repeat([0, 1], 2 * POSE))
    np.testing.assert_array_equal(rows.keys[::POSE, 1], pose_keys(np.arange(7, 11)))


def test_a_scale_error_shortens_the_distance() -> None:
    """The odometry measured 10 m where it reads 10 % too much, so to first order the car drove 9 m."""
    np.testing.assert_allclose(calibrated_delta(straight(10.0), np.array([0.1, 0.0])), [9.0, 0.0, 0.0])


def test_a_bias_of_the_yaw_rate_turns_the_end_back_about_the_start() -> None:
    """After one second straight ahead: 0.02 rad less, and half of it times 10 m to the right."""
    found = calibrated_delta(straight(10.0), np.array([0.0, 0.02]))
    np.testing.assert_allclose(found, [10.0, -0.1, -0.02], atol=1e-12)


def test_the_correction_is_in_the_frame_of_the_end() -> None:
    """The end looks to the left, so its own error ahead is an error to the left of the start."""
    odometry = IntegratedOdometry(
        np.array([3.0, 4.0, np.pi / 2.0]),
        np.eye(3),
        np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]),
        np.eye(3),
    )
    found = calibrated_delta(odometry, np.array([0.5, 9.0]))
    np.testing.assert_allclose(found, [3.0, 3.5, np.pi / 2.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_the_calibrated_pose_has_no_residual_to_first_order(seed: int) -> None:
    chain, variables = scene(seed, count=1)
    for size in (1e-3, 1e-4):
        calibration = size * np.array([1.0, -0.5])
        start = variables.poses[0]
        end = compose(start, calibrated_delta(chain.intervals[0], calibration))
        residual, _ = chain.terms(slice(None), np.stack([start, end]), calibration)
        assert np.abs(np.linalg.solve(chain.whiteners[0], residual[0])).max() < 100.0 * size**2


@pytest.mark.parametrize("seed", range(3))
def test_a_row_on_the_predicted_pose_reaches_what_it_is_predicted_from(seed: int) -> None:
    """Numerically, through `pose * delta * (w - G b)` with w the odometry's noise."""
    chain, _ = scene(seed, count=2)
    rng = np.random.default_rng(seed)
    start, g = rng.normal(size=POSE), rng.normal(size=(5, POSE))
    delta, G = chain.deltas[-1], chain.by_calibration[-1]
    poses = np.stack([start, compose(start, delta)])
    by_older, by_calibration, noise = through_odometry(g, poses, chain)
    by_noise = noise @ chain.whiteners[-1]  # noise is per unit variance

    def function(older: Array, calibration: Array, error: Array) -> tuple[Array, ...]:
        end = compose(compose(older, delta), error - G @ calibration)
        return g @ end, by_older, by_calibration, by_noise

    assert_jacobians(function, [start, np.zeros(2), np.zeros(POSE)])
    covariance = np.linalg.inv(chain.whiteners[-1].T @ chain.whiteners[-1])
    np.testing.assert_allclose(noise @ noise.T, by_noise @ covariance @ by_noise.T, rtol=1e-9, atol=1e-12)


def test_the_factor_is_on_both_poses_and_the_calibration() -> None:
    factor = odometry_factor(3, straight(10.0))
    assert list(factor.keys()) == [pose_key(3), pose_key(4), CALIBRATION_KEY]
