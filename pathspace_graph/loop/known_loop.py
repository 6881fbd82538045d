"""The closed map compared with detections: their evidence on the estimate, and repair."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.batch.simplification import fit_through
from pathspace_graph.batch.start import StartMap
from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.factors.se2 import path_lengths, to_map, to_vehicle
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.front_end.sides import ROW_GAP
from pathspace_graph.graph.gaussian import half_solve
from pathspace_graph.graph.smoother import place_again
from pathspace_graph.graph.variables import POSE
from pathspace_graph.health import SHARE_DEGRADED, Evidence
from pathspace_graph.io.map import NO_CONES
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT
from pathspace_graph.loop.closing import SIGMA_STEP
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.path import along_and_across
from pathspace_graph.mapping.smoother import CurveSmoother, Gating
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.mapping.tracks import Tracks, linked
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import ahead_of, sampled
from pathspace_graph.spline.bspline import BSpline

BESIDE_CURVE: Final = 1.0  # distance from the closed curve within which an unused detection is explained (m)
GAP_RATIO: Final = 3.0  # least distance of neighbouring cones beside a gap, over the median distance
_POSITION: Final = np.asfortranarray(np.eye(POSE)[:, :2])  # unit vectors of a pose's position


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed map, sampled for comparison with detections."""

    curves: Mapping[int, KDTree]  # densely sampled points of each boundary
    mapped: Mapping[int, BoolArray]  # whether each of these points is between mapped cones (`is_mapped`)
    begins: Mapping[int, float]  # parameter of the first point (m)

    def distances(self, labels: IntArray, points: Array, most: float) -> Array:
        """Return distances (..., m) in m of points (..., m, 2) from their labels' curves, up to `most`."""
        found = np.full(points.shape[:-1], most)
        for label, curve in self.curves.items():
            of_label = labels == label
            distance, _ = curve.query(points[..., of_label, :], distance_upper_bound=most)
            found[..., of_label] = np.minimum(distance, most)
        return found

    def with_gaps(self) -> list[int]:
        """Return the boundaries whose curves have gaps."""
        return [label for label, mapped in self.mapped.items() if not mapped.all()]

    def is_mapped(self, label: int, u: Array) -> BoolArray:
        """Whether parameters (m,) of a boundary are between mapped cones, to the nearest sample."""
        nearest = np.rint((u - self.begins[label]) / SAMPLE).astype(np.intp)
        return self.mapped[label].take(nearest, mode="wrap")

    def beside_gaps(self, labels: IntArray, points: Array) -> BoolArray:
        """Whether points (m, 2) are nearest to a gap of the curve of their label (m,)."""
        found = np.zeros(len(points), bool)
        for label, curve in self.curves.items():
            of_label = np.flatnonzero(labels == label)
            if len(of_label):
                found[of_label] = ~self.mapped[label][curve.query(points[of_label])[1]]
        return found

    def compared(self, labels: IntArray, points: Array) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Whether points (m, 2) with labels (m,) lie on their curve, beside a gap of it, and are evidence.

        A point only on the curve of the other colour is no evidence.
        """
        on_curve = self.distances(labels, points, BESIDE_CURVE) < BESIDE_CURVE
        beside_gap = ~on_curve & self.beside_gaps(labels, points)
        on_other = self.distances(LEFT + RIGHT - labels, points, BESIDE_CURVE) < BESIDE_CURVE
        return on_curve, beside_gap, on_curve | ~on_other


def is_mapped(u: Array, cones: Array, length: float, gap: float, margin: float) -> BoolArray:
    """Whether parameters (m,) of a closed curve are between neighbouring cones at parameters (k,), in m.

    A gap is longer than `gap` times the median distance of neighbours; the `margin` (m) at its ends counts as
    mapped. Without known cones, all of the curve does.
    """
    if len(cones) < 2:
        return np.ones(len(u), bool)
    places = np.unique(np.mod(cones, length))
    steps = np.diff(places, append=places[0] + length)
    before = np.searchsorted(places, np.mod(u, length)) - 1
    past = np.mod(u - places[before], length)
    near_end = np.minimum(past, steps[before] - past) < margin
    return np.asarray(near_end | (steps <= gap * np.median(steps))[before])


class KnownLoop(Copyable):
    """Cache of the sampled loop, renewed when the curves are replaced."""

    def __init__(self) -> None:
        self._laid_out: tuple[list[SpanPolynomials], Loop] | None = None

    def of(self, smoother: CurveSmoother) -> Loop:
        """Return the loop, sampled at the first call for its curves; no variable changes."""
        state = smoother.map.state
        tables = [boundary.tables for boundary in state.boundaries.values()]
        if self._laid_out is None or self._laid_out[0] != tables:
            values = state.variables.values.copy()
            smoother.refresh()
            curves, mapped, begins = {}, {}, {}
            margin = smoother.map.settings.growth.merge_radius
            for label, boundary in state.boundaries.items():
                u = np.arange(boundary.tables.low, boundary.tables.high, SAMPLE)
                curves[label] = KDTree(boundary.evaluate(state.control_points(label), u))
                begins[label] = boundary.tables.low
                cones = smoother.map.cones.get(label, NO_CONES)[:, 0]
                mapped[label] = is_mapped(u, cones, boundary.length, GAP_RATIO, margin)
            self._laid_out = tables, Loop(curves, mapped, begins)
            state.variables.values[:] = values
        return self._laid_out[1]


def evidence_of(
    smoother: CurveSmoother, tested: Gating | None, known: KnownLoop | None, reading: Reading
) -> Evidence:
    """Return the evidence of the tested detections on the newest pose, before the update.

    On a closed map every coloured detection should lie on a curve. If many are not in use, and the loop is
    `known`, they are searched on their whole curve: they may show a stretch across the infield. Three kinds
    of unused detections are no evidence: those not seen again, those on the curve of the other colour, and
    those beside a gap of the map.
    """
    motion, seen_again = reading.motion, reading.seen_again
    if tested is None:
        return Evidence(reading.detections.t, rests=motion.rests, odometry=motion.fault)
    detections, closed = smoother.map.detections, smoother.map.state.closed
    labels, used = detections.label[tested.rows], detections.used[tested.rows]
    again = seen_again[tested.rows - (len(detections) - len(seen_again))]
    judged = used | ((tested.in_view | closed) & again)
    explained, unmapped = used.copy(), np.zeros(len(used), bool)
    if known is not None and used.sum() < SHARE_DEGRADED * judged.sum():
        others = np.flatnonzero(judged & ~used)
        points = detections.points_map(tested.rows[others], smoother.variables)
        on_curve, beside_gap, says = known.of(smoother).compared(labels[others], points)
        explained[others], unmapped[others], judged[others] = on_curve, beside_gap & says, says
    offered = judged & ~unmapped
    return Evidence(
        t=reading.detections.t,
        offered=int(offered.sum()),
        explained=int(explained.sum()),
        used=int(used.sum()),
        innovations=float(tested.innovation[used] @ tested.innovation[used]),
        closed=closed,
        sigma=_sigma_of_position(smoother) if closed else np.nan,
        offered_by=_by_boundary(labels[offered]),
        explained_by=_by_boundary(labels[explained]),
        unmapped=_by_boundary(labels[unmapped]),
        rests=motion.rests,
        odometry=motion.fault,
    )


def _sigma_of_position(smoother: CurveSmoother) -> float:
    """Return the standard deviation (m) of the newest position in its worst direction, at the last step."""
    last = smoother.last_step
    if last is None:
        return np.nan
    half = half_solve(last.factor[-POSE:, -POSE:], _POSITION.copy())  # the newest pose is last
    (a, b), (_, d) = (half.T @ half).tolist()
    return sqrt(0.5 * (a + d) + hypot(0.5 * (a - d), b))


def _by_boundary(labels: IntArray) -> tuple[int, int]:
    left, right = np.bincount(labels, minlength=len(BOUNDARIES)).tolist()
    return left, right


# --- repair -------------------------------------------------------------------------------------------------


REPAIRED: Final = "the map was repaired"  # beginning of the notice of a repair
SIGHTINGS: Final = 6  # least number of detections of a contradiction; clutter has 1, a passed cone 20
REPAIR_MEMORY: Final = 30.0  # time without a detection after which a contradiction is forgotten (s)
CONES: Final = 3  # least number of contradictions of a repaired stretch
REPAIR_BESIDE: Final = 0.5  # distance from a curve within which a cone does not contradict it (m)
CERTAIN: Final = 1.0  # largest sigma of a detection that may contradict the map (m)
SETTLE: Final = 1.5  # time without detections after which a cone counts as passed (s)
MOST: Final = 20  # number of passed contradictions from which a stretch is repaired before its end
REPAIR_INTERVAL: Final = 1.0  # time between searches for contradictions (s)
REPAIRS: Final = 8  # largest number of attempts
REPLACED: Final = 0.5  # prior standard deviation of moved control points of a known map (m)
BEND: Final = 0.1  # weight of the second differences of their moves
LEFT_OUT: Final = 2.0  # distance from a repaired curve beyond which a cone of the earlier curve is lost (m)
EXPLAINED: Final = 0.5  # least share of the contradictions that a repaired map must explain


@dataclass(frozen=True, eq=False)
class ContradictedStretch:
    """Row of cones of a boundary's colour that are not on its curve."""

    label: int
    cones: Array  # (k, 2) positions in m, map frame, unordered


