"""Tables of detections: one row for each detected cone, with its association by an estimator."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotated, to_map
from pathspace_graph.factors.sensor import corrected
from pathspace_graph.graph.variables import ONE_DRIVE, Drives, Variables, of_sensor
from pathspace_graph.io.log import Detections
from pathspace_graph.labels import UNKNOWN

NO_STATION: Final = -1  # station of a detection whose cone is ambiguous or not in the map


@dataclass
class DetectionColumns:
    """Measurements of the sensor: columns of equal length, the oldest detection first.

    A subclass adds columns of its associations. Points are corrected by the sensor's calibration on access.
    """

    cycle: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))
    """(m,) Perception cycles, non-decreasing."""
    measured: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(m, 2) Measured positions (x, y) in m, vehicle frame."""
    twist: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(m, 3) Twists of the vehicle at the detections, in m/s, m/s and rad/s."""
    covariance: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    """(m, 2, 2) Covariances of the positions in m^2, vehicle frame."""
    label: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # colour: LEFT, RIGHT or UNKNOWN
    changed: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    """Whether the association has changed since the last linearization of the detection's cycle."""
    sensor: Array = field(default_factory=lambda: np.zeros(0))  # calibration that corrects `point`; no column
    drives: Drives = ONE_DRIVE  # drives of the detections; no column

    def __len__(self) -> int:
        return len(self.cycle)

    @classmethod
    def of(cls, cycles: Sequence[Detections], first: int = 0, twists: Array | None = None) -> Self:
        """Build the table of consecutive cycles, numbered from `first`, with no detection in use.

        twists (k, 3) are the vehicle's at the cycles (m/s, m/s, rad/s), by default zero.
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
    def of_drives(cls, tables: Sequence["DetectionColumns"], drives: Drives) -> Self:
        """Build the table of several drives with consecutive cycles, with no detection in use."""
        names = ("cycle", "measured", "twist", "covariance", "label")
        cycle, *columns = (np.concatenate([vars(table)[name] for table in tables]) for name in names)
        begins = np.repeat(drives.first, [len(table) for table in tables])
        return replace(cls._unused(cycle + begins, *columns), drives=drives)

    @classmethod
    def _unused(
        cls, cycle: IntArray, measured: Array, twist: Array, covariance: Array, label: IntArray
    ) -> Self:
        """Build a table with no detection in use."""
        table = cls(cycle, measured, twist, covariance, label.astype(np.intp), np.zeros(len(cycle), bool))
        table._clear_associations()
        return table

    def _clear_associations(self) -> None:
        """Reset the subclass's columns to their state before any association."""

    def append(self, detections: Detections, cycle: int, twist: Array | None = None) -> slice:
        """Insert unused detections at the end of their cycle, with a twist (3,) or none; return the rows."""
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
        """Return positions (m, 2), vehicle frame, corrected by the sensor's calibration, (5,) or empty.

        With several drives, `sensor` (5 s,) has the calibrations of all s sensors.
        """
        measured, twist = self.measured[rows], self.twist[rows]

        def terms(own: IntArray | slice, sensor: Array) -> tuple[Array]:
            return (corrected(measured[own], twist[own], sensor),)

        return self.drives.by_sensor(terms, self.cycle[rows], sensor)[0]

    def correct(self, sensor: Array) -> None:
        """Set the calibration of the sensor that corrects `point`."""
        self.sensor = sensor.copy()

    def cones(self, of_lines: bool) -> Self:
        """Select the detections of cones: all, or none of a table of points of lines."""
        return self.where(np.zeros(0, np.intp)) if of_lines else self

    @property
    def point(self) -> Array:
        """All positions (m, 2), vehicle frame, corrected by the calibration of the latest `correct`."""
        return self.corrected(slice(None), self.sensor)

    def points_map(self, rows: IntArray | BoolArray | slice, variables: Variables) -> Array:
        """Transform corrected positions (m, 2) to the map frame, by the poses of their cycles."""
        if isinstance(rows, slice) or rows.dtype == np.bool_:
            rows = np.arange(len(self))[rows]
        if len(self.drives) > 1:
            return to_map(self.corrected(rows, variables.sensor), variables.poses_at(self.cycle[rows]))
        poses = variables.poses, variables.first_cycle
        return kernels.placed(
            rows.astype(np.intp, copy=False), self.cycle, self.measured, self.twist, *poses, variables.sensor
        )

    def covariances_map(self, rows: IntArray | slice, variables: Variables) -> Array:
        """Rotate the covariances (m, 2, 2) in m^2 to the map frame, by the poses of their cycles."""
        return rotated(self.covariance[rows], variables.poses_at(self.cycle[rows])[:, 2])

    def where(self, rows: IntArray) -> Self:
        """Select rows."""
        chosen = {column: vars(self)[column][rows] for column in self._columns()}
        return replace(self, **chosen)

    def of_drive(self, drive: int) -> Self:
        """Select the detections of one drive; their cycles keep their numbers."""
        if len(self.drives) == 1:
            return self
        own = self.where(np.flatnonzero(self.drives.of(self.cycle) == drive))
        sensor = of_sensor(self.sensor, self.drives.sensors[drive])
        return replace(own, sensor=sensor, drives=ONE_DRIVE)

    def keep_from(self, cycle: int) -> None:
        """Remove the detections of all cycles before `cycle`."""
        first, columns = int(self.cycle.searchsorted(cycle)), vars(self)
        for column in self._columns():
            columns[column] = columns[column][first:]

    def in_cycles(self, cycles: IntArray) -> BoolArray:
        """Whether each detection (m,) is of one of the ascending cycles (k,)."""
        if len(cycles) == 0:
            return np.zeros(len(self), bool)
        return np.asarray(cycles.take(cycles.searchsorted(self.cycle), mode="clip") == self.cycle)

    def mark_linearized(self) -> None:
        """Clear every `changed` flag: the graph has all present associations."""
        self.changed[:] = False


