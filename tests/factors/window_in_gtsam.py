"""A drive around a bend between two boundaries: the same window as whitened rows and as GTSAM factors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors._kernels import odometry_residuals
from pathspace_graph.factors.bspline import SpanPolynomials, uniform_knots
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.gtsam_factors import (
    calibrated_odometry_factor,
    pose_array,
    smoothness_factors,
    spacing_factors,
    spline_projection_factors,
)
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.odometry import IntegratedOdometry, integrate_twists
from pathspace_graph.factors.residuals import greville, pair_residuals, project, smoothness_matrix
from pathspace_graph.factors.se2 import compose, rotation, to_map
from pathspace_graph.graph.variables import CALIBRATION_KEY, POSE

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
Rows = tuple[IntArray, Array, Array]
"""Columns (m, k) of each whitened row, its derivatives (m, k) there, and the residuals (m,)."""

SPACING, DEGREE, SIZE = 3.5, 3, 11
"""Knot interval (m), degree and control points of each boundary."""
POSES = 10
ROOM = 2.5
SIGMA_MODEL, HUBER = 0.08, 1.5
SIGMA_SPACING, SIGMA_SMOOTHNESS = 0.3 * SPACING, SPACING
SIGMA_CALIBRATION = np.array([0.005, 0.002])
SIGMA_START = 1e-2
SIGMA_ANCHOR = 0.5
"""Hold of each control point where it starts (m): an optimum to 1e-6 needs one that the slide can't blur."""
MAP = 4 * SIZE
"""State entries that are control points."""
TABLES = SpanPolynomials(uniform_knots(SIZE, DEGREE, SPACING), DEGREE)
CONTROL_KEYS = [[gtsam.symbol(letter, j) for j in range(SIZE)] for letter in "lr"]


@dataclass(frozen=True)
class Scene:
    """A drive around a bend between two boundaries, as measured, and an estimate to start from."""

    state: Array
    """[left | right control points, calibration, poses]: the initial estimate."""
    start: Array
    """This is the first pose, which has a prior."""
    odometry: list[IntegratedOdometry]
    """Between the poses."""
    slots: tuple[Array, Array]
    """Each detection was made from this pose, by boundary."""
    points: tuple[Array, Array]
    """Readings (m, 2) in the vehicle frame."""
    covariances: tuple[Array, Array]
    """Their covariances (m, 2, 2)."""
    u: tuple[Array, Array] = field(default=(np.zeros(0), np.zeros(0)))
    """Parameters where their foot points are expected."""

    def control(self, label: int, state: Array) -> Array:
        return state[2 * SIZE * label : 2 * SIZE * (label + 1)].reshape(-1, 2)

    def poses(self, state: Array) -> Array:
        return state[MAP + 2 :].reshape(-1, POSE)


def on_bend(s: Array, radius: float) -> Array:
    """Returns points along a left bend of the middle line with radius 25 m, at another radius."""
    return np.column_stack([radius * np.sin(s / 25.0), 25.0 - radius * np.cos(s / 25.0)])


def make_scene(seed: int, isotropic: bool = True, outliers: int = 4) -> Scene:
    """Returns noisy odometry and detections of cones beside the path, and an estimate by dead reckoning."""
    rng = np.random.default_rng(seed)
    true = np.column_stack([on_bend(1.8 * np.arange(POSES), 25.0), 1.8 * np.arange(POSES) / 25.0])
    odometry = [integrate_noisy(rng) for _ in range(POSES - 1)]
    poses = [true[0]]
    for step in odometry:
        poses.append(compose(poses[-1], step.delta))
    read = [make_readings(rng, true, label, isotropic, outliers) for label in (0, 1)]
    slots, points, covariances = zip(*read, strict=True)
    control = [on_bend(SPACING * np.arange(-1, SIZE - 1), radius) for radius in (23.0, 27.0)]
    noisy = np.concatenate([(c + rng.normal(0.0, 0.1, c.shape)).ravel() for c in control])
    state = np.concatenate([noisy, np.zeros(2), np.ravel(poses)])
    scene = Scene(state, true[0], odometry, slots, points, covariances)
    return replace(scene, u=tuple(search(scene, label) for label in (0, 1)))


def integrate_noisy(rng: np.random.Generator) -> IntegratedOdometry:
    """Returns nine samples of 0.02 s at 10 m/s in the bend."""
    sigma = np.array([0.25, 0.12, 0.035])
    return integrate_twists(np.full(9, 0.02), [10.0, 0.0, 0.4] + rng.normal(size=(9, 3)) * sigma, sigma)


