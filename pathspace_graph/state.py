"""What is estimated, by name: one flat vector, and which of its entries are what."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE

from .boundary import Boundary
from .curves import Curves, side_by_side
from .window import POSE, without

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class State:
    """`x = [control points of each boundary | calibration | keyframes | poses, oldest first]`.

    Points in the map frame (m); poses (x, y, theta) in the map frame, theta unwrapped (rad); calibration as
    `integrate_twists` has it. Keyframes are those of a loop that closes, or the pose that far control points
    hang on. What is solved for in a cycle is the *system*: x without the control points that are far.
    """

    def __init__(self) -> None:
        self.vector: Array = np.zeros(CALIBRATION_SIZE)
        """(n,) x."""
        self.boundaries: dict[int, Boundary] = {}
        """The curves by label, in the order of their control points."""
        self.narrowed: dict[int, IntArray] = {}
        """Where not all of a boundary's control points are in the system, those (k,) that are: one stretch,
        in driving order."""
        self.stations: dict[int, Array] = {}
        """For each boundary the parameter (P,) of each pose's foot point on it; not wrapped."""
        self.keyframes = 0
        """Poses in x before the window's own."""
        self._known_near: list[IntArray] = []
        self._places = (np.zeros(0, np.intp), np.zeros(0, np.intp))
        self._curves: Curves | None = None

    @property
    def map_size(self) -> int:
        """Entries that are control points."""
        return 2 * sum(boundary.size for boundary in self.boundaries.values())

    @property
    def near_size(self) -> int:
        """Entries of the system that are control points."""
        return 2 * sum(len(self.near(label)) for label in self.boundaries)

    def near(self, label: int) -> IntArray:
        """(k,) a boundary's control points that are in the system."""
        return self.narrowed.get(label, self.boundaries[label].everything)

    @property
    def whole(self) -> bool:
        """Whether every control point is in the system."""
        return not self.narrowed

    @property
    def system(self) -> IntArray:
        """Columns of x that are in the system, in its order."""
        return np.concatenate([self._near_places()[0], np.arange(self.map_size, len(self.vector))])

    @property
    def position(self) -> IntArray:
        """(n,) place in the system of each entry of x, -1 where it is far."""
        columns, places = self._near_places()
        rest = len(self.vector) - len(places)
        return np.concatenate([places, len(columns) + np.arange(rest)])

    def _near_places(self) -> tuple[IntArray, IntArray]:
        """Columns of the near control points, and the place among them of each entry; kept for next time."""
        near = [self.near(label) for label in self.boundaries]
        if len(near) != len(self._known_near) or any(
            a is not b for a, b in zip(near, self._known_near, strict=True)
        ):
            points = [
                self.offset(label) + 2 * indices for label, indices in zip(self.boundaries, near, strict=True)
            ]
            control = [np.stack([x, x + 1], axis=1).ravel() for x in points]
            columns = np.concatenate([np.zeros(0, np.intp), *control])
            places = np.full(self.map_size, -1)
            places[columns] = np.arange(len(columns))
            self._known_near, self._places = near, (columns, places)
        return self._places

    @property
    def curves(self) -> Curves:
        """The boundaries, at least one, side by side; kept for next time."""
        known = self._curves
        if known is None or not known.are(self.boundaries, self.near):
            near = {label: self.near(label) for label in self.boundaries}
            known = self._curves = side_by_side(self.boundaries, near)
        return known

    @property
    def map_points(self) -> Array:
        """Control points (m, 2) of all boundaries: a view of x."""
        return self.vector[: self.map_size].reshape(-1, 2)

    def near_block(self, label: int) -> slice:
        """Entries of the system that are a boundary's control points."""
        start = 2 * sum(len(self.near(b)) for b in self.boundaries if b < label)
        return slice(start, start + 2 * len(self.near(label)))

    @property
    def poses(self) -> Array:
        """Poses (P, 3) in the window, oldest first: a view of x."""
        return self.vector[self.pose_column(0) :].reshape(-1, POSE)

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]): a view of x."""
        return self.vector[self.map_size : self.map_size + CALIBRATION_SIZE]

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary: a view of x."""
        return self.vector[self.block(label)].reshape(-1, 2)

    def block(self, label: int) -> slice:
        """Entries of a boundary's control points."""
        start = self.offset(label)
        return slice(start, start + 2 * self.boundaries[label].size)

    def offset(self, label: int) -> int:
        """First entry of a boundary's control points."""
        return 2 * sum(boundary.size for b, boundary in self.boundaries.items() if b < label)

    def pose_column(self, slot: int) -> int:
        """First entry of a pose of the window, 0 the oldest."""
        return self.map_size + CALIBRATION_SIZE + POSE * (self.keyframes + slot)

    def pose_columns(self, slots: IntArray) -> IntArray:
        """(m, 3) entries of poses of the window."""
        return (self.pose_column(0) + POSE * slots)[:, None] + np.arange(POSE)

    def control_ids(self) -> tuple[IntArray, IntArray]:
        """Boundary and index (n,) of each control point of the system, in its order."""
        near = [self.near(label) for label in self.boundaries]
        labels = np.repeat(np.array(list(self.boundaries), np.intp), [len(indices) for indices in near])
        return labels, np.concatenate([*near, np.zeros(0, np.intp)])

    def add_boundary(self, label: int, boundary: Boundary) -> None:
        """Take up a boundary, whose control points are to be inserted next."""
        self.boundaries = dict(sorted({**self.boundaries, label: boundary}.items()))

    def insert(self, index: int, values: Array) -> None:
        """New entries (k,) at an index of x."""
        self.vector = np.insert(self.vector, index, values)

    def append_pose(self, pose: Array) -> None:
        """A newest pose (3,)."""
        self.vector = np.concatenate([self.vector, pose])

    def drop_oldest_pose(self) -> None:
        """The oldest pose leaves the window."""
        low = self.pose_column(0)
        self.vector = without(self.vector, low, low + POSE, 0)
        self._drop_oldest_station()

    def keep_oldest_pose(self) -> None:
        """The oldest pose leaves the window, and is a keyframe from now on."""
        self.keyframes += 1
        self._drop_oldest_station()

    def drop_keyframes(self) -> None:
        """There are no keyframes any more."""
        stop = self.pose_column(0)
        self.vector = without(self.vector, stop - POSE * self.keyframes, stop, 0)
        self.keyframes = 0

    def _drop_oldest_station(self) -> None:
        self.stations = {label: u[1:] for label, u in self.stations.items()}
