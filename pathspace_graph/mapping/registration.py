"""The registration of the newest detections with the beginning of the curves, where the loop may close."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.se2 import to_map, wrap_angle
from pathspace_graph.settings.mapper import ClosingSettings

from .curve_map import CurveMap
from .path import DrivenPath

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of the newest poses and their readings."""

    centre: Array
    """(2,) what it turns about: the newest position, m, map frame."""
    vector: Array
    """(3,) translation (m, m) after the rotation (rad)."""

    def apply(self, points: Array) -> Array:
        """Moved points (m, 2)."""
        c, s = np.cos(self.vector[2]), np.sin(self.vector[2])
        turned = (points - self.centre) @ np.array([[c, s], [-s, c]])
        return np.asarray(turned + self.centre + self.vector[:2])


@dataclass(frozen=True, eq=False)
class Matches:
    """Readings whose foot point is inside the beginning of their boundary, at one motion."""

    rows: IntArray
    """(m,) readings."""
    labels: IntArray
    """(m,) their boundaries."""
    u: Array
    """(m,) their parameters on it."""
    near: NDArray[np.bool_]
    """(m,) whether they lie on it."""
    hessian: Array
    """(3, 3) of the motion, from the readings within reach."""
    negative_gradient: Array
    """(3,) negative gradient."""

    def agreeing(self, label: int) -> tuple[IntArray, Array]:
        """Readings that lie on the beginning of one boundary, and their parameters."""
        chosen = self.near & (self.labels == label)
        return self.rows[chosen], self.u[chosen]


@dataclass(frozen=True, eq=False)
class Registration:
    """Where the newest readings lie on the beginning of the curves."""

    motion: Motion
    """Takes the window there."""
    matches: dict[int, tuple[IntArray, Array]]
    """Per boundary: rows of the readings that agree, and their parameters on the beginning."""


def near_start(path: DrivenPath, pose: Array, settings: ClosingSettings) -> bool:
    """Whether a pose (3,) may be on the beginning again: driven far enough, near it, and along it."""
    if path.length < settings.min_path:
        return False
    drift = settings.radius + settings.drift * path.length
    away = np.hypot(*(path.beginning[:, :2] - pose[:2]).T)
    same_direction = np.cos(path.beginning[:, 2] - pose[2]) > np.cos(settings.heading)
    return bool((same_direction & (away < drift)).any())


def register(
    track: CurveMap, times: Sequence[float], covariance: Array, beginning: Array, settings: ClosingSettings
) -> Registration | None:
    """The motion that lays the newest readings on the beginning; None where they don't agree with it.

    Iterated closest points on the curves, `min sum (n . (M p - S(u)))^2 / sigma^2 + m' P^-1 m`. The vehicle's
    own uncertainty P, the `covariance` (3, 3) of its newest pose, is the prior: along a straight or an arc
    the readings leave the motion free. Where it is larger than what the iteration can bridge, it starts from
    the best of the `beginning`, poses (k, 3) of the drive's first stretch. `times`: stamps (s) of the poses.
    """
    recent, points = _recent(track, times, settings.window)
    prior = np.linalg.inv(covariance * settings.prior_scale**2)
    centre = track.state.poses[-1, :2].copy()
    vector = np.zeros(3)
    lost = bool(np.linalg.eigvalsh(prior[:2, :2])[0] < settings.icp_reach**-2)
    if lost:
        pose = track.state.poses[-1]
        starts = [v for v in _motions(pose, beginning, settings) if v @ prior @ v < settings.start_chi2]
        agreement = [
            _match(track, settings, recent, points, Motion(centre, v), settings.icp_reach).near.sum()
            for v in [vector, *starts]
        ]
        vector = [vector, *starts][int(np.argmax(agreement))]
    for reach in _reaches(settings):
        matches = _match(track, settings, recent, points, Motion(centre, vector), reach)
        negative_gradient = matches.negative_gradient - prior @ vector
        vector = vector + np.linalg.solve(matches.hessian + prior, negative_gradient)
    posterior = np.linalg.inv(matches.hessian + prior)
    labels = track.state.boundaries
    if not (_agree(matches, list(labels), settings) and _certain(matches, posterior, settings, lost)):
        return None
    return Registration(Motion(centre, vector), {label: matches.agreeing(label) for label in labels})


