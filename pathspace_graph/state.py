"""What is estimated, by name: one flat vector, and which of its entries are what."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE

from .boundary import Boundary
from .window import POSE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class State:
    """`x = [control points of each boundary | calibration | keyframes | poses, oldest first]`.

    Points in the map frame (m); poses (x, y, theta) in the map frame, theta unwrapped (rad); calibration as
    `integrate_twists` has it. Keyframes are there only while the loop closes.
    """

    def __init__(self) -> None:
        self.vector: Array = np.zeros(CALIBRATION_SIZE)
        """(n,) x."""
        self.boundaries: dict[int, Boundary] = {}
        """The curves by label, in the order of their control points."""
        self.stations: dict[int, Array] = {}
        """For each boundary the parameter (P,) of each pose's foot point on it; not wrapped."""
        self.keyframes = 0
        """Poses in x before the window's own."""

    @property
    def map_size(self) -> int:
        """Entries that are control points."""
        return 2 * sum(boundary.size for boundary in self.boundaries.values())

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
        """Boundary and index (n,) of each control point, in the order of x."""
        sizes = [boundary.size for boundary in self.boundaries.values()]
        labels = np.repeat(np.array(list(self.boundaries), np.intp), sizes)
        return labels, np.concatenate([np.arange(n) for n in sizes] or [np.zeros(0, np.intp)])

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
        self.vector = np.delete(self.vector, np.s_[low : low + POSE])
        self.stations = {label: u[1:] for label, u in self.stations.items()}
