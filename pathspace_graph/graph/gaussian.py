"""Gaussian graphs: their normal equations, what is eliminated from them, and the factor that remains.

Traps of the binding that this file is the place for. `hessian(ordering)` leaves out a key that no factor
holds, and `optimizeDensely()` gives numbers for a singular system: both raise here. `R()`, `S()`, `d()`,
`getA()`, `getb()` and `linearTerm()` are views of memory that nobody owns: no function gives one away.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.gtsam_factors import linear_factor

from .keys import name, sizes
from .variables import Layout

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

GraphPart = (
    gtsam.GaussianFactor | gtsam.GaussianFactorGraph | gtsam.GaussianBayesNet | gtsam.GaussianBayesTree
)
"""What can be pushed into a graph."""
NEGLIGIBLE = 1e-6
"""Information (1/m^2) that is as good as none, and keeps a pivot from being zero."""

RANK_TOLERANCE = 1e-12
"""Information below this share of the diagonal's is none."""


def graph_of(*factors: GraphPart) -> gtsam.GaussianFactorGraph:
    """A graph of factors, and of the factors of graphs, nets and trees; it shares them."""
    graph = gtsam.GaussianFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def factors_of(graph: gtsam.GaussianFactorGraph) -> list[gtsam.GaussianFactor]:
    """The factors of a graph, or the conditionals of a Bayes tree that was pushed into one."""
    return [graph.at(i) for i in range(graph.size())]


def keys_of(graph: gtsam.GaussianFactorGraph) -> IntArray:
    """(k,) keys of a graph, ascending."""
    return np.array(list(graph.keyVector()), np.intp)


def normal_equations(graph: gtsam.GaussianFactorGraph, layout: Layout) -> tuple[Array, Array]:
    """`H` (n, n) and `g` (n,) of `1/2 d' H d - g' d`, on the columns of a layout.

    H is laid out by columns. SingularSystemError where no factor holds one of the keys, which GTSAM leaves
    out in silence, and ValueError where a factor holds another key.
    """
    held = keys_of(graph)
    if not np.array_equal(held, layout.keys):
        foreign, missing = np.setdiff1d(held, layout.keys), np.setdiff1d(layout.keys, held)
        if len(foreign):
            raise ValueError(f"expected factors on {len(layout.keys)} keys, found others: {_names(foreign)}")
        raise SingularSystemError(f"expected a factor on every variable, found none on {_names(missing)}")
    hessian, vector = graph.hessian(layout.ordering)
    return hessian, vector


def _names(keys: IntArray) -> str:
    return ", ".join(name(key) for key in keys[:3].tolist())


def cholesky(hessian: Array) -> Array:
    """Lower factor `L L' = H`, its upper triangle not cleared; SingularSystemError where there is none.

    It takes the place of an H that is laid out by columns.
    """
    factor, info = lapack.dpotrf(hessian, lower=1, clean=0, overwrite_a=1)
    if info != 0:
        raise SingularSystemError(f"expected a positive definite system, found pivot {info} not positive")
    return np.asarray(factor)


def solve(factor: Array, vector: Array) -> Array:
    """`H^-1 g` from the lower factor of H; g (n,) or (n, k)."""
    solution, _ = lapack.dpotrs(factor, vector, lower=1)
    return np.asarray(solution)


def half_solve(factor: Array, columns: Array) -> Array:
    """`L^-1 G` (n, k), so that `half' half = G' H^-1 G`; it may take the place of G."""
    half, _ = lapack.dtrtrs(factor, columns, lower=1, overwrite_b=1)
    return np.asarray(half)


def covariance(graph: gtsam.GaussianFactorGraph, layout: Layout, keys: IntArray) -> Array:
    """(q, q) joint covariance of keys (k,), all others marginalized out, in the order of the keys."""
    return covariance_of(cholesky(normal_equations(graph, layout)[0]), layout, keys)


def covariance_of(factor: Array, layout: Layout, keys: IntArray) -> Array:
    """The same from the lower factor of the normal equations."""
    entries = layout.entries(keys)
    unit = np.zeros((layout.size, len(entries)), order="F")
    unit[entries, np.arange(len(entries))] = 1.0
    half = half_solve(factor, unit)
    return np.asarray(half.T @ half)


# --- factors ---------------------------------------------------------------------------------------------


def jacobian_factor(keys: IntArray, A: Array, b: Array) -> gtsam.GaussianConditional:
    """`1/2 |A d - b|^2` on any number of keys (k,): A (m, n) whitened, b (m,)."""
    return linear_factor(keys.tolist(), sizes(keys).tolist(), A, b)


