"""A revisit: the pose of the vehicle as seen from an earlier one, by the cones that were seen from both.

Where a drive meets its road again without a lap, as on a skidpad, a pose may slide along both boundaries. The
cones themselves hold it in every direction.
"""

from dataclasses import dataclass

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import relative, wrap_angle
from pathspace_graph.graph.relative import RelativeFactor, by_frame_of, rotations
from pathspace_graph.graph.rows import Rows
from pathspace_graph.graph.variables import POSE, Layout, pose_keys


@dataclass(frozen=True, eq=False)
class Revisit:
    """The pose of one cycle in the frame of an earlier one's, as it was measured: `A (y(x) - y0)`."""

    earlier: int  # cycle in whose frame the pose is
    later: int
    local: Array  # (3,) the measured pose y0 (m, m, rad)
    root: Array  # (3, 3) A, a square root of its information

    def factor(self) -> RelativeFactor:
        earlier, later = pose_keys(np.array([self.earlier, self.later]))
        return RelativeFactor(int(earlier), Layout(np.array([later])), self.root, np.zeros(POSE), self.local)

    def residual(self, poses: Array) -> Array:
        """Return the whitened residual (3,) at the poses (P, 3) of all cycles."""
        seen = relative(poses[self.earlier], poses[self.later]) - self.local
        return np.asarray(self.root @ [*seen[:2], wrap_angle(seen[2])])

    def rows(self, poses: Array) -> Rows:
        """Return the rows on [earlier pose | later pose], linearized at the poses (P, 3) of all cycles."""
        frame, values = poses[self.earlier], poses[self.later]
        layout = Layout(pose_keys(np.array([self.later])))
        jacobian = [by_frame_of(values, frame, layout), rotations(layout, frame[2]).T]
        keys = np.tile(pose_keys(np.array([self.earlier, self.later])), (POSE, 1))
        owner = np.full(POSE, -1 - self.later)  # a factor of its own, since its poses are far apart
        return Rows(keys, self.root @ np.concatenate(jacobian, axis=1), self.residual(poses), owner)
