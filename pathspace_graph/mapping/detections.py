"""The readings of the poses in the window, row by row."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass
class DetectionTable:
    """Columns of equal length, oldest reading first."""

    cycle: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Perception cycle that each was made in."""
    point: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Reading in the vehicle frame (m)."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Its covariance in the vehicle frame (m^2)."""
    label: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """What the sensor says: LEFT, RIGHT or UNKNOWN."""
    boundary: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Boundary whose curve it is held against; UNKNOWN until that is decided."""
    u: Array = field(default_factory=lambda: np.zeros(0))
    """Its foot point's parameter on that curve, where used."""
    used: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """Whether it is a row of the factor graph."""
    changed: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """Whether it came into use, or went out of it, since its cycle was linearized last."""

    def __len__(self) -> int:
        return len(self.cycle)

    def append(self, detections: Detections, cycle: int) -> slice:
        """Add the readings of one cycle, none used yet; gives their rows."""
        m = len(detections.labels)
        start = len(self)
        new = DetectionTable(
            np.full(m, cycle, np.intp),
            np.asarray(detections.points_vehicle, float),
            np.asarray(detections.covariances, float),
            np.asarray(detections.labels, np.intp),
            np.asarray(detections.labels, np.intp),
            np.zeros(m),
            np.zeros(m, bool),
            np.zeros(m, bool),
        )
        for column in fields(self):
            setattr(
                self, column.name, np.concatenate([getattr(self, column.name), getattr(new, column.name)])
            )
        return slice(start, start + m)

    def keep_from(self, cycle: int) -> None:
        """Forget the readings of earlier cycles."""
        first = int(self.cycle.searchsorted(cycle))
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[first:])

    def take(self, rows: IntArray, boundary: IntArray | int, u: Array) -> None:
        """These readings are in use on a boundary, each with its foot point's parameter."""
        self.used[rows], self.boundary[rows], self.u[rows], self.changed[rows] = True, boundary, u, True

    def release(self, rows: IntArray) -> None:
        """These readings are in use no more; the boundary of those without a colour is open again."""
        self.used[rows], self.boundary[rows], self.changed[rows] = False, self.label[rows], True

    def used_on(self, label: int) -> IntArray:
        """Rows in use on the boundary `label`."""
        return np.flatnonzero(self.used & (self.boundary == label))

    def pending(self, label: int) -> IntArray:
        """Rows not in use that may belong to the boundary `label`, those of unknown colour included."""
        return np.flatnonzero(~self.used & ((self.label == label) | (self.label == UNKNOWN)))

    def open_to(self, label: int, since: int) -> IntArray:
        """Rows, from one on, that the boundary `label` may take: not in use, or doubtful where they are.

        Of unknown colour are those too that another boundary has in use.
        """
        said, used = self.label[since:], self.used[since:]
        unknown = said == UNKNOWN
        open_to = np.where(used, unknown & (self.boundary[since:] != label), unknown | (said == label))
        return since + np.flatnonzero(open_to)
