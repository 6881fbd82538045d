"""The inactive part of an open map: a chain of stretches, each in the frame of the pose where it was left.

While the loop is open, nothing ties the map to the place where the drive began but the drive itself. A bias
of the yaw rate bends the whole of it: after a thousand metres, a thousandth of a radian per second is tens of
metres. So the active part of the map is held at an anchor pose near the vehicle, and the stretches behind
hang on it, one on the next, like a chain. Each is given by its conditional in the frame of its own anchor.
However far the chain swings, no stretch is bent by more than the measurements say.

The oldest link holds the origin of the map frame. To bring it back to (0, 0, 0), the whole map is moved
rigidly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose, inverse

from .gaussian import (
    eliminate,
    graph_of,
    jacobian_factor,
    keys_of,
    normal_equations,
    sparse_marginal,
    square_root_form,
)
from .inactive import InactiveMap
from .keys import ORIGIN_KEY, POSE, are_poses, pose_key, sizes
from .relative import RelativeFactor, by_frame_of, from_frame, relative_factor, rotations, to_frame
from .variables import Layout, Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


SIGMA_ANCHOR: Final = 1e-3
"""An open map is held at its anchor with this standard deviation (m, rad). All else is relative, so that any
value gives the same step."""


class Follower(Protocol):
    """Describes what else is in the map frame, and must go where the open map goes."""

    def move(self, motion: Array) -> None:
        """Moves everything by a rigid motion (3,) of the map frame: a turn (rad) and then a shift (m, m)."""


@dataclass(frozen=True, eq=False)
class Link:
    """A link is the conditional of some variables, given others, in the frame of an anchor pose."""

    factor: RelativeFactor
    """This is the conditional as a factor."""
    shared: tuple[RelativeFactor, ...]
    """These weak priors are part of the conditional, and their owners add them again to an active map."""
    leaving: Layout
    """These variables are given by the link: map points, older anchors, and the origin in the last link."""
    others: Layout
    """The link depends on these variables and on its anchor."""
    gain: Array
    """In the frame of the anchor the mean is `y = G z + e`, with G (n, m) for the others z."""
    offset: Array
    """This is e (n,)."""

    def solve(self, variables: Variables, frame: Array) -> Array:
        """Returns the mean (n,) of the leaving variables in the map frame, with the anchor at a pose (3,)."""
        others = to_frame(variables.of(self.others.keys), frame, self.others)
        return from_frame(self.gain @ others + self.offset, frame, self.leaving)

    def holds(self, keys: IntArray) -> bool:
        """Returns whether the link is a function of any of some variables."""
        return bool(np.isin(self.factor.keys.keys, keys).any())


class InactiveChain(InactiveMap):
    """Holds the links, the oldest first. Each depends on variables that left later, or on active ones."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[Link] = []
        """These are the links, in the order in which they left."""
        self.poses: dict[int, Array] = {}
        """These are the poses (3,) of the origin and of anchors that are no variables, as of `refresh`."""

    def __len__(self) -> int:
        return len(self.links)

    @property
    def origin(self) -> Array:
        """Returns the pose (3,) that the origin of the map frame had in the last `refresh`."""
        return self.poses.get(ORIGIN_KEY, np.zeros(POSE))

    def attach(
        self,
        prior: gtsam.GaussianFactorGraph,
        keys: IntArray,
        shared: Sequence[gtsam.GaussianFactor],
        variables: Variables,
    ) -> gtsam.GaussianFactorGraph:
        """Moves map points (k,) and all keyframes from a prior to a new link, and returns the prior left.

        The anchor is the oldest pose of the window. The factors `shared` are moved with them.
        """
        known = variables
        if not self.links:
            prior, known = on_origin(prior, variables), self._with_poses(variables)
        keyframes = variables.keyframes
        graph, leaving = graph_of(prior, *shared), np.concatenate([keys, keyframes])
        frontals = np.intersect1d(np.append(leaving, ORIGIN_KEY), keys_of(graph))
        conditional, remaining = eliminate(graph, frontals)
        anchor = pose_key(variables.first_cycle)
        self.links.append(new_link(conditional, frontals, shared, anchor, known))
        self._changed()
        return remaining

    def detach(self, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Removes the newest link and returns it as a graph, linearized at the refreshed variables.

        Its anchors become variables again. The `shared` factors of `attach` are taken out.
        """
        graph, link = graph_of(*self._factors(self.links[-1], self._with_poses(variables))), self.links.pop()
        for key in link.leaving.keys[are_poses(link.leaving.keys)].tolist():
            if key != ORIGIN_KEY:
                variables.insert(np.array([key]), self.poses[key])
            del self.poses[key]
        self._changed()
        return graph

    def _changed(self) -> None:
        """Notes which variables are inactive, and which pose is the anchor, after the links have changed."""
        leaving = [link.leaving.keys for link in self.links]
        keys = np.concatenate([np.zeros(0, np.intp), *leaving])
        self.keys = np.sort(keys[~are_poses(keys)])
        self.members = frozenset(self.keys.tolist())
        self.anchors = np.array([link.factor.frame for link in self.links[-1:]], np.intp)
        self._active = None

    def refresh(self, variables: Variables) -> None:
        """Updates the inactive variables, from the newest link to the oldest, given the active ones."""
        self.poses = {}
        for link in reversed(self.links):
            values = link.solve(variables, self._pose(link.factor.frame, variables))
            points = ~are_poses(link.leaving.keys)
            count = int(link.leaving.widths[points].sum())
            variables.values[variables.layout.entries(link.leaving.keys[points])] = values[:count]
            poses = values[count:].reshape(-1, POSE)
            self.poses |= dict(zip(link.leaving.keys[~points].tolist(), poses, strict=True))

    def _pose(self, key: int, variables: Variables) -> Array:
        """Returns the pose (3,) of an anchor."""
        return self.poses[key] if key in self.poses else variables.of(np.array([key]))

    @property
    def newest(self) -> IntArray:
        """Returns the keys (k,) of the map points that left last."""
        keys = self.links[-1].leaving.keys
        return np.asarray(keys[~are_poses(keys)])

    def holds(self, keys: IntArray) -> bool:
        """Returns whether any link is a function of any of some variables."""
        return any(link.holds(keys) for link in self.links)

    # --- the frame ---------------------------------------------------------------------------------------

    def hold(self, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Returns a factor that holds the anchor where it is, since all other information is relative."""
        if not self.links:
            return []
        now = variables.change(variables.layout.entries(self.anchors))
        return [jacobian_factor(self.anchors, np.eye(POSE) / SIGMA_ANCHOR, now / SIGMA_ANCHOR)]

    def carry(
        self, prior: gtsam.GaussianFactorGraph, variables: Variables, followers: Sequence[Follower]
    ) -> gtsam.GaussianFactorGraph:
        """Updates the inactive variables, and moves everything so that the origin is at (0, 0, 0) again.

        It returns the prior of the active variables, linearized there.
        """
        anchor = int(self.anchors[0])
        near = relative_factor(prior, anchor, *pose_and_reference(anchor, variables), variables)
        self.refresh(variables)
        motion = inverse(self.origin)
        self.poses = {key: compose(motion, pose) for key, pose in self.poses.items()}
        variables.values = from_frame(variables.values, motion, variables.layout)
        for follower in followers:
            follower.move(motion)
        return graph_of(near.factor(variables))

    # --- as one Gaussian ---------------------------------------------------------------------------------

    def joint(self, prior: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Returns the prior of all variables and anchors in the map frame.

        It is linearized at the refreshed values. The `shared` factors of `attach` are part of it.
        """
        known = self._with_poses(variables)
        return graph_of(prior, *(link.factor.factor(known) for link in self.links))

    def marginal(self, prior: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Returns the prior of the active variables in the map frame, linearized at the refreshed values."""
        graph = self.joint(prior, variables)
        anchors = np.array([key for key in self.poses if key != ORIGIN_KEY], np.intp)
        inactive = np.append(self.keys, anchors)
        return sparse_marginal(graph, np.setdiff1d(keys_of(graph), inactive))

    def _factors(self, link: Link, known: Variables) -> list[gtsam.GaussianFactor]:
        return [link.factor.factor(known), *(one.factor(known).negate() for one in link.shared)]

    def _with_poses(self, variables: Variables) -> Variables:
        """Returns copies of the variables, together with the anchors and the origin."""
        known = variables.copy()
        poses = {ORIGIN_KEY: np.zeros(POSE)} | self.poses
        keys = sorted(poses)
        values = np.concatenate([poses[key] for key in keys])
        reference = np.concatenate([np.zeros(POSE) if key == ORIGIN_KEY else poses[key] for key in keys])
        known.insert(np.array(keys, np.intp), values, reference)
        return known


def on_origin(graph: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
    """Returns a graph of absolute information as one of relative information, on the origin as a pose.

    What is known in the map frame is known relative to its origin.
    """
    keys = Layout(keys_of(graph))
    root, right = square_root_form(*normal_equations(graph, keys))
    by_origin = by_frame_of(variables.of(keys.keys), np.zeros(POSE), keys)
    return graph_of(
        jacobian_factor(np.append(keys.keys, ORIGIN_KEY), np.hstack([root, root @ by_origin]), right)
    )


def new_link(
    conditional: gtsam.GaussianConditional,
    leaving: IntArray,
    shared: Sequence[gtsam.GaussianFactor],
    frame: int,
    variables: Variables,
) -> Link:
    """Returns a conditional of variables (k,), given others, as a link in the frame of a pose.

    In the frame of a fixed pose all other variables are linear functions of the unknowns.
    """
    order, (A, b) = np.array(list(conditional.keys()), np.intp), conditional.jacobian()
    (pose, reference), columns = pose_and_reference(frame, variables), np.repeat(order, sizes(order))
    right = np.array(b).ravel() - A[:, columns == frame] @ (pose - reference)
    keys = Layout(np.sort(order[order != frame]))
    placed = np.empty((len(right), keys.size))
    placed[:, keys.entries(order[order != frame])] = A[:, columns != frame]
    entries = variables.layout.entries(keys.keys)
    right -= placed @ variables.change(entries)
    root = placed @ rotations(keys, pose[2])
    factor = RelativeFactor(frame, keys, root, right, to_frame(variables.values[entries], pose, keys))
    own, others = Layout(leaving), Layout(np.setdiff1d(keys.keys, leaving))
    solved = np.linalg.solve(
        root[:, keys.entries(own.keys)], np.column_stack([-root[:, keys.entries(others.keys)], right])
    )
    weak = tuple(relative_factor(graph_of(one), frame, pose, reference, variables) for one in shared)
    gain = np.asarray(solved[:, :-1], float)
    offset = factor.local[keys.entries(own.keys)] - gain @ factor.local[keys.entries(others.keys)]
    offset += solved[:, -1]
    return Link(factor, weak, own, others, gain, offset)


def pose_and_reference(key: int, variables: Variables) -> tuple[Array, Array]:
    """Returns the pose (3,) of a key, and the pose (3,) that its unknown is measured from."""
    entries = variables.layout.entries(np.array([key]))
    return variables.values[entries], variables.reference[entries]
