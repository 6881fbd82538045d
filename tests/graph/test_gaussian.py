"""Gaussian graphs against dense algebra, and the traps of the binding that the engine avoids."""

from __future__ import annotations

import gc

import gtsam
import numpy as np
import pytest

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.graph.gaussian import (
    cholesky,
    eliminate,
    factorize,
    factors_of,
    graph_of,
    half_solve,
    jacobian_factor,
    keys_of,
    marginalize,
    merge_variables,
    normal_equations,
    remove_information,
    solve,
    square_root_form,
)
from pathspace_graph.graph.variables import Layout

from ..scenes.graph import (
    KEYS,
    LEFT_KEYS,
    MAP_KEYS,
    POSE_KEYS,
    RIGHT_KEYS,
    columns_of,
    random_factor,
    random_graph,
    schur,
)

LAYOUT = Layout(KEYS)
CHAIN = [np.append(MAP_KEYS[k : k + 4], POSE_KEYS[k : k + 1]) for k in range(4)] + [
    np.append(KEYS[:1], POSE_KEYS[k : k + 2]) for k in range(3)
]
"""Factors on these keys determine all variables: detections of each pose, and odometry."""


def at(values: Array, keys: IntArray = KEYS) -> gtsam.VectorValues:
    """A flat vector as GTSAM has it."""
    vectors = gtsam.VectorValues()
    for key in keys:
        vectors.insert(int(key), values[columns_of(np.array([key]), keys)])
    return vectors


def root_factor(layout: Layout, information: Array, vector: Array) -> gtsam.GaussianConditional:
    """Information of any rank as rows."""
    return jacobian_factor(layout.keys, *square_root_form(information, vector))


# --- factors ---------------------------------------------------------------------------------------------


def test_a_jacobian_factor_has_the_error_of_its_rows() -> None:
    rng = np.random.default_rng(0)
    factor, A, b = random_factor(rng, KEYS, rows=6)
    x = rng.normal(size=LAYOUT.size)
    assert list(factor.keys()) == KEYS.tolist()
    assert gtsam.JacobianFactor(factor).error(at(x)) == pytest.approx(
        0.5 * np.sum((A @ x - b) ** 2), rel=1e-12
    )


@pytest.mark.parametrize(
    ("keys", "shape", "rows"),
    [
        (LEFT_KEYS[:2], (3, 5), 3),
        (LEFT_KEYS[:2], (3, 4), 2),
        (LEFT_KEYS[[0, 0]], (3, 4), 3),
        (POSE_KEYS[:1], (3, 2), 3),
    ],
    ids=["columns", "rows", "a key twice", "the size of a pose"],
)
def test_a_jacobian_factor_that_does_not_fit_is_refused(
    keys: IntArray, shape: tuple[int, int], rows: int
) -> None:
    with pytest.raises(ValueError, match="expected"):
        jacobian_factor(keys, np.zeros(shape), np.zeros(rows))


@pytest.mark.parametrize("rank", [0, 1, 5, 14])
def test_information_of_any_rank_is_a_factor_on_many_keys(rank: int) -> None:
    """Exactly `1/2 d' L d - g' d`, up to a constant; five keys, L singular or not, of unlike sizes."""
    rng, layout = np.random.default_rng(rank), Layout(np.append(MAP_KEYS[:4], POSE_KEYS[:2]))
    scale = np.geomspace(1e-3, 1e3, layout.size)
    root = rng.normal(size=(rank, layout.size)) * scale
    information, vector = root.T @ root, root.T @ rng.normal(size=rank)
    factor = root_factor(layout, information, vector)
    found, found_vector = normal_equations(graph_of(factor), layout)
    assert (np.abs(found - information) <= 1e-9 * np.outer(scale, scale)).all()
    np.testing.assert_allclose(
        found_vector / scale, vector / scale, atol=1e-6 * np.abs(vector).max(initial=1.0)
    )


def test_the_square_root_form_has_an_error_that_is_never_negative_and_a_row_for_each_direction() -> None:
    """An optimizer can judge steps by it, unlike by the error of a Hessian factor without a constant."""
    rng, layout = np.random.default_rng(3), Layout(LEFT_KEYS)
    root = rng.normal(size=(5, layout.size))
    information, vector = root.T @ root, root.T @ rng.normal(size=5)
    factor = gtsam.JacobianFactor(root_factor(layout, information, vector))
    assert factor.rows() == 5
    optimum = np.linalg.lstsq(information, vector, rcond=None)[0]
    assert factor.error(at(optimum, LEFT_KEYS)) == pytest.approx(0.0, abs=1e-12)
    assert all(factor.error(at(rng.normal(size=layout.size), LEFT_KEYS)) > 0.0 for _ in range(20))


