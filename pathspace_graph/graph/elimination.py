"""A linear problem of poses and the map that they see: its solution, and how sure it is.

GTSAM eliminates the poses, `p(poses, map) = p(poses | map) p(map)`, once for each linearization. What remains
on the map is one dense matrix, which LAPACK factors for each damping that is tried; the poses follow by
back-substitution. The map is every variable that is no pose: control points or landmarks, the calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.errors import SingularSystemError

from .gaussian import cholesky, factors_of, graph_of, keys_of, normal_equations, solve
from .keys import POINT, POSE, are_poses, name, sizes
from .rows import Rows, jacobian_factors
from .variables import Layout, Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POSES_A_FACTOR = 8
"""Poses whose rows make one factor: a factor costs its hand-over from Python, and each pose makes it wider.
Between 5 and 10 it hardly matters."""


def owners(cycles: IntArray, part: int = 0) -> IntArray:
    """The factor that the rows of poses at perception cycles belong to, of any shape.

    `part` (0 or 1) splits it by what the rows see of the map. Rows on the left and on the right boundary have
    no key of the map in common, and two narrow factors are faster to eliminate than a wide, half empty one.
    """
    return np.asarray(2 * (cycles // POSES_A_FACTOR) + part)


def linear_graph(groups: Sequence[Rows], variables: Variables) -> gtsam.GaussianFactorGraph:
    """The rows as a graph whose unknowns are the changes from the variables' values.

    For one linearization: unlike the window's factors, none of these outlives the values that it was made at.
    """
    here = variables.copy()
    here.reference = here.values
    return graph_of(*(factor.linear for factor in jacobian_factors(groups, here).values()))


def map_held(groups: Sequence[Rows]) -> list[Rows]:
    """The rows without the map's derivatives: the problem of the poses beside a map that is held."""
    on_poses = []
    for rows in groups:
        poses = are_poses(rows.keys[0]) if len(rows) else np.zeros(0, bool)
        if poses.any():
            entries = np.repeat(poses, sizes(rows.keys[0]))
            on_poses += [Rows(rows.keys[:, poses], rows.jacobian[:, entries], rows.residual, rows.owner)]
    return on_poses


