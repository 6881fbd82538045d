"""Gaussian graphs: their normal equations, elimination of variables, and the factors that remain.

This file stands between the engine and three traps of GTSAM's binding. `hessian(ordering)` leaves out a key
that no factor holds, and `optimizeDensely()` gives numbers for a singular system: both raise here. `R()`,
`S()`, `d()`, `getA()`, `getb()` and `linearTerm()` are views of memory that nobody owns, so none is returned.
"""

from dataclasses import dataclass
from typing import Final

import gtsam
import numpy as np
from scipy.linalg import lapack

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.linear import linear_factor

from .variables import Layout, Variables, names, sizes

GraphPart = (
    gtsam.GaussianFactor | gtsam.GaussianFactorGraph | gtsam.GaussianBayesNet | gtsam.GaussianBayesTree
)
NEGLIGIBLE: Final = 1e-6  # information (1/m^2) that keeps a pivot from being zero
RANK_TOLERANCE: Final = 1e-12  # information below this share of the diagonal's counts as zero


def graph_of(*factors: GraphPart) -> gtsam.GaussianFactorGraph:
    """Return a graph that shares the given factors, and the factors of the given graphs, nets and trees."""
    graph = gtsam.GaussianFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def factors_of(graph: gtsam.GaussianFactorGraph) -> list[gtsam.GaussianFactor]:
    """Return the factors of a graph; a Bayes tree in it has given its conditionals."""
    return [graph.at(i) for i in range(graph.size())]


def keys_of(graph: gtsam.GaussianFactorGraph) -> IntArray:
    """Return the keys (k,) of a graph, ascending."""
    return np.array(list(graph.keyVector()), np.intp)


# --- normal equations ------------------------------------------------------------------------------------


def require_keys(graph: gtsam.GaussianFactorGraph, layout: Layout) -> None:
    """Raise SingularSystemError where no factor holds a key of the layout, ValueError for a foreign key."""
    held = keys_of(graph)
    if np.array_equal(held, layout.keys):
        return
    foreign, missing = np.setdiff1d(held, layout.keys), np.setdiff1d(layout.keys, held)
    if len(foreign):
        raise ValueError(f"expected factors on {len(layout.keys)} keys, found others: {names(foreign)}")
    raise SingularSystemError(f"expected a factor on every variable, found none on {names(missing)}")


def normal_equations(graph: gtsam.GaussianFactorGraph, layout: Layout) -> tuple[Array, Array]:
    """Return H (n, n), stored by columns, and g (n,) of `1/2 d' H d - g' d`. Raises as `require_keys`."""
    require_keys(graph, layout)
    hessian, vector = graph.hessian(layout.ordering)
    return hessian, vector


def cholesky(hessian: Array) -> Array:
    """Return the lower factor of `L L' = H`, whose upper triangle is not cleared.

    An H stored by columns is overwritten. SingularSystemError where H is not positive definite.
    """
    factor, info = lapack.dpotrf(hessian, lower=1, clean=0, overwrite_a=1)
    if info != 0:
        raise SingularSystemError(f"expected a positive definite system, found pivot {info} not positive")
    return np.asarray(factor)


def upper_root(information: Array) -> Array:
    """Return the upper triangular R of `R' R = H` (n, n)."""
    return np.asarray(np.linalg.cholesky(information).T, np.float64)


def solve(factor: Array, vector: Array) -> Array:
    """Return `H^-1 g` from the lower factor of H, for g (n,) or (n, k)."""
    solution, _ = lapack.dpotrs(factor, vector, lower=1)
    return np.asarray(solution)


def half_solve(factor: Array, columns: Array) -> Array:
    """Return `L^-1 G` (n, k), so that `half' half = G' H^-1 G`; it may overwrite G."""
    half, _ = lapack.dtrtrs(factor, columns, lower=1, overwrite_b=1)
    return np.asarray(half)


@dataclass(frozen=True, eq=False)
class FactoredSystem:
    """Lower Cholesky factor (n, n) of normal equations; its upper triangle is not cleared."""

    layout: Layout
    factor: Array

    def covariance(self, keys: IntArray) -> Array:
        """Return the joint covariance (q, q) of keys (k,), in their order, all others marginalized out."""
        entries = self.layout.entries(keys)
        unit = np.zeros((self.layout.size, len(entries)), order="F")
        unit[entries, np.arange(len(entries))] = 1.0
        half = half_solve(self.factor, unit)
        return np.asarray(half.T @ half)


def factorize(graph: gtsam.GaussianFactorGraph, layout: Layout) -> FactoredSystem:
    """Return the factored normal equations of a graph. Raises as `require_keys` and `cholesky` do."""
    return FactoredSystem(layout, cholesky(normal_equations(graph, layout)[0]))


@dataclass(frozen=True, eq=False)
class HeldMap:
    """Joint covariance (2k, 2k) of a closed map's points (k,) when its gauge was held: the most claimed."""

    keys: IntArray
    covariance: Array

    def claimed(self, joint: Array) -> Array:
        """Return the covariance (q, q) of variables, given the joint one (2k + q, 2k + q) with the map's.

        The variables y follow the map m by `A = Sigma_ym Sigma_mm^-1`. With D what the detections since then
        have taken off the map's covariance, the result is `Sigma_yy + A D A'`.
        """
        n = len(self.covariance)
        now, mixed, others = joint[:n, :n], joint[:n, n:], joint[n:, n:]
        by_map = np.linalg.solve(now, mixed).T
        values, vectors = np.linalg.eigh(self.covariance - now)
        root = by_map @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        return np.asarray(others + root @ root.T)


# --- factors ---------------------------------------------------------------------------------------------


