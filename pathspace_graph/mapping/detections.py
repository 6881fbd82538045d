"""Tables of detections: one row for each detected cone, with what an estimator has decided about it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Final, Self

import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.factors.sensor import corrected
from pathspace_graph.graph.drives import ONE_DRIVE, Drives, of_sensor
from pathspace_graph.graph.variables import Variables
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN

NO_STATION: Final = -1  # of a detection that may be of several cones, or of none of the map


@dataclass
class DetectionColumns:
    """What the sensor measured: columns of equal length, the oldest detection first.

    A subclass adds columns of its associations. Points are corrected by the sensor's calibration on demand.
    """

    cycle: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """Perception cycle of each detection; it never decreases."""
    measured: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(m, 2) Positions (x, y) in m, vehicle frame, as the sensor says."""
    twist: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(m, 3) Twists of the vehicle then, in m/s, m/s and rad/s."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """(m, 2, 2) Covariances of the positions in m^2, vehicle frame."""
    label: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # colour: LEFT, RIGHT or UNKNOWN
    changed: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """Whether the association has changed since the detection's cycle was last linearized."""
    sensor: Array = field(default_factory=lambda: np.zeros(0))  # by which `point` is corrected; no column
    drives: Drives = ONE_DRIVE  # whose detections these are; no column

    def __len__(self) -> int:
        return len(self.cycle)

    @classmethod
    def of(cls, cycles: Sequence[Detections], first: int = 0, twists: Array | None = None) -> Self:
        """Build the table of consecutive cycles, numbered from `first`, with no detection in use.

        The vehicle has twists (k, 3) at the cycles (m/s, m/s, rad/s), by default zero.
        """
        counts = [len(one.labels) for one in cycles]
        moving = np.zeros((len(cycles), 3)) if twists is None else twists
        return cls._unused(
            first + np.repeat(np.arange(len(cycles)), counts),
            np.concatenate([np.zeros((0, 2)), *(one.points_vehicle for one in cycles)]),
            np.repeat(moving, counts, axis=0),
            np.concatenate([np.zeros((0, 2, 2)), *(one.covariances for one in cycles)]),
            np.concatenate([np.zeros(0, np.intp), *(one.labels for one in cycles)]),
        )

    @classmethod
    def of_drives(cls, tables: Sequence[Self], drives: Drives) -> Self:
        """Build the table of several drives, whose cycles are counted on, with no detection in use."""
        names = ("cycle", "measured", "twist", "covariance", "label")
        cycle, *columns = (np.concatenate([vars(table)[name] for table in tables]) for name in names)
        begins = np.repeat(drives.first, [len(table) for table in tables])
        return replace(cls._unused(cycle + begins, *columns), drives=drives)

    @classmethod
    def _unused(
        cls, cycle: IntArray, measured: Array, twist: Array, covariance: Array, label: IntArray
    ) -> Self:
        """Build the table of columns whose detections are not in use."""
        table = cls(cycle, measured, twist, covariance, label.astype(np.intp), np.zeros(len(cycle), bool))
        table._clear_associations()
        return table

    def _clear_associations(self) -> None:
        """Fill the subclass's columns as they are before any association."""

    def append(self, detections: Detections, cycle: int, twist: Array | None = None) -> slice:
        """Add unused detections at the end of their cycle's, with a twist (3,) or none; return their rows."""
        start, count = int(self.cycle.searchsorted(cycle, side="right")), len(detections.labels)
        twists = np.zeros((count, 3))
        if twist is not None:
            twists[:] = twist
        measured = detections.points_vehicle, twists, detections.covariances, detections.labels
        columns, new = vars(self), vars(self._unused(np.full(count, cycle), *measured))
        for column in self._columns():
            known = columns[column]
            columns[column] = np.concatenate([known[:start], new[column], known[start:]])
        return slice(start, start + count)

    @classmethod
    @cache
    def _columns(cls) -> list[str]:
        return [column.name for column in fields(cls) if column.name not in ("sensor", "drives")]

    def corrected(self, rows: IntArray | BoolArray | slice, sensor: Array) -> Array:
        """Return positions (m, 2), vehicle frame, corrected by the sensor's calibration: (5,) or empty.

        Of several drives, it is that of all sensors (5 s,).
        """
        measured, twist = self.measured[rows], self.twist[rows]

        def terms(own: IntArray | slice, sensor: Array) -> tuple[Array]:
            return (corrected(measured[own], twist[own], sensor),)

        return self.drives.by_sensor(terms, self.cycle[rows], sensor)[0]

    def correct(self, sensor: Array) -> None:
        """Set the calibration of the sensor by which `point` is corrected."""
        self.sensor = sensor.copy()

    def cones(self, lines: Sequence[int]) -> Self:
        """Return the detections that are of no boundary of these labels, which are lines."""
        return self.where(np.flatnonzero(~np.isin(self.label, lines))) if lines else self

    @property
    def point(self) -> Array:
        """Return all positions (m, 2), vehicle frame, corrected by the calibration that was set last."""
        return self.corrected(slice(None), self.sensor)

    def points_map(self, rows: IntArray | BoolArray | slice, variables: Variables) -> Array:
        """Return corrected positions (m, 2) in the map frame, by the poses of their cycles."""
        if isinstance(rows, slice) or rows.dtype == np.bool_:
            rows = np.arange(len(self))[rows]
        if len(self.drives) > 1:
            return to_map(self.corrected(rows, variables.sensor), variables.poses_at(self.cycle[rows]))
        poses = variables.poses, variables.first_cycle
        return kernels.placed(
            rows.astype(np.intp, copy=False), self.cycle, self.measured, self.twist, *poses, variables.sensor
        )

    def covariances_map(self, rows: IntArray | slice, variables: Variables) -> Array:
        """Return the covariances (m, 2, 2) in m^2 in the map frame, by the poses of their cycles."""
        return rotated(self.covariance[rows], variables.poses_at(self.cycle[rows])[:, 2])

    def where(self, rows: IntArray) -> Self:
        """Return the table of the given rows."""
        chosen = {column: vars(self)[column][rows] for column in self._columns()}
        return replace(self, **chosen)

    def of_drive(self, drive: int) -> Self:
        """Return the table of one of its drives, whose cycles keep their numbers."""
        if len(self.drives) == 1:
            return self
        own = self.where(np.flatnonzero(self.drives.of(self.cycle) == drive))
        sensor = of_sensor(self.sensor, self.drives.sensors[drive])
        return replace(own, sensor=sensor, drives=ONE_DRIVE)

    def keep_from(self, cycle: int) -> None:
        """Remove the detections of all cycles before `cycle`."""
        first = int(self.cycle.searchsorted(cycle))
        for column in self._columns():
            vars(self)[column] = vars(self)[column][first:]

    def in_cycles(self, cycles: IntArray) -> BoolArray:
        """Return (m,) whether each detection was made in one of the ascending cycles (k,)."""
        if len(cycles) == 0:
            return np.zeros(len(self), bool)
        return np.asarray(cycles.take(cycles.searchsorted(self.cycle), mode="clip") == self.cycle)

    def mark_linearized(self) -> None:
        """Clear every `changed` flag: the graph holds all associations as they are now."""
        self.changed[:] = False


