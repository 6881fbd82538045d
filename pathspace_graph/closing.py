"""Closing the loop: the newest readings meet the beginning of the curves, and each curve becomes periodic.

Steps of one closing cycle: find the rigid motion of the newest poses that lays their readings on the beginning (`register`);
tie those readings to the oldest control points and solve; join each curve and simplify it, a linear change of variables
`C_old = E C_new` in the prior (paper: Simplification).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.projection import to_map

from .boundary import Boundary
from .knots import BreakSettings, curvature_weighted_breaks, refit
from .segments import relinearized_prior
from .spline import BSpline

from .window import POSE, Prior, schur_leave

if TYPE_CHECKING:
    from .fixed_lag import FixedLagMapper

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class Registration:
    """Where the newest readings lie on the beginning of the curves."""

    rotation: float
    """Rotation (rad) of the window about `centre`."""
    shift: Array
    """(2,) translation after it, m."""
    centre: Array
    """(2,) the newest position, m, map frame."""
    matches: dict[int, tuple[IntArray, Array]]
    """Per boundary: rows of the readings that agree, and their parameters on the beginning."""

    def apply(self, points: Array) -> Array:
        """Moved points (m, 2)."""
        return _moved(points, self.centre, self.rotation, self.shift)


def _moved(points: Array, centre: Array, rotation: float, shift: Array) -> Array:
    c, s = np.cos(rotation), np.sin(rotation)
    return (points - centre) @ np.array([[c, s], [-s, c]]) + centre + shift


def near_start(mapper: FixedLagMapper) -> bool:
    """Whether the vehicle may be on the beginning again: driven far enough, and near it in place and direction."""
    c = mapper.settings.closing
    if mapper.path.length < max(c.min_path, 1.5 * c.overlap) or not mapper.boundaries:
        return False
    pose = mapper.poses[-1]
    beginning = mapper.path.beginning
    drift = c.radius + c.drift * mapper.path.length
    away = np.hypot(*(beginning[:, :2] - pose[:2]).T)
    same_way = np.cos(beginning[:, 2] - pose[2]) > np.cos(c.heading)
    return bool((same_way & (away < drift)).any())


def close_loop(mapper: FixedLagMapper) -> bool:
    """Close the loop where the newest readings agree with the beginning; True where it closed."""
    if not near_start(mapper) or mapper.path.length - mapper.closing_checked < 1.0:
        return False
    mapper.closing_checked = mapper.path.length
    registration = register(mapper)
    if registration is None:
        return False
    _tie(mapper, registration)
    _bend(mapper)
    joins = {label: _join(mapper, label) for label in mapper.boundaries}
    _substitute(mapper, joins)
    for _ in range(mapper.settings.closing.iterations):
        mapper.step(damped=False)
    return True


def register(mapper: FixedLagMapper) -> Registration | None:
    """Iterated closest points on the curves' beginnings, for a rigid motion of the newest readings.

    The vehicle's own uncertainty is the prior: along a straight or an arc the readings leave the motion free.
    """
    c, r = mapper.settings.closing, mapper.readings
    recent = np.flatnonzero(np.asarray(mapper.times)[r.slot] > mapper.times[-1] - c.window)
    recent = recent[np.isin(r.label[recent], list(mapper.boundaries))]
    points = to_map(r.point[recent], mapper.poses[r.slot[recent]])
    centre, motion = mapper.poses[-1, :2].copy(), np.zeros(3)
    prior = np.linalg.inv(mapper.pose_covariance() * c.prior_scale**2)
    matched = _Matches(np.zeros(0, np.intp), np.zeros(0), np.zeros(0, bool), prior, np.zeros(3))
    for iteration in range(c.icp_iterations):
        reach = max(c.inlier_distance, c.icp_reach * 0.7**iteration)
        matched = _match(mapper, recent, points, centre, motion, reach)
        descent = matched.descent - prior @ motion
        motion = motion + np.linalg.solve(matched.hessian + prior, descent)
    posterior = np.linalg.inv(matched.hessian + prior)
    sigma = float(np.sqrt(np.linalg.eigvalsh(posterior[:2, :2])[-1]))
    agree = matched.near
    labels = r.label[matched.rows]
    spans = [np.ptp(matched.u[agree & (labels == b)]) if (agree & (labels == b)).sum() > 4 else 0.0 for b in mapper.boundaries]
    mapper.debug.append(f"closing at {mapper.path.length:.1f}: {agree.sum()}/{len(agree)} spans {np.round(spans,1)} motion {motion.round(2)} sigma {sigma:.2f} prior {np.sqrt(np.diag(np.linalg.inv(prior))).round(2)}")
    enough = len(agree) >= c.min_readings and agree.sum() >= c.inlier_share * len(agree)
    if not enough or min(spans) < c.overlap:
        return None
    driven_again = float(np.median(matched.u[agree]))
    if sigma > c.sigma_max and driven_again < c.patience:
        return None
    matches = {b: (matched.rows[agree & (labels == b)], matched.u[agree & (labels == b)]) for b in mapper.boundaries}
    return Registration(float(motion[2]), motion[:2], centre, matches)


@dataclass(frozen=True)
class _Matches:
    """Readings against the beginning, at one motion."""

    rows: IntArray
    """Readings whose foot point is inside the beginning."""
    u: Array
    """Their parameters."""
    near: NDArray[np.bool_]
    """Whether they lie on it."""
    hessian: Array
    """(3, 3) of the motion (x, y, rotation), from the readings within reach."""
    descent: Array
    """(3,) negative gradient."""


def _match(
    mapper: FixedLagMapper, recent: IntArray, points: Array, centre: Array, motion: Array, reach: float
) -> _Matches:
    c = mapper.settings.closing
    labels = mapper.readings.label[recent]
    moved = _moved(points, centre, motion[2], motion[:2])
    rows, u, near = [], [], []
    hessian, descent = np.zeros((3, 3)), np.zeros(3)
    for b, boundary in mapper.boundaries.items():
        of = np.flatnonzero(labels == b)
        if len(of) == 0:
            continue
        high = np.full(len(of), min(c.beginning, 0.6 * boundary.confirmed))
        foot = boundary.find(mapper.control_points(b), moved[of], np.zeros(len(of)), high)
        good = foot.interior & (np.abs(foot.distance) < reach)
        n, arm = foot.normal_unit[good], moved[of[good]] - centre - motion[:2]
        jacobian = np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]]) / c.sigma_reading
        hessian += jacobian.T @ jacobian
        descent -= jacobian.T @ foot.distance[good] / c.sigma_reading
        inside = foot.interior
        rows.append(recent[of[inside]])
        u.append(foot.u[inside])
        near.append(np.abs(foot.distance[inside]) < c.inlier_distance)
    return _Matches(np.concatenate(rows), np.concatenate(u), np.concatenate(near), hessian, descent)


def _tie(mapper: FixedLagMapper, registration: Registration) -> None:
    """Move the window onto the beginning, and hold the agreeing readings against it."""
    poses = mapper.poses
    poses[:, :2] = registration.apply(poses[:, :2])
    poses[:, 2] += registration.rotation
    r = mapper.readings
    for label, (rows, u) in registration.matches.items():
        r.used[rows] = True
        r.boundary[rows] = label
        r.u[rows] = u


def _bend(mapper: FixedLagMapper) -> None:
    """Solve the whole loop, each stretch of the drive relinearized in its own frame; then forget the keyframes."""
    history = mapper.history
    assert history is not None
    segments = history.all_segments(*mapper.control_ids())
    low = mapper.pose_column(0)
    count = len(segments)
    if count:
        mapper.state = np.insert(mapper.state, low, np.concatenate(history.keyframes))
        mapper.keyframes = count
    offsets = {label: mapper.offset(label) for label in mapper.boundaries}
    for _ in range(mapper.settings.closing.iterations):
        if count:
            mapper.prior = relinearized_prior(history, segments, mapper.state, offsets, mapper.map_size)
        mapper.step(damped=False)
    if count:
        prior = relinearized_prior(history, segments, mapper.state, offsets, mapper.map_size)
        keyframes = slice(low, low + POSE * count)
        information, gradient = schur_leave(
            prior.information, prior.gradient, keyframes.start, keyframes.stop
        )
        mapper.prior = Prior(information, gradient, np.delete(prior.point, keyframes))
        mapper.state = np.delete(mapper.state, keyframes)
        mapper.keyframes = 0
    mapper.history = None


@dataclass(frozen=True)
class Join:
    """How an open curve becomes periodic."""

    period: float
    """Length of the closed curve in the open one's parameter, m."""
    knots: Array
    """Periodic knots."""
    points: Array
    """Control points (m, 2) of the closed curve."""
    old_from_new: Array
    """E (n, m)."""
    overlap_u: Array
    """Parameters (k,) of the open curve that lie on the beginning, and ..."""
    overlap_w: Array
    """... theirs (k,) on the beginning."""

    def new_parameter(self, u: Array) -> Array:
        """Parameter on the closed curve (not wrapped) of the open curve's."""
        return np.where(u < self.overlap_u[0], u, self.period + np.interp(u, self.overlap_u, self.overlap_w))