# --- normal equations ------------------------------------------------------------------------------------


def test_normal_equations_are_the_dense_ones_on_the_columns_of_the_layout() -> None:
    graph, hessian, vector = random_graph(np.random.default_rng(4), CHAIN)
    found = normal_equations(graph, LAYOUT)
    np.testing.assert_allclose(found[0], hessian, atol=1e-10)
    np.testing.assert_allclose(found[1], vector, atol=1e-10)
    assert found[0].flags.f_contiguous


@pytest.mark.parametrize(
    ("held", "wanted", "error", "message"),
    [
        (LEFT_KEYS[:2], LEFT_KEYS[:3], SingularSystemError, "none on l2$"),
        (RIGHT_KEYS, MAP_KEYS, SingularSystemError, "none on l0, l1, l2$"),
        (LEFT_KEYS[:3], LEFT_KEYS[:2], ValueError, "others: l2$"),
        (LEFT_KEYS[[0, 2]], LEFT_KEYS[[0, 1]], ValueError, "others: l2$"),
        (np.append(LEFT_KEYS[:1], POSE_KEYS[:1]), LEFT_KEYS[:2], ValueError, "others: x5$"),
    ],
    ids=["missing", "many missing", "foreign", "foreign in the place of a missing one", "of another size"],
)
def test_a_graph_on_other_keys_than_the_layout_s_is_refused(
    held: IntArray, wanted: IntArray, error: type[Exception], message: str
) -> None:
    """GTSAM gives a smaller system for a key that no factor holds, and takes a foreign one in its place."""
    graph, *_ = random_graph(np.random.default_rng(5), [held], held)
    with pytest.raises(error, match=message):
        normal_equations(graph, Layout(wanted))


def test_gtsam_leaves_out_a_key_that_no_factor_holds() -> None:
    """This is why the engine looks for such a key."""
    graph, *_ = random_graph(np.random.default_rng(6), [LEFT_KEYS[:2]], LEFT_KEYS[:2])
    hessian, _ = graph.hessian(gtsam.Ordering(LEFT_KEYS[:3].tolist()))
    assert hessian.shape == (4, 4)


def test_a_singular_system_raises_where_gtsam_s_dense_solver_gives_numbers() -> None:
    graph, *_ = random_graph(np.random.default_rng(7), [LEFT_KEYS[:1]], LEFT_KEYS[:1], rows=1)
    assert np.isfinite(graph.optimizeDensely().at(int(LEFT_KEYS[0]))).all()
    with pytest.raises(SingularSystemError, match="pivot 2 not positive"):
        cholesky(np.asfortranarray(np.diag([1.0, 0.0])))
    with pytest.raises(SingularSystemError):
        factorize(
            graph_of(jacobian_factor(LEFT_KEYS[:1], np.array([[1.0, 0.0]]), np.ones(1))),
            Layout(LEFT_KEYS[:1]),
        )


def test_gtsam_takes_a_key_of_two_sizes_and_the_engine_s_factors_have_one() -> None:
    """The size follows from the key's letter, so no factor of the engine can disagree with another."""
    key, graph = int(LEFT_KEYS[0]), gtsam.GaussianFactorGraph()
    for size in (2, 3):
        noise = gtsam.noiseModel.Unit.Create(size)
        graph.add(gtsam.JacobianFactor(key, np.eye(size), np.ones(size), noise))
    assert len(graph.hessian(gtsam.Ordering([key]))[1]) not in (0, 2)
    for size in (1, 3):
        with pytest.raises(ValueError, match="expected a matrix"):
            jacobian_factor(LEFT_KEYS[:1], np.eye(size), np.ones(size))


def test_solve_and_half_solve_are_those_of_the_dense_matrix() -> None:
    _, hessian, vector = random_graph(np.random.default_rng(8), CHAIN)
    factor = cholesky(np.asfortranarray(hessian.copy()))
    columns = np.asfortranarray(np.random.default_rng(9).normal(size=(LAYOUT.size, 3)))
    np.testing.assert_allclose(solve(factor, vector), np.linalg.solve(hessian, vector), atol=1e-9)
    expected = columns.T @ np.linalg.solve(hessian, columns)
    half = half_solve(factor, columns.copy(order="F"))
    np.testing.assert_allclose(half.T @ half, expected, atol=1e-9)


