"""What left the window, stretch by stretch, each in its own frame, so that closing can relinearize it.

Everything that a stretch of the drive measured is relative: readings tie poses to map points, odometry ties
poses to poses. Its marginal is therefore a function of coordinates in the frame of the stretch's first pose,
its keyframe, and stays valid when the loop turns the whole stretch. A single dense prior cannot do that: it
is linearized at the heading that the vehicle had drifted to.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import (
    conditioned,
    graph_of,
    jacobian_factor,
    keys_of,
    marginalize,
    normal_equations,
    remove_information,
    square_root_form,
)
from .keys import CALIBRATION_KEY, POSE
from .variables import Layout, Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Submap:
    """`1/2 |A e - b|^2`, `e = y(x) - y0`: map points, calibration and end pose seen from a keyframe.

    In the frame of the keyframe `(p, theta)`: a point c is at `R(theta)' (c - p)`, the end pose at
    `(R(theta)' (t - p), theta_end - theta)`; the calibration is as it is.
    """

    keyframe: int
    """Key of the pose in whose frame it is."""
    keys: Layout
    """Calibration, map points, and the end pose last."""
    root: Array
    """(r, q) A."""
    right: Array
    """(r,) b."""
    local: Array
    """(q,) y0."""

    def factor(self, variables: Variables) -> gtsam.GaussianFactor:
        """The submap as a factor between its keys and the keyframe, linearized at the variables' values."""
        keys = np.append(self.keys.keys, self.keyframe)
        values, frame = variables.of(self.keys.keys), variables.of(keys[-1:])
        by_keys, by_frame = _turn(self.keys, frame).T, _by_frame(values, frame, self.keys)
        jacobian = self.root @ np.concatenate([by_keys, by_frame], axis=1)
        left = self.right - self.root @ (_local(values, frame, self.keys) - self.local)
        now = variables.change(variables.layout.entries(keys))
        return jacobian_factor(keys, jacobian, left + jacobian @ now)

    def without(self, keys: IntArray) -> Submap:
        """A submap that knows nothing of some keys."""
        gone = np.intersect1d(self.keys.keys, keys)
        if len(gone) == 0:
            return self
        kept, leaving = Layout(np.setdiff1d(self.keys.keys, gone)), Layout(gone)
        graph = graph_of(jacobian_factor(self.keys.keys, self.root, self.right))
        graph = remove_information(graph, leaving, np.zeros(leaving.size))
        root, right = square_root_form(*normal_equations(graph, kept))
        return Submap(self.keyframe, kept, root, right, self.local[self.keys.entries(kept.keys)])


def _points(keys: Layout) -> IntArray:
    """Columns of the x of every point, and of the end pose, which turn with the frame."""
    return np.asarray(keys.starts[keys.keys != CALIBRATION_KEY])


def _turn(keys: Layout, frame: Array) -> Array:
    """(q, q) block-diagonal: keyframe's frame to map frame; calibration and heading stay as they are."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    matrix, x = np.eye(keys.size), _points(keys)
    matrix[x, x], matrix[x, x + 1], matrix[x + 1, x], matrix[x + 1, x + 1] = c, -s, s, c
    return matrix


def _local(values: Array, frame: Array, keys: Layout) -> Array:
    """(q,) values in the map frame, seen from the keyframe (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    local, x = values.copy(), _points(keys)
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    local[x], local[x + 1] = c * dx + s * dy, -s * dx + c * dy
    local[-1] -= frame[2]
    return local


def _by_frame(values: Array, frame: Array, keys: Layout) -> Array:
    """(q, 3) derivative of `_local` by the keyframe."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    matrix, x = np.zeros((keys.size, POSE)), _points(keys)
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    matrix[x, 0], matrix[x, 1], matrix[x, 2] = -c, -s, -s * dx + c * dy
    matrix[x + 1, 0], matrix[x + 1, 1], matrix[x + 1, 2] = s, -c, -c * dx - s * dy
    matrix[-1, 2] = -1.0
    return matrix


class Submaps:
    """The submaps of the drive so far, the last of them unfinished; given up when the loop has closed."""

    def __init__(self, first: gtsam.GaussianFactorGraph, interval: float) -> None:
        self.first = first
        """Absolute prior of the calibration and the first pose, as the drive began."""
        self.interval = interval
        """Path (m) between keyframes."""
        self.finished: list[Submap] = []
        self.keyframes: dict[int, tuple[Array, Array]] = {}
        """Of each keyframe by its key the pose (3,) as it was when it left the window, and its reference."""
        self._graph: gtsam.GaussianFactorGraph | None = None
        self._keyframe = 0
        self._driven = 0.0

    def leave(self, pose: int, factors: gtsam.GaussianFactorGraph, variables: Variables) -> None:
        """The oldest pose leaves the window: the factors that hold it, the prior not among them.

        The next pose of the window is the submap's end from now on.
        """
        if self._driven >= self.interval:
            self.cut(variables)
        entries = variables.layout.entries(np.array([pose]))
        if self._graph is None:
            self._keyframe, self._graph, self._driven = pose, factors, 0.0
            self.keyframes[pose] = variables.linearized[entries].copy(), variables.reference[entries].copy()
        else:
            self._graph = marginalize(graph_of(self._graph, factors), np.array([pose]))
        following = variables.linearized[variables.layout.entries(np.array([pose + 1]))]
        self._driven += float(np.hypot(*(following[:2] - variables.linearized[entries[:2]])))

    def cut(self, variables: Variables) -> None:
        """The submap under way ends at the oldest pose of the window."""
        if self._graph is not None:
            self.finished.append(self._finish(variables))
            self._graph = None

    def remove_information(self, keys: IntArray, variables: Variables) -> None:
        """Know nothing of some map points any more."""
        self.cut(variables)
        self.finished = [submap.without(keys) for submap in self.finished]

    def graph(self, variables: Variables) -> gtsam.GaussianFactorGraph:
        """The prior as a graph between keyframes: all submaps, linearized at the variables' values."""
        return graph_of(self.first, *(submap.factor(variables) for submap in self.finished))

    def insert_keyframes(self, variables: Variables) -> None:
        """The keyframes of all finished submaps become variables again."""
        for key, (pose, reference) in self.keyframes.items():
            variables.insert(np.array([key]), pose, reference)

    def _finish(self, variables: Variables) -> Submap:
        """The marginal of what the stretch measured, with its keyframe held where it was.

        Seen from the keyframe, the variables are linear functions of the unknowns: nothing is lost in
        turning.
        """
        assert self._graph is not None
        frame, reference = self.keyframes[self._keyframe]
        keys = Layout(np.setdiff1d(keys_of(self._graph), [self._keyframe]))
        information, vector = conditioned(self._graph, keys, self._keyframe, frame - reference)
        known = keys.keys[np.diagonal(information)[keys.starts] > 0.0]
        kept, own = Layout(known), keys.entries(known)
        entries = variables.layout.entries(known)
        vector = vector[own] - information[np.ix_(own, own)] @ variables.change(entries)
        root, right = square_root_form(information[np.ix_(own, own)], vector)
        local = _local(variables.values[entries], frame, kept)
        return Submap(self._keyframe, kept, root @ _turn(kept, frame), right, local)
