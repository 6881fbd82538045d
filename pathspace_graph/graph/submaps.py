"""Submaps: the marginals of parts of the drive, each in its own frame, so that closing can relinearize them.

All measurements of a part of the drive are relative: detections relate poses to map points, and odometry
relates poses to poses. Its marginal is therefore a function of coordinates in the frame of its first pose,
the keyframe, and stays valid when loop closure turns the whole part. A single dense prior does not: it is
linearized at the heading that the vehicle had drifted to.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import (
    condition,
    graph_of,
    jacobian_factor,
    keys_of,
    marginalize,
    normal_equations,
    remove_information,
    square_root_form,
)
from .keys import CALIBRATION_KEY, POSE
from .variables import Layout, Variables, rotation_blocks

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Submap:
    """A submap is `1/2 |A e - b|^2` with `e = y(x) - y0`, where y are variables in the frame of a keyframe.

    In the frame of the keyframe `(p, theta)` a map point c is `R(theta)' (c - p)`, and the end pose is
    `(R(theta)' (t - p), theta_end - theta)`. The calibration does not depend on a frame.
    """

    keyframe: int
    """This is the key of the pose in whose frame the submap is."""
    keys: Layout
    """The variables y are the calibration, map points and, last, the end pose."""
    root: Array
    """This is A (r, q), a square root of the information."""
    right: Array
    """This is b (r,)."""
    local: Array
    """This is the linearization point y0 (q,)."""

    def factor(self, variables: Variables) -> gtsam.GaussianFactor:
        """Returns the submap as a factor on its keys and the keyframe, linearized at the current values."""
        keys = np.append(self.keys.keys, self.keyframe)
        values, frame = variables.of(self.keys.keys), variables.of(keys[-1:])
        by_keys, by_frame = _rotations(self.keys, frame).T, _by_frame(values, frame, self.keys)
        jacobian = self.root @ np.concatenate([by_keys, by_frame], axis=1)
        residual = self.root @ (_local(values, frame, self.keys) - self.local) - self.right
        now = variables.change(variables.layout.entries(keys))
        return jacobian_factor(keys, jacobian, jacobian @ now - residual)

    def without(self, keys: IntArray) -> Submap:
        """Returns the submap without information about some keys."""
        removed = Layout(np.intersect1d(self.keys.keys, keys))
        if removed.size == 0:
            return self
        kept = Layout(np.setdiff1d(self.keys.keys, removed.keys))
        graph = graph_of(jacobian_factor(self.keys.keys, self.root, self.right))
        graph = remove_information(graph, removed, np.zeros(removed.size))
        root, right = square_root_form(*normal_equations(graph, kept))
        return Submap(self.keyframe, kept, root, right, self.local[self.keys.entries(kept.keys)])


def _points(keys: Layout) -> IntArray:
    """Returns the columns of the x of all points and of the end pose, which turn with the frame."""
    return np.asarray(keys.starts[keys.keys != CALIBRATION_KEY])


def _rotations(keys: Layout, frame: Array) -> Array:
    """Returns the rotation (q, q) of points and end pose from the keyframe's frame to the map frame."""
    x = _points(keys)
    return rotation_blocks(keys.size, x, np.full(len(x), frame[2]))


def _local(values: Array, frame: Array, keys: Layout) -> Array:
    """Returns the values (q,), which are in the map frame, in the frame of the keyframe (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    local, x = values.copy(), _points(keys)
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    local[x], local[x + 1] = c * dx + s * dy, -s * dx + c * dy
    local[-1] -= frame[2]
    return local


def _by_frame(values: Array, frame: Array, keys: Layout) -> Array:
    """Returns the derivative (q, 3) of `_local` by the keyframe."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    matrix, x = np.zeros((keys.size, POSE)), _points(keys)
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    matrix[x, 0], matrix[x, 1], matrix[x, 2] = -c, -s, -s * dx + c * dy
    matrix[x + 1, 0], matrix[x + 1, 1], matrix[x + 1, 2] = s, -c, -c * dx - s * dy
    matrix[-1, 2] = -1.0
    return matrix


class Submaps:
    """Holds the submaps of the drive up to loop closure; the last of them is unfinished."""

    def __init__(self, first: gtsam.GaussianFactorGraph, interval: float) -> None:
        self.first = first
        """This is the absolute prior of the calibration and the first pose."""
        self.interval = interval
        """This is the length of path (m) between keyframes."""
        self.finished: list[Submap] = []
        """These are the finished submaps, in the order of the drive."""
        self.keyframes: dict[int, tuple[Array, Array]] = {}
        """Each keyframe, by key, has its pose (3,) when it was marginalized, and its reference (3,)."""
        self._graph: gtsam.GaussianFactorGraph | None = None
        self._keyframe = 0
        self._driven = 0.0

    def add_pose(self, pose: int, factors: gtsam.GaussianFactorGraph, variables: Variables) -> None:
        """Adds the window's oldest pose, by its key, and its factors, without the prior, to the submap.

        The pose is marginalized out unless it is the keyframe. The next pose is the end of the submap.
        """
        if self._driven >= self.interval:
            self.finish(variables)
        entries = variables.layout.entries(np.array([pose]))
        if self._graph is None:
            self._keyframe, self._graph, self._driven = pose, factors, 0.0
            self.keyframes[pose] = variables.linearized[entries].copy(), variables.reference[entries].copy()
        else:
            self._graph = marginalize(graph_of(self._graph, factors), np.array([pose]))
        following = variables.linearized[variables.layout.entries(np.array([pose + 1]))]
        self._driven += float(np.hypot(*(following[:2] - variables.linearized[entries[:2]])))

    def finish(self, variables: Variables) -> None:
        """Finishes the current submap at the oldest pose of the window."""
        if self._graph is not None:
            self.finished.append(self._finished_submap(variables))
            self._graph = None

    def remove_information(self, keys: IntArray, variables: Variables) -> None:
        """Removes all information about some map points."""
        self.finish(variables)
        self.finished = [submap.without(keys) for submap in self.finished]

    def graph(self, variables: Variables) -> gtsam.GaussianFactorGraph:
        """Returns the prior as a graph on keyframes: all submaps, linearized at the variables' values."""
        return graph_of(self.first, *(submap.factor(variables) for submap in self.finished))

    def insert_keyframes(self, variables: Variables) -> None:
        """Inserts the keyframes of all finished submaps into the variables."""
        for key, (pose, reference) in self.keyframes.items():
            variables.insert(np.array([key]), pose, reference)

    def _finished_submap(self, variables: Variables) -> Submap:
        """Returns the marginal of the current submap, given that its keyframe is where it was.

        In the frame of a fixed keyframe the variables are linear functions of the unknowns, so the change of
        frame is exact.
        """
        assert self._graph is not None
        frame, reference = self.keyframes[self._keyframe]
        keys = Layout(np.setdiff1d(keys_of(self._graph), [self._keyframe]))
        information, vector = condition(self._graph, keys, self._keyframe, frame - reference)
        known = keys.keys[np.diagonal(information)[keys.starts] > 0.0]
        kept, own = Layout(known), keys.entries(known)
        entries = variables.layout.entries(known)
        vector = vector[own] - information[np.ix_(own, own)] @ variables.change(entries)
        root, right = square_root_form(information[np.ix_(own, own)], vector)
        local = _local(variables.values[entries], frame, kept)
        return Submap(self._keyframe, kept, root @ _rotations(kept, frame), right, local)