@dataclass
class DetectionTable(DetectionColumns):
    """Detections with the boundary curve that each of them is associated with."""

    boundary: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # its label, or UNKNOWN
    u: Array = field(default_factory=lambda: np.zeros(0))  # parameter of the foot point (m)
    used: BoolArray = field(default_factory=lambda: np.zeros(0, bool))  # whether a row of the graph
    station: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # its cone of a closed map, or -1

    def _clear_associations(self) -> None:
        self.boundary, self.u, self.used = self.label.copy(), np.zeros(len(self)), np.zeros(len(self), bool)
        self.station = np.full(len(self), NO_STATION)

    def take(self, rows: IntArray, boundary: IntArray | int, u: Array) -> None:
        """Put detections into use on a boundary, with the parameters (m,) of their foot points."""
        self.used[rows], self.boundary[rows], self.u[rows], self.changed[rows] = True, boundary, u, True
        self.station[rows] = NO_STATION

    def match(self, rows: IntArray, station: IntArray) -> None:
        """Set the stations (m,) of detections that have just been put into use."""
        self.station[rows] = station

    def release(self, rows: IntArray) -> None:
        """Take detections out of use; those of unknown colour may join either boundary again."""
        self.used[rows], self.boundary[rows], self.changed[rows] = False, self.label[rows], True
        self.station[rows] = NO_STATION

    def release_all(self) -> None:
        self.release(np.arange(len(self)))

    def refine(self, rows: IntArray, u: Array) -> None:
        """Store the refreshed foot points' parameters (m,); the associations do not change."""
        self.u[rows] = u

    def copy(self) -> Self:
        """Return a table whose associations can change independently; other columns are only replaced."""
        return replace(
            self,
            changed=self.changed.copy(),
            boundary=self.boundary.copy(),
            u=self.u.copy(),
            used=self.used.copy(),
            station=self.station.copy(),
        )

    @property
    def associated(self) -> tuple[IntArray, IntArray, BoolArray, Array, Array, Array, Array]:
        """Columns that say what is in use, where, and as what it was measured."""
        decided = self.cycle, self.boundary, self.used, self.u
        return *decided, self.measured, self.twist, self.covariance

    def used_on(self, label: int) -> IntArray:
        """Return the rows in use on the boundary `label`."""
        return np.flatnonzero(self.used & (self.boundary == label))

    def pending(self, label: int) -> IntArray:
        """Return the rows out of use that have the colour of the boundary `label`."""
        return np.flatnonzero(~self.used & (self.label == label))

    def open_to(self, labels: IntArray, since: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows (m,) to test for boundaries (k,) from `since` (k,) on, and the boundary of each.

        These are the rows out of use, and those of unknown colour that the other boundary uses: if both
        boundaries accept one, it is ambiguous.
        """
        return kernels.open_rows(labels, since, self.label, self.boundary, self.used, UNKNOWN)