def make_readings(
    rng: np.random.Generator, true: Array, label: int, isotropic: bool, outliers: int
) -> tuple[Array, Array, Array]:
    """Cones ahead of each pose, read with noise; a few are half a metre to a metre off."""
    cones = on_bend(np.arange(1.0, 28.0, 2.5), 23.0 if label == 0 else 27.0)
    slots, points = [], []
    for k, pose in enumerate(true):
        local = (cones - pose[:2]) @ rotation(pose[2])
        seen = local[np.hypot(*local.T) < 12.0]
        slots += [k] * len(seen)
        points += list(seen)
    read = np.array(points) + rng.normal(0.0, 0.1, (len(points), 2))
    read[rng.choice(len(read), outliers, replace=False), 1] += rng.uniform(0.5, 1.0, outliers)
    covariance = np.diag([0.01, 0.01] if isotropic else [0.02, 0.005])
    return np.array(slots), read, np.tile(covariance, (len(read), 1, 1))


def search(scene: Scene, label: int) -> Array:
    """Parameters of the foot points at the initial estimate."""
    points = to_map(scene.points[label], scene.poses(scene.state)[scene.slots[label]])
    whole = np.full(len(points), TABLES.low), np.full(len(points), TABLES.high)
    return foot_points(TABLES, scene.control(label, scene.state), points, *whole, 0.5).u


def detection_rows(scene: Scene, label: int, state: Array) -> Rows:
    """Returns the whitened rows of all detections of a boundary."""
    slots, u = scene.slots[label], scene.u[label]
    poses = scene.poses(state)[slots]
    points = to_map(scene.points[label], poses)
    foot = foot_points(TABLES, scene.control(label, state), points, u - ROOM, u + ROOM, 1.0)
    lin = project(points, scene.covariances[label], poses, foot, SIGMA_MODEL)
    weight = np.sqrt(huber_weights(lin.residual / lin.sigma, HUBER)) * foot.interior / lin.sigma
    base = 2 * SIZE * label + 2 * (foot.span[:, None] + np.arange(-DEGREE, 1))
    by_control = lin.by_control.reshape(len(u), -1)
    columns = [
        MAP + 2 + POSE * slots[:, None] + np.arange(POSE),
        np.stack([base, base + 1], 2).reshape(len(u), -1),
    ]
    jacobian = np.concatenate([lin.by_pose, by_control], axis=1) * weight[:, None]
    return np.concatenate(columns, axis=1), jacobian, lin.residual * weight


def gauge_rows(scene: Scene, label: int, state: Array) -> list[Rows]:
    """Spacing, smoothness and anchors of a boundary."""
    control, base = scene.control(label, state), 2 * SIZE * label
    residual, direction = pair_residuals(control[:-1], control[1:], np.full(SIZE - 1, SPACING))
    first = base + 2 * np.arange(SIZE - 1)[:, None] + np.arange(4)
    spacing = first, np.concatenate([-direction, direction], 1) / SIGMA_SPACING, residual / SIGMA_SPACING
    D = np.kron(smooth(), np.eye(2)) / SIGMA_SMOOTHNESS
    columns = np.tile(base + np.arange(2 * SIZE), (len(D), 1))
    offset = (control - scene.control(label, scene.state)).ravel() / SIGMA_ANCHOR
    anchors = base + np.arange(2 * SIZE)[:, None], np.full((2 * SIZE, 1), 1.0 / SIGMA_ANCHOR), offset
    return [spacing, (columns, D, D @ control.ravel()), anchors]


def smooth() -> Array:
    return smoothness_matrix(greville(TABLES.knots, DEGREE), None)


def odometry_rows(scene: Scene, state: Array) -> Rows:
    """Odometry with its calibration."""
    poses, m = scene.poses(state), POSES - 1
    residual, by_start, by_end = odometry_residuals(
        poses[:-1], poses[1:], np.array([o.delta for o in scene.odometry])
    )
    by_calibration = np.array([o.calibration_jacobian for o in scene.odometry])
    whiteners = np.array([o.whitener for o in scene.odometry])
    residual = residual + by_calibration @ state[MAP : MAP + 2]
    jacobian = whiteners @ np.concatenate([by_calibration, by_start, by_end], axis=2)
    poses_columns = MAP + 2 + POSE * np.arange(m)[:, None] + np.arange(2 * POSE)
    columns = np.concatenate([np.tile([MAP, MAP + 1], (m, 1)), poses_columns], axis=1)
    whitened = np.einsum("mij,mj->mi", whiteners, residual)
    return np.repeat(columns, POSE, axis=0), jacobian.reshape(m * POSE, -1), whitened.ravel()


def prior_rows_of(scene: Scene, state: Array) -> list[Rows]:
    """Returns the rows of the priors on the first pose and the calibration."""
    calibration = MAP + np.arange(2)[:, None]
    start = MAP + 2 + np.arange(POSE)[:, None]
    return [
        (calibration, 1.0 / SIGMA_CALIBRATION[:, None], state[MAP : MAP + 2] / SIGMA_CALIBRATION),
        (start, np.full((POSE, 1), 1.0 / SIGMA_START), (scene.poses(state)[0] - scene.start) / SIGMA_START),
    ]


