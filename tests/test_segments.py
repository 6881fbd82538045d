"""Segments: relative, so that a rigid motion changes nothing, and at their point exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE, odometry_residuals
from pathspace_graph.segments import History, Segment, compress, forget, relinearize, relinearized_prior
from pathspace_graph.window import POSE, Prior, Rows, accumulate, schur_leave

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

POINTS = 3
"""Control points of the random segment."""
SIZE = 2 * POINTS + CALIBRATION_SIZE + POSE
"""Entries of its values."""


def turn(theta: float) -> Array:
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def random_segment(rng: np.random.Generator) -> Segment:
    root = rng.normal(size=(SIZE + 2, SIZE))
    labels, indices = np.array([0, 0, 1], np.intp), np.array([4, 5, 2], np.intp)
    return Segment(labels, indices, root.T @ root, rng.normal(size=SIZE), rng.normal(size=SIZE))


def seen_from(values: Array, keyframe: Array) -> Array:
    """Values in the map frame as a keyframe sees them, written once more."""
    inverse = turn(keyframe[2]).T
    points = values[: 2 * POINTS].reshape(-1, 2)
    return np.concatenate(
        [
            np.concatenate([inverse @ (p - keyframe[:2]) for p in points]),
            values[2 * POINTS : -POSE],
            inverse @ (values[-POSE:-1] - keyframe[:2]),
            [values[-1] - keyframe[2]],
        ]
    )


def energy(segment: Segment, x: Array) -> float:
    """`1/2 e' L e - g' e` at x = (values, keyframe)."""
    e = seen_from(x[:-POSE], x[-POSE:]) - segment.local
    return float(0.5 * e @ segment.information @ e - segment.gradient @ e)


def moved(x: Array, theta: float, shift: Array) -> Array:
    """(values, keyframe) after a rigid motion of the map frame."""
    x = x.copy()
    for at in (*range(0, 2 * POINTS, 2), SIZE - POSE, SIZE):
        x[at : at + 2] = turn(theta) @ x[at : at + 2] + shift
    x[[SIZE - 1, SIZE + 2]] += theta
    return x


@pytest.mark.parametrize("seed", range(5))
def test_relinearize_is_the_derivative_of_the_energy(seed: int) -> None:
    """Far from the segment's own point, at any heading."""
    rng = np.random.default_rng(seed)
    segment, x = random_segment(rng), rng.normal(size=SIZE + POSE) * 3.0
    hessian, descent = relinearize(segment, x[:-POSE], x[-POSE:])
    steps = 1e-6 * np.eye(len(x))
    numeric = np.array([(energy(segment, x + h) - energy(segment, x - h)) / 2e-6 for h in steps])
    np.testing.assert_allclose(descent, -numeric, rtol=1e-6, atol=1e-5)
    differences = [
        seen_from((x + h)[:-POSE], (x + h)[-POSE:]) - seen_from((x - h)[:-POSE], (x - h)[-POSE:])
        for h in steps
    ]
    jacobian = np.array(differences).T / 2e-6
    np.testing.assert_allclose(hessian, jacobian.T @ segment.information @ jacobian, rtol=1e-6, atol=1e-5)


