"""What the landmark graph estimates, by name, and the readings of the poses in its window."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.log import Detections
from pathspace_graph.readings import Readings
from pathspace_graph.state import State

from .landmark_association import NONE, PLANE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

LEFT_OUT = -2
"""The landmark of a reading between the gates, or of a known landmark in another colour: it is of none, and
makes none."""


class LandmarkState(State):
    """`x = [landmarks, oldest first | calibration | keyframes | poses]`."""

    def __init__(self) -> None:
        super().__init__()
        self.labels: IntArray = np.zeros(0, np.intp)
        """(n,) colour of each landmark."""
        self.ids: IntArray = np.zeros(0, np.intp)
        """(n,) its number, which stays when others are merged."""
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)
        """(n, 2) readings of either colour that each landmark explained."""
        self.born = 0
        """Landmarks made so far, and the next one's number."""

    @property
    def map_size(self) -> int:
        """Entries that are landmarks."""
        return PLANE * len(self.labels)

    @property
    def landmarks(self) -> Array:
        """Landmarks (n, 2), map frame, m: a view of x."""
        return self.vector[: self.map_size].reshape(-1, PLANE)

    def add_landmarks(self, points: Array, labels: IntArray) -> None:
        """New landmarks (k, 2) with colours (k,), after those that there are."""
        self.insert(self.map_size, points.ravel())
        self.labels = np.concatenate([self.labels, labels])
        self.ids = np.concatenate([self.ids, self.born + np.arange(len(labels))])
        self.born += len(labels)
        self.votes = np.concatenate([self.votes, np.zeros((len(labels), len(BOUNDARIES)), np.intp)])

    def vote(self, labels: IntArray, landmarks: IntArray) -> None:
        """Readings (k,) with these colours lie on these landmarks, each of which has the colour of the most.

        A landmark that was made of a few readings in the wrong colour would have the wrong one for good.
        """
        coloured = np.isin(labels, BOUNDARIES)
        np.add.at(self.votes, (landmarks[coloured], labels[coloured]), 1)
        most = self.votes.argmax(axis=1)
        outvoted = self.votes[np.arange(len(most)), most] > self.votes[np.arange(len(most)), self.labels]
        self.labels = np.where(outvoted, most, self.labels)

    def keep(self, stays: NDArray[np.bool_]) -> None:
        """Only these landmarks (n,) stay in the state."""
        others = np.ones(len(self.vector) - self.map_size, bool)
        self.vector = self.vector[np.append(np.repeat(stays, PLANE), others)]
        self.labels, self.ids, self.votes = self.labels[stays], self.ids[stays], self.votes[stays]

    def control_ids(self) -> tuple[IntArray, IntArray]:
        """(n,) zero, and the index of each landmark: a single list."""
        return np.zeros(len(self.labels), np.intp), np.arange(len(self.labels))


@dataclass
class LandmarkReadings(Readings):
    """Readings of the window, with what each is of."""

    landmark: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Index of the landmark that each saw, where in use; else NONE or LEFT_OUT."""

    def append(self, detections: Detections, slot: int) -> slice:
        """Add the readings of one cycle, none used yet; gives their rows."""
        start, plain = len(self), Readings()
        plain.append(detections, slot)
        shared = {column.name: getattr(plain, column.name) for column in fields(plain)}
        new = LandmarkReadings(**shared, landmark=np.full(len(plain), NONE, np.intp))
        for column in fields(self):
            setattr(
                self, column.name, np.concatenate([getattr(self, column.name), getattr(new, column.name)])
            )
        return slice(start, len(self))

    def numbers(self, ids: IntArray) -> IntArray:
        """(m,) number of the landmark that each is of, NONE where not in use; ids (n,) of the landmarks."""
        return np.append(ids, NONE)[np.where(self.used, self.landmark, -1)]

    def take(self, rows: IntArray, landmarks: IntArray) -> None:
        """These readings are in use, and of these landmarks."""
        self.used[rows] = True
        self.landmark[rows] = landmarks