class MapRepair(Copyable):
    """The cones that contradict a closed map, and attempts to repair it."""

    def __init__(self, settings: MapperSettings) -> None:
        self.tracks = Tracks(settings.growth.merge_radius, REPAIR_MEMORY)
        """Cones that no curve of the map explains."""
        self._stretches: list[ContradictedStretch] = []
        self._lap: Array = np.zeros((0, 3))  # poses of the newest lap at the start of the attempt
        self._mapped = dict[int, Array]()  # cones (k, 2) on each curve at the start of the attempt
        self._asked = -np.inf
        self._wait_until = 0.0
        self._attempts = 0

    def observe(self, track: CurveMap, loop: Loop, new: slice, t: float) -> None:
        """Add the new coloured detections at t (s) that are unused, or used in a gap of their curve."""
        detections, rows = track.detections, np.arange(new.start, new.stop)
        unexplained = ~detections.used[new]
        for label in loop.with_gaps():
            on = np.flatnonzero(detections.used[new] & (detections.boundary[new] == label))
            if len(on):
                unexplained[on] = ~loop.is_mapped(label, detections.u[rows[on]])
        rows = rows[unexplained]
        if len(rows):
            covariances = detections.covariances_map(rows, track.variables)
            certain = np.linalg.eigvalsh(covariances)[:, -1] < CERTAIN**2
            rows, covariances = rows[certain], covariances[certain]
            points = detections.points_map(rows, track.variables)
            self.tracks.add(points, covariances, detections.label[rows], t)

    def stretches(self, loop: Loop, t: float) -> list[ContradictedStretch]:
        """Return the stretches whose cones contradict the loop or are in a gap, once all cones are passed.

        A long stretch is complete with `MOST` passed cones.
        """
        found, tracks = list[ContradictedStretch](), self.tracks
        for label in BOUNDARIES:
            chosen = tracks.confirmed(label, SIGHTINGS)
            if len(chosen) < CONES:
                continue
            away = {
                b: curve.query(tracks.points[chosen])[0] > REPAIR_BESIDE for b, curve in loop.curves.items()
            }
            in_gap = loop.beside_gaps(np.full(len(chosen), label), tracks.points[chosen])
            chosen = chosen[(away[label] | in_gap) & away[LEFT + RIGHT - label]]
            chosen = chosen[tracks.undisputed(chosen, label)]
            if len(chosen) < CONES:
                continue
            points, passed = tracks.points[chosen], tracks.last_t[chosen] < t - SETTLE
            for row in (row for row in linked(points, ROW_GAP) if len(row) >= CONES):
                if not passed[row].all() and passed[row].sum() < MOST:
                    return []
                found.append(ContradictedStretch(label, points[row[passed[row]]]))
        return found

    def is_due(self, known: KnownLoop, smoother: CurveSmoother, t: float, driven: float) -> bool:
        """Whether a repair is due at t (s), after a path of length `driven` (m)."""
        if t < self._asked + REPAIR_INTERVAL or driven < self._wait_until or self._attempts >= REPAIRS:
            return False
        loop, self._asked = known.of(smoother), t
        self._stretches = self.stretches(loop, t)
        if self._stretches:
            longest = max(boundary.length for boundary in smoother.map.state.boundaries.values())
            self._attempts, self._wait_until = self._attempts + 1, driven + longest
        return bool(self._stretches)

    def begin(self, smoother: CurveSmoother, poses: Array) -> StartMap:
        """Return the initial map of the batch, with the poses (P, 3) of all cycles."""
        smoother.refresh()
        track, state = smoother.map, smoother.map.state
        longest = max(boundary.length for boundary in state.boundaries.values())
        self._lap = poses[lap_begin(poses, longest) :]
        self._mapped = {label: mapped_cones(track, label) for label in state.boundaries}
        splines = {label: refitted(track, label, self._stretches, poses) for label in state.boundaries}
        return StartMap(splines, poses, state.variables.calibrations.copy())

    def in_place(self, smoother: CurveSmoother) -> str:
        """Refit the curves of a known map through the contradicting cones; return the notice.

        The prior of the control points there is dropped. No batch can replace the map, since the drive has
        not covered it.
        """
        stretches, self._stretches = self._stretches, []
        smoother.refresh()
        replaced = [stretch for stretch in stretches if replace_stretch(smoother, stretch)]
        self.tracks.clear()
        if not replaced:
            return ""
        smoother.reassociate()
        for _ in range(smoother.map.settings.closing.iterations):
            smoother.step(SIGMA_STEP)
        self._wait_until = 0.0
        names = [NAMES[label] for label in BOUNDARIES if any(one.label == label for one in replaced)]
        count = sum(len(stretch.cones) for stretch in replaced)
        return f"{REPAIRED}: it passes through {count} other cones on the {' and on the '.join(names)}"

    def end(self, marginal: LapMarginal | None) -> str:
        """End an attempt; return its notice, which is empty if the batch does not repair the map.

        It must explain half of the contradictions, and no fewer cones than it takes from the curves.
        """
        stretches, self._stretches = self._stretches, []
        if marginal is None:
            return ""
        now, explained = marginal.poses[len(marginal.poses) - len(self._lap) :], [0, 0]
        curves = {label: KDTree(sampled(spline, SAMPLE)) for label, spline in marginal.splines.items()}

        def distances(label: int, cones: Array) -> Array:
            return np.asarray(curves[label].query(carried(cones, self._lap, now))[0])

        for stretch in stretches:
            near = distances(stretch.label, stretch.cones) < REPAIR_BESIDE
            explained[stretch.label] += int(np.count_nonzero(near))
        lost = sum(int(np.sum(distances(label, old) > LEFT_OUT)) for label, old in self._mapped.items())
        if sum(explained) < max(EXPLAINED * sum(len(stretch.cones) for stretch in stretches), lost):
            return ""
        self._wait_until = 0.0
        self.tracks.clear()
        names = [NAMES[label] for label in BOUNDARIES if explained[label]]
        return f"{REPAIRED}: {sum(explained)} more cones on the {' and on the '.join(names)} lie on it"