def all_rows(scene: Scene, state: Array) -> list[Rows]:
    groups = [*prior_rows_of(scene, state), odometry_rows(scene, state)]
    for label in (0, 1):
        groups += [detection_rows(scene, label, state), *gauge_rows(scene, label, state)]
    return groups


def nonlinear_graph(scene: Scene) -> gtsam.NonlinearFactorGraph:
    """The same problem as GTSAM factors."""
    graph = gtsam.NonlinearFactorGraph()
    calibration_noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMA_CALIBRATION)
    start_noise = gtsam.noiseModel.Isotropic.Sigma(POSE, SIGMA_START)
    graph.add(gtsam.PriorFactorPoint2(CALIBRATION_KEY, np.zeros(2), calibration_noise))
    graph.add(gtsam.PriorFactorPose2(gtsam.symbol("x", 0), gtsam.Pose2(*scene.start), start_noise))
    for k, odometry in enumerate(scene.odometry):
        ends = gtsam.symbol("x", k), gtsam.symbol("x", k + 1)
        graph.add(calibrated_odometry_factor(*ends, CALIBRATION_KEY, odometry))
    nominal, sigma = np.full(SIZE - 1, SPACING), np.full(SIZE - 1, SIGMA_SPACING)
    for label, keys in enumerate(CONTROL_KEYS):
        for factor in spacing_factors(keys, nominal, sigma, False):
            graph.add(factor)
        for factor in smoothness_factors(keys, smooth(), SIGMA_SMOOTHNESS):
            graph.add(factor)
        for key, point in zip(keys, scene.control(label, scene.state), strict=True):
            graph.add(gtsam.PriorFactorPoint2(key, point, gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_ANCHOR)))
        for slot in np.unique(scene.slots[label]):
            graph.add(projection_factor(scene, label, slot))
    return graph


def projection_factor(scene: Scene, label: int, slot: int) -> gtsam.CustomFactor:
    rows = np.flatnonzero(scene.slots[label] == slot)
    (factor,) = spline_projection_factors(
        np.full(len(rows), gtsam.symbol("x", int(slot))),
        CONTROL_KEYS[label],
        TABLES,
        points_vehicle=scene.points[label][rows],
        covariances=scene.covariances[label][rows],
        low=scene.u[label][rows] - ROOM,
        high=scene.u[label][rows] + ROOM,
        sigma_model=SIGMA_MODEL,
        huber=HUBER,
    )
    return factor


def to_values(scene: Scene, state: Array) -> gtsam.Values:
    values = gtsam.Values()
    for label, keys in enumerate(CONTROL_KEYS):
        for key, point in zip(keys, scene.control(label, state), strict=True):
            values.insert(key, point)
    values.insert(CALIBRATION_KEY, state[MAP : MAP + 2])
    for k, pose in enumerate(scene.poses(state)):
        values.insert(gtsam.symbol("x", k), gtsam.Pose2(*pose))
    return values


def to_state(values: gtsam.Values) -> Array:
    control = [values.atPoint2(key) for keys in CONTROL_KEYS for key in keys]
    poses = [pose_array(values.atPose2(gtsam.symbol("x", k))) for k in range(POSES)]
    return np.concatenate([np.ravel(control), values.atPoint2(CALIBRATION_KEY), np.ravel(poses)])


def solve_window(scene: Scene, iterations: int = 25) -> Array:
    """Gauss-Newton on the kernels' rows, relinearized at every step."""
    state = scene.state
    for _ in range(iterations):
        state = state + np.linalg.solve(*system(scene, state))
    return state


def system(scene: Scene, state: Array) -> tuple[Array, Array]:
    """`J' J` and `-J' r` of all rows."""
    J, r = dense(all_rows(scene, state), len(state))
    return J.T @ J, -J.T @ r


def dense(groups: list[Rows], size: int) -> tuple[Array, Array]:
    """J (m, size) and r (m,) of all rows."""
    matrices = []
    for columns, jacobian, _ in groups:
        J = np.zeros((len(columns), size))
        np.put_along_axis(J, columns, jacobian, axis=1)
        matrices.append(J)
    return np.concatenate(matrices), np.concatenate([residual for *_, residual in groups])


def in_tangents(scene: Scene, state: Array, J: Array) -> Array:
    """The same with each pose's columns by its own axes, as the tangent of `gtsam.Pose2` has them."""
    turned = J.copy()
    for k, pose in enumerate(scene.poses(state)):
        x = MAP + 2 + POSE * k
        turned[:, x : x + 2] = J[:, x : x + 2] @ rotation(pose[2])
    return turned


def curves(scene: Scene, state: Array) -> Array:
    """Returns samples of both curves where there are detections."""
    samples = []
    for label in (0, 1):
        u = np.linspace(scene.u[label].min(), scene.u[label].max(), 100)
        values, span = TABLES.evaluate(u)
        columns = span[:, None] + np.arange(-DEGREE, 1)
        samples.append(np.einsum("mj,mjd->md", values[0], scene.control(label, state)[columns]))
    return np.concatenate(samples)
