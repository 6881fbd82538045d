"""Tables of detections: one row for each detected cone, with what an estimator has decided about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.sensor import SensorRows, corrected, sensor_rows
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


@dataclass
class DetectionColumns:
    """Holds what the sensor measured: columns of equal length, the oldest detection first.

    A subclass adds the columns of its associations; only the table's own methods write to any column.
    """

    cycle: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Each detection was made in this perception cycle; the column never decreases."""
    measured: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Each row holds a detected position (x, y) in m, vehicle frame, as the sensor says."""
    twist: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """The vehicle moved with this twist (m, 3) then, in m/s, m/s and rad/s."""
    point: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """Each row holds the position after the latest correction."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """Each entry is the (2, 2) covariance of the position in m^2, vehicle frame."""
    label: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """The sensor assigned this colour: LEFT, RIGHT or UNKNOWN."""
    changed: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """The flag is set when the association has changed since the detection's cycle was last linearized."""

    def __len__(self) -> int:
        return len(self.cycle)

    @classmethod
    def of(cls, cycles: Sequence[Detections], first: int = 0, twists: Array | None = None) -> Self:
        """Builds the table of consecutive perception cycles, numbered from `first`; nothing is in use.

        The vehicle moved with twists (k, 3) at the cycles, in m/s, m/s and rad/s; by default it stood still.
        """
        counts = [len(one.labels) for one in cycles]
        points = np.concatenate([np.zeros((0, 2)), *(one.points_vehicle for one in cycles)])
        moving = np.zeros((len(cycles), 3)) if twists is None else twists
        table = cls(
            cycle=first + np.repeat(np.arange(len(cycles)), counts),
            measured=points,
            twist=np.repeat(moving, counts, axis=0),
            point=points.copy(),
            covariance=np.concatenate([np.zeros((0, 2, 2)), *(one.covariances for one in cycles)]),
            label=np.concatenate([np.zeros(0, np.intp), *(one.labels for one in cycles)]).astype(np.intp),
            changed=np.zeros(sum(counts), bool),
        )
        table._clear_associations()
        return table

    def _clear_associations(self) -> None:
        """Fills the subclass's columns as they are before any association."""

    def append(self, detections: Detections, cycle: int, twist: Array | None = None) -> slice:
        """Adds the detections of one cycle, none of them in use; returns their rows.

        The vehicle moved with this twist (3,), in m/s, m/s and rad/s; by default it stood still.
        """
        return self.insert(detections, cycle, twist)

    def insert(self, detections: Detections, cycle: int, twist: Array | None = None) -> slice:
        """Adds detections behind those of their cycle and before those of later ones, as `append` does."""
        twists = None if twist is None else twist[None]
        start = int(self.cycle.searchsorted(cycle, side="right"))
        new = type(self).of([detections], cycle, twists)
        for column in fields(self):
            known, own = getattr(self, column.name), getattr(new, column.name)
            setattr(self, column.name, np.concatenate([known[:start], own, known[start:]]))
        return slice(start, start + len(new))

    def corrected(self, rows: IntArray | slice, sensor: Array) -> Array:
        """Returns positions (m, 2) corrected by the sensor's calibration (5,), which may be empty."""
        return corrected(self.measured[rows], self.twist[rows], sensor)

    def sensor_rows(
        self, rows: IntArray, directions: Array, residual: Array, poses: Array, sensor: Array
    ) -> SensorRows:
        """Returns `factors.sensor:sensor_rows` of residuals (m,) along unit vectors (m, 2), map frame.

        The detections were made from poses (m, 3), and the sensor's calibration (5,) may be empty.
        """
        return sensor_rows(directions, residual, poses, self.measured[rows], self.twist[rows], sensor)

    def correct(self, sensor: Array) -> None:
        """Corrects all positions by the sensor's calibration (5,), which is empty where there is none."""
        if len(sensor):
            self.point = self.corrected(slice(None), sensor)

    def keep_from(self, cycle: int) -> None:
        """Removes the detections of all cycles before `cycle`."""
        first = int(self.cycle.searchsorted(cycle))
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[first:])

    def in_cycles(self, cycles: IntArray) -> BoolArray:
        """Returns (m,) whether each detection was made in one of the ascending cycles (k,)."""
        if len(cycles) == 0:
            return np.zeros(len(self), bool)
        return np.asarray(cycles.take(cycles.searchsorted(self.cycle), mode="clip") == self.cycle)

    def mark_linearized(self) -> None:
        """Clears every `changed` flag: the graph holds all associations as they are now."""
        self.changed[:] = False


@dataclass
class DetectionTable(DetectionColumns):
    """Holds detections with the boundary curve that each of them is associated with."""

    boundary: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Each detection is associated with this boundary's curve; it is UNKNOWN until that is decided."""
    u: Array = field(default_factory=lambda: np.zeros(0))
    """Each detection in use has its foot point at this parameter of the curve."""
    used: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """The flag is set when the detection is a row of the factor graph."""

    def _clear_associations(self) -> None:
        self.boundary, self.u, self.used = self.label.copy(), np.zeros(len(self)), np.zeros(len(self), bool)

    def take(self, rows: IntArray, boundary: IntArray | int, u: Array) -> None:
        """Puts detections into use on a boundary, with the parameters (m,) of their foot points."""
        self.used[rows], self.boundary[rows], self.u[rows], self.changed[rows] = True, boundary, u, True

    def release(self, rows: IntArray) -> None:
        """Takes detections out of use; those of unknown colour may join either boundary again."""
        self.used[rows], self.boundary[rows], self.changed[rows] = False, self.label[rows], True

    def refine(self, rows: IntArray, u: Array) -> None:
        """Stores the refreshed foot points' parameters (m,); the associations do not change."""
        self.u[rows] = u

    def used_on(self, label: int) -> IntArray:
        """Returns the rows in use on the boundary `label`."""
        return np.flatnonzero(self.used & (self.boundary == label))

    def pending(self, label: int) -> IntArray:
        """Returns the rows out of use that may join the boundary `label`; unknown colours are included."""
        return np.flatnonzero(~self.used & ((self.label == label) | (self.label == UNKNOWN)))

    def open_to(self, label: int, since: int) -> IntArray:
        """Returns the rows, from `since` on, that the boundary `label` is tested for.

        These are the rows out of use, and those of unknown colour that the other boundary uses: if both
        boundaries accept one, it is ambiguous.
        """
        label_since, used = self.label[since:], self.used[since:]
        unknown = label_since == UNKNOWN
        is_open = np.where(used, unknown & (self.boundary[since:] != label), unknown | (label_since == label))
        return since + np.flatnonzero(is_open)
