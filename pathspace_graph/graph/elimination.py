"""A linear problem of poses and the map that they see: its solution and its covariances.

For a solution, GTSAM eliminates poses and map in one order: on a long road a clique holds little more than
what is seen around a place. For covariances it eliminates the poses, `p(poses, map) = p(poses | map) p(map)`,
and one dense matrix remains on the map. The map is every variable that is not a pose: control points or
landmarks, and the calibration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Final, cast

import gtsam
import numpy as np
from scipy.linalg import lapack

from pathspace_graph.errors import SingularSystemError
from pathspace_graph.factors.arrays import Array, IntArray

from .gaussian import factorize, factors_of, graph_of, keys_of, normal_equations, require_keys
from .rows import Rows, jacobian_factors
from .variables import NO_KEYS, POSE, Layout, Variables, are_poses, indices, pose_keys, sizes

POSES_IN_FACTOR: Final = 8
"""Few factors are cheap to create, narrow ones to eliminate; 5 to 10 poses take alike. All rows of a graph
need the same number: a factor across two groups of poses doubles the time."""


def owners(cycles: IntArray, side: IntArray | int = 0) -> IntArray:
    """Return the number of the factor that the rows of poses belong to, by perception cycles of any shape.

    Each side, left (0) and right (1), has its own, since they have no key of the map in common.
    """
    return np.asarray(2 * (cycles // POSES_IN_FACTOR) + side)


def linear_graph(groups: Sequence[Rows], variables: Variables) -> gtsam.GaussianFactorGraph:
    """Return the rows as a graph whose unknowns are the changes from the variables' values.

    Its factors are squared already: GTSAM takes longer to do that while it eliminates.
    """
    factors = jacobian_factors(groups, variables.layout).values()
    return graph_of(*map(gtsam.HessianFactor, factors))


def fix_map(groups: Sequence[Rows]) -> list[Rows]:
    """Return the rows without derivatives by the map: the problem of the poses given a fixed map."""
    on_poses = []
    for rows in groups:
        poses = are_poses(rows.keys[0]) if len(rows) else np.zeros(0, bool)
        if poses.any():
            entries = np.repeat(poses, sizes(rows.keys[0]))
            on_poses += [Rows(rows.keys[:, poses], rows.jacobian[:, entries], rows.residual, rows.owner)]
    return on_poses


def bayes_net(graph: gtsam.GaussianFactorGraph, layout: Layout) -> gtsam.GaussianBayesNet:
    """Eliminate all variables of a layout: the conditionals are `R' R = H`, with the graph's information H.

    SingularSystemError where the graph does not determine it, or holds no factor on a variable.
    """
    require_keys(graph, layout)
    return _eliminated(graph, Layout(NO_KEYS), len(layout.keys))[0]


def solution(graph: gtsam.GaussianFactorGraph, layout: Layout) -> Array:
    """Return the solution (n,) of a graph on the variables of a layout. Raises as `bayes_net` does."""
    return np.asarray(bayes_net(graph, layout).optimize().vector(layout.keys.tolist()))


def step_by(net: gtsam.GaussianBayesNet, groups: Sequence[Rows], layout: Layout) -> tuple[Array, float]:
    """Return the step (n,) `-H^-1 g` of rows with gradient `g = J' r`, by the information H of a net.

    The second result is the decrease `1/2 g' H^-1 g` that it predicts: 1/2 for a step of one sigma. The net
    is that of these rows, or of rows at a point nearby.
    """
    gradient, own = np.zeros(layout.size), gtsam.VectorValues()
    for rows in groups:
        by_row = (rows.jacobian * rows.residual[:, None]).ravel()
        gradient += np.bincount(rows.columns(layout).ravel(), by_row, layout.size)
    places = zip(layout.keys.tolist(), layout.starts.tolist(), layout.widths.tolist(), strict=True)
    for key, start, width in places:
        own.insert(key, -gradient[start : start + width])
    found = net.backSubstitute(net.backSubstituteTranspose(own))
    step = np.asarray(found.vector(layout.keys.tolist()))
    return step, -0.5 * float(gradient @ step)


class Elimination:
    """Linear problem whose poses have been eliminated, for its covariances."""

    def __init__(self, graph: gtsam.GaussianFactorGraph, layout: Layout) -> None:
        """Eliminate the poses of a graph on the variables of a layout.

        SingularSystemError where the graph does not determine the poses, or holds no factor on a variable.
        """
        require_keys(graph, layout)
        poses = are_poses(layout.keys)
        self.poses = Layout(layout.keys[poses])
        self.map = Layout(layout.keys[~poses])
        self._net, self._remaining = _eliminated(graph, self.map, len(self.poses.keys))

    @cached_property
    def map_covariance(self) -> Array:
        """Return the joint covariance (n, n) of the map's variables, in the order of their keys."""
        if self.map.size == 0:
            return np.zeros((0, 0))
        inverse, _ = lapack.dpotri(factorize(self._remaining, self.map).factor, lower=1)
        return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)

    def joint(self, keys: IntArray) -> Array:
        """Return the joint covariance of some of the map's variables (k,), in the given order."""
        entries = self.map.entries(keys)
        return np.asarray(self.map_covariance[np.ix_(entries, entries)])

    @property
    def pose_marginals(self) -> Array:
        """Return the covariance (P, 3, 3) of each pose."""
        return self._pose_covariances[0]

    @property
    def cross_covariance(self) -> Array:
        """Return the covariance (3 P, n) of every pose with every variable of the map."""
        return self._pose_covariances[1]

    @cached_property
    def _pose_covariances(self) -> tuple[Array, Array]:
        """Return marginals and cross covariances, computed from the root clique to the leaves.

        A clique's poses x are `T y + R^-1 w` with w white, so `cov(x, z) = T cov(y, z)` for all z above, and
        `cov(x) = T cov(y) T' + R^-1 R^-T` (Kaess and Dellaert 2009).
        """
        marginals = np.empty((self.poses.size // POSE, POSE, POSE))
        cross = np.empty((self.poses.size, self.map.size))
        joints: list[tuple[IntArray, Array]] = []
        clique_of, place = np.empty((2, self.poses.size), np.intp)
        for x, y, m, root, by_poses, by_map in self._cliques():
            above = np.zeros((len(y), len(y)))
            if len(y):
                columns, joint = joints[clique_of[y].max()]  # the deepest that holds one of y holds all
                place[columns] = np.arange(len(columns))
                above = joint[np.ix_(place[y], place[y])]
            cross[x] = by_map @ self.map_covariance[m] + by_poses @ cross[y]
            with_above = by_map @ cross[np.ix_(y, m)].T + by_poses @ above
            own = cross[np.ix_(x, m)] @ by_map.T + with_above @ by_poses.T
            own += root @ root.T
            clique_of[x] = len(joints)
            joints.append((np.append(x, y), np.block([[own, with_above], [with_above.T, above]])))
            for k in range(0, len(x), POSE):
                marginals[x[k] // POSE] = own[k : k + POSE, k : k + POSE]
        return marginals, cross

    def _cliques(self) -> Iterator[tuple[IntArray, IntArray, IntArray, Array, Array, Array]]:
        """Yield the conditionals `x = T y + R^-1 w` of poses x (f,), given their separator y, root first.

        The tuples hold the entries of x, of the poses (p,) and of the map's variables (m,) in y, R^-1 (f, f),
        and the columns of T for the poses (f, p) and for the map (f, m).
        """
        for k in reversed(range(self._net.size())):
            conditional = self._net.at(k)
            keys = np.array(conditional.keys(), np.intp)
            R, S = np.array(conditional.R()), np.array(conditional.S())  # copies: views of freed memory
            count = len(R) // POSE
            root, _ = lapack.dtrtri(R)
            above, on_poses = keys[count:], are_poses(keys[count:])
            by_above, entries = -(root @ S), np.repeat(on_poses, sizes(above))
            yield (
                self.poses.entries(keys[:count]),
                self.poses.entries(above[on_poses]),
                self.map.entries(above[~on_poses]),
                root,
                by_above[:, entries],
                by_above[:, ~entries],
            )


def eliminated_system(graph: gtsam.GaussianFactorGraph, kept: Layout) -> tuple[Array, Array]:
    """Return H (n, n) and g (n,) on a layout, all others eliminated. Raises as `Elimination` does."""
    _, remaining = _eliminated(graph, kept, len(keys_of(graph)) - len(kept.keys))
    return normal_equations(remaining, kept)


def marginal_before(groups: Sequence[Rows], variables: Variables, first: int) -> tuple[Layout, Array, Array]:
    """Return what poses before the cycle `first` say: H (n, n) and g (n,) on [calibrations | map | its pose].

    It has all rows with an earlier pose or without a pose, and no others, on the variables of the map that
    they hold. The unknowns are the changes from the variables' values.
    """
    before = list[Rows]()
    for rows in groups:
        if len(rows):
            poses = are_poses(rows.keys)
            kept = (poses & (indices(rows.keys) < first)).any(axis=1) | ~poses.any(axis=1)
            before.append(rows.where(np.flatnonzero(kept)))
    held = np.unique(np.concatenate([rows.keys.ravel() for rows in before]))
    layout = Layout(np.append(held[~are_poses(held)], pose_keys(np.array([first]))))
    return layout, *eliminated_system(linear_graph(before, variables), layout)


def _eliminated(
    graph: gtsam.GaussianFactorGraph, others: Layout, count: int
) -> tuple[gtsam.GaussianBayesNet, gtsam.GaussianFactorGraph]:
    """Return the conditionals of `count` variables, the root last, and the graph that remains on the others.

    GTSAM may take poses for free that are certain relative to each other alone, as those of a vehicle that
    rests far from its start. Eliminated from the last pose to the first, they hang on those before them.
    """
    order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(graph, others.keys.tolist(), False)
    keys = [order.at(k) for k in range(count)]
    try:
        tree, remaining = graph.eliminatePartialMultifrontal(gtsam.Ordering(keys))
    except RuntimeError:
        try:
            in_turn = gtsam.Ordering(sorted(keys, reverse=True))
            tree, remaining = graph.eliminatePartialMultifrontal(in_turn)
        except RuntimeError as error:
            raise SingularSystemError(
                "expected a graph that determines poses and map, found a variable that is free"
            ) from error
    net = gtsam.GaussianBayesNet()
    for conditional in reversed(factors_of(graph_of(tree))):  # a tree gives its root first
        net.push_back(cast("gtsam.GaussianConditional", conditional))
    return net, remaining