def replace_stretch(smoother: CurveSmoother, stretch: ContradictedStretch) -> bool:
    """Refit a closed curve through the cones of a stretch, on its own knots; return whether they fit.

    The moved control points get a wide prior, and the cones there lose their stations.
    """
    state, label, cones = smoother.map.state, stretch.label, stretch.cones
    boundary, points = state.boundaries[label], state.control_points(label)
    u = boundary.find_anywhere(points, cones).u
    middle = np.angle(np.exp(2j * np.pi * u / boundary.length).mean()) * boundary.length / (2.0 * np.pi)
    within = ahead_of(middle, u, boundary.length)
    low, high = within.min() - ROW_GAP, within.max() + ROW_GAP

    def is_there(at: Array) -> BoolArray:
        beyond = ahead_of(middle, at, boundary.length)
        return np.asarray((beyond > low) & (beyond < high))

    tables = boundary.tables
    moved, every = np.flatnonzero(is_there(boundary.abscissae)), np.arange(tables.low, tables.high, SAMPLE)
    held = every[~is_there(every)]
    at, targets = np.append(u, held), np.concatenate([cones, boundary.evaluate(points, held)])
    basis = boundary.basis(at)[:, moved]
    bend = BEND * np.diff(np.eye(len(moved)), 2, axis=0)
    off = np.concatenate([targets - boundary.evaluate(points, at), np.zeros((len(bend), 2))])
    change = np.linalg.lstsq(np.concatenate([basis, bend]), off, rcond=None)[0]
    left = np.hypot(*(off[: len(u)] - basis[: len(u)] @ change).T)
    if np.count_nonzero(left < REPAIR_BESIDE) < EXPLAINED * len(u):
        return False
    place_again(smoother, state.control_keys(label)[moved], points[moved] + change, REPLACED)
    smoother.map.forget_cones(label, is_there)
    return True


