"""The inactive map: variables that nothing in the window touches, conditional on the active ones.

`p(active, inactive) = p(active) p(inactive | active)`: what the window measures changes the active part only,
and the inactive part follows through its conditional when it is asked for. That is exact, and a cycle costs
no more on a longer track. It is one path of a Bayes tree (Kaess et al. 2012), or a compressed filter (Guivant
and Nebot 2001).

A conditional needs the oldest pose of the window as it was when its variables left, since what the two sides
know of each other they know through it. That pose, its anchor, stays active until the next ones leave with
it.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import as_hessian_factor, eliminate, graph_of, keys_of
from .keys import are_poses
from .variables import Variables, spread

IntArray = NDArray[np.intp]

_NO_KEYS: IntArray = np.zeros(0, np.intp)


class InactiveMap:
    """A Bayes net: each conditional hangs on what left after it, and the last one on active variables."""

    def __init__(self) -> None:
        self.net = gtsam.GaussianBayesNet()
        """The conditionals, the first to leave first."""
        self.keys: IntArray = _NO_KEYS
        """(k,) the variables that are inactive, ascending."""
        self.members: frozenset[int] = frozenset()
        """The same as a set."""
        self.anchors: IntArray = _NO_KEYS
        """(a,) poses that the last conditional hangs on, which have to stay active."""
        self._gone: IntArray = _NO_KEYS  # anchors of earlier conditionals, which left with the next ones
        self._given: IntArray = _NO_KEYS  # what the conditionals hang on and is neither inactive nor gone
        self._shared: list[gtsam.GaussianFactor] = []

    def __len__(self) -> int:
        return int(self.net.size())

    def push(
        self,
        prior: gtsam.GaussianFactorGraph,
        leaving: IntArray,
        keyframes: IntArray,
        shared: Sequence[gtsam.GaussianFactor],
    ) -> gtsam.GaussianFactorGraph:
        """Variables (k,) and the keyframes leave a prior; gives the prior of what stays.

        `shared`: other factors that leave with them, and come back by themselves: weak priors between them
        and with the rest, and the user's own.
        """
        graph = graph_of(prior, *shared)
        frontals = np.intersect1d(np.append(leaving, keyframes), keys_of(graph))
        conditional, remaining = eliminate(graph, frontals)
        self.net.push_back(conditional)
        self.keys = np.union1d(self.keys, leaving)
        self.members = frozenset(self.keys.tolist())
        self._gone = np.union1d(self._gone, keyframes)
        separator = np.array(list(conditional.keys()), np.intp)[len(frontals) :]
        self.anchors = separator[are_poses(separator)]
        self._given = np.setdiff1d(np.union1d(self._given, separator), np.append(self.keys, self._gone))
        self._shared += shared
        return remaining

    def refresh(self, variables: Variables) -> None:
        """Bring the inactive variables up to date: back-substitution, given the active ones."""
        if len(self) == 0:
            return
        given, places = gtsam.VectorValues(), variables.layout.positions(self._given)
        starts, widths = variables.layout.starts[places], variables.layout.widths[places]
        change = np.split(variables.change(spread(starts, widths)), np.cumsum(widths)[:-1])
        for key, values in zip(self._given.tolist(), change, strict=True):
            given.insert(key, values)
        solution = self.net.optimize(given)
        entries = variables.layout.entries(self.keys)
        variables.values[entries] = variables.reference[entries] + solution.vector(self.keys.tolist())

    def joined(self, prior: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        """The prior as if nothing had left, without what had left beside it and comes back by itself.

        A conditional is a factor. The anchors that are no variables any more are eliminated.
        """
        if len(self) == 0:
            return prior
        negative = [factor.negate() for factor in self._shared]
        whole = graph_of(as_hessian_factor(graph_of(prior, self.net, *negative)))
        return eliminate(whole, self._gone)[1] if len(self._gone) else whole