def _motions(pose: Array, beginning: Array, settings: ClosingSettings) -> list[Array]:
    """Motions (3,) that take a pose (3,) to places of the beginning (k, 3), `start_step` apart."""
    along = np.hypot(*np.diff(beginning[:, :2], axis=0, prepend=beginning[:1, :2]).T).cumsum()
    _, first = np.unique(along // settings.start_step, return_index=True)
    motions = beginning[first] - pose
    motions[:, 2] = wrap_angle(motions[:, 2])
    return list(motions)


def _recent(track: CurveMap, times: Sequence[float], seconds: float) -> tuple[IntArray, Array]:
    """Coloured readings of the newest poses, and where they are in the map (m, 2)."""
    detections, variables, stamps = track.detections, track.variables, np.asarray(times)
    rows = np.flatnonzero(stamps[detections.cycle - variables.first_cycle] > stamps[-1] - seconds)
    rows = rows[np.isin(detections.label[rows], list(track.state.boundaries))]
    return rows, to_map(detections.point[rows], variables.poses_at(detections.cycle[rows]))


def _reaches(settings: ClosingSettings) -> Iterator[float]:
    """How far off a reading may be to pull, in each iteration: less and less."""
    for iteration in range(settings.icp_iterations):
        yield max(settings.inlier_distance, settings.icp_reach * settings.icp_shrink**iteration)


def _match(
    track: CurveMap,
    settings: ClosingSettings,
    recent: IntArray,
    points: Array,
    motion: Motion,
    reach: float,
) -> Matches:
    """Readings against the beginning; those within reach (m) pull."""
    state = track.state
    labels, moved = track.detections.label[recent], motion.apply(points)
    hessian, negative_gradient = np.zeros((3, 3)), np.zeros(3)
    rows, u, near = [recent[:0]], [np.zeros(0)], [np.zeros(0, bool)]
    for label, boundary in state.boundaries.items():
        of = np.flatnonzero(labels == label)
        low = np.zeros(len(of))
        high = low + min(settings.beginning, settings.beginning_share * boundary.confirmed_end)
        foot = boundary.find(state.control_points(label), moved[of], low, high)
        pulls = foot.interior & (np.abs(foot.distance) < reach)
        n, arm = foot.normal_unit[pulls], moved[of[pulls]] - motion.centre - motion.vector[:2]
        by_motion = np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]]) / settings.sigma_reading
        hessian += by_motion.T @ by_motion
        negative_gradient -= by_motion.T @ foot.distance[pulls] / settings.sigma_reading
        rows.append(recent[of[foot.interior]])
        u.append(foot.u[foot.interior])
        near.append(np.abs(foot.distance[foot.interior]) < settings.inlier_distance)
    matched = np.concatenate(rows)
    of_rows = track.detections.label[matched]
    return Matches(matched, of_rows, np.concatenate(u), np.concatenate(near), hessian, negative_gradient)


def _agree(matches: Matches, labels: list[int], settings: ClosingSettings) -> bool:
    """Enough readings, nearly all of them on the beginning, along enough of it on every boundary."""
    count, agreeing = len(matches.rows), int(matches.near.sum())
    if count < settings.min_readings or agreeing < settings.inlier_share * count:
        return False
    on_each = [matches.agreeing(label)[1] for label in labels]
    return all(len(u) >= settings.min_boundary_readings and np.ptp(u) >= settings.overlap for u in on_each)


def _certain(matches: Matches, posterior: Array, settings: ClosingSettings, lost: bool = False) -> bool:
    """The motion is certain in every direction: less so where no more will be known of it.

    That is no excuse where the vehicle is `lost`, with several places to choose from: along a straight one
    agrees as well as the next.
    """
    sigma = float(np.sqrt(np.linalg.eigvalsh(posterior[:2, :2])[-1]))
    driven_again = float(np.median(matches.u[matches.near]))
    patient = driven_again >= settings.patience and not lost
    return sigma <= (settings.sigma_patience if patient else settings.sigma_max)