def carried(points: Array, before: Array, after: Array) -> Array:
    """Move points (k, 2) rigidly with the nearest pose, from `before` to `after` (n, 3)."""
    nearest = KDTree(before[:, :2]).query(points)[1]
    return to_map(to_vehicle(points, before[nearest]), after[nearest])


def refitted(track: CurveMap, label: int, stretches: list[ContradictedStretch], poses: Array) -> BSpline:
    """Fit the closed curve of a boundary through its cones, with those of the stretches replaced.

    The cones are ordered by the newest lap of the poses (P, 3).
    """
    state, settings = track.state, track.settings
    chosen = [stretch for stretch in stretches if stretch.label == label]
    if not chosen:
        return state.spline(label)
    cones = mapped_cones(track, label)
    lap, stations = newest_lap(poses, state.boundaries[label].length)
    at = along_and_across(cones, lap, stations)[0]
    for stretch in chosen:
        new_at = along_and_across(stretch.cones, lap, stations)[0]
        kept = ~_is_replaced(cones, at, stretch.cones, new_at, settings)
        cones, at = np.concatenate([cones[kept], stretch.cones]), np.append(at[kept], new_at)
    if len(cones) < settings.spline.min_size:
        return state.spline(label)
    return fit_through(cones[np.argsort(at)], True, settings, settings.batch.dense_share)[0]


