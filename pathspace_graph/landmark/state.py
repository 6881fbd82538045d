"""The state of the landmark graphs: landmarks with their variables, and detections with associations."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import LANDMARK_LETTER, POINT, landmark_keys
from pathspace_graph.graph.variables import Variables
from pathspace_graph.io.map import NO_COVARIANCE, Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.detections import DetectionColumns

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

UNASSOCIATED = -1
"""This stands for the landmark of a detection that has none, and that may create one."""
AMBIGUOUS = -2
"""This stands for the landmark of a detection that has none, and that must not create one."""


class LandmarkState:
    """Holds the landmarks, oldest first. A landmark's number is that of its key and never changes."""

    def __init__(self, variables: Variables | None = None) -> None:
        self.variables = variables or Variables()
        """These are the landmarks, the calibration and the poses by key."""
        self.numbers: IntArray = np.zeros(0, np.intp)
        """(n,) These are the numbers of the landmarks, ascending."""
        self.labels: IntArray = np.zeros(0, np.intp)
        """(n,) These are the labels of the landmarks."""
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)
        """(n, 2) Each row counts the detections with the left and the right label on a landmark."""
        self.next_number = 0
        """This is the number of the next landmark."""

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def keys(self) -> IntArray:
        """Returns the keys (n,) of the landmarks."""
        return landmark_keys(self.numbers)

    @property
    def landmarks(self) -> Array:
        """Returns the landmarks (n, 2) in the map frame, in m: a view."""
        return self.variables.block(LANDMARK_LETTER).reshape(-1, POINT)

    def positions(self, numbers: IntArray) -> IntArray:
        """Returns the position of each of these numbers, of any shape, all of which must be known."""
        return self.numbers.searchsorted(numbers)

    def add(self, points: Array, labels: IntArray, numbers: IntArray | None = None) -> IntArray:
        """Adds landmarks (k, 2) with labels (k,) behind the others, and returns their numbers (k,).

        `numbers` must be ascending, and none may be less than `next_number`; by default they follow it.
        """
        new = self.next_number + np.arange(len(labels)) if numbers is None else numbers
        self.variables.insert(landmark_keys(new), points.ravel())
        self.numbers = np.concatenate([self.numbers, new])
        self.labels = np.concatenate([self.labels, labels])
        self.votes = np.concatenate([self.votes, np.zeros((len(labels), len(BOUNDARIES)), np.intp)])
        self.next_number = int(new[-1]) + 1 if len(new) else self.next_number
        return new

    def vote(self, labels: IntArray, numbers: IntArray) -> None:
        """Counts detections with labels (k,) on landmarks (k,), which take the label of their majority.

        Otherwise a landmark that was created by a few detections with the wrong label would keep it forever.
        """
        known = np.isin(labels, BOUNDARIES)
        np.add.at(self.votes, (self.positions(numbers[known]), labels[known]), 1)
        most = self.votes.argmax(axis=1)
        outvoted = self.votes[np.arange(len(most)), most] > self.votes[np.arange(len(most)), self.labels]
        self.labels = np.where(outvoted, most, self.labels)

    def keep(self, stays: NDArray[np.bool_]) -> None:
        """Removes the landmarks whose entry in `stays` (n,) is not set; the variables stay as they are."""
        self.numbers, self.labels, self.votes = self.numbers[stays], self.labels[stays], self.votes[stays]


@dataclass
class LandmarkDetections(DetectionColumns):
    """Holds detections with the landmark that each of them is associated with."""

    landmark: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Each detection is of the landmark with this number; otherwise it is UNASSOCIATED or AMBIGUOUS."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """Returns (m,) whether each detection has a landmark, and so is a row of the graph."""
        return self.landmark >= 0

    def _clear_associations(self) -> None:
        self.landmark = np.full(len(self), UNASSOCIATED, np.intp)

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Associates all detections of landmarks `gone` (k,), by number, with `kept` (k,)."""
        for number, became in zip(gone.tolist(), kept.tolist(), strict=True):
            self.landmark[self.landmark == number] = became

    def take(self, rows: IntArray, numbers: IntArray) -> None:
        """Associates detections (k,) with landmarks (k,)."""
        self.landmark[rows], self.changed[rows] = numbers, True


def landmark_counts(labels: IntArray) -> tuple[int, int]:
    """Returns the number of landmarks with the left and with the right label."""
    return int((labels == LEFT).sum()), int((labels == RIGHT).sum())


def point_map(points: Array, labels: IntArray, joint: Array | None, closed: bool) -> Map:
    """Returns landmarks (n, 2) by label, each boundary with its block of the joint covariance (2 n, 2 n).

    Where the joint covariance is None, the boundaries have none.
    """
    boundaries, order = {}, [np.zeros(0, np.intp)]
    for label in BOUNDARIES:
        own = np.flatnonzero(labels == label)
        if len(own):
            order.append((POINT * own[:, None] + np.arange(POINT)).ravel())
            covariance = NO_COVARIANCE if joint is None else joint[np.ix_(order[-1], order[-1])]
            boundaries[label] = PointBoundary(points[own].copy(), covariance)
    columns = np.concatenate(order)
    return Map(closed, boundaries, None if joint is None else joint[np.ix_(columns, columns)])
