"""Fixed-lag online mapping: predict, classify, expand, project and gate, update, close, simplify, marginalize."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from pathspace_graph.factors.footpoint import FootPoints
from pathspace_graph.factors.gauge import spacing_residuals
from pathspace_graph.factors.odometry import (
    CALIBRATION_SIZE,
    IntegratedOdometry,
    compose,
    integrate_twists,
    odometry_residuals,
)
from pathspace_graph.factors.projection import huber_weights, project, sigma_across, to_map

from .boundary import Boundary, open_boundary
from .closing import close_loop
from .labels import BOUNDARIES, UNKNOWN
from .log import Detections, Odometry
from .map import Map, SplineBoundary
from .path import DrivenPath, along_and_across
from .readings import Readings
from .settings import MapperSettings
from .segments import History
from .sightings import Sightings
from .window import POSE, Prior, Rows, accumulate, cholesky, schur_leave, solve

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


@dataclass(frozen=True)
class CycleResult:
    """The estimate after one perception cycle."""

    t: float
    pose: Array
    sizes: tuple[int, int]
    readings: int
    closed: bool
    stages: dict[str, float] = field(default_factory=dict)


class FixedLagMapper:
    """Maps a track's two boundaries cycle by cycle; see DESIGN for the mathematics."""

    def __init__(self, settings: MapperSettings | None = None, odometry_sigma: Array | None = None) -> None:
        self.settings = settings or MapperSettings()
        self.odometry_sigma = (
            np.array([0.25, 0.12, 0.035]) if odometry_sigma is None else np.asarray(odometry_sigma)
        )
        s = self.settings
        self.boundaries: dict[int, Boundary] = {}
        self.sightings = {b: Sightings(s.growth) for b in BOUNDARIES}
        self.readings = Readings()
        self.path = DrivenPath()
        self.closed = False
        self.state: Array = np.zeros(CALIBRATION_SIZE)
        calibration = np.array([s.odometry.sigma_scale, s.odometry.sigma_bias])
        self.prior = Prior(np.diag(calibration**-2.0), np.zeros(CALIBRATION_SIZE), np.zeros(CALIBRATION_SIZE))
        self.times: list[float] = []
        self.odometry: list[IntegratedOdometry] = []
        self.first_pose = 0
        self.factor: Array | None = None
        self.factor_dropped = 0
        self.curvature = 0.0
        self.stations: dict[int, Array] = {}
        self.debug: list[str] = []
        self.start_heading = 0.0
        self.closing_checked = 0.0
        self.keyframes = 0
        self.history: History | None = None

    # -- the state, by name -----------------------------------------------------------------------------------------

    @property
    def poses(self) -> Array:
        """Poses (P, 3) in the window, oldest first: a view of the state."""
        return self.state[self.pose_column(0) :].reshape(-1, POSE)

    @property
    def map_size(self) -> int:
        """State entries that are control points."""
        return 2 * sum(b.size for b in self.boundaries.values())

    @property
    def calibration(self) -> Array:
        """(scale error, yaw-rate bias): a view of the state."""
        return self.state[self.map_size : self.map_size + CALIBRATION_SIZE]

    def offset(self, label: int) -> int:
        """First state entry of a boundary's control points."""
        before = [b for b in self.boundaries if b < label]
        return 2 * sum(self.boundaries[b].size for b in before)

    def control_points(self, label: int) -> Array:
        """Control points (m, 2) of a boundary: a view of the state."""
        start = self.offset(label)
        return self.state[start : start + 2 * self.boundaries[label].size].reshape(-1, 2)

    def pose_column(self, slot: int | IntArray) -> int | IntArray:
        """First state entry of a pose in the window."""
        return self.map_size + CALIBRATION_SIZE + POSE * (self.keyframes + slot)

    # -- one cycle ----------------------------------------------------------------------------------------------------

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """One perception cycle: the twists since the last one, and what was detected now."""
        clock = [time.perf_counter()]
        names = []

        def lap(name: str) -> None:
            clock.append(time.perf_counter())
            names.append(name)

        self._predict(odometry, detections.t)
        lap("predict")
        self._classify(detections)
        lap("classify")
        self._expand()
        lap("expand")
        for _ in range(self.settings.steps):
            self.step()
        lap("update")
        self._close()
        lap("close")
        self._marginalize()
        lap("marginalize")
        sizes = tuple(self.boundaries[b].size if b in self.boundaries else 0 for b in BOUNDARIES)
        used = int((self.readings.used & (self.readings.slot == len(self.poses) - 1)).sum())
        return CycleResult(
            detections.t, self.poses[-1].copy(), sizes, used, self.closed, dict(zip(names, np.diff(clock)))
        )

    # -- predict ------------------------------------------------------------------------------------------------------

    def _predict(self, odometry: Odometry, t: float) -> None:
        durations = np.diff(np.append(odometry.t, t))
        integrated = integrate_twists(durations, odometry.twist, self.odometry_sigma)
        first = len(self.times) == 0
        delta = integrated.delta - self._calibrated(integrated)
        pose = compose(np.zeros(3) if first else self.poses[-1], delta)
        self.state = np.concatenate([self.state, pose])
        self.times.append(t)
        if first:
            covariance = integrated.covariance + np.diag([1e-4, 1e-4, 1e-5]) ** 2
            self._extend_prior_by_pose(np.linalg.inv(covariance), pose)
        else:
            self.odometry.append(integrated)
        self.path.update(pose)
        if len(odometry.t):
            twist = odometry.twist.mean(axis=0)
            if twist[0] > 1.0:
                limit = self.settings.growth.max_curvature
                self.curvature += 0.4 * (float(np.clip(twist[2] / twist[0], -limit, limit)) - self.curvature)

    def _calibrated(self, integrated: IntegratedOdometry) -> Array:
        """What calibration takes off an integrated odometry, in the frame of its start."""
        local = integrated.calibration_jacobian @ self.calibration
        c, s = np.cos(integrated.delta[2]), np.sin(integrated.delta[2])
        return np.array([c * local[0] - s * local[1], s * local[0] + c * local[1], local[2]])

    def _extend_prior_by_pose(self, information: Array, pose: Array) -> None:
        q = len(self.prior.point)
        block = np.zeros((q + POSE, q + POSE))
        block[:q, :q] = self.prior.information
        block[q:, q:] = information
        self.prior = Prior(
            block, np.append(self.prior.gradient, np.zeros(POSE)), np.append(self.prior.point, pose)
        )
        self.history = History(self.prior, self.settings.closing.keyframe_interval)

    # -- classify -----------------------------------------------------------------------------------------------------

    def _classify(self, detections: Detections) -> None:
        """Which readings update a curve, and which are sightings of what no curve explains yet."""
        slot = len(self.poses) - 1
        new = self.readings.append(detections, slot)
        self._locate_vehicle()
        for label in self.boundaries:
            self._admit(label)
        self._sight(new, detections.t)

    def _locate_vehicle(self) -> None:
        """Parameter of the newest pose on each boundary, near where it was."""
        for label, boundary in self.boundaries.items():
            known = self.stations[label]
            low, high = known[-1] - 3.0, known[-1] + 8.0
            foot = boundary.find(
                self.control_points(label), self.poses[-1:, :2], np.array([low]), np.array([high])
            )
            u = foot.u[0]
            if boundary.periodic:  # unwrap
                u += boundary.length * np.round((known[-1] - u) / boundary.length)
            self.stations[label] = np.append(known, u)

    def _admit(self, label: int) -> None:
        """Readings that are not in use and lie on the curve, by the joint uncertainty of pose and curve."""
        r, boundary, gate = self.readings, self.boundaries[label], self.settings.gate
        rows = r.pending(label)
        newest = r.slot[rows] == len(self.poses) - 1
        rows = rows[newest | self._retest(label, rows)]
        if len(rows) == 0 or self.factor is None:
            return
        station = self.stations[label][r.slot[rows]]
        low, high = station - gate.view_behind, station + gate.view_ahead
        if not boundary.periodic:
            high = np.minimum(high, boundary.confirmed + 0.5)
        poses = self.poses[r.slot[rows]]
        points = to_map(r.point[rows], poses)
        foot = boundary.find(self.control_points(label), points, low, high)
        rough = foot.interior & (np.abs(foot.distance) < 3.0)
        rows, keep = rows[rough], np.flatnonzero(rough)
        if len(rows) == 0:
            return
        foot = _take(foot, keep)
        lin = project(points[keep], r.covariance[rows], poses[keep], foot, self.settings.spline.sigma_model)
        variance = lin.sigma**2 + gate.sigma_floor**2 + self._joint_variance(label, rows, lin, foot)
        passes = foot.distance**2 < gate.chi**2 * variance
        unknown = r.label[rows] == UNKNOWN
        passes &= ~unknown | (r.boundary[rows] == UNKNOWN)
        chosen = rows[passes]
        r.used[chosen] = True
        r.boundary[chosen] = label
        r.u[chosen] = foot.u[passes]

    def _retest(self, label: int, rows: IntArray) -> NDArray[np.bool_]:
        grown = getattr(self, "_grown", {})
        return np.full(len(rows), grown.get(label, False))

    def _joint_variance(self, label: int, rows: IntArray, lin, foot: FootPoints) -> Array:
        """`g' Sigma g` of each row, from the last factorization; the newest pose through its odometry."""
        assert self.factor is not None
        size = self.factor.shape[0]
        boundary, r = self.boundaries[label], self.readings
        m = len(rows)
        slots = r.slot[rows]
        newest = slots == len(self.poses) - 1
        by_pose = lin.by_pose.copy()
        extra = np.zeros(m)
        gradient = np.zeros((size, m))
        columns = boundary.columns(foot.span)
        base = self.offset(label) + 2 * columns
        where = np.arange(m)[:, None]
        gradient[base, where] += lin.by_control[:, :, 0]
        gradient[base + 1, where] += lin.by_control[:, :, 1]
        if newest.any():
            odo = self.odometry[-1]
            last, now = self.poses[-2], self.poses[-1]
            dx, dy = now[:2] - last[:2]
            g = by_pose[newest]
            c, s = np.cos(now[2]), np.sin(now[2])
            R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
            extra[newest] = np.einsum("mi,ij,mj->m", g @ R, odo.covariance, g @ R)
            by_calibration = -(g @ R) @ odo.calibration_jacobian
            gradient[self.map_size : self.map_size + CALIBRATION_SIZE, newest] = by_calibration.T
            by_pose[newest, 2] += g[:, 1] * dx - g[:, 0] * dy
            slots = np.where(newest, slots - 1, slots)
        column = self.pose_column(slots + self.factor_dropped)
        for k in range(POSE):
            gradient[column + k, np.arange(m)] += by_pose[:, k]
        half, _ = lapack.dtrtrs(self.factor, gradient, lower=1)
        return np.einsum("im,im->m", half, half) + extra

    def _sight(self, new: slice, t: float) -> None:
        """New readings that no curve takes are sightings."""
        r = self.readings
        rows = np.arange(new.start, new.stop)
        rows = rows[~r.used[rows]]
        poses = self.poses[r.slot[rows]]
        points = to_map(r.point[rows], poses)
        variances = np.trace(r.covariance[rows], axis1=1, axis2=2)
        for label in BOUNDARIES:
            if self.closed:
                break
            of = r.label[rows] == label
            self.sightings[label].add(points[of], variances[of], t)

    # -- expand -------------------------------------------------------------------------------------------------------

    def _expand(self) -> None:
        """Lead each open end through the sightings that come next along the way driven."""
        self._grown = {}
        if self.closed:
            return
        growth = self.settings.growth
        path, stations = self.path.with_prediction(self.poses[-1], self.curvature, growth.reach)
        for label in BOUNDARIES:
            if label not in self.boundaries:
                self._begin(label, path, stations)
            elif self._extend(label, path, stations):
                self._grown[label] = True

    def _candidates(self, label: int, path: Array, stations: Array) -> tuple[IntArray, Array, Array]:
        """Confirmed sightings within reach, on their side of the path: indices, stations, distances across."""
        sightings = self.sightings[label]
        indices = sightings.confirmed()
        if len(indices) == 0:
            return indices, np.zeros(0), np.zeros(0)
        s, lateral = along_and_across(sightings.points[indices], path, stations)
        side = lateral if label == 0 else -lateral
        ok = (s <= stations[-1]) & (side > 0.0)
        order = np.argsort(s[ok])
        return indices[ok][order], s[ok][order], side[ok][order]

    def _begin(self, label: int, path: Array, stations: Array) -> None:
        """A new curve through the first sightings."""
        growth = self.settings.growth
        indices, s, side = self._candidates(label, path, stations)
        near = side < growth.max_lateral
        indices, s, side = indices[near], s[near], side[near]
        chain = _chain(s, side, growth.lateral_change, growth.lateral_rate)
        if len(chain) < 2:
            return
        points = self.sightings[label].points[indices[chain]]
        u = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        boundary = open_boundary(self.settings.spline, self.settings.gauge)
        cps = boundary.grow(np.zeros((0, 2)), u, points, self.settings.spline.spacing)
        boundary.confirmed = float(u[-1])
        self.boundaries = dict(sorted({**self.boundaries, label: boundary}.items()))
        self._insert_control_points(label, 0, cps)
        self._consume(label, indices[chain], points, 0.0)
        n = len(self.poses)
        foot = boundary.find(
            self.control_points(label), self.poses[:, :2], np.zeros(n), np.full(n, boundary.confirmed)
        )
        self.stations[label] = foot.u

    def _extend(self, label: int, path: Array, stations: Array) -> bool:
        """Extend by every sighting that comes next; carry a stranded end along the path. True where it grew."""
        growth, boundary = self.settings.growth, self.boundaries[label]
        cps = self.control_points(label)
        end = boundary.evaluate(cps, np.array([boundary.confirmed]))
        s_end, lateral = along_and_across(end, path, stations)
        s_end, side_end = float(s_end[0]), float(lateral[0] if label == 0 else -lateral[0])
        indices, s, side = self._candidates(label, path, stations)
        distance = (
            np.hypot(*(self.sightings[label].points[indices] - end[0]).T) if len(indices) else np.zeros(0)
        )
        ahead = (s > s_end + 0.3) & (distance > growth.threshold)
        indices, s, side = indices[ahead], s[ahead], side[ahead]
        chain = (
            _chain(
                np.append(s_end, s),
                np.append(side_end, side),
                growth.lateral_change,
                growth.lateral_rate,
                anchored=True,
            )[1:]
            - 1
        )
        if len(chain):
            points = self.sightings[label].points[indices[chain]]
            self._lead(label, end[0], points)
            self._consume(label, indices[chain], points, boundary.confirmed)
            return True
        if s_end < self.path.length - growth.stranded:
            return self._carry_on(label, path, stations, s_end, side_end)
        return False

    def _lead(self, label: int, end: Array, points: Array) -> None:
        """Lead the curve from its end through points (k, 2)."""
        boundary = self.boundaries[label]
        steps = np.hypot(*np.diff(np.concatenate([end[None], points]), axis=0).T)
        u = boundary.confirmed + np.cumsum(steps)
        old = self.control_points(label).copy()
        size = boundary.size
        cps = boundary.grow(old, u, points, self.settings.spline.spacing)
        start = self.offset(label)
        self.state[start : start + 2 * size] = cps[:size].ravel()
        if len(cps) > size:
            self._insert_control_points(label, size, cps[size:])
        boundary.confirmed = float(u[-1])

    def _carry_on(self, label: int, path: Array, stations: Array, s_end: float, side_end: float) -> bool:
        """The vehicle has passed a stranded end: lead it beside the path as far as the vehicle is."""
        sign = 1.0 if label == 0 else -1.0
        s = self.path.length - 0.5 * self.settings.growth.stranded
        i = int(np.clip(np.searchsorted(stations, s), 1, len(stations) - 1))
        direction = path[i] - path[i - 1]
        direction /= max(np.hypot(*direction), 1e-9)
        side = max(side_end, 0.5)
        point = path[i] + sign * side * np.array([-direction[1], direction[0]])
        boundary = self.boundaries[label]
        end = boundary.evaluate(self.control_points(label), np.array([boundary.confirmed]))[0]
        if np.hypot(*(point - end)) < 0.5:
            return False
        self._lead(label, end, point[None])
        return True

    def _insert_control_points(self, label: int, at: int, points: Array) -> None:
        """New control points at index `at` of a boundary's, of which the prior knows nothing."""
        index = self.offset(label) + 2 * at
        self.state = np.insert(self.state, index, points.ravel())
        self.prior.widen(index, points.ravel())
        if self.history is not None:
            self.history.widen(index, points.ravel())

    def _consume(self, label: int, indices: IntArray, points: Array, from_u: float) -> None:
        """Sightings that are on the curve now: their readings update it."""
        boundary, r = self.boundaries[label], self.readings
        boundary.sighted.extend(points)
        rows = r.pending(label)
        rows = rows[r.label[rows] == label]
        p = to_map(r.point[rows], self.poses[r.slot[rows]])
        offset = p[:, None, :] - points[None]
        near = np.hypot(offset[:, :, 0], offset[:, :, 1]).min(axis=1) < self.settings.growth.merge_radius
        rows, p = rows[near], p[near]
        n = len(rows)
        if n:
            foot = boundary.find(
                self.control_points(label), p, np.full(n, from_u - 1.0), np.full(n, boundary.confirmed + 0.5)
            )
            r.used[rows] = True
            r.u[rows] = foot.u
        self.sightings[label].remove(indices)

    # -- update -------------------------------------------------------------------------------------------------------

    def linearize(self) -> list[Rows]:
        """Whitened rows of everything in the window but the prior, at the current estimate."""
        groups = []
        for label in self.boundaries:
            groups.append(self._linearize_readings(label))
            groups.append(self._linearize_spacing(label))
        if self.odometry:
            groups.append(self._linearize_odometry())
        return groups

    def _linearize_readings(self, label: int) -> Rows:
        r, boundary, gate = self.readings, self.boundaries[label], self.settings.gate
        rows = r.used_on(label)
        slots = r.slot[rows]
        poses = self.poses[slots]
        points = to_map(r.point[rows], poses)
        foot = boundary.refine(self.control_points(label), points, r.u[rows], 2.0)
        r.u[rows] = foot.u
        lin = project(points, r.covariance[rows], poses, foot, self.settings.spline.sigma_model)
        whitened = lin.residual / lin.sigma
        weight = np.sqrt(huber_weights(whitened, gate.huber)) * foot.interior / lin.sigma
        m = len(rows)
        base = self.offset(label) + 2 * boundary.columns(foot.span)
        columns = np.concatenate(
            [
                self.pose_column(slots)[:, None] + np.arange(POSE),
                np.stack([base, base + 1], axis=2).reshape(m, 2 * base.shape[1]),
            ],
            axis=1,
        )
        jacobian = (
            np.concatenate([lin.by_pose, lin.by_control.reshape(m, 2 * base.shape[1])], axis=1)
            * weight[:, None]
        )
        return Rows(columns, jacobian, lin.residual * weight)

    def _linearize_spacing(self, label: int) -> Rows:
        boundary = self.boundaries[label]
        residual, direction = spacing_residuals(
            self.control_points(label), boundary.nominal, boundary.periodic
        )
        sigma = self.settings.gauge.sigma_spacing * boundary.nominal
        j = np.arange(len(residual))
        k = (j + 1) % boundary.size
        base = self.offset(label)
        columns = base + np.column_stack([2 * j, 2 * j + 1, 2 * k, 2 * k + 1])
        jacobian = np.concatenate([-direction, direction], axis=1) / sigma[:, None]
        return Rows(columns, jacobian, residual / sigma)

    def _linearize_odometry(self) -> Rows:
        poses = self.poses
        deltas = np.array([o.delta for o in self.odometry])
        roots = np.array([o.whitener for o in self.odometry])
        by_calibration = np.array([o.calibration_jacobian for o in self.odometry])
        residual, by_start, by_end = odometry_residuals(poses[:-1], poses[1:], deltas)
        residual = residual + by_calibration @ self.calibration
        m = len(deltas)
        first = self.pose_column(np.arange(m))[:, None]
        shared = np.full((m, 1), self.map_size)
        columns = np.concatenate([shared + np.arange(CALIBRATION_SIZE), first + np.arange(2 * POSE)], axis=1)
        jacobian = roots @ np.concatenate([by_calibration, by_start, by_end], axis=2)
        residual = np.einsum("mij,mj->mi", roots, residual)
        return Rows(np.repeat(columns, POSE, axis=0), jacobian.reshape(m * POSE, -1), residual.ravel())

    def _normal_equations(self, groups: Sequence[Rows]) -> tuple[Array, Array]:
        hessian, descent = accumulate(groups, len(self.state))
        q = len(self.prior.point)
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(self.state)
        for label, boundary in self.boundaries.items():
            block = slice(self.offset(label), self.offset(label) + 2 * boundary.size)
            hessian[block, block] += boundary.gauge_hessian
            descent[block] -= boundary.smooth_only @ self.state[block]
        return hessian, descent

    def step(self, damped: bool = True) -> None:
        """One Gauss-Newton step, relinearized at the current estimate."""
        self._groups = self.linearize()
        hessian, descent = self._normal_equations(self._groups)
        self._linearized_at = self.state.copy()
        damping = np.arange(self.map_size)
        hessian[damping, damping] += (self.settings.sigma_step if damped else 10.0) ** -2
        self.factor = cholesky(hessian)
        self.factor_dropped = 0
        self.state = self.state + solve(self.factor, descent)

    # -- close and simplify ---------------------------------------------------------------------------------------------

    def _close(self) -> None:
        if not self.closed and close_loop(self):
            self.closed = True
            self.path.move(np.zeros(2))

    # -- marginalize ----------------------------------------------------------------------------------------------------

    def _marginalize(self) -> None:
        """Poses older than the lag leave into the prior."""
        while len(self.times) > 1 and self.times[-1] - self.times[0] > self.settings.lag + 1e-9:
            self._marginalize_oldest()

    def _marginalize_oldest(self) -> None:
        low = self.pose_column(0)
        size = low + 2 * POSE
        touching = [g.touching(low, low + POSE) for g in self._groups]
        hessian, descent = accumulate(touching, size)
        if self.history is not None:
            self.history.leave(hessian, descent, self._linearized_at[:size], *self.control_ids())
        q = len(self.prior.point)
        hessian[:q, :q] += self.prior.information
        descent[:q] += self.prior.descent_at(self._linearized_at)
        information, gradient = schur_leave(hessian, descent, low, low + POSE)
        point = np.delete(self._linearized_at[:size], np.s_[low : low + POSE])
        self.prior = Prior(information, gradient, point)
        self.state = np.delete(self.state, np.s_[low : low + POSE])
        self._linearized_at = np.delete(self._linearized_at, np.s_[low : low + POSE])
        self._groups = [_without(g, low) for g in self._groups]
        self.times.pop(0)
        self.odometry.pop(0)
        self.readings.drop_oldest_pose()
        self.stations = {label: u[1:] for label, u in self.stations.items()}
        self.first_pose += 1
        self.factor_dropped += 1

    def control_ids(self) -> tuple[IntArray, IntArray]:
        """Boundary and index (n,) of each control point, in the order of the state."""
        sizes = [b.size for b in self.boundaries.values()]
        labels = np.repeat(np.array(list(self.boundaries), np.intp), sizes)
        return labels, np.concatenate([np.arange(n) for n in sizes] or [np.zeros(0, np.intp)])

    # -- results ------------------------------------------------------------------------------------------------------

    def map(self) -> Map:
        """The map as it stands, with the joint covariance of each boundary's control points."""
        if not self.boundaries:
            return Map(self.closed, {})
        joint = self.covariance()
        boundaries = {}
        for label, boundary in self.boundaries.items():
            block = slice(self.offset(label), self.offset(label) + 2 * boundary.size)
            spline = boundary.spline(self.control_points(label).copy())
            boundaries[label] = SplineBoundary(spline, joint[block, block])
        return Map(self.closed, boundaries)

    def pose_covariance(self) -> Array:
        """(3, 3) marginal covariance of the newest pose (x, y, theta), map frame, without damping."""
        factor = cholesky(self._normal_equations(self.linearize())[0])
        selected = np.eye(len(factor), POSE, -(len(factor) - POSE))
        half, _ = lapack.dtrtrs(factor, selected, lower=1)
        return half.T @ half

    def covariance(self) -> Array:
        """Joint covariance of the control points, of both boundaries together."""
        factor = cholesky(self._normal_equations(self.linearize())[0])
        n = self.map_size
        half, _ = lapack.dtrtrs(factor, np.eye(len(factor), n), lower=1)
        return half.T @ half


def _without(rows: Rows, low: int) -> Rows:
    """Rows that don't touch the pose at `low`, with the columns behind it moved up."""
    keep = ~((rows.columns >= low) & (rows.columns < low + POSE)).any(axis=1)
    columns = rows.columns[keep]
    return Rows(np.where(columns >= low, columns - POSE, columns), rows.jacobian[keep], rows.residual[keep])


def _take(foot: FootPoints, keep: IntArray) -> FootPoints:
    return FootPoints(*(getattr(foot, f)[keep] for f in foot.__dataclass_fields__))


def _chain(s: Array, side: Array, change: float, rate: float, anchored: bool = False) -> IntArray:
    """Indices of a chain along the path (stations `s`, sorted): each next one not much farther from the path than the last,

    and of those at about the same station the one nearest to the path."""
    chain: list[int] = [0] if anchored else []
    for i in range(len(chain), len(s)):
        beside = np.abs(s - s[i]) < 2.0
        if anchored:
            beside[0] = False
        if (side[beside] < side[i] - 0.8).any():
            continue
        if chain:
            j = chain[-1]
            if side[i] > side[j] + change + rate * (s[i] - s[j]):
                continue
        chain.append(i)
    return np.array(chain, dtype=np.intp)
