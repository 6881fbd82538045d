"""The paper's filters: the spline filter, which closes its loop, and its landmark baseline (Results)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.batch.association import LINE_STEP
from pathspace_graph.factors import se2
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.variables import POINT, POSE
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary
from pathspace_graph.io.results import VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.mapping.detections import DetectionColumns
from pathspace_graph.mapping.path import DrivenPath
from pathspace_graph.mapping.tracks import FORGET_AFTER, Tracks, nearest_within
from pathspace_graph.places import find as places
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import SAMPLED_WEIGHT, BSpline, LeastSquares, sparse_rows

from . import landmarks
from .ckf import HEAD, Belief, CurveState, Expansion, classify, in_map, point_columns, transform, update

JOIN_MARGIN: Final = 10.0  # with `BEGINNING`, largest distance of the seam from the end of a curve (m)
JOIN_SHARE: Final = 0.5  # least parameter of the seam on a short curve, as a share of its length
OVERLAP_STEP: Final = 1.0  # step of the points of the overlap (m)
OVERLAP_ROOM: Final = 4.0  # search range of their foot points on the beginning, about the expected ones (m)


@dataclass(frozen=True, eq=False)
class Overlap:
    """The correspondence between a curve's end and its beginning."""

    period: float  # length of the closed curve in the open curve's parameter (m)
    u: Array  # (k,) increasing parameters of the open curve's end, from the seam on
    w: Array  # (k,) parameters of the corresponding points on the beginning, from 0 on

    def new_parameter(self, u: Array) -> Array:
        """Map parameters of the open curve to those of the closed one, without wrapping."""
        return np.where(u < self.u[0], u, self.period + np.interp(u, self.u, self.w))


def make_periodic(
    boundary: Boundary, control_points: Array, settings: MapperSettings
) -> tuple[Overlap, BSpline, Array]:
    """Fit a periodic curve to an open one with control points C (n, 2), on knots by curvature.

    The number of its control points is a share of the number of cones, or of equivalent places on a line. The
    third result is F of the change of variables, `C_new = F C`.
    """
    spline, overlap = boundary.spline(control_points), find_overlap(boundary, control_points)
    period, u = overlap.period, boundary.cone_parameters
    u = np.arange(0.0, period, LINE_STEP) if settings.of_lines else u
    kept = list[float]()  # on the closed curve, each farther than the merge radius from the one before
    for place in u[u < period - 0.5].tolist():  # half a metre before the seam the beginning has them
        if not kept or place - kept[-1] > settings.growth.merge_radius:
            kept.append(place)
    size = max(settings.spline.min_size, int(settings.spline.size_share * len(kept)))
    breaks = curvature_weighted_breaks(spline, size, 0.5, 0.0, period)  # half of the knots are even
    frame = BSpline.periodic_from(breaks, np.zeros((len(breaks) - 1, 2)), boundary.degree)
    u = np.linspace(*spline.domain, int(boundary.length / 0.1) + 1)
    fit = LeastSquares(frame, overlap.new_parameter(u), SAMPLED_WEIGHT)
    change = fit.solve(sparse_rows(*spline.local_basis(u), spline.size))
    return overlap, frame.with_points(change @ control_points), change


def curvature_weighted_breaks(spline: BSpline, count: int, baseline: float, low: float, high: float) -> Array:
    """Place breaks (count + 1,) between the parameters low and high of a spline (paper: Simplification).

    They are equal quantiles of the density `(1 - b) |kappa| / integral |kappa| ds + b / length` along the
    curve, with the linear baseline b. An open curve is straight beyond its ends.
    """
    first, last = spline.domain
    u = np.linspace(low, high, 40 * count + 1)
    middle, even = 0.5 * (u[1:] + u[:-1]), np.hypot(*np.diff(spline.evaluate(u), axis=0).T)
    bent = np.minimum(np.abs(spline.curvature(middle)), 0.7) * even  # 1/m, or a kink attracts all knots
    if not spline.periodic:
        beyond = (middle < first) | (middle > last)
        bent[beyond], even[beyond] = 0.0, (u[1] - u[0]) * spline.length() / (last - first)
    share = even / even.sum()
    if bent.any():
        share = (1.0 - baseline) * bent / bent.sum() + baseline * share
    breaks = np.interp(np.linspace(0.0, 1.0, count + 1), np.append(0.0, np.cumsum(share)), u)
    breaks[[0, -1]] = low, high
    return breaks


