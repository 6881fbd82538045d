"""A landmark graph over a whole log: every pose and every landmark at once, told which reading saw which."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.log import Log, Odometry

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LandmarkBatchSettings:
    """How the batch is solved; its noise is the log's own."""

    max_iterations: int = 100
    """Levenberg-Marquardt stops after so many."""

    relative_tolerance: float = 1e-8
    """or where |cost_before - cost_after| <= relative_tolerance * cost_before."""

    odometry_sigma_floor: float = 1e-6
    """Least standard deviation (m, rad) of the motion between two cycles: a noiseless log stays solvable."""

    first_pose_sigma: float = 1e-6
    """Standard deviation (m, rad) of the first pose, which is the map frame."""

    min_range: float = 1e-3
    """A reading nearer (m) than this has no bearing and is left out."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Every reading of a log that is of a landmark, flat."""

    cycle: Ints
    """(k,) index of the perception cycle."""

    landmark: Ints
    """(k,) index of the landmark, as associated."""

    points_vehicle: Array
    """(k, 2) m."""

    covariances: Array
    """(k, 2, 2) m^2, vehicle frame."""


@dataclass(frozen=True, eq=False)
class LandmarkSolution:
    """The optimum of a landmark batch."""

    trajectory_t: Array
    """(n,) s, one per perception cycle."""

    trajectory: Array
    """(n, 3) [x, y, theta], map frame, smoothed."""

    landmark_ids: Ints
    """(m,) what the associations call each landmark that was seen, ascending."""

    landmarks: Array
    """(m, 2) m, map frame."""

    covariance: Array | None
    """(2m, 2m) m^2, joint covariance of the landmarks, or None where it wasn't asked for."""

    error: float
    """Half the squared whitened residuals that are left."""

    iterations: int
    """Levenberg-Marquardt iterations taken."""


def solve_landmarks(
    log: Log,
    associations: Ints,
    *,
    with_covariance: bool = False,
    settings: LandmarkBatchSettings | None = None,
) -> LandmarkSolution:
    """argmin over poses and landmarks of the odometry's and all readings' squared Mahalanobis distances.

    associations: (R,) landmark of each detection row in file order, negative for none (left out). The first
    pose, at the first odometry stamp, is (0, 0, 0). Started at the integrated odometry and first sightings.
    """
    settings = settings or LandmarkBatchSettings()
    sightings = collect_sightings(log, associations, settings.min_range)
    stamps = np.array([cycle.t for cycle in log.cycles])
    motions, covariances = integrate_between(log.odometry, log.odometry_sigma, stamps)
    graph = _motion_graph(motions, covariances, settings)
    _add_sightings(graph, sightings)
    initial = _initial_values(motions, sightings)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, _parameters(settings))
    values = optimizer.optimize()
    ids = np.unique(sightings.landmark)
    poses = [values.atPose2(X(k + 1)) for k in range(len(stamps))]
    return LandmarkSolution(
        trajectory_t=stamps,
        trajectory=np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses]).reshape(-1, 3),
        landmark_ids=ids,
        landmarks=np.array([values.atPoint2(L(int(j))) for j in ids]).reshape(-1, 2),
        covariance=_joint_covariance(graph, values, ids) if with_covariance else None,
        error=float(optimizer.error()),
        iterations=int(optimizer.iterations()),
    )


def collect_sightings(log: Log, associations: Ints, min_range: float) -> Sightings:
    """The readings of `log` whose association (R,) isn't negative, at least `min_range` m away."""
    counts = [len(cycle.labels) for cycle in log.cycles]
    cycle = np.repeat(np.arange(len(counts)), counts)
    points = np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in log.cycles)])
    covariances = np.concatenate([np.zeros((0, 2, 2)), *(cycle.covariances for cycle in log.cycles)])
    kept = (np.asarray(associations) >= 0) & (np.linalg.norm(points, axis=1) >= min_range)
    return Sightings(cycle[kept], np.asarray(associations)[kept], points[kept], covariances[kept])


def integrate_between(odometry: Odometry, sigma: Array, stamps: Array) -> tuple[Array, Array]:
    """Motions (n, 3) and end-frame covariances (n, 3, 3) up to each of `stamps` (n,), from the one before it.

    The first is from the first odometry stamp.
    """
    starts = np.concatenate([odometry.t[:1], stamps[:-1]])
    steps = [
        integrate_twists(*held_twists(odometry, start, end), sigma)
        for start, end in zip(starts, stamps, strict=True)
    ]
    return (
        np.array([step.delta for step in steps]).reshape(-1, 3),
        np.array([step.covariance for step in steps]).reshape(-1, 3, 3),
    )


def held_twists(odometry: Odometry, start: float, end: float) -> tuple[Array, Array]:
    """(k,) s and (k, 3): how long each twist is held between `start` and `end`, and the twist.

    Each is held until the next row's time, the last for good; before the first row nothing moves.
    """
    held = odometry.between(start, end)
    return np.diff(np.append(held.t, end)), held.twist


def _motion_graph(
    motions: Array, covariances: Array, settings: LandmarkBatchSettings
) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(3, settings.first_pose_sigma)
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), fixed))
    floored = covariances + settings.odometry_sigma_floor**2 * np.eye(3)
    for k, (motion, covariance) in enumerate(zip(motions, floored, strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.BetweenFactorPose2(X(k), X(k + 1), gtsam.Pose2(*motion), noise))
    return graph


def _add_sightings(graph: gtsam.NonlinearFactorGraph, sightings: Sightings) -> None:
    """A native bearing-range factor for each reading: C_polar = J K J^T of its full covariance K."""
    x, y = sightings.points_vehicle.T
    distances = np.hypot(x, y)
    jacobians = np.stack(
        [np.stack([-y, x], axis=1) / distances[:, None] ** 2, np.stack([x, y], axis=1) / distances[:, None]],
        axis=1,
    )
    polar = jacobians @ sightings.covariances @ np.swapaxes(jacobians, 1, 2)
    bearings = np.arctan2(y, x)
    for cycle, landmark, bearing, distance, covariance in zip(
        sightings.cycle.tolist(),
        sightings.landmark.tolist(),
        bearings.tolist(),
        distances.tolist(),
        polar,
        strict=True,
    ):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.BearingRangeFactor2D(X(cycle + 1), L(landmark), gtsam.Rot2(bearing), distance, noise))


def _initial_values(motions: Array, sightings: Sightings) -> gtsam.Values:
    values = gtsam.Values()
    poses = [gtsam.Pose2()]
    for motion in motions:
        poses.append(poses[-1].compose(gtsam.Pose2(*motion)))
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    landmarks, first = np.unique(sightings.landmark, return_index=True)
    for landmark, row in zip(landmarks.tolist(), first.tolist(), strict=True):
        pose = poses[int(sightings.cycle[row]) + 1]
        values.insert(L(landmark), pose.transformFrom(sightings.points_vehicle[row]))
    return values


def _parameters(settings: LandmarkBatchSettings) -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(settings.max_iterations)
    parameters.setRelativeErrorTol(settings.relative_tolerance)
    return parameters


def _joint_covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ids: Ints) -> Array:
    """(2m, 2m): the inverse of the information that the poses leave on the landmarks (Schur complement)."""
    keys = [L(int(j)) for j in ids]
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    information, _ = graph.linearize(values).marginal(keys).hessian(ordering)
    covariance = np.linalg.inv(information)
    return 0.5 * (covariance + covariance.T)
