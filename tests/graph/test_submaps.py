"""Submaps: relative, so that a rigid motion changes nothing, and where they were linearized exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pathspace_graph.factors._kernels import odometry_residuals
from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.graph.gaussian import graph_of, jacobian_factor, keys_of, normal_equations
from pathspace_graph.graph.relative import RelativeFactor, Submaps
from pathspace_graph.graph.rows import Rows, at_reference, jacobian_factors
from pathspace_graph.graph.variables import (
    CALIBRATION_KEY,
    POSE,
    Layout,
    Variables,
    control_keys,
    pose_key,
    pose_keys,
)

from ..scenes.graph import columns_of, dense_rows, schur

NOTHING = np.zeros(0, np.intp)
KEYFRAME, END = pose_key(2), pose_key(6)
POINTS = np.append(control_keys(0, np.array([4, 5])), control_keys(1, np.array([2])))
KEYS = np.concatenate([[CALIBRATION_KEY], POINTS, [END]])
"""Of the random submap: calibration, three control points, and the end pose."""
SIZE = 2 + 2 * len(POINTS) + POSE
WHOLE = np.concatenate([[CALIBRATION_KEY], POINTS, [KEYFRAME, END]])
"""The same with the keyframe, ascending."""


def random_submap(rng: np.random.Generator) -> RelativeFactor:
    root, right = rng.normal(size=(SIZE + 2, SIZE)), rng.normal(size=SIZE + 2)
    return RelativeFactor(KEYFRAME, Layout(KEYS), root, right, rng.normal(size=SIZE))


def variables_at(x: Array, keys: IntArray, rng: np.random.Generator) -> Variables:
    """Values x away from their references."""
    variables = Variables()
    variables.insert(keys, x, x + rng.normal(size=len(x)))
    return variables


def seen_from(x: Array, keyframe: Array) -> Array:
    """Calibration, points and end pose as a keyframe sees them, written once more."""
    inverse = rotation(keyframe[2]).T
    points = x[2:-POSE].reshape(-1, 2)
    return np.concatenate(
        [
            x[:2],
            *(inverse @ (p - keyframe[:2]) for p in points),
            inverse @ (x[-POSE:-1] - keyframe[:2]),
            [x[-1] - keyframe[2]],
        ]
    )


def parts(x: Array) -> tuple[Array, Array]:
    """The submap's values, and the keyframe, of all values in the order of their keys."""
    return np.delete(x, np.arange(SIZE - POSE, SIZE)), x[SIZE - POSE : SIZE]


def energy(submap: RelativeFactor, x: Array) -> float:
    """`1/2 |A e - b|^2`."""
    left = submap.root @ (seen_from(*parts(x)) - submap.local) - submap.right
    return float(0.5 * left @ left)