def find_overlap(boundary: Boundary, control_points: Array) -> Overlap:
    """Find the overlap of a curve's end with its beginning; the seam is the foot point of the beginning.

    A gap between end and beginning is bridged by a straight line.
    """
    confirmed_end = boundary.confirmed_end
    late = max(confirmed_end - places.BEGINNING - JOIN_MARGIN, JOIN_SHARE * confirmed_end)
    ends = boundary.evaluate(control_points, np.array([0.0, confirmed_end]))
    foot = boundary.find(control_points, ends[:1], np.array([late]), np.array([confirmed_end]))
    if not foot.interior[0]:
        period = confirmed_end + float(np.hypot(*(ends[0] - ends[1])))
        return Overlap(period, np.array([period, period + 1.0]), np.array([0.0, 1.0]))
    seam = float(foot.u[0])
    u = np.linspace(seam, confirmed_end, max(int((confirmed_end - seam) / OVERLAP_STEP), 1) + 1)
    low, high = np.maximum(u - seam - OVERLAP_ROOM, 0.0), u - seam + OVERLAP_ROOM
    w = boundary.find(control_points, boundary.evaluate(control_points, u), low, high).u
    w = np.maximum.accumulate(w)
    w[0], beyond = 0.0, 2.0 * boundary.nominal[0]  # two knot intervals past the end go on alike
    return Overlap(seam, np.append(u, u[-1] + beyond), np.append(w, w[-1] + beyond))


# --- the filters -----------------------------------------------------------------------------------------

FILTER_REACH: Final = 9.0  # reach of a curve's end ahead of the vehicle (m along the predicted path)
SIGMA_TIE: Final = 0.15  # standard deviation of the distance between the ends of a curve at closure (m)
SIGMA_ALONG: Final = 0.4  # standard deviation of the place on the early segment, along the curves (m)


class _Filter(landmarks.OnlineBaseline):
    """Belief of both filters."""

    def _begin(self) -> None:
        # the priors of the sensor are wide: unlike a window, a filter cannot relinearize past errors
        odometry, sensor = self.settings.odometry, self.settings.calibration
        sigmas = np.array([*odometry.sigmas, *sensor.widened().sigmas])
        self.belief = Belief(np.zeros(POSE), np.diag(np.square(odometry.sigmas_start)), sigmas)
        known = self.settings.calibrations
        self.belief.mean[POSE : POSE + len(known)] = known

    def vehicle_state(self) -> VehicleState:
        mean, covariance = self.belief.mean, self.belief.covariance
        return VehicleState.split(mean[:POSE], mean[POSE:HEAD], covariance[:HEAD, :HEAD].copy())


class CkfMapper(_Filter):
    """Maps a track's two boundaries by a cubature Kalman filter over the pose and all control points."""

    READS: ClassVar = (*landmarks.FRONT_END, "ckf", "gauge")

    def _begin(self) -> None:
        super()._begin()
        self.state = CurveState(self.belief, self.settings)
        self.path = DrivenPath()
        self.expansion = Expansion(self.settings)
        self.closed = False
        self._recent: list[tuple[Array, Detections]] = []
        self._last_check = 0.0

    def _process(self, reading: Reading, watch: Stopwatch) -> CycleResult:
        state = self.state
        self.belief.follow(reading.motion)
        detections = self.belief.corrected(reading.detections)
        state.locate_vehicle()
        self.path.update(state.belief.pose.copy())
        self.path.steer(reading.motion.twists)
        watch.lap("predict")
        found = classify(state, detections)
        watch.lap("classify")
        if not self.closed:
            self.expansion.observe(state, detections)
            free = np.ones(len(detections.labels), bool)
            for on in found.values():
                free[on.rows] = False
            path_ahead = self.path.ahead(state.belief.pose, FILTER_REACH)
            if self.expansion.expand(state, detections, path_ahead, free):
                found = classify(state, detections)
        watch.lap("expand")
        update(state, detections, found)
        watch.lap("update")
        self._close(detections)
        watch.lap("close")
        left, right = (state.curves[label].size if label in state.curves else 0 for label in BOUNDARIES)
        used = sum(len(on.rows) for on in found.values())
        return CycleResult(
            detections.t, state.belief.pose.copy(), (left, right), used, self.closed, watch.laps
        )

    def _close(self, detections: Detections) -> None:
        """Search the early segment after the shortest lap; close and simplify both curves there."""
        settings, state = self.settings.closing, self.state
        if self.closed:
            return
        recent = [*self._recent, (state.belief.pose.copy(), detections)]
        self._recent = [cycle for cycle in recent if cycle[1].t > detections.t - 2.0]  # s
        too_soon = self.path.length - self._last_check < settings.check_interval
        if too_soon or not state.curves or not self.path.near_beginning(state.belief.pose, settings):
            return
        self._last_check = self.path.length
        motion = associate_early_segment(state, self._recent, self.path.beginning)
        if motion is not None and update_by_correspondences(state, motion):
            simplify(state, self.expansion.observed)
            self.closed = True

    def map(self, with_covariance: bool = True) -> Map:
        state, curves = self.state, {}
        for label in state.curves:
            covariance = state.covariance(label) if with_covariance else NO_COVARIANCE
            curves[label] = SplineBoundary(state.spline(label), covariance)
        joint = state.belief.covariance[HEAD:, HEAD:].copy() if with_covariance else None
        return Map(self.closed, curves, joint)


