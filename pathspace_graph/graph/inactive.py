"""The inactive map: variables on which the window has no factor, given the active ones.

The joint is `p(active) p(inactive | active)`. Measurements in the window change the first factor only, and
inactive variables follow from the second when they are needed. That is exact, and a cycle costs no more on a
longer track. It is one path of a Bayes tree (Kaess et al. 2012), or a compressed filter (Guivant and Nebot
2001).

A conditional depends on its anchor, the pose that was the oldest of the window when its variables were
deactivated and that separates them from the rest of the drive. The anchor stays active as a keyframe until
the next variables are deactivated, together with it.

While the loop is open, only the drive itself ties the map to its beginning, and a bias of the yaw rate bends
all of it: after a thousand metres, a thousandth of a radian per second is tens of metres. So the active part
is held at an anchor near the vehicle, and the stretches behind are attached to it like a chain, each given
by its conditional in the frame of its own anchor: however far the chain swings, it bends none of them. The
oldest link holds the origin of the map frame. To bring it back to (0, 0, 0), the whole map is moved rigidly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, Self

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, IntArray, read_only
from pathspace_graph.factors.linear import keys_of_factor
from pathspace_graph.factors.se2 import compose, inverse

from .gaussian import eliminate, graph_of, jacobian_factor, keys_of, normal_equations, square_root_form
from .variables import (
    NO_KEYS,
    ORIGIN_KEY,
    POSE,
    Layout,
    Variables,
    are_poses,
    pose_key,
    rotation_blocks,
    sizes,
)


@dataclass(frozen=True, eq=False)
class RelativeFactor:
    """Factor `1/2 |A e - b|^2` with `e = y(x) - y0`, where y are in the frame of a pose.

    In the frame of the pose `(p, theta)` a map point c is `R(theta)' (c - p)`, and another pose `(t, h)` is
    `(R(theta)' (t - p), h - theta)`. The calibration does not depend on a frame.
    """

    frame: int  # key of the pose
    keys: Layout  # of the variables y: calibration, map points and poses
    root: Array  # (r, q) A, a square root of the information
    right: Array  # (r,) b
    local: Array  # (q,) linearization point y0

    def factor(self, variables: Variables) -> gtsam.GaussianFactor:
        """Return the factor on its keys and the frame's, but the origin's, linearized at the values."""
        keys = np.append(self.keys.keys, self.frame)
        entries = variables.layout.entries(keys)
        now = variables.values[entries], variables.change(entries)
        block = kernels.relative_block(self.root, self.right, self.local, *now, self.keys)
        widths, moves = np.append(self.keys.widths, POSE), keys != ORIGIN_KEY
        if not moves.all():
            block = np.asfortranarray(block[:, np.append(np.repeat(moves, widths), True)])
        matrix = gtsam.VerticalBlockMatrix([*widths[moves].tolist(), 1], block, False)
        return gtsam.GaussianConditional(keys[moves].tolist(), 1, matrix)


def relative_factor(
    graph: gtsam.GaussianFactorGraph, frame: int, pose: Array, reference: Array, variables: Variables
) -> RelativeFactor:
    """Return a graph of relative measurements as a factor in the frame of a pose.

    That is at `pose` (3,), its unknown measured from `reference` (3,). In the frame of a fixed pose variables
    are linear functions of the unknowns, so the change of frame is exact.
    """
    held = Layout(keys_of(graph))
    information, vector = normal_equations(graph, held)
    known = held.keys[(np.diagonal(information)[held.starts] > 0.0) & (held.keys != frame)]
    kept, own, fixed = Layout(known), held.entries(known), held.entries(held.keys[held.keys == frame])
    entries = variables.layout.entries(known)
    vector = vector[own] - information[np.ix_(own, fixed)] @ (pose - reference)[: len(fixed)]
    information = information[np.ix_(own, own)]
    root, right = square_root_form(information, vector - information @ variables.change(entries))
    local = to_frame(variables.values[entries], pose, kept)
    return RelativeFactor(frame, kept, root @ rotation_of_keys(kept, pose[2]), right, local)


# --- coordinates in the frame of a pose ------------------------------------------------------------------


def rotation_of_keys(keys: Layout, heading: float) -> Array:
    """Return the rotation (q, q) of points and poses from a frame with a heading (rad) to the map frame."""
    x = keys.turning
    return rotation_blocks(keys.size, x, np.full(len(x), heading))


def to_frame(values: Array, frame: Array, keys: Layout) -> Array:
    """Return values (q,) of keys, which are in the map frame, in the frame of a pose (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    local, x = values.copy(), keys.turning
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    local[x], local[x + 1] = c * dx + s * dy, -s * dx + c * dy
    local[keys.headings] -= frame[2]
    return local


def from_frame(local: Array, frame: Array, keys: Layout) -> Array:
    """Return values (q,) of keys, which are in the frame of a pose (3,), in the map frame."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    values, x = local.copy(), keys.turning
    values[x] = frame[0] + c * local[x] - s * local[x + 1]
    values[x + 1] = frame[1] + s * local[x] + c * local[x + 1]
    values[keys.headings] += frame[2]
    return values


def by_frame_of(values: Array, frame: Array, keys: Layout) -> Array:
    """Return the derivative (q, 3) of `to_frame` by the pose of the frame."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    matrix, x = np.zeros((keys.size, POSE)), keys.turning
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    matrix[x, 0], matrix[x, 1], matrix[x, 2] = -c, -s, -s * dx + c * dy
    matrix[x + 1, 0], matrix[x + 1, 1], matrix[x + 1, 2] = s, -c, -c * dx - s * dy
    matrix[keys.headings, 2] = -1.0
    return matrix


# --- factors in the frame of a pose ----------------------------------------------------------------------


class InactiveMap:
    """Bayes net: each conditional depends on variables deactivated later, or on active ones."""

    def __init__(self) -> None:
        self.net = gtsam.GaussianBayesNet()  # conditionals, in the order of their deactivation
        self.keys: IntArray = NO_KEYS  # (k,) of the inactive variables, ascending
        self.anchors: IntArray = NO_KEYS  # (a,) poses that the last conditional depends on
        self._old_anchors: IntArray = NO_KEYS  # they were eliminated with the next conditional
        self._given: IntArray = NO_KEYS  # active variables that the conditionals depend on
        self._active: tuple[Layout, Layout, IntArray] | None = None
        """Layout of all variables, that of the active ones, and their columns in the former."""

    def copy(self) -> Self:
        """Return a map to which conditionals can be added independently."""
        other = shallow(self)
        other.net = gtsam.GaussianBayesNet()
        other.net.push_back(self.net)
        return other

    def __len__(self) -> int:
        return int(self.net.size())

    @property
    def newest(self) -> IntArray:
        """Return the keys (k,) of the variables that become active again together."""
        return self.keys

    def active(self, layout: Layout) -> tuple[Layout, IntArray | slice]:
        """Return the layout of the active variables, and their columns in the layout of all variables."""
        if len(self.keys) == 0:
            return layout, slice(None)
        if self._active is None or self._active[0] is not layout:
            active = np.ones(len(layout.keys), bool)
            active[layout.positions(self.keys)] = False
            part = Layout(layout.keys[active])
            self._active = layout, part, kernels.spread(layout.starts[active], part.widths)
        return self._active[1:]

    def push(
        self, prior: gtsam.GaussianFactorGraph, keys: IntArray, keyframes: IntArray
    ) -> gtsam.GaussianFactorGraph:
        """Move variables (k,) and keyframes from a prior to the net; return what remains."""
        frontals = np.intersect1d(np.append(keys, keyframes), keys_of(prior))
        conditional, remaining = eliminate(prior, frontals)
        self._old_anchors = np.union1d(self._old_anchors, keyframes)
        self.add(conditional, keys)
        return remaining

    def add(self, conditional: gtsam.GaussianConditional, keys: IntArray) -> None:
        """Add the conditional of variables (k,), and perhaps of keyframes, given others."""
        self.net.push_back(conditional)
        self.keys = np.union1d(self.keys, keys)
        separator = np.setdiff1d(keys_of_factor(conditional), np.append(self.keys, self._old_anchors))
        self.anchors = separator[are_poses(separator)]
        self._given = np.setdiff1d(
            np.union1d(self._given, separator), np.append(self.keys, self._old_anchors)
        )
        self._active = None

    def refresh(self, variables: Variables) -> None:
        """Update the inactive variables, given the active ones."""
        if len(self) == 0:
            return
        given, ends = gtsam.VectorValues(), sizes(self._given).cumsum()
        change = np.split(variables.change(variables.layout.entries(self._given)), ends[:-1])
        for key, values in zip(self._given.tolist(), change, strict=True):
            given.insert(key, values)
        solution = self.net.optimize(given)
        entries = variables.layout.entries(self.keys)
        variables.values[entries] = variables.reference[entries] + solution.vector(self.keys.tolist())

    def joint_prior(self, prior: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        """Return the prior of active and inactive variables."""
        if len(self) == 0:
            return prior
        joint = graph_of(gtsam.HessianFactor(graph_of(prior, self.net)))
        return eliminate(joint, self._old_anchors)[1] if len(self._old_anchors) else joint


SIGMA_ANCHOR: Final = 1e-3  # of the pose that holds an open map (m, rad); any value gives the same step


class Attached(Protocol):
    """What else is in the map frame, and moves with the open map."""

    def move(self, motion: Array) -> None:
        """Move by a rigid motion (3,) of the map frame: a turn (rad) and then a shift (m, m)."""


@dataclass(frozen=True, eq=False)
class Link:
    """Conditional of some variables, given others, in the frame of an anchor: its mean is `y = G z + e`."""

    factor: RelativeFactor
    leaving: Layout  # variables y: map points, older anchors, and the origin in the last link
    others: Layout  # variables z
    gain: Array  # (n, m) G
    offset: Array  # (n,) e
    noise: Array  # (n, n) square root N of the covariance N N' of y given z


class InactiveChain(InactiveMap):
    """Links, the oldest first. Each depends on variables that left later, or on active ones."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[Link] = []
        self._pose_keys: IntArray = NO_KEYS  # (a,) keys of the origin and of past anchors, ascending
        self._by_link = NO_KEYS, NO_KEYS, NO_KEYS
        """Keys of the links' frames, and of their variables y and z, link after link."""
        self.poses: dict[int, Array] = {}  # (3,) of the origin and of past anchors by key, as of `refresh`

    def copy(self) -> Self:
        """Return a chain that can grow independently."""
        other = super().copy()
        other.links = self.links.copy()
        other.poses = self.poses.copy()
        return other

    def __len__(self) -> int:
        return len(self.links)

    @property
    def origin(self) -> Array:
        """Return the pose (3,) that the origin of the map frame had in the last `refresh`."""
        return self.poses.get(ORIGIN_KEY, np.zeros(POSE))

    def attach(
        self,
        prior: gtsam.GaussianFactorGraph,
        keys: IntArray,
        variables: Variables,
    ) -> gtsam.GaussianFactorGraph:
        """Move map points (k,) and keyframes from a prior to a new link; return the rest.

        The anchor is the oldest pose of the window.
        """
        known = variables
        if not self.links:
            prior, known = on_origin(prior, variables), self._with_poses(variables)
        leaving = np.concatenate([keys, variables.keyframes, [ORIGIN_KEY]])
        frontals = np.intersect1d(leaving, keys_of(prior))
        conditional, remaining = eliminate(prior, frontals)
        self.links.append(new_link(conditional, frontals, pose_key(variables.first_cycle), known))
        self._changed()
        return remaining

    def detach(self, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Remove the newest link and return it as a graph, linearized at the refreshed variables.

        Its anchors become variables again.
        """
        known, link = self._with_poses(variables), self.links.pop()
        graph = graph_of(link.factor.factor(known))
        for key in link.leaving.keys[are_poses(link.leaving.keys)].tolist():
            if key != ORIGIN_KEY:
                variables.insert(np.array([key]), self.poses[key])
            del self.poses[key]
        self._changed()
        return graph

    def _changed(self) -> None:
        frames = np.array([link.factor.frame for link in self.links], np.intp)
        leaving = np.concatenate([NO_KEYS, *(link.leaving.keys for link in self.links)])
        others = np.concatenate([NO_KEYS, *(link.others.keys for link in self.links)])
        self._by_link, is_pose = (frames, leaving, others), are_poses(leaving)
        self.keys, self._pose_keys = np.sort(leaving[~is_pose]), np.sort(leaving[is_pose])
        self.anchors, self._active = frames[-1:], None

    def refresh(self, variables: Variables) -> None:
        if not self.links:
            return
        known = self._with_poses(variables)
        known.values = kernels.link_means(known.values, self.links, *self._columns(known.layout))
        variables.values[:] = known.of(variables.keys)
        poses = read_only(known.of(self._pose_keys).reshape(-1, POSE))
        self.poses = dict(zip(self._pose_keys.tolist(), poses, strict=True))

    def _columns(self, layout: Layout) -> tuple[IntArray, IntArray, IntArray]:
        """Return the columns of the links' frames (l,), and of their variables y and z, link after link."""
        frames, leaving, others = self._by_link
        return layout.columns(frames), layout.entries(leaving), layout.entries(others)

    @property
    def newest(self) -> IntArray:
        keys = self.links[-1].leaving.keys
        return np.asarray(keys[~are_poses(keys)])

    def holds(self, keys: IntArray) -> bool:
        held = [NO_KEYS, *(link.factor.keys.keys for link in self.links)]
        return bool(np.isin(keys, np.concatenate(held)).any())

    # --- the frame ---------------------------------------------------------------------------------------

    def hold(self, variables: Variables) -> list[gtsam.GaussianFactor]:
        """Return a factor that holds the anchor where it is, since all other information is relative."""
        if not self.links:
            return []
        now = variables.change(variables.layout.entries(self.anchors))
        return [jacobian_factor(self.anchors, np.eye(POSE) / SIGMA_ANCHOR, now / SIGMA_ANCHOR)]

    def transform_to_origin(
        self, prior: gtsam.GaussianFactorGraph, variables: Variables, attached: Sequence[Attached]
    ) -> gtsam.GaussianFactorGraph:
        """Update the inactive variables, and move everything so that the origin is at (0, 0, 0) again.

        Return the prior of the active variables, linearized there.
        """
        anchor = int(self.anchors[0])
        near = relative_factor(prior, anchor, *pose_and_reference(anchor, variables), variables)
        self.refresh(variables)
        motion = inverse(self.origin)
        moved = read_only(compose(motion, np.array([*self.poses.values()])))
        self.poses = dict(zip(self.poses, moved, strict=True))
        variables.values = from_frame(variables.values, motion, variables.layout)
        for one in attached:
            one.move(motion)
        return graph_of(near.factor(variables))

    # --- as one Gaussian ---------------------------------------------------------------------------------

    def joint(self, prior: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Return the prior of all variables and anchors, at the refreshed values."""
        known = self._with_poses(variables)
        return graph_of(prior, *(link.factor.factor(known) for link in self.links))

    def marginal(self, prior: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Return the prior of the active variables, linearized at the refreshed values.

        The links constrain them only through the pose of the origin, which is (0, 0, 0) by definition.
        """
        known, (active, entries) = self._with_poses(variables), self.active(variables.layout)
        columns = self._columns(known.layout)
        by_all, covariance = kernels.origin_by_active(
            known.values, self.links, *columns, int(known.layout.columns(np.array([ORIGIN_KEY]))[0])
        )
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        jacobian = root @ by_all[:, known.layout.entries(active.keys)]
        right = jacobian @ variables.change(entries) - root @ self.origin
        return graph_of(prior, jacobian_factor(active.keys, jacobian, right))

    def _with_poses(self, variables: Variables) -> Variables:
        """Return the variables with the origin and past anchors, as of `refresh`."""
        known, poses, unknown = variables.copy(), self.poses, np.zeros(POSE)
        keys = self._pose_keys if self.links else np.array([ORIGIN_KEY])
        values = np.concatenate([poses.get(key, unknown) for key in keys.tolist()])
        known.insert(keys, values, values * np.repeat(keys != ORIGIN_KEY, POSE))
        return known


def on_origin(graph: gtsam.GaussianFactorGraph, variables: Variables) -> gtsam.GaussianFactorGraph:
    """Return a graph of absolute information as one relative to the origin of the map frame, as a pose."""
    keys = Layout(keys_of(graph))
    root, right = square_root_form(*normal_equations(graph, keys))
    by_origin = by_frame_of(variables.of(keys.keys), np.zeros(POSE), keys)
    return graph_of(
        jacobian_factor(np.append(keys.keys, ORIGIN_KEY), np.hstack([root, root @ by_origin]), right)
    )


def new_link(
    conditional: gtsam.GaussianConditional,
    leaving: IntArray,
    frame: int,
    variables: Variables,
) -> Link:
    """Return a conditional of variables (k,), given others, as a link in the frame of a pose."""
    order, (A, b) = keys_of_factor(conditional), conditional.jacobian()
    (pose, reference), columns = pose_and_reference(frame, variables), np.repeat(order, sizes(order))
    right = np.array(b).ravel() - A[:, columns == frame] @ (pose - reference)
    keys = Layout(np.sort(order[order != frame]))
    placed = np.empty((len(right), keys.size))
    placed[:, keys.entries(order[order != frame])] = A[:, columns != frame]
    entries = variables.layout.entries(keys.keys)
    right -= placed @ variables.change(entries)
    root = placed @ rotation_of_keys(keys, pose[2])
    factor = RelativeFactor(frame, keys, root, right, to_frame(variables.values[entries], pose, keys))
    own, others = Layout(leaving), Layout(np.setdiff1d(keys.keys, leaving))
    solved = np.linalg.solve(
        root[:, keys.entries(own.keys)], np.column_stack([-root[:, keys.entries(others.keys)], right])
    )
    gain = np.asarray(solved[:, :-1], float)
    offset = factor.local[keys.entries(own.keys)] - gain @ factor.local[keys.entries(others.keys)]
    offset += solved[:, -1]
    noise = np.asarray(np.linalg.inv(root[:, keys.entries(own.keys)]), float)
    return Link(factor, own, others, gain, offset, noise)


def pose_and_reference(key: int, variables: Variables) -> tuple[Array, Array]:
    """Return the pose (3,) of a key, and the pose (3,) that its unknown is measured from."""
    entries = variables.layout.entries(np.array([key]))
    return variables.values[entries], variables.reference[entries]