def test_covariance_is_that_of_the_dense_inverse_in_the_order_of_the_keys() -> None:
    graph, hessian, _ = random_graph(np.random.default_rng(10), CHAIN)
    keys = np.array([POSE_KEYS[2], LEFT_KEYS[3], KEYS[0], RIGHT_KEYS[1]])
    entries = columns_of(keys, KEYS)
    expected = np.linalg.inv(hessian)[np.ix_(entries, entries)]
    np.testing.assert_allclose(factorize(graph, LAYOUT).covariance(keys), expected, rtol=1e-8, atol=1e-10)


# --- elimination -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("gone", [POSE_KEYS[:1], np.append(LEFT_KEYS[1:3], POSE_KEYS[:2]), MAP_KEYS])
def test_eliminate_gives_the_schur_complement_and_the_conditional_mean(gone: IntArray) -> None:
    """`p(x) = p(gone | rest) p(rest)`: both information forms follow from the joint covariance."""
    rng = np.random.default_rng(11)
    graph, hessian, vector = random_graph(rng, CHAIN)
    conditional, remaining = eliminate(graph, gone)
    rest = np.setdiff1d(KEYS, gone)
    information, negative_gradient = schur(hessian, vector, columns_of(gone, KEYS))
    found, found_vector = normal_equations(remaining, Layout(rest))
    np.testing.assert_allclose(found, information, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found_vector, negative_gradient, rtol=1e-8, atol=1e-8)
    x = rng.normal(size=len(found_vector))
    own, others = columns_of(gone, KEYS), columns_of(rest, KEYS)
    mean = np.linalg.solve(hessian[np.ix_(own, own)], vector[own] - hessian[np.ix_(own, others)] @ x)
    assert set(list(conditional.keys())[: len(gone)]) == set(gone.tolist())
    given = at(x, rest)
    solution = conditional.solve(given)
    found_mean = np.concatenate([solution.at(int(key)) for key in gone])
    np.testing.assert_allclose(found_mean, mean, rtol=1e-8, atol=1e-8)


def test_eliminate_leaves_the_factors_of_others_as_they_are() -> None:
    graph, *_ = random_graph(np.random.default_rng(12), CHAIN)
    _, remaining = eliminate(graph, POSE_KEYS[:1])
    others = [factor for factor in factors_of(graph) if int(POSE_KEYS[0]) not in list(factor.keys())]
    kept = [sorted(factor.keys()) for factor in factors_of(remaining)]
    assert len(kept) == len(others) + 1
    for factor in others:
        assert sorted(factor.keys()) in kept


@pytest.mark.parametrize("key", [int(POSE_KEYS[1]), int(LEFT_KEYS[2]), int(KEYS[0])])
def test_marginalize_is_the_marginal_of_gtsam_and_of_the_covariance(key: int) -> None:
    graph, hessian, vector = random_graph(np.random.default_rng(13), CHAIN)
    rest = Layout(np.setdiff1d(KEYS, [key]))
    found, found_vector = normal_equations(marginalize(graph, np.array([key])), rest)
    information, negative_gradient = schur(hessian, vector, columns_of(np.array([key]), KEYS))
    np.testing.assert_allclose(found, information, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found_vector, negative_gradient, rtol=1e-8, atol=1e-8)
    native = graph.marginal(gtsam.KeyVector(rest.keys.tolist())).hessian(rest.ordering)
    np.testing.assert_allclose(found, native[0], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found_vector, native[1], rtol=1e-8, atol=1e-8)


def test_marginalize_takes_several_variables_and_leaves_out_those_that_nothing_holds() -> None:
    graph, hessian, vector = random_graph(np.random.default_rng(20), CHAIN)
    gone, unheld = POSE_KEYS[[0, 2]], RIGHT_KEYS[-1:] + 9
    remaining = marginalize(graph, np.append(unheld, gone))
    information, negative_gradient = schur(hessian, vector, columns_of(gone, KEYS))
    found, found_vector = normal_equations(remaining, Layout(np.setdiff1d(KEYS, gone)))
    np.testing.assert_allclose(found, information, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found_vector, negative_gradient, rtol=1e-8, atol=1e-8)
    assert marginalize(graph, np.append(unheld, unheld + 1)) is graph