def jacobian_factor(keys: IntArray, A: Array, b: Array) -> gtsam.GaussianConditional:
    """Return the factor `1/2 |A d - b|^2` on any number of keys (k,), with whitened A (m, n), b (m,)."""
    return linear_factor(keys, sizes(keys), A, b)


def absolute_factor(
    keys: IntArray, root: Array, variables: Variables, mean: Array | None = None
) -> gtsam.GaussianConditional:
    """Return the factor `1/2 |A (x - m)|^2` on keys (k,), with A the `root`, and m the values by default."""
    entries = variables.layout.entries(keys)
    change = variables.change(entries) if mean is None else mean - variables.reference[entries]
    return jacobian_factor(keys, root, root @ change)


def calibration_factors(variables: Variables, mean: Array, sigma: Array) -> list[gtsam.GaussianConditional]:
    """Return the factors `(b - mean) / sigma` of the calibrations of the odometry and of the sensor."""
    factors = []
    for keys in variables.calibration_keys[:, None]:
        entries = variables.layout.entries(keys)
        factors.append(absolute_factor(keys, np.diag(1.0 / sigma[entries]), variables, mean[entries]))
    return factors


def square_root_form(information: Array, vector: Array) -> tuple[Array, Array]:
    """Return A (r, n) and b (r,) with `A'A = L` and `A'b = g`, where L (n, n) has rank r.

    A is a pivoted Cholesky factor of L scaled to a diagonal of ones. A direction with less information than
    `RANK_TOLERANCE` has no row.
    """
    scale = np.sqrt(np.maximum(np.diagonal(information), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    factor, pivots, rank, _ = lapack.dpstrf(information / np.outer(scale, scale), tol=RANK_TOLERANCE, lower=1)
    order, lower = pivots - 1, np.tril(factor)[:, :rank]
    right, _ = lapack.dtrtrs(lower[:rank], (vector / scale)[order][:rank], lower=1)
    root = np.empty((rank, len(scale)))
    root[:, order] = lower.T
    return root * scale, np.asarray(right)


def as_rows(graph: gtsam.GaussianFactorGraph) -> gtsam.GaussianConditional:
    """Return one factor of rows on all keys of a graph, without what round-off has made negative."""
    keys = Layout(keys_of(graph))
    return jacobian_factor(keys.keys, *square_root_form(*normal_equations(graph, keys)))


# --- elimination -----------------------------------------------------------------------------------------


def eliminate(
    graph: gtsam.GaussianFactorGraph, keys: IntArray
) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactorGraph]:
    """Return the conditional `p(keys | others)` of all keys (k,) together, and the graph `p(others)`.

    Factors that hold none of the keys stay as they are.
    """
    eliminated, factors = frozenset(keys.tolist()), factors_of(graph)
    holding = [factor for factor in factors if not eliminated.isdisjoint(factor.keys())]
    others = [factor for factor in factors if eliminated.isdisjoint(factor.keys())]
    dense = graph_of(gtsam.HessianFactor(graph_of(*holding)))  # one factor gives one clique
    tree, remaining = dense.eliminatePartialMultifrontal(gtsam.Ordering(keys.tolist()))
    return tree.roots()[0].conditional(), graph_of(*others, remaining)


def marginalize(graph: gtsam.GaussianFactorGraph, keys: IntArray) -> gtsam.GaussianFactorGraph:
    """Return the graph with variables (k,) marginalized out; keys that no factor holds are ignored."""
    if len(keys) == 1:
        return graph.eliminatePartialSequential(gtsam.Ordering(keys.tolist()))[1]
    held = keys_of(graph)
    gone = np.isin(held, keys)
    return sparse_marginal(graph, held[~gone]) if gone.any() else graph


def sparse_marginal(graph: gtsam.GaussianFactorGraph, keys: IntArray) -> gtsam.GaussianFactorGraph:
    """Return the graph of some of the keys (k,) of a large and sparse graph, all others marginalized out."""
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, keys.tolist(), False)
    others = gtsam.Ordering([order.at(i) for i in range(order.size() - len(keys))])
    _, remaining = graph.eliminatePartialMultifrontal(others)
    return remaining


def remove_information(
    graph: gtsam.GaussianFactorGraph, layout: Layout, values: Array
) -> gtsam.GaussianFactorGraph:
    """Return the graph without a layout's variables; the information about all others is kept.

    `NEGLIGIBLE` information about `values` (n,) of their unknowns makes undetermined ones regular.
    """
    root = np.sqrt(NEGLIGIBLE) * np.eye(layout.size)
    weak = jacobian_factor(layout.keys, root, root @ values)
    return eliminate(graph_of(graph, weak), layout.keys)[1]


# --- changes of variables --------------------------------------------------------------------------------


def merge_variables(
    graph: gtsam.GaussianFactorGraph, removed: IntArray, kept: IntArray, offset: Array
) -> gtsam.GaussianFactorGraph:
    """Return the graph where each key of `removed` (k,) is replaced by that of `kept` (k,).

    The unknowns satisfy `d_removed = d_kept + offset` (n,). With `d_old = E d_new + e`, the information
    becomes `E' L E` and the vector `E' (g - L e)`.
    """
    old = Layout(keys_of(graph))
    becomes, places = old.keys.copy(), old.positions(removed)
    becomes[places[places >= 0]] = kept[places >= 0]
    new = Layout(np.unique(becomes))
    E, e = np.zeros((old.size, new.size)), np.zeros(old.size)
    E[np.arange(old.size), new.entries(becomes)] = 1.0
    e[old.entries(removed[places >= 0])] = offset[np.repeat(places >= 0, sizes(removed))]
    information, vector = normal_equations(graph, old)
    root, right = square_root_form(E.T @ information @ E, E.T @ (vector - information @ e))
    return graph_of(gtsam.HessianFactor(graph_of(jacobian_factor(new.keys, root, right))))