@dataclass
class DetectionTable(DetectionColumns):
    """Detections with their associations to boundary curves."""

    boundary: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # label of the curve, or UNKNOWN
    u: Array = field(default_factory=lambda: np.zeros(0))  # parameter of the foot point (m)
    used: BoolArray = field(default_factory=lambda: np.zeros(0, bool))  # whether the graph has its row
    station: IntArray = field(default_factory=lambda: np.zeros(0, np.intp))  # station of its cone, or -1

    def _clear_associations(self) -> None:
        self.boundary, self.u, self.used = self.label.copy(), np.zeros(len(self)), np.zeros(len(self), bool)
        self.station = np.full(len(self), NO_STATION)

    def take(self, rows: IntArray, boundary: IntArray | int, u: Array) -> None:
        """Use detections on a boundary, with the parameters (m,) of their foot points."""
        self.used[rows], self.boundary[rows], self.u[rows], self.changed[rows] = True, boundary, u, True
        self.station[rows] = NO_STATION

    def match(self, rows: IntArray, station: IntArray) -> None:
        """Set the stations (m,) of newly used detections."""
        self.station[rows] = station

    def release(self, rows: IntArray) -> None:
        """Take detections out of use. Those of unknown colour may join either boundary again."""
        self.used[rows], self.boundary[rows], self.changed[rows] = False, self.label[rows], True
        self.station[rows] = NO_STATION

    def release_all(self) -> None:
        self.release(np.arange(len(self)))

    def refine(self, rows: IntArray, u: Array) -> None:
        """Store refined parameters (m,) of foot points; the associations do not change."""
        self.u[rows] = u

    def copy(self) -> Self:
        """Return an independent copy; columns that are only replaced are shared."""
        other = shallow(self)
        for column in ("changed", "boundary", "u", "used", "station"):
            vars(other)[column] = vars(self)[column].copy()
        return other

    @property
    def associated(self) -> tuple[IntArray, IntArray, BoolArray, Array, Array, Array, Array, IntArray]:
        """Columns of the associations and of the measurements."""
        decided = self.cycle, self.boundary, self.used, self.u
        return *decided, self.measured, self.twist, self.covariance, self.station

    def used_on(self, label: int) -> IntArray:
        """Rows in use on the boundary `label`."""
        return np.flatnonzero(self.used & (self.boundary == label))

    def pending(self, label: int) -> IntArray:
        """Unused rows with the colour of the boundary `label`."""
        return np.flatnonzero(~self.used & (self.label == label))

    def open_to(self, labels: IntArray, since: IntArray) -> tuple[IntArray, IntArray]:
        """Return the rows (m,) to test for boundaries (k,) from `since` (k,) on, and the boundary of each.

        These are unused rows, and rows of unknown colour that the other boundary uses. A row that both
        boundaries accept is ambiguous.
        """
        return kernels.open_rows(labels, since, self.label, self.boundary, self.used, UNKNOWN)
