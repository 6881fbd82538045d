"""Relative factors: Gaussian information on coordinates in the frame of a pose, and revisits.

All measurements of a drive are relative: detections relate poses to map points, and odometry relates poses to
poses. So what an elimination leaves of them is a function of coordinates in the frame of any one of these
poses. It stays valid when the pose's whole neighbourhood turns, and says nothing of that turn. A factor that
is linear in map coordinates does neither: it is linearized at the heading that the vehicle had drifted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import left_of, to_vehicle, wrap_angle

from .gaussian import (
    keys_of,
    normal_equations,
    square_root_form,
)
from .rows import Rows
from .variables import ORIGIN_KEY, POSE, Layout, Variables, pose_keys, rotation_blocks


@dataclass(frozen=True, eq=False)
class RelativeFactor:
    """Factor `1/2 |A e - b|^2` with `e = y(x) - y0`, where y are in the frame of a pose.

    In the frame of the pose `(p, theta)` a map point c is `R(theta)' (c - p)`, and another pose `(t, h)` is
    `(R(theta)' (t - p), h - theta)`. The calibration does not depend on a frame.
    """

    frame: int  # key of the pose
    keys: Layout  # of the variables y: calibration, map points and poses
    root: Array  # (r, q) A, a square root of the information
    right: Array  # (r,) b
    local: Array  # (q,) linearization point y0

    def factor(self, variables: Variables) -> gtsam.GaussianFactor:
        """Return the factor on its keys and the frame's, but the origin's, linearized at the values."""
        keys = np.append(self.keys.keys, self.frame)
        entries = variables.layout.entries(keys)
        now = variables.values[entries], variables.change(entries)
        block = kernels.relative_block(self.root, self.right, self.local, *now, self.keys)
        widths, moves = np.append(self.keys.widths, POSE), keys != ORIGIN_KEY
        if not moves.all():
            block = np.asfortranarray(block[:, np.append(np.repeat(moves, widths), True)])
        matrix = gtsam.VerticalBlockMatrix([*widths[moves].tolist(), 1], block, False)
        return gtsam.GaussianConditional(keys[moves].tolist(), 1, matrix)


def relative_factor(
    graph: gtsam.GaussianFactorGraph, frame: int, pose: Array, reference: Array, variables: Variables
) -> RelativeFactor:
    """Return a graph of relative measurements as a factor in the frame of a pose.

    That is at `pose` (3,), its unknown measured from `reference` (3,). In the frame of a fixed pose variables
    are linear functions of the unknowns, so the change of frame is exact.
    """
    held = Layout(keys_of(graph))
    information, vector = normal_equations(graph, held)
    known = held.keys[(np.diagonal(information)[held.starts] > 0.0) & (held.keys != frame)]
    kept, own, fixed = Layout(known), held.entries(known), held.entries(held.keys[held.keys == frame])
    entries = variables.layout.entries(known)
    vector = vector[own] - information[np.ix_(own, fixed)] @ (pose - reference)[: len(fixed)]
    information = information[np.ix_(own, own)]
    root, right = square_root_form(information, vector - information @ variables.change(entries))
    local = to_frame(variables.values[entries], pose, kept)
    return RelativeFactor(frame, kept, root @ rotations(kept, pose[2]), right, local)


# --- coordinates in the frame of a pose ------------------------------------------------------------------


def rotations(keys: Layout, heading: float) -> Array:
    """Return the rotation (q, q) of points and poses from a frame with a heading (rad) to the map frame."""
    x = keys.turning
    return rotation_blocks(keys.size, x, np.full(len(x), heading))


def to_frame(values: Array, frame: Array, keys: Layout) -> Array:
    """Return values (q,) of keys, which are in the map frame, in the frame of a pose (3,)."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    local, x = values.copy(), keys.turning
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    local[x], local[x + 1] = c * dx + s * dy, -s * dx + c * dy
    local[keys.headings] -= frame[2]
    return local


def from_frame(local: Array, frame: Array, keys: Layout) -> Array:
    """Return values (q,) of keys, which are in the frame of a pose (3,), in the map frame."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    values, x = local.copy(), keys.turning
    values[x] = frame[0] + c * local[x] - s * local[x + 1]
    values[x + 1] = frame[1] + s * local[x] + c * local[x + 1]
    values[keys.headings] += frame[2]
    return values


def by_frame_of(values: Array, frame: Array, keys: Layout) -> Array:
    """Return the derivative (q, 3) of `to_frame` by the pose of the frame."""
    c, s = np.cos(frame[2]), np.sin(frame[2])
    matrix, x = np.zeros((keys.size, POSE)), keys.turning
    dx, dy = values[x] - frame[0], values[x + 1] - frame[1]
    matrix[x, 0], matrix[x, 1], matrix[x, 2] = -c, -s, -s * dx + c * dy
    matrix[x + 1, 0], matrix[x + 1, 1], matrix[x + 1, 2] = s, -c, -c * dx - s * dy
    matrix[keys.headings, 2] = -1.0
    return matrix


# --- a place that was met again --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Revisit:
    """The pose of one cycle in the frame of an earlier one's, by cones seen from both: `A (y(x) - y0)`.

    Where a drive meets its road again without a lap, as on a skidpad, a pose may slide along both boundaries,
    but the cones themselves hold it in every direction.
    """

    earlier: int  # cycle in whose frame the pose is
    later: int
    local: Array  # (3,) the measured pose y0 (m, m, rad)
    root: Array  # (3, 3) A, a square root of its information


def revisit_rows(revisits: Sequence[Revisit], poses: Array) -> list[Rows]:
    """Return the rows on [earlier pose | later pose], linearized at the poses (P, 3) of all cycles.

    They are one group, or none without revisits. Those of one later pose are a factor of their own, since the
    earlier one is far away.
    """
    if not revisits:
        return []
    ends = np.array([(one.earlier, one.later) for one in revisits])
    frame, other = poses[ends.T]
    turn, moved = se2.rotations(frame[:, 2]), other - frame
    off = np.column_stack([(moved[:, None, :2] @ turn)[:, 0], moved[:, 2]])
    off -= [one.local for one in revisits]
    off[:, 2] = wrap_angle(off[:, 2])
    by_other = np.tile(np.eye(POSE), (len(ends), 1, 1))
    by_other[:, :2, :2] = turn.transpose(0, 2, 1)
    by_frame = -by_other
    by_frame[:, :2, 2] = -left_of(to_vehicle(other[:, :2], frame))
    by_ends = np.concatenate([by_frame, by_other], axis=2)
    jacobian = np.concatenate([one.root @ by for one, by in zip(revisits, by_ends, strict=True)])
    residual = np.concatenate([one.root @ own for one, own in zip(revisits, off, strict=True)])
    keys, owner = np.repeat(pose_keys(ends), POSE, axis=0), np.repeat(-1 - ends[:, 1], POSE)
    return [Rows(keys, jacobian, residual, owner)]
