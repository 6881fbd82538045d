"""What left the window, stretch by stretch, each in its own frame, so that closing can relinearize it.

Everything that a stretch of the drive measured is relative: readings tie poses to control points, odometry
ties poses to poses. Its marginal is therefore a function of coordinates in the frame of the stretch's first
pose, its *keyframe*, and stays valid when the loop turns the whole stretch. A single dense prior can't do
that: it is linearized at the heading that the vehicle had drifted to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .window import POSE, Prior, marginal, schur_leave

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Segment:
    """`1/2 e' L e - g' e`, `e = y(x) - y0`: control points, calibration and end pose seen from a keyframe."""

    labels: IntArray
    """(k,) boundary of each control point it touches."""
    indices: IntArray
    """(k,) index of each in its boundary."""
    information: Array
    """(q, q) L, q = 2 k + calibration + 3."""
    gradient: Array
    """(q,) g."""
    local: Array
    """(q,) y0: points (m) and pose (m, m, rad) in the keyframe's frame, calibration as it is."""


def compress(
    prior: Prior, keyframe: Array, labels: IntArray, indices: IntArray, touched: NDArray[np.bool_]
) -> Segment:
    """A segment from a prior on [control points | calibration | pose], given its keyframe's pose (3,).

    labels, indices (n,) name the prior's control points, `touched` (n,) says which of them it knows anything
    of.
    """
    n = len(labels)
    columns = np.concatenate([np.flatnonzero(np.repeat(touched, 2)), np.arange(2 * n, len(prior.point))])
    k = int(touched.sum())
    rotation = _frame_rotation(k, len(columns), keyframe[2])
    information = rotation.T @ prior.information[np.ix_(columns, columns)] @ rotation
    gradient = rotation.T @ prior.gradient[columns]
    local = _local(prior.point[columns], keyframe, k)
    return Segment(labels[touched], indices[touched], information, gradient, local)


def relinearize(segment: Segment, values: Array, keyframe: Array) -> tuple[Array, Array]:
    """Normal equations (H, -gradient) of a segment by (values, keyframe) at values (q,) in the map frame.

    The last three entries of both belong to the keyframe's (x, y, theta).
    """
    k, q = len(segment.labels), len(values)
    error = _local(values, keyframe, k) - segment.local
    descent_local = segment.gradient - segment.information @ error
    jacobian = np.zeros((q, q + POSE))
    jacobian[:, :q] = _frame_rotation(k, q, keyframe[2]).T
    c, s = np.cos(keyframe[2]), np.sin(keyframe[2])
    position = np.concatenate([np.arange(2 * k).reshape(-1, 2), [[q - 3, q - 2]]])
    offset = values[position] - keyframe[:2]
    jacobian[position[:, 0], q], jacobian[position[:, 0], q + 1] = -c, -s
    jacobian[position[:, 1], q], jacobian[position[:, 1], q + 1] = s, -c
    jacobian[position[:, 0], q + 2] = -s * offset[:, 0] + c * offset[:, 1]
    jacobian[position[:, 1], q + 2] = -c * offset[:, 0] - s * offset[:, 1]
    jacobian[q - 1, q + 2] = -1.0
    return jacobian.T @ segment.information @ jacobian, jacobian.T @ descent_local


def forget(segment: Segment, label: int, first: int) -> Segment:
    """A segment that knows nothing of a boundary's control points from an index on."""
    gone = (segment.labels == label) & (segment.indices >= first)
    if not gone.any():
        return segment
    columns = np.append(np.repeat(gone, 2), np.zeros(len(segment.local) - 2 * len(gone), bool))
    leaving, rest = np.flatnonzero(columns), np.flatnonzero(~columns)
    information, gradient = marginal(segment.information, segment.gradient, leaving, rest)
    labels, indices = segment.labels[~gone], segment.indices[~gone]
    return Segment(labels, indices, information, gradient, segment.local[rest])


def _frame_rotation(k: int, q: int, theta: float) -> Array:
    """(q, q) block-diagonal: keyframe's frame to map frame; calibration and heading stay as they are."""
    c, s = np.cos(theta), np.sin(theta)
    matrix = np.eye(q)
    x = np.append(np.arange(0, 2 * k, 2), q - 3)
    matrix[x, x], matrix[x, x + 1], matrix[x + 1, x], matrix[x + 1, x + 1] = c, -s, s, c
    return matrix