def mapped_cones(track: CurveMap, label: int) -> Array:
    """Return the cones (k, 2) on the curve of a boundary, or points at regular distances on a line."""
    boundary, spacing = track.state.boundaries[label], track.settings.spline.spacing
    u = track.cones.get(label, NO_CONES)[:, 0]
    if len(u) == 0:
        u = np.arange(boundary.tables.low, boundary.tables.high, spacing)
    return boundary.evaluate(track.state.control_points(label), u)


def newest_lap(poses: Array, length: float) -> tuple[Array, Array]:
    """Return positions (n, 2) and stations (n,) of the newest lap; the last position repeats the first."""
    first = lap_begin(poses, length)
    lap = np.concatenate([poses[first:, :2], poses[first : first + 1, :2]])
    return lap, path_lengths(lap)


def lap_begin(poses: Array, length: float) -> int:
    """Return the index of the pose (P, 3) nearest to the newest one, about a lap (m) earlier."""
    driven = path_lengths(poses)
    before = np.flatnonzero(np.abs(driven[-1] - driven - length) < 0.5 * length)
    away = np.hypot(*(poses[before, :2] - poses[-1, :2]).T)
    return int(before[away.argmin()]) if len(before) else 0


def _is_replaced(cones: Array, at: Array, row: Array, row_at: Array, settings: MapperSettings) -> BoolArray:
    """Whether cones (k, 2) at stations (k,) coincide with a row (r, 2), or lie beside it.

    A row that leads across the neck of a hairpin does not replace the cones of the hairpin.
    """
    order, beside = np.argsort(row_at), REPAIR_BESIDE
    away = np.abs(along_and_across(cones, row[order], row_at[order])[1])
    ends = np.sort(np.concatenate([[-np.inf], row_at - beside, row_at + beside, [np.inf]]))
    after = ends.searchsorted(at)
    within = (
        ends[after] - ends[after - 1] < 2.0 * ROW_GAP
    )  # along the drive: less on the inner side of a bend
    same = KDTree(row).query(cones)[0] < settings.growth.merge_radius
    return np.asarray(same | (within & (away > beside)))