def _join(mapper: FixedLagMapper, label: int) -> Join:
    boundary = mapper.boundaries[label]
    cps = mapper.control_points(label)
    spline = boundary.spline(cps)
    period, overlap_u, overlap_w = _overlap(mapper, boundary, cps)
    s = mapper.settings.spline
    sighted = np.array(boundary.sighted).reshape(-1, 2)
    low = np.zeros(len(sighted))
    u = boundary.find(cps, sighted, low, low + boundary.confirmed).u
    size = max(s.min_size, int(s.size_share * int((u < period - 0.5).sum())))
    breaks = curvature_weighted_breaks(spline, size, BreakSettings(s.linear_baseline), 0.0, period)
    frame = BSpline.periodic_from(breaks, np.zeros((size, 2)), boundary.degree)
    join = Join(period, frame.knots, np.zeros((size, 2)), np.zeros((0, 0)), overlap_u, overlap_w)
    change = refit(spline, frame, join.new_parameter)
    return Join(period, frame.knots, change.new_from_old @ cps, change.old_from_new, overlap_u, overlap_w)


def _overlap(mapper: FixedLagMapper, boundary: Boundary, cps: Array) -> tuple[float, Array, Array]:
    """Period, and the parameters of the end with theirs on the beginning (relative to 0)."""
    c = mapper.settings.closing
    late = max(boundary.confirmed - c.beginning - 10.0, 0.5 * boundary.confirmed)
    start = boundary.evaluate(cps, np.zeros(1))
    foot = boundary.find(cps, start, np.array([late]), np.array([boundary.confirmed]))
    if not foot.interior[0]:
        end = boundary.evaluate(cps, np.array([boundary.confirmed]))
        period = boundary.confirmed + float(np.hypot(*(start - end)[0]))
        high = boundary.tables.high
        return period, np.array([period, period + 1.0]), np.array([0.0, 1.0])
    u0 = float(foot.u[0])
    u = np.linspace(u0, boundary.confirmed, max(int(boundary.confirmed - u0), 1) + 1)
    points = boundary.evaluate(cps, u)
    guess = u - u0
    low, high = np.maximum(guess - 4.0, 0.0), guess + 4.0
    w = boundary.find(cps, points, low, high).u
    w = np.maximum.accumulate(w)
    w[0] = 0.0
    step = boundary.nominal[0]
    u, w = np.append(u, u[-1] + 2 * step), np.append(w, w[-1] + 2 * step)
    return u0, u, w