def _local(values: Array, keyframe: Array, k: int) -> Array:
    """Control points and pose of (q,) values in the map frame, seen from the keyframe."""
    q = len(values)
    c, s = np.cos(keyframe[2]), np.sin(keyframe[2])
    local = values.copy()
    x = np.append(np.arange(0, 2 * k, 2), q - 3)
    dx, dy = values[x] - keyframe[0], values[x + 1] - keyframe[1]
    local[x], local[x + 1] = c * dx + s * dy, -s * dx + c * dy
    local[q - 1] = values[q - 1] - keyframe[2]
    return local


class History:
    """The segments of the drive so far, the last of them unfinished; forgotten when the loop has closed."""

    def __init__(self, first: Prior, interval: float) -> None:
        self.first = Prior(first.information, first.gradient, first.point)
        """Absolute prior on [calibration | first pose], as the drive began."""
        self.interval = interval
        """Path (m) between keyframes."""
        self.keyframes: list[Array] = []
        """Pose (3,) of each segment's keyframe, as it was when it left the window."""
        self.segments: list[Segment] = []
        self._current: Prior | None = None
        self._driven = 0.0

    def widen(self, at: int, values: Array) -> None:
        """Make room for new control points at state index `at`."""
        if self._current is not None:
            self._current.widen(at, values)

    def leave(
        self, hessian: Array, descent: Array, point: Array, labels: IntArray, indices: IntArray
    ) -> None:
        """The oldest pose leaves: normal equations of its rows, on [map | calibration | it | next]."""
        low = len(point) - 2 * POSE
        pose, following = point[low : low + POSE], point[low + POSE :]
        stay = np.r_[0:low, low + POSE : len(point)]
        if self._driven >= self.interval:
            self.cut(labels, indices)
        if self._current is None:
            self.keyframes.append(pose.copy())
            information, gradient = hessian[np.ix_(stay, stay)], descent[stay]
            self._driven = 0.0
        else:
            q = low + POSE
            hessian, descent = hessian.copy(), descent.copy()
            hessian[:q, :q] += self._current.information
            descent[:q] += self._current.descent_at(point)
            information, gradient = schur_leave(hessian, descent, low, low + POSE)
        self._current = Prior(information, gradient, point[stay])
        self._driven += float(np.hypot(*(following[:2] - pose[:2])))

    def cut(self, labels: IntArray, indices: IntArray) -> None:
        """The segment under way ends here."""
        if self._current is not None:
            self.segments.append(self._finish(labels, indices))
            self._current = None

    def forget(self, label: int, first: int) -> None:
        """Know nothing of a boundary's control points from an index on; no segment is under way."""
        assert self._current is None
        self.segments = [forget(segment, label, first) for segment in self.segments]

    def _finish(self, labels: IntArray, indices: IntArray) -> Segment:
        assert self._current is not None
        touched = np.diagonal(self._current.information)[: 2 * len(labels) : 2] > 0.0
        return compress(self._current, self.keyframes[-1], labels, indices, touched)

    def all_segments(self, labels: IntArray, indices: IntArray) -> list[Segment]:
        """The finished segments and the one that ends at the oldest pose of the window."""
        under_way = [] if self._current is None else [self._finish(labels, indices)]
        return [*self.segments, *under_way]


def relinearized_prior(
    history: History, segments: list[Segment], state: Array, offsets: dict[int, int], map_size: int
) -> Prior:
    """The prior on [map | calibration | keyframes | oldest pose], every segment linearized at the state."""
    calibration = len(history.first.point) - POSE
    poses = map_size + calibration
    size = poses + POSE * (len(segments) + 1)
    information, descent = np.zeros((size, size)), np.zeros(size)
    own = np.arange(map_size, poses + POSE)
    information[np.ix_(own, own)] += history.first.information
    descent[own] += history.first.descent_at(state[own])
    start = np.array([offsets.get(label, 0) for label in range(max(offsets) + 1)])
    for i, segment in enumerate(segments):
        points = start[segment.labels] + 2 * segment.indices
        columns = np.concatenate(
            [
                np.column_stack([points, points + 1]).ravel(),
                np.arange(map_size, poses),
                poses + POSE * (i + 1) + np.arange(POSE),
                poses + POSE * i + np.arange(POSE),
            ]
        )
        block, gradient = relinearize(segment, state[columns[:-POSE]], state[columns[-POSE:]])
        information[columns[:, None], columns] += block
        descent[columns] += gradient
    return Prior(information, descent, state[:size].copy())