def test_merged_keys_are_one_variable() -> None:
    """`d_gone = d_kept + offset` substituted in the dense system; a kept one may be new to the graph."""
    rng = np.random.default_rng(21)
    graph, hessian, vector = random_graph(rng, CHAIN)
    gone = np.array([LEFT_KEYS[2], RIGHT_KEYS[0]])
    kept, offset = np.array([LEFT_KEYS[0], RIGHT_KEYS[-1] + 5]), rng.normal(size=4)
    new = np.sort(np.append(np.setdiff1d(KEYS, gone), kept[1:]))
    E, e = np.zeros((len(vector), len(columns_of(new, new)))), np.zeros(len(vector))
    for key in KEYS:
        becomes = kept[gone == key] if key in gone else np.array([key])
        E[columns_of(np.array([key]), KEYS), columns_of(becomes, new)] = 1.0
    e[columns_of(gone, KEYS)] = offset
    found, found_vector = normal_equations(merge_variables(graph, gone, kept, offset), Layout(new))
    np.testing.assert_allclose(found, E.T @ hessian @ E, atol=1e-9 * hessian.max())
    np.testing.assert_allclose(found_vector, E.T @ (vector - hessian @ e), atol=1e-9 * hessian.max())


@pytest.mark.parametrize("unknown", [False, True])
def test_removing_information_keeps_the_covariance_of_the_others(unknown: bool) -> None:
    """The others keep covariance and mean, also where a removed variable was undetermined."""
    rng = np.random.default_rng(14)
    graph, hessian, vector = random_graph(rng, [*CHAIN, POSE_KEYS])
    gone, rest = LEFT_KEYS[[1, 3]], np.setdiff1d(KEYS, LEFT_KEYS[[1, 3]])
    if unknown:
        free = RIGHT_KEYS[-1:] + 7  # one direction of it is held, the other is not
        graph = graph_of(graph, jacobian_factor(free, np.array([[1.0, 2.0]]), np.ones(1)))
        gone = np.append(gone, free)
    left = remove_information(graph, Layout(np.sort(gone)), rng.normal(size=2 * len(gone)))
    assert np.isin(gone, keys_of(left)).sum() == 0
    information, negative_gradient = schur(hessian, vector, columns_of(LEFT_KEYS[[1, 3]], KEYS))
    found, found_vector = normal_equations(left, Layout(rest))
    np.testing.assert_allclose(np.linalg.inv(found), np.linalg.inv(information), rtol=1e-4, atol=1e-7)
    mean = np.linalg.solve(information, negative_gradient)
    np.testing.assert_allclose(np.linalg.solve(found, found_vector), mean, atol=1e-4)


def test_a_graph_of_graphs_nets_and_factors_has_all_of_their_factors() -> None:
    rng = np.random.default_rng(16)
    graph, hessian, vector = random_graph(rng, CHAIN)
    conditional, remaining = eliminate(graph, MAP_KEYS)
    net = gtsam.GaussianBayesNet()
    net.push_back(conditional)
    again = graph_of(net, remaining)
    found, found_vector = normal_equations(again, LAYOUT)
    np.testing.assert_allclose(found, hessian, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found_vector, vector, rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(keys_of(again), KEYS)
    whole = graph_of(gtsam.HessianFactor(again))
    assert whole.size() == 1
    np.testing.assert_allclose(normal_equations(whole, LAYOUT)[0], hessian, rtol=1e-8, atol=1e-8)


# --- memory ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["R", "S", "d", "getA", "getb"])
def test_the_binding_gives_views_that_nobody_owns(name: str) -> None:
    """Documents the trap: neither its own memory, nor an object that keeps the factor alive."""
    factor, *_ = random_factor(np.random.default_rng(17), LEFT_KEYS)
    array = getattr(factor, name)()
    assert not array.flags.owndata and array.base is None


def test_the_linear_term_of_a_hessian_factor_is_such_a_view_too() -> None:
    factor, *_ = random_factor(np.random.default_rng(18), LEFT_KEYS)
    array = gtsam.HessianFactor(graph_of(factor)).linearTerm()
    assert not array.flags.owndata and array.base is None


def test_no_function_gives_a_view_of_a_factor_away() -> None:
    """Every array stays the same after its graph and factors are freed and their memory is overwritten."""
    rng = np.random.default_rng(19)
    graph, *_ = random_graph(rng, CHAIN)
    found = [
        *normal_equations(graph, LAYOUT),
        factorize(graph, LAYOUT).covariance(LEFT_KEYS),
        keys_of(graph),
    ]
    for array in found:
        assert array.flags.owndata or array.base is not None
    before = [array.copy() for array in found]
    del graph
    gc.collect()
    rubbish = [random_factor(rng, KEYS)[0] for _ in range(200)]
    for array, expected in zip(found, before, strict=True):
        np.testing.assert_array_equal(array, expected)
    assert len(rubbish) == 200
