"""A track: two rows of cones in driving order, and the pose that the vehicle starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

from .centre_line import CentreLine, along_path, fit_centre_line
from .geometry import direction, left_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class Track:
    """Holds the cones of a track, in a frame of its own."""

    left: FloatArray
    """These are the cones of the left boundary in driving order (n, 2) in m."""
    right: FloatArray
    """These are the cones of the right boundary in driving order (m, 2) in m."""
    other: FloatArray
    """These are the cones of no boundary, such as those of a gate (k, 2) in m."""
    closed: bool
    """The last cones are followed by the first where this is true."""
    start: FloatArray
    """The vehicle starts from this pose [x, y, theta] (3,) in m, m, rad."""
    name: str
    """The track is known by this name."""
    other_labels: IntArray | None = None
    """(k,) Labels of the other cones; all are UNKNOWN where this is None."""
    path: FloatArray | None = None
    """The road is driven along these points (k, 2) in m, where that is not once along its middle."""

    @cached_property
    def centre_line(self) -> CentreLine:
        """Returns the smooth curve halfway between the boundaries, or along the path, track frame."""
        if self.path is not None:
            return along_path(self.path, np.vstack([self.left, self.right]), self.closed)
        return fit_centre_line(self.left, self.right, self.closed, self.start[:2])

    @property
    def cones(self) -> FloatArray:
        """Returns all cones (M, 2) in m: left, right, other."""
        return np.vstack([self.left, self.right, self.other])

    @property
    def cone_labels(self) -> IntArray:
        """Returns the label of each of `cones` (M,)."""
        other = np.full(len(self.other), UNKNOWN) if self.other_labels is None else self.other_labels
        return np.concatenate([np.repeat([LEFT, RIGHT], [len(self.left), len(self.right)]), other])


def to_map_frame(track: Track) -> Track:
    """Moves the track so that its start pose is (0, 0, 0): the map frame of a log that starts there."""
    ahead = direction(track.start[2])
    rotation = np.column_stack([ahead, left_normals(ahead)])

    def move(points: FloatArray) -> FloatArray:
        return np.asarray((points - track.start[:2]) @ rotation)

    return replace(
        track,
        left=move(track.left),
        right=move(track.right),
        other=move(track.other),
        start=np.zeros(3),
        path=None if track.path is None else move(track.path),
    )