def associate_early_segment(
    state: CurveState, cycles: list[tuple[Array, Detections]], beginning: Array
) -> Array | None:
    """Find the motion (3,) of the newest detections onto the beginning of the curves; None if none is sure.

    The newest pose is tried at the poses (k, 3) of the beginning, too.
    """
    splines = {label: state.spline(label) for label in state.curves}
    ends = {label: spline.domain[1] for label, spline in splines.items()}
    poses, table = np.array([pose for pose, _ in cycles]), DetectionColumns.of([seen for _, seen in cycles])
    seen = places.Constellation.of(table, poses, state.settings.growth).seen_from(poses[-1])
    information = np.asarray(np.linalg.inv(state.belief.covariance[:POSE, :POSE]), np.float64)
    prior, _ = places.tried_along(beginning, places.Prior(poses[-1:], information))
    place = places.sure(places.find(seen, places.SampledCurves.of(splines, ends), prior))
    return None if place is None else se2.compose(place.pose, se2.inverse(poses[-1]))


def update_by_correspondences(state: CurveState, motion: Array) -> bool:
    """Update by the correspondences of the end of each curve and its beginning, in one Kalman update.

    `n . (S(u) - S(w)) = 0` with sigma `SIGMA_TIE`, where the motion moves S(u) onto S(w), with the normal n.
    Along the tangent all k correspondences are one result of the registration, so each has sqrt(k) times its
    sigma. Return False, without an update, if an end has not reached its beginning yet.
    """
    rows, columns = [], []
    for label in state.curves:
        spline = state.spline(label)
        high = spline.domain[1]
        u = np.arange(max(high - places.BEGINNING - JOIN_MARGIN, JOIN_SHARE * high), high, OVERLAP_STEP)
        zero = np.zeros(len(u))
        moved = se2.move_points(motion, spline.evaluate(u))
        foot = state.foot_points(label, moved, zero, zero + places.beginning_of(high))
        on = foot.interior & (np.abs(foot.distance) < 1.0)  # m
        if not on.any():
            return False
        u, w = u[on], foot.u[on]
        basis = spline.basis_matrix(u) - spline.basis_matrix(w)
        tangents = spline.tangent_unit(w)
        normals = se2.left_of(tangents)
        by_axis = [(basis[:, :, None] * axis[:, None, :]).reshape(len(u), -1) for axis in (normals, tangents)]
        rows.append(np.concatenate(by_axis))
        columns.append(state.columns(label, np.arange(spline.size)))
    matrix = block_diag(*rows)
    counts = [len(r) // 2 for r in rows]
    sigma = np.concatenate([np.repeat([SIGMA_TIE, SIGMA_ALONG * np.sqrt(k)], k) for k in counts])
    measured, noise = np.zeros(len(matrix)), np.diag(sigma**2)
    state.belief.update(np.concatenate(columns), lambda x: x @ matrix.T, measured, noise)
    return True


def simplify(state: CurveState, observed: Mapping[int, Mapping[int, Array]]) -> None:
    """Make both curves periodic, on curvature-weighted knots (paper: Simplification)."""
    settings = state.settings
    for label in state.curves:
        boundary = state.boundary(label)
        known = state.control_points(label)
        cones, zero = np.array([*observed[label].values()]).reshape(-1, POINT), np.zeros(len(observed[label]))
        foot = boundary.find(known, cones, zero, zero + boundary.confirmed_end)
        boundary.cone_parameters = np.sort(foot.u)
        overlap, curve, change = make_periodic(boundary, known, settings)
        state.replace(label, curve, change, 0.1)  # m, by which simplification moves a control point
        state.pose_u[label] = float(overlap.new_parameter(np.array([state.pose_u[label]]))[0])


class LandmarkCkf(_Filter):
    """Maps cones as points: predict, associate, update, create.

    The paper's baseline has "a similarly structured state and overall implementation style", with the
    Mahalanobis distance as the cost of the assignment (section Results). Our choices for the rest do not
    weaken it: the gates are those of the landmark graph, labels must agree, a track becomes a landmark after
    `ckf.sightings` detections, and the odometry is calibrated. Landmarks are never merged, and the loop never
    closes, so duplicates remain.
    """

    READS: ClassVar = (*landmarks.FRONT_END, "ckf")

    def _begin(self) -> None:
        super()._begin()
        self.labels: IntArray = np.zeros(0, np.intp)  # (n,) labels of the landmarks
        growth = self.settings.growth
        self.tentative = Tracks(growth.merge_radius, FORGET_AFTER)

    def _process(self, reading: Reading, watch: Stopwatch) -> CycleResult:
        self.belief.follow(reading.motion)
        detections = self.belief.corrected(reading.detections)
        watch.lap("predict")
        landmark, is_new = self._associate(detections)
        watch.lap("associate")
        rows = np.flatnonzero(landmark != landmarks.UNASSOCIATED)
        if len(rows):
            columns = self.belief.measuring_columns(point_columns(landmark[rows]))
            noise = block_diag(*detections.covariances[rows])
            measured = detections.points_vehicle[rows].ravel()
            self.belief.update(columns, self.belief.measuring(landmark[rows]), measured, noise)
        watch.lap("update")
        self._create(detections, is_new)
        watch.lap("create")
        pose, sizes = self.belief.pose.copy(), landmarks.landmark_counts(self.labels)
        return CycleResult(detections.t, pose, sizes, len(rows), False, watch.laps)

    def _associate(self, detections: Detections) -> tuple[IntArray, BoolArray]:
        points = se2.to_map(detections.points_vehicle, self.belief.pose[None])
        nearby = np.flatnonzero(nearest_within(self.belief.points, points, landmarks.ROUGH_GATE)[1])
        predicted, covariances = np.zeros((0, POINT)), np.zeros((0, POINT, POINT))
        if (k := len(nearby)) > 0:
            columns, belief = self.belief.measuring_columns(point_columns(nearby)), self.belief
            covariance = belief.covariance[np.ix_(columns, columns)]
            seen = transform(belief.measuring(nearby), belief.mean[columns], covariance)
            predicted = seen.mean.reshape(k, POINT)
            covariances = seen.covariance.reshape(k, POINT, k, POINT)[np.arange(k), :, np.arange(k)]
        cost = landmarks.pair_costs(detections.points_vehicle, detections.covariances, predicted, covariances)
        cost[~landmarks.compatible(detections.labels, self.labels[nearby])] = np.inf
        column, is_new = landmarks.assign(cost)
        matched = column != landmarks.UNASSOCIATED
        landmark = np.full(len(detections.labels), landmarks.UNASSOCIATED, np.intp)
        landmark[matched] = nearby[column[matched]]
        return landmark, is_new

    def _create(self, detections: Detections, new: BoolArray) -> None:
        """Add a landmark for each track that has enough detections beyond the gate of every landmark."""
        points, covariances = in_map(detections, self.belief.pose)
        rows, tracks, least = np.flatnonzero(new), self.tentative, self.settings.ckf.sightings
        numbers = tracks.add(points[rows], covariances[rows], detections.labels[rows], detections.t)
        confirmed = np.concatenate([tracks.confirmed(label, least) for label in BOUNDARIES])
        own, first = np.unique(numbers, return_index=True)
        rows = rows[first[np.isin(own, tracks.numbers[confirmed])]]
        tracks.remove(confirmed)
        if len(rows):
            self.belief.add_points(detections.points_vehicle[rows], detections.covariances[rows])
            self.labels = np.concatenate([self.labels, detections.labels[rows]])

    def map(self, with_covariance: bool = True) -> Map:
        joint = self.belief.covariance[HEAD:, HEAD:] if with_covariance else None
        return landmarks.point_map(self.belief.points, self.labels, joint, False)
