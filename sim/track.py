"""A track: two rows of cones in driving order, and where the vehicle starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN

from .centre_line import CentreLine, fit_centre_line
from .geometry import direction, left_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int_]


@dataclass(frozen=True, eq=False)
class Track:
    """The cones of a track, in any frame of its own."""

    left: FloatArray
    """Cones of the left boundary in driving order (n, 2), m."""
    right: FloatArray
    """Cones of the right boundary in driving order (m, 2), m."""
    other: FloatArray
    """Cones of no boundary, such as those of a gate (k, 2), m."""
    closed: bool
    """Whether the last cones are followed by the first."""
    start: FloatArray
    """Pose that the vehicle starts from [x, y, theta] (3,), m, m, rad."""
    name: str
    """What the track is called."""

    @cached_property
    def centre_line(self) -> CentreLine:
        """The smooth curve halfway between the boundaries, in the track's frame."""
        return fit_centre_line(self.left, self.right, self.closed, self.start[:2])

    @property
    def cones(self) -> FloatArray:
        """All cones: left, right, other (M, 2), m."""
        return np.vstack([self.left, self.right, self.other])

    @property
    def cone_labels(self) -> IntArray:
        """LEFT, RIGHT or UNKNOWN of each of `cones` (M,)."""
        return np.repeat([LEFT, RIGHT, UNKNOWN], [len(self.left), len(self.right), len(self.other)])


def to_map_frame(track: Track) -> Track:
    """The track moved so that its start pose is (0, 0, 0): the map frame of a log that starts there."""
    ahead = direction(track.start[2])
    rotation = np.column_stack([ahead, left_normals(ahead)])

    def move(points: FloatArray) -> FloatArray:
        return np.asarray((points - track.start[:2]) @ rotation)

    return replace(
        track, left=move(track.left), right=move(track.right), other=move(track.other), start=np.zeros(3)
    )