def linearized(submap: RelativeFactor, x: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Hessian and negative gradient of the factor by all values, in the order of their keys."""
    variables = variables_at(x, WHOLE, rng)
    hessian, vector = normal_equations(graph_of(submap.factor(variables)), variables.layout)
    return hessian, vector - hessian @ (variables.values - variables.reference)


def moved(x: Array, theta: float, shift: Array) -> Array:
    """All values after a rigid motion of the map frame."""
    x = x.copy()
    for at in (*range(2, SIZE - POSE, 2), SIZE - POSE, SIZE):
        x[at : at + 2] = rotation(theta) @ x[at : at + 2] + shift
    x[[SIZE - 1, SIZE + 2]] += theta
    return x


@pytest.mark.parametrize("seed", range(5))
def test_a_factor_is_the_derivative_of_the_energy(seed: int) -> None:
    """Far from the submap's own point, at any heading, and whatever the references."""
    rng = np.random.default_rng(seed)
    submap, x = random_submap(rng), rng.normal(size=SIZE + POSE) * 3.0
    hessian, negative_gradient = linearized(submap, x, rng)
    steps = 1e-6 * np.eye(len(x))
    numeric = np.array([(energy(submap, x + h) - energy(submap, x - h)) / 2e-6 for h in steps])
    np.testing.assert_allclose(negative_gradient, -numeric, rtol=1e-6, atol=1e-5)
    differences = [seen_from(*parts(x + h)) - seen_from(*parts(x - h)) for h in steps]
    jacobian = submap.root @ np.array(differences).T / 2e-6
    np.testing.assert_allclose(hessian, jacobian.T @ jacobian, rtol=1e-6, atol=1e-5)


@given(st.integers(0, 1000), st.floats(-4.0, 4.0), st.floats(-100.0, 100.0), st.floats(-100.0, 100.0))
def test_a_rigid_motion_turns_the_gradient_and_keeps_the_energy(
    seed: int, theta: float, dx: float, dy: float
) -> None:
    rng = np.random.default_rng(seed)
    submap, x = random_submap(rng), rng.normal(size=SIZE + POSE)
    y = moved(x, theta, np.array([dx, dy]))
    assert energy(submap, y) == pytest.approx(energy(submap, x), rel=1e-8, abs=1e-8)
    before, after = linearized(submap, x, rng), linearized(submap, y, rng)
    rotations = np.eye(SIZE + POSE)
    for at in (*range(2, SIZE - POSE, 2), SIZE - POSE, SIZE):
        rotations[at : at + 2, at : at + 2] = rotation(theta)
    np.testing.assert_allclose(after[1], rotations @ before[1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(after[0], rotations @ before[0] @ rotations.T, rtol=1e-8, atol=1e-8)


def test_a_submap_leaves_a_rigid_motion_free() -> None:
    """Three directions without information: both shifts and the turn."""
    rng = np.random.default_rng(0)
    hessian, _ = linearized(random_submap(rng), rng.normal(size=SIZE + POSE), rng)
    values = np.linalg.eigvalsh(hessian)
    assert values[2] < 1e-10 * values[-1] < values[3]


def test_a_submap_loses_information_on_removed_points_only() -> None:
    """The other variables keep covariance and mean."""
    rng = np.random.default_rng(3)
    submap = random_submap(rng)
    less = submap.without(np.array([POINTS[1], POINTS[1] + 1]))
    assert less.keys.keys.tolist() == np.delete(KEYS, 2).tolist()
    rest = np.delete(np.arange(SIZE), [4, 5])
    covariance = np.linalg.inv(submap.root.T @ submap.root)
    np.testing.assert_allclose(
        np.linalg.inv(less.root.T @ less.root), covariance[np.ix_(rest, rest)], rtol=1e-3, atol=1e-3
    )
    mean, found = covariance @ submap.root.T @ submap.right, np.linalg.solve(less.root, less.right)
    np.testing.assert_allclose(found, mean[rest], atol=1e-3)
    np.testing.assert_array_equal(less.local, submap.local[rest])
    assert submap.without(control_keys(1, np.array([3]))) is submap


# --- a small drive ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drive:
    """Holds poses and control points of two boundaries with measurements that are linearized once."""

    variables: Variables
    """Calibration, six control points, nine poses a metre apart; away from their references."""
    seen: tuple[IntArray, ...]
    """Keys of the control points that each pose measured."""

    @property
    def poses(self) -> IntArray:
        return pose_keys(np.arange(9))


def random_drive(rng: np.random.Generator, late: int) -> Drive:
    """The last point of the left boundary is seen only from pose `late` on."""
    keys = np.concatenate([[CALIBRATION_KEY], *(control_keys(b, np.arange(3)) for b in (0, 1))])
    poses = np.column_stack([np.arange(9.0), rng.normal(size=9) * 0.2, rng.normal(size=9)])
    values = np.concatenate([rng.normal(size=2), rng.normal(size=12) * 5.0, poses.ravel()])
    variables = variables_at(values, np.append(keys, pose_keys(np.arange(9))), rng)
    points, hidden = keys[1:], keys[3]
    seen = [rng.choice(points, 4, replace=False) for _ in poses]
    return Drive(variables, tuple(own if k >= late else own[own != hidden] for k, own in enumerate(seen)))


def detection_rows(drive: Drive, k: int, rng: np.random.Generator) -> Rows:
    """`R_k' (c_j - t_k) - z`, with random z."""
    pose = drive.variables.of(drive.poses[k : k + 1])
    inverse, keys, jacobian = rotation(pose[2]).T, [], []
    by_heading = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ inverse
    for key in drive.seen[k]:
        offset = drive.variables.of(np.array([key])) - pose[:2]
        keys += [[drive.poses[k], key]] * 2
        jacobian += list(np.column_stack([-inverse, by_heading @ offset, inverse]) / 0.1)
    owner = np.full(len(keys), k)
    return Rows(np.array(keys), np.array(jacobian), rng.normal(size=len(keys)), owner)


def odometry_rows(drive: Drive, k: int, rng: np.random.Generator) -> Rows:
    """From pose k to the next, with the calibration."""
    first, second = drive.variables.of(drive.poses[k : k + 2]).reshape(2, 1, POSE)
    residual, start, end = odometry_residuals(first, second, rng.normal(size=(1, 3)))
    keys = np.tile([CALIBRATION_KEY, drive.poses[k], drive.poses[k + 1]], (POSE, 1))
    jacobian = np.concatenate([rng.normal(size=(POSE, 2)), start[0], end[0]], axis=1)
    return Rows(keys, jacobian / 0.05, residual[0] / 0.05, np.full(POSE, k))


def drive_on(
    drive: Drive, groups: list[list[Rows]], interval: float, cut: int = -1, gone: IntArray = NOTHING
) -> tuple[Submaps, Array, Array]:
    """Returns submaps of all poses but the last, added oldest first, and the dense A and b.

    Before the pose `cut`, the information about the points `gone` is removed.
    """
    variables = drive.variables
    known = np.array([CALIBRATION_KEY, drive.poses[0]])
    A, b = np.diag(np.arange(1.0, 6.0)), np.linspace(-1.0, 1.0, 5)
    submaps = Submaps(graph_of(jacobian_factor(known, A, b)), interval)
    for k, own in enumerate(groups):
        if k == cut:
            submaps.remove_information(gone, variables)
        graph = graph_of(jacobian_factors(at_reference(own, variables), variables.layout)[k])
        submaps.add_pose(int(drive.poses[k]), graph, variables)
        variables.remove(drive.poses[k : k + 1])
        variables.first_cycle = k + 1
    submaps.finish(variables)
    return submaps, A, b


@pytest.mark.parametrize("interval", [0.5, 2.5, 100.0])
@pytest.mark.parametrize("late", [0, 3, 4])
def test_the_submaps_are_the_dense_marginal_where_they_were_linearized(interval: float, late: int) -> None:
    """A keyframe at every pose, at some, and one; all points known from the start, and one only later."""
    rng = np.random.default_rng(7)
    drive = random_drive(rng, late)
    variables, keys = drive.variables, drive.variables.keys
    moved = variables.values - variables.reference
    groups = [[detection_rows(drive, k, rng), odometry_rows(drive, k, rng)] for k in range(8)]
    J, r, _ = dense_rows([rows for own in groups for rows in own], keys)
    hessian, vector = J.T @ J, J.T @ (J @ moved - r)

    submaps, A, b = drive_on(drive, groups, interval)
    own = columns_of(np.array([CALIBRATION_KEY, drive.poses[0]]), keys)
    hessian[np.ix_(own, own)] += A.T @ A
    vector[own] += A.T @ b
    information, negative_gradient = schur(hessian, vector, columns_of(drive.poses[:-1], keys))

    assert len(submaps.finished) == len(submaps.keyframes) == {0.5: 8, 2.5: 3, 100.0: 1}[interval]
    submaps.insert_keyframes(variables)
    assert variables.keyframes.tolist() == sorted(submaps.keyframes)
    graph = submaps.graph(variables)
    whole = Layout(keys_of(graph))
    gone = whole.entries(np.array(sorted(submaps.keyframes)))
    found, found_descent = schur(*normal_equations(graph, whole), gone)
    scale = np.abs(information).max()
    np.testing.assert_allclose(found, information, rtol=1e-8, atol=1e-9 * scale)
    np.testing.assert_allclose(found_descent, negative_gradient, rtol=1e-8, atol=1e-9 * scale)


@pytest.mark.parametrize("interval", [0.5, 2.5])
def test_a_whole_drive_turned_with_its_start_is_known_as_well_as_before(interval: float) -> None:
    """Submaps that are linearized after a rigid motion of everything have the same information, turned."""
    rng = np.random.default_rng(8)
    drive = random_drive(rng, 0)
    variables = drive.variables
    groups = [[detection_rows(drive, k, rng), odometry_rows(drive, k, rng)] for k in range(8)]
    submaps, *_ = drive_on(drive, groups, interval)
    submaps.first = graph_of()
    submaps.insert_keyframes(variables)
    before = normal_equations(submaps.graph(variables), variables.layout)
    negative_gradient = before[1] - before[0] @ (variables.values - variables.reference)
    theta, shift = 2.3, np.array([40.0, -7.0])
    rotations = np.eye(variables.layout.size)
    for key in variables.keys[1:].tolist():
        x = slice((at := int(columns_of(np.array([key]), variables.keys)[0])), at + 2)
        rotations[x, x] = rotation(theta)
        variables.values[x] = rotation(theta) @ variables.values[x] + shift
        if chr(key >> 56) == "x":
            variables.values[at + 2] += theta
    after = normal_equations(submaps.graph(variables), variables.layout)
    scale = np.abs(before[0]).max()
    np.testing.assert_allclose(after[0], rotations @ before[0] @ rotations.T, atol=1e-9 * scale)
    turned = after[1] - after[0] @ (variables.values - variables.reference)
    np.testing.assert_allclose(turned, rotations @ negative_gradient, atol=1e-9 * scale)


@pytest.mark.parametrize("interval", [2.5, 100.0])
def test_submaps_go_on_after_information_is_removed_in_the_middle_of_one(interval: float) -> None:
    """What was known of a point is gone, what is measured later counts, and all else is the dense marginal.

    The point was seen in the unfinished submap alone.
    """
    rng, cut = np.random.default_rng(9), 5
    drive = random_drive(rng, 3)
    variables, keys = drive.variables, drive.variables.keys
    gone, moved = keys[3:4], variables.values - variables.reference
    assert gone in np.concatenate(drive.seen[3:cut]) and gone in np.concatenate(drive.seen[cut:8])
    groups = [[detection_rows(drive, k, rng), odometry_rows(drive, k, rng)] for k in range(8)]
    submaps, A, b = drive_on(drive, groups, interval, cut, gone)

    hessian, vector = np.zeros((len(moved), len(moved))), np.zeros(len(moved))
    first = columns_of(np.array([CALIBRATION_KEY, drive.poses[0]]), keys)
    hessian[np.ix_(first, first)], vector[first] = A.T @ A, A.T @ b
    for k, own in enumerate(groups):
        if k == cut:
            known, at = np.flatnonzero(np.diagonal(hessian)), columns_of(gone, keys)
            less = schur(hessian[np.ix_(known, known)], vector[known], np.searchsorted(known, at))
            hessian[:], vector[:], rest = 0.0, 0.0, np.setdiff1d(known, at)
            hessian[np.ix_(rest, rest)], vector[rest] = less
        J, r, _ = dense_rows(own, keys)
        hessian, vector = hessian + J.T @ J, vector + J.T @ (J @ moved - r)
    information, negative_gradient = schur(hessian, vector, columns_of(drive.poses[:-1], keys))

    submaps.insert_keyframes(variables)
    graph = submaps.graph(variables)
    whole = Layout(keys_of(graph))
    keyframes = whole.entries(np.array(sorted(submaps.keyframes)))
    found, found_descent = schur(*normal_equations(graph, whole), keyframes)
    np.testing.assert_allclose(found, information, atol=1e-6 * np.abs(information).max())
    np.testing.assert_allclose(found_descent, negative_gradient, atol=1e-6 * np.abs(negative_gradient).max())


def test_a_drive_without_a_pose_has_no_submap() -> None:
    first = graph_of(jacobian_factor(np.array([CALIBRATION_KEY]), np.eye(2), np.zeros(2)))
    submaps, variables = Submaps(first, 10.0), Variables()
    submaps.finish(variables)
    assert submaps.finished == [] and submaps.keyframes == {}
    assert keys_of(submaps.graph(variables)).tolist() == [CALIBRATION_KEY]


def test_a_drive_without_keyframes_has_none_to_insert_or_to_place() -> None:
    submaps, variables = Submaps(graph_of(), 10.0), Variables()
    submaps.insert_keyframes(variables)
    assert len(variables.keys) == 0
    assert submaps.place(variables) == {}


def test_keyframes_come_back_where_they_were_placed() -> None:
    submaps, variables = Submaps(graph_of(), 10.0), Variables()
    for key, at in ((KEYFRAME, 1.0), (END, 2.0)):
        submaps.keyframes[key] = np.full(POSE, at), np.full(POSE, 0.1 * at)
    submaps.insert_keyframes(variables)
    np.testing.assert_array_equal(variables.of(np.array([END])), np.full(POSE, 2.0))
    np.testing.assert_allclose(variables.reference, np.repeat([0.1, 0.2], POSE))
    variables.values[:POSE] = 7.0
    placed = submaps.place(variables)
    np.testing.assert_array_equal(placed[KEYFRAME - pose_key(0)], np.full(POSE, 7.0))
    np.testing.assert_array_equal(submaps.keyframes[KEYFRAME][0], np.full(POSE, 7.0))
    np.testing.assert_allclose(submaps.keyframes[KEYFRAME][1], np.full(POSE, 0.1))