def square_root_form(information: Array, vector: Array) -> tuple[Array, Array]:
    """`A` (r, n) and `b` (r,) with `A'A = L` and `A'b = g`: as many rows as L (n, n), which may be singular,
    has rank.

    By a Cholesky factor with pivots, of L scaled to a diagonal of ones: a direction of which less is known
    than `RANK_TOLERANCE` of that has no row.
    """
    scale = np.sqrt(np.diagonal(information))
    scale = np.where(scale > 0.0, scale, 1.0)
    factor, pivots, rank, _ = lapack.dpstrf(information / np.outer(scale, scale), tol=RANK_TOLERANCE, lower=1)
    order, lower = pivots - 1, np.tril(factor)[:, :rank]
    right, _ = lapack.dtrtrs(lower[:rank], (vector / scale)[order][:rank], lower=1)
    root = np.empty((rank, len(scale)))
    root[:, order] = lower.T
    return root * scale, np.asarray(right)


def as_hessian_factor(graph: gtsam.GaussianFactorGraph) -> gtsam.HessianFactor:
    """All factors of a graph as one, on all of their keys."""
    return gtsam.HessianFactor(graph)


# --- elimination -----------------------------------------------------------------------------------------


def eliminate(
    graph: gtsam.GaussianFactorGraph, keys: IntArray
) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactorGraph]:
    """`p(x) = p(keys | rest) p(rest)`: the conditional of all keys (k,) together, and the graph that remains.

    Only the factors that hold one of the keys are combined; the others remain as they are.
    """
    leaving, factors = frozenset(keys.tolist()), factors_of(graph)
    holding = [factor for factor in factors if not leaving.isdisjoint(factor.keys())]
    others = [factor for factor in factors if leaving.isdisjoint(factor.keys())]
    dense = graph_of(as_hessian_factor(graph_of(*holding)))  # one factor, hence one clique
    tree, remaining = dense.eliminatePartialMultifrontal(gtsam.Ordering(keys.tolist()))
    return tree.roots()[0].conditional(), graph_of(*others, remaining)


def marginalize(graph: gtsam.GaussianFactorGraph, keys: IntArray) -> gtsam.GaussianFactorGraph:
    """The graph without some variables (k,), one after the other; factors that hold none remain as they are.

    A variable that no factor holds is none of the graph's, and stays out.
    """
    held = keys[np.isin(keys, keys_of(graph))] if len(keys) > 1 else keys
    if len(held) == 0:
        return graph
    _, remaining = graph.eliminatePartialSequential(gtsam.Ordering(held.tolist()))
    return remaining


def remove_information(
    graph: gtsam.GaussianFactorGraph, layout: Layout, values: Array
) -> gtsam.GaussianFactorGraph:
    """A graph that knows nothing of a layout's keys any more, and of the others no less than before.

    It may know a part of them only: a negligible information about `values` (n,) of d makes them regular.
    """
    root = np.sqrt(NEGLIGIBLE) * np.eye(layout.size)
    weak = jacobian_factor(layout.keys, root, root @ values)
    return eliminate(graph_of(graph, weak), layout.keys)[1]


def merge_variables(
    graph: gtsam.GaussianFactorGraph, gone: IntArray, kept: IntArray, offset: Array
) -> gtsam.GaussianFactorGraph:
    """A graph where `d_gone = d_kept + offset`: keys `gone` (k,) of it have become `kept` (k,), offset (n,).

    Exact: with `d_old = E d_new + e` it is `E' L E` and `E' (g - L e)`.
    """
    old = Layout(keys_of(graph))
    becomes, places = old.keys.copy(), old.positions(gone)
    becomes[places[places >= 0]] = kept[places >= 0]
    new = Layout(np.unique(becomes))
    E, e = np.zeros((old.size, new.size)), np.zeros(old.size)
    E[np.arange(old.size), new.entries(becomes)] = 1.0
    e[old.entries(gone[places >= 0])] = offset[np.repeat(places >= 0, sizes(gone))]
    information, vector = normal_equations(graph, old)
    root, right = square_root_form(E.T @ information @ E, E.T @ (vector - information @ e))
    return graph_of(as_hessian_factor(graph_of(jacobian_factor(new.keys, root, right))))


def conditioned(
    graph: gtsam.GaussianFactorGraph, layout: Layout, held: int, value: Array
) -> tuple[Array, Array]:
    """Normal equations on a layout's keys where one other variable is held at a value of its unknown."""
    everything = Layout(np.sort(np.append(layout.keys, held)))
    hessian, vector = normal_equations(graph, everything)
    own, known = everything.entries(layout.keys), everything.entries(np.array([held]))
    return hessian[np.ix_(own, own)], vector[own] - hessian[np.ix_(own, known)] @ value
