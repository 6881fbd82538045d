"""The inactive map: variables on which the window has no factor, given the active ones.

The joint is split as `p(active, inactive) = p(active) p(inactive | active)`. Measurements in the window
change the first factor only, and the inactive variables follow from their conditional when they are needed.
That is exact, and a cycle costs no more on a longer track. It is one path of a Bayes tree (Kaess et al.
2012), or a compressed filter (Guivant and Nebot 2001).

A conditional depends on the pose that was the oldest of the window when its variables were deactivated: it
separates them from the rest of the drive. This pose, the anchor, stays active as a keyframe until the next
variables are deactivated, together with it.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import as_hessian_factor, eliminate, graph_of, keys_of
from .keys import are_poses
from .variables import Layout, Variables, spread

IntArray = NDArray[np.intp]

_NO_KEYS: IntArray = np.zeros(0, np.intp)


class InactiveMap:
    """Holds a Bayes net: each conditional depends on variables deactivated later, or on active ones."""

    def __init__(self) -> None:
        self.net = gtsam.GaussianBayesNet()
        """These are the conditionals, in the order of their deactivation."""
        self.keys: IntArray = _NO_KEYS
        """These are the keys (k,) of the inactive variables, ascending."""
        self.members: frozenset[int] = frozenset()
        """This is the set of the same keys."""
        self.anchors: IntArray = _NO_KEYS
        """The last conditional depends on these poses (a,), which must stay active."""
        self._old_anchors: IntArray = _NO_KEYS  # they were eliminated with the next conditional
        self._given: IntArray = _NO_KEYS  # active variables that the conditionals depend on
        self._shared: list[gtsam.GaussianFactor] = []
        self._active: tuple[Layout, Layout] | None = None  # layouts of all and of the active variables

    def __len__(self) -> int:
        return int(self.net.size())

    @property
    def newest(self) -> IntArray:
        """Returns the keys (k,) of the variables that become active again together, which are all."""
        return self.keys

    def active(self, layout: Layout) -> Layout:
        """Returns the layout of the active variables, given that of all variables."""
        if len(self.keys) == 0:
            return layout
        if self._active is None or self._active[0] is not layout:
            active = np.ones(len(layout.keys), bool)
            active[layout.positions(self.keys)] = False
            self._active = layout, Layout(layout.keys[active])
        return self._active[1]

    def push(
        self,
        prior: gtsam.GaussianFactorGraph,
        keys: IntArray,
        keyframes: IntArray,
        shared: Sequence[gtsam.GaussianFactor],
    ) -> gtsam.GaussianFactorGraph:
        """Moves variables (k,) and the keyframes from a prior to the net, and returns the remaining prior.

        The factors `shared` are moved with them. They are weak priors on these variables and the user's
        factors, which their owners add again once all variables are active.
        """
        graph = graph_of(prior, *shared)
        frontals = np.intersect1d(np.append(keys, keyframes), keys_of(graph))
        conditional, remaining = eliminate(graph, frontals)
        self.net.push_back(conditional)
        self.keys = np.union1d(self.keys, keys)
        self.members = frozenset(self.keys.tolist())
        self._old_anchors = np.union1d(self._old_anchors, keyframes)
        separator = np.array(list(conditional.keys()), np.intp)[len(frontals) :]
        self.anchors = separator[are_poses(separator)]
        self._given = np.setdiff1d(
            np.union1d(self._given, separator), np.append(self.keys, self._old_anchors)
        )
        self._shared += shared
        self._active = None
        return remaining

    def refresh(self, variables: Variables) -> None:
        """Updates the inactive variables by back-substitution, given the active ones."""
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

    def joint_prior(self, prior: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        """Returns the prior of active and inactive variables, without the `shared` factors of `push`.

        A conditional is a factor, so the joint is the product of the prior and the net. Anchors that are no
        longer variables are eliminated.
        """
        if len(self) == 0:
            return prior
        negative = [factor.negate() for factor in self._shared]
        joint = graph_of(as_hessian_factor(graph_of(prior, self.net, *negative)))
        return eliminate(joint, self._old_anchors)[1] if len(self._old_anchors) else joint
