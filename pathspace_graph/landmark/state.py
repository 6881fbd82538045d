"""The landmarks beside their variables, and the readings that see them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.graph.keys import LANDMARK_LETTER, POINT, landmark_keys
from pathspace_graph.graph.variables import Variables
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionColumns

from .association import NONE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

LEFT_OUT = -2
"""The landmark of a reading between the gates, or of a known landmark in another colour: it is of none, and
makes none."""


class LandmarkState:
    """The landmarks by position, oldest first, each with a number that is its key's and never changes."""

    def __init__(self, variables: Variables | None = None) -> None:
        self.variables = variables or Variables()
        """Landmarks, calibration and poses by key."""
        self.numbers: IntArray = np.zeros(0, np.intp)
        """(n,) ascending."""
        self.labels: IntArray = np.zeros(0, np.intp)
        """(n,) colour of each landmark."""
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)
        """(n, 2) readings of either colour that each landmark explained."""
        self.born = 0
        """Landmarks made so far, and the next one's number."""

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def keys(self) -> IntArray:
        """(n,) key of each."""
        return landmark_keys(self.numbers)

    @property
    def landmarks(self) -> Array:
        """Landmarks (n, 2), map frame, m: a view."""
        return self.variables.block(LANDMARK_LETTER).reshape(-1, POINT)

    def positions(self, numbers: IntArray) -> IntArray:
        """Position of each of these numbers, of any shape, all of which are known."""
        return self.numbers.searchsorted(numbers)

    def add(self, points: Array, labels: IntArray, numbers: IntArray | None = None) -> IntArray:
        """New landmarks (k, 2) with colours (k,), after those that there are; gives their numbers (k,).

        `numbers`: ascending, none less than `born`; else the next ones.
        """
        new = self.born + np.arange(len(labels)) if numbers is None else numbers
        self.variables.insert(landmark_keys(new), points.ravel())
        self.numbers = np.concatenate([self.numbers, new])
        self.labels = np.concatenate([self.labels, labels])
        self.votes = np.concatenate([self.votes, np.zeros((len(labels), len(BOUNDARIES)), np.intp)])
        self.born = int(new[-1]) + 1 if len(new) else self.born
        return new

    def vote(self, labels: IntArray, numbers: IntArray) -> None:
        """Readings (k,) with these colours lie on landmarks (k,), each of which has the colour of the most.

        A landmark that was made of a few readings in the wrong colour would have the wrong one for good.
        """
        coloured = np.isin(labels, BOUNDARIES)
        np.add.at(self.votes, (self.positions(numbers[coloured]), labels[coloured]), 1)
        most = self.votes.argmax(axis=1)
        outvoted = self.votes[np.arange(len(most)), most] > self.votes[np.arange(len(most)), self.labels]
        self.labels = np.where(outvoted, most, self.labels)

    def keep(self, stays: NDArray[np.bool_]) -> None:
        """Only these landmarks (n,) are there from now on; the variables are left as they are."""
        self.numbers, self.labels, self.votes = self.numbers[stays], self.labels[stays], self.votes[stays]


@dataclass
class LandmarkDetections(DetectionColumns):
    """Holds detections with the landmark that each of them is of."""

    landmark: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Number of the landmark that it is of; else NONE or LEFT_OUT."""

    @property
    def used(self) -> NDArray[np.bool_]:
        """(m,) whether each is of a landmark, and so a row of the graph."""
        return self.landmark >= 0

    def _clear_associations(self) -> None:
        self.landmark = np.full(len(self), NONE, np.intp)

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Readings of landmarks `gone` (k,), by number, are of `kept` (k,) from now on."""
        for number, became in zip(gone.tolist(), kept.tolist(), strict=True):
            self.landmark[self.landmark == number] = became

    def take(self, rows: IntArray, numbers: IntArray) -> None:
        """These readings (k,) are of landmarks (k,)."""
        self.landmark[rows], self.changed[rows] = numbers, True