@given(st.integers(0, 1000), st.floats(-4.0, 4.0), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_a_rigid_motion_turns_the_gradient_and_keeps_the_energy(
    seed: int, theta: float, dx: float, dy: float
) -> None:
    rng = np.random.default_rng(seed)
    segment, x = random_segment(rng), rng.normal(size=SIZE + POSE)
    y = moved(x, theta, np.array([dx, dy]))
    assert energy(segment, y) == pytest.approx(energy(segment, x), rel=1e-8, abs=1e-8)
    before, after = relinearize(segment, x[:-POSE], x[-POSE:]), relinearize(segment, y[:-POSE], y[-POSE:])
    rotation = moved(np.zeros(SIZE + POSE), 0.0, np.zeros(2)) + np.eye(SIZE + POSE)
    for at in (*range(0, 2 * POINTS, 2), SIZE - POSE, SIZE):
        rotation[at : at + 2, at : at + 2] = turn(theta)
    np.testing.assert_allclose(after[1], rotation @ before[1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(after[0], rotation @ before[0] @ rotation.T, rtol=1e-8, atol=1e-8)


def test_a_segment_leaves_a_rigid_motion_free() -> None:
    """Three directions without information: both shifts and the turn."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=SIZE + POSE)
    hessian, _ = relinearize(random_segment(rng), x[:-POSE], x[-POSE:])
    values = np.linalg.eigvalsh(hessian)
    assert values[2] < 1e-10 * values[-1] < values[3]


def test_a_segment_forgets_control_points_and_nothing_else() -> None:
    """Of boundary 0 from index 5 on: what is left has the same covariance."""
    rng = np.random.default_rng(3)
    segment = random_segment(rng)
    less = forget(segment, 0, 5)
    assert (less.labels.tolist(), less.indices.tolist()) == ([0, 1], [4, 2])
    rest = np.delete(np.arange(SIZE), [2, 3])
    covariance = np.linalg.inv(segment.information)[np.ix_(rest, rest)]
    np.testing.assert_allclose(np.linalg.inv(less.information), covariance, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(less.local, segment.local[rest])
    assert forget(segment, 1, 3) is segment


def test_compress_keeps_the_energy_and_what_is_touched() -> None:
    rng = np.random.default_rng(1)
    labels, indices = np.array([0, 0, 1, 1], np.intp), np.array([0, 1, 0, 1], np.intp)
    touched = np.array([True, False, True, True])
    known = np.delete(np.arange(8 + CALIBRATION_SIZE + POSE), [2, 3])
    size = 8 + CALIBRATION_SIZE + POSE
    root = np.zeros((20, size))
    root[:, known] = rng.normal(size=(20, len(known)))
    prior = Prior(root.T @ root, root.T @ rng.normal(size=20), rng.normal(size=size))
    keyframe = rng.normal(size=3)
    segment = compress(prior, keyframe, labels, indices, touched)
    assert segment.labels.tolist() == [0, 1, 1]
    assert segment.indices.tolist() == [0, 0, 1]
    for _ in range(3):
        x = rng.normal(size=size)
        d = x - prior.point
        expected = 0.5 * d @ prior.information @ d - prior.gradient @ d
        assert energy(segment, np.concatenate([x[known], keyframe])) == pytest.approx(expected, rel=1e-9)


# --- a small drive ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drive:
    """Poses and control points of two boundaries, and what the poses measured, linearized once."""

    points: Array
    """(n, 2) control points, both boundaries."""
    sizes: tuple[int, int]
    """Of each boundary."""
    calibration: Array
    """(2,)."""
    poses: Array
    """(P, 3)."""
    seen: tuple[IntArray, ...]
    """Control points that each pose measured."""

    @property
    def map_size(self) -> int:
        return 2 * len(self.points)

    def state(self) -> Array:
        return np.concatenate([self.points.ravel(), self.calibration, self.poses.ravel()])


def random_drive(rng: np.random.Generator, late: int) -> Drive:
    """Poses a metre apart; the last point of the left boundary is seen from pose `late` on only."""
    poses = np.column_stack([np.arange(9.0), rng.normal(size=9) * 0.2, rng.normal(size=9)])
    seen = [rng.choice(6, 4, replace=False) for _ in poses]
    seen = [points if k >= late else points[points != 2] for k, points in enumerate(seen)]
    return Drive(rng.normal(size=(6, 2)) * 5.0, (3, 3), rng.normal(size=2), poses, tuple(seen))


def reading_rows(drive: Drive, k: int, rng: np.random.Generator) -> Rows:
    """`R_k' (c_j - t_k) - z`, with random z, on the state of the whole drive."""
    pose, inverse = drive.poses[k], turn(drive.poses[k, 2]).T
    by_heading = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ inverse
    at = drive.map_size + CALIBRATION_SIZE + POSE * k
    columns, jacobian = [], []
    for j in drive.seen[k]:
        offset = drive.points[j] - pose[:2]
        block = np.column_stack([inverse, -inverse, by_heading @ offset])
        columns += [np.r_[2 * j, 2 * j + 1, at : at + POSE]] * 2
        jacobian += list(block / 0.1)
    return Rows(np.array(columns), np.array(jacobian), rng.normal(size=len(columns)))


def odometry_rows(drive: Drive, k: int, rng: np.random.Generator) -> Rows:
    """From pose k to the next, with the calibration."""
    residual, start, end = odometry_residuals(
        drive.poses[k : k + 1], drive.poses[k + 1 : k + 2], rng.normal(size=(1, 3))
    )
    at = drive.map_size + CALIBRATION_SIZE + POSE * k
    columns = np.r_[drive.map_size : drive.map_size + CALIBRATION_SIZE, at : at + 2 * POSE]
    jacobian = np.concatenate([rng.normal(size=(POSE, CALIBRATION_SIZE)), start[0], end[0]], axis=1)
    return Rows(np.tile(columns, (POSE, 1)), jacobian / 0.05, residual[0] / 0.05)


def first_prior(drive: Drive, rng: np.random.Generator) -> Prior:
    """On [calibration | first pose]."""
    point = np.concatenate([drive.calibration, drive.poses[0]]) + 0.01 * rng.normal(size=5)
    return Prior(np.diag(rng.uniform(1.0, 9.0, 5)), np.zeros(5), point)


def control_ids(left: int, right: int) -> tuple[IntArray, IntArray]:
    labels = np.repeat([0, 1], [left, right]).astype(np.intp)
    return labels, np.concatenate([np.arange(left), np.arange(right)]).astype(np.intp)


def leave_all(drive: Drive, rows: list[list[Rows]], first: Prior, interval: float, late: int) -> History:
    """The history after every pose but the last has left, oldest first; point 2 comes in at pose `late`."""
    history = History(first, interval)
    state = drive.state()
    for k, groups in enumerate(rows):
        if k == late:
            history.widen(4, state[4:6])
        known = np.delete(np.arange(drive.map_size + CALIBRATION_SIZE), [4, 5] if k < late else [])
        at = drive.map_size + CALIBRATION_SIZE + POSE * k
        stay = np.r_[known, at : at + 2 * POSE]
        hessian, descent = accumulate(groups, len(state))
        ids = control_ids(2 if k < late else 3, 3)
        history.leave(hessian[np.ix_(stay, stay)], descent[stay], state[stay], *ids)
    return history


@pytest.mark.parametrize("interval", [0.5, 2.5, 100.0])
@pytest.mark.parametrize("late", [0, 3, 4])
def test_the_history_is_the_dense_marginal_where_it_was_linearized(interval: float, late: int) -> None:
    """A keyframe at every pose, at some, and one; all points known from the start, and one only later."""
    rng = np.random.default_rng(7)
    drive = random_drive(rng, late)
    leaving = len(drive.poses) - 1
    rows = [[reading_rows(drive, k, rng), odometry_rows(drive, k, rng)] for k in range(leaving)]
    first = first_prior(drive, rng)
    low = drive.map_size + CALIBRATION_SIZE
    hessian, descent = accumulate([g for groups in rows for g in groups], len(drive.state()))
    own = slice(drive.map_size, low + POSE)
    hessian[own, own] += first.information
    descent[own] += first.descent_at(drive.state()[own])
    expected = schur_leave(hessian, descent, low, low + POSE * leaving)

    history = leave_all(drive, rows, first, interval, late)
    segments = history.all_segments(*control_ids(*drive.sizes))
    assert len(segments) == len(history.keyframes) == {0.5: 8, 2.5: 3, 100.0: 1}[interval]
    state = np.concatenate([drive.state()[:low], *history.keyframes, drive.poses[-1]])
    prior = relinearized_prior(history, segments, state, {0: 0, 1: 6}, drive.map_size)
    information, gradient = schur_leave(prior.information, prior.gradient, low, low + POSE * len(segments))
    scale = np.abs(expected[0]).max()
    np.testing.assert_allclose(information, expected[0], rtol=1e-9, atol=1e-9 * scale)
    np.testing.assert_allclose(gradient, expected[1], rtol=1e-9, atol=1e-9 * scale)
    np.testing.assert_array_equal(prior.point, state)


def test_a_history_without_a_pose_has_no_segment() -> None:
    history = History(Prior(np.eye(5), np.zeros(5), np.zeros(5)), 10.0)
    assert history.all_segments(*control_ids(1, 1)) == []