class Elimination:
    """A linear problem whose poses are eliminated."""

    def __init__(self, graph: gtsam.GaussianFactorGraph, layout: Layout) -> None:
        """A graph on the variables of a layout; SingularSystemError where it does not hold the poses."""
        free = np.setdiff1d(layout.keys, keys_of(graph))  # GTSAM would leave them out in silence
        if len(free):
            raise SingularSystemError(f"expected a factor on every variable, found none on {name(free[0])}")
        poses = are_poses(layout.keys)
        self.poses = Layout(layout.keys[poses])
        """The poses."""
        self.map = Layout(layout.keys[~poses])
        """The other variables. A solution is in the order of the keys, so theirs comes first."""
        self._net, rest = _eliminated(graph, self.map, len(self.poses.keys))
        self.information, self.vector = np.zeros((0, 0)), np.zeros(0)
        """`1/2 y' L y - g' y` of the map (n,), the poses eliminated: L (n, n) and g (n,)."""
        if self.map.size:
            self.information, self.vector = normal_equations(rest, self.map)

    # --- solution ----------------------------------------------------------------------------------------

    def step(self, damping: Array) -> Array:
        """(n + 3 P,) the solution where the map's information gains a diagonal (n,).

        SingularSystemError where it is not positive definite then.
        """
        change = solve(cholesky(self.information + np.diag(damping)), self.vector)
        return np.concatenate([change, self.beside(change)])

    def beside(self, change: Array) -> Array:
        """(3 P,) the poses' solution beside a map that changes by (n,)."""
        given = gtsam.VectorValues()
        for key, point in zip(self.map.keys.tolist(), change.reshape(-1, POINT), strict=True):
            given.insert(key, point)
        return np.asarray(self._net.optimize(given).vector(self.poses.keys.tolist()))

    # --- covariances -------------------------------------------------------------------------------------

    @cached_property
    def map_covariance(self) -> Array:
        """(n, n) joint covariance of the map's variables, in the order of their keys."""
        if self.map.size == 0:
            return np.zeros((0, 0))
        inverse, _ = lapack.dpotri(cholesky(self.information.copy()), lower=1)
        return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)

    def joint(self, keys: IntArray) -> Array:
        """Joint covariance of some of the map's variables (k,), in the order that is asked for."""
        entries = self.map.entries(keys)
        return np.asarray(self.map_covariance[np.ix_(entries, entries)])

    @property
    def pose_marginals(self) -> Array:
        """(P, 3, 3) covariance of each pose."""
        return self._of_poses[0]

    @property
    def cross_covariance(self) -> Array:
        """(3 P, n) covariance of every pose with every variable of the map."""
        return self._of_poses[1]

    @cached_property
    def _of_poses(self) -> tuple[Array, Array]:
        """Marginals and cross covariances, from the root clique to the leaves (Kaess and Dellaert 2009).

        A clique's poses x are `T y + R^-1 w`, w white, where y is in the map or in the clique above it. So
        `cov(x, z) = T cov(y, z)` for all z above, and `cov(x) = T cov(y) T' + R^-1 R^-T`.
        """
        marginals = np.empty((self.poses.size // POSE, POSE, POSE))
        cross = np.empty((self.poses.size, self.map.size))
        joints: list[tuple[IntArray, Array]] = []
        clique_of, place = np.empty((2, self.poses.size), np.intp)
        for clique in self._cliques():
            x, y, m = clique.poses, clique.poses_above, clique.map_above
            above = np.zeros((len(y), len(y)))
            if len(y):
                columns, joint = joints[clique_of[y].max()]  # of the cliques that hold one of y, the deepest
                place[columns] = np.arange(len(columns))
                above = joint[np.ix_(place[y], place[y])]
            cross[x] = clique.by_map @ self.map_covariance[m] + clique.by_poses @ cross[y]
            with_above = clique.by_map @ cross[np.ix_(y, m)].T + clique.by_poses @ above
            own = cross[np.ix_(x, m)] @ clique.by_map.T + with_above @ clique.by_poses.T
            own += clique.root @ clique.root.T
            clique_of[x] = len(joints)
            joints.append((np.append(x, y), np.block([[own, with_above], [with_above.T, above]])))
            for k in range(0, len(x), POSE):
                marginals[x[k] // POSE] = own[k : k + POSE, k : k + POSE]
        return marginals, cross

    def _cliques(self) -> Iterator[_Clique]:
        """The poses' cliques, from the root on."""
        for k in reversed(range(self._net.size())):
            conditional = self._net.at(k)
            keys = np.array(conditional.keys(), np.intp)
            R, S = np.array(conditional.R()), np.array(conditional.S())  # views of what is not theirs: copies
            count = len(R) // POSE
            root, _ = lapack.dtrtri(R)
            above, on_poses = keys[count:], are_poses(keys[count:])
            by_above, entries = -(root @ S), np.repeat(on_poses, sizes(above))
            yield _Clique(
                self.poses.entries(keys[:count]),
                self.poses.entries(above[on_poses]),
                self.map.entries(above[~on_poses]),
                root,
                by_above[:, entries],
                by_above[:, ~entries],
            )


@dataclass(frozen=True, eq=False)
class _Clique:
    """`x = T y + R^-1 w`: some poses, by what they shared rows with when they were eliminated."""

    poses: IntArray
    """(f,) entries of x among the poses."""
    poses_above: IntArray
    """(p,) entries of the poses of y among the poses."""
    map_above: IntArray
    """(m,) entries of the rest of y among the map's."""
    root: Array
    """(f, f) R^-1."""
    by_poses: Array
    """(f, p) columns of T of the poses of y."""
    by_map: Array
    """(f, m) columns of T of the rest of y."""


def _eliminated(
    graph: gtsam.GaussianFactorGraph, others: Layout, count: int
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    """The conditionals of `count` poses, the root last, and what is left on the other variables."""
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, others.keys.tolist(), False)
    poses = gtsam.Ordering([order.at(k) for k in range(count)])
    try:
        tree, rest = graph.eliminatePartialMultifrontal(poses)
    except RuntimeError as error:
        raise SingularSystemError("expected poses that the graph holds, found one that is free") from error
    net = gtsam.GaussianBayesNet()
    for conditional in reversed(factors_of(graph_of(tree))):  # a tree gives its conditionals from the root on
        net.push_back(cast("gtsam.GaussianConditional", conditional))
    return net, rest
