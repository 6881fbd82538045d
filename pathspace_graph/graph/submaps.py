"""Submaps: the marginals of parts of the drive, each in its own frame, so that closing can relinearize them.

All measurements of a part of the drive are relative: detections relate poses to map points, and odometry
relates poses to poses. Its marginal is therefore a function of coordinates in the frame of its first pose,
the keyframe, and stays valid when loop closure turns the whole part. A single dense prior does not: it is
linearized at the heading that the vehicle had drifted to.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import compose, relative

from .gaussian import graph_of, marginalize
from .relative import RelativeFactor, relative_factor
from .variables import Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class Submaps:
    """Holds the submaps of the drive up to loop closure; the last of them is unfinished."""

    def __init__(self, first: gtsam.GaussianFactorGraph, interval: float) -> None:
        self.first = first
        """This is the absolute prior of the calibration and the first pose."""
        self.interval = interval
        """This is the length of path (m) between keyframes."""
        self.finished: list[RelativeFactor] = []
        """These are the finished submaps, in the order of the drive."""
        self.keyframes: dict[int, tuple[Array, Array]] = {}
        """Each keyframe, by key, has its pose (3,) when it was marginalized, and its reference (3,)."""
        self._hung: dict[
            int, tuple[int, Array]
        ] = {}  # the anchor of a keyframe, and the keyframe in its frame
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

    def hang(self, anchor: int, pose: Array) -> None:
        """Hangs all new keyframes on an anchor, by its key, which is at a pose (3,); they move with it."""
        for key, (keyframe, _) in self.keyframes.items():
            if key not in self._hung:
                self._hung[key] = anchor, relative(pose, keyframe)

    def carry(self, anchors: Mapping[int, Array]) -> None:
        """Places all hung keyframes anew, given the poses (3,) of their anchors."""
        for key, (anchor, local) in self._hung.items():
            self.keyframes[key] = compose(anchors[anchor], local), self.keyframes[key][1]
        self._hung = {}

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

    def _finished_submap(self, variables: Variables) -> RelativeFactor:
        """Returns the marginal of the current submap, given that its keyframe is where it was."""
        assert self._graph is not None
        pose, reference = self.keyframes[self._keyframe]
        return relative_factor(self._graph, self._keyframe, pose, reference, variables)