def _substitute(mapper: FixedLagMapper, joins: dict[int, Join]) -> None:
    """`x_old = M x_new` in the prior: the closed curves' control points replace the open ones."""
    q, n_old = len(mapper.prior.point), mapper.map_size
    sizes = [2 * len(j.points) for j in joins.values()]
    n_new = sum(sizes)
    change = np.zeros((q, n_new + q - n_old))
    change[n_old:, n_new:] = np.eye(q - n_old)
    at = 0
    for (label, join), size in zip(joins.items(), sizes, strict=True):
        rows = slice(mapper.offset(label), mapper.offset(label) + 2 * mapper.boundaries[label].size)
        change[rows, at : at + size] = np.kron(join.old_from_new, np.eye(2))
        at += size
    points = np.concatenate([j.points.ravel() for j in joins.values()])
    point = np.concatenate([points, mapper.state[n_old:q]])
    information, gradient = _loosened(mapper, n_old)
    gradient = gradient - information @ (change @ point - mapper.prior.point)
    mapper.prior.information = change.T @ information @ change
    mapper.prior.gradient = change.T @ gradient
    mapper.prior.point = point
    mapper.state = np.concatenate([points, mapper.state[n_old:]])
    for label, join in joins.items():
        _replace(mapper, label, join)


def _loosened(mapper: FixedLagMapper, n_old: int) -> tuple[Array, Array]:
    """The prior where the old control points may be off `E C_new` by sigma_simplify: `(I + L S)^-1 (L, g)`."""
    prior = mapper.prior
    variance = np.zeros(len(prior.point))
    variance[:n_old] = mapper.settings.spline.sigma_simplify**2
    inner = np.eye(len(variance)) + prior.information * variance
    solved = np.linalg.solve(inner, np.column_stack([prior.information, prior.gradient]))
    information = solved[:, :-1]
    return 0.5 * (information + information.T), solved[:, -1]


def _replace(mapper: FixedLagMapper, label: int, join: Join) -> None:
    """The closed boundary takes the open one's place, for its readings and stations too."""
    old = mapper.boundaries[label]
    new = Boundary(join.knots, old.degree, True, old.gauge)
    mapper.boundaries[label] = new
    new.confirmed = new.tables.high
    rows = mapper.readings.used_on(label)
    mapper.readings.u[rows] = join.new_parameter(mapper.readings.u[rows])
    mapper.stations[label] = join.new_parameter(mapper.stations[label])
    mapper.sightings[label].clear()
