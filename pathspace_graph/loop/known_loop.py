"""The closed map prepared for comparison with detections, and the evidence of detections on the estimate."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.copies import Copyable
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials
from pathspace_graph.front_end.front_end import Reading
from pathspace_graph.graph.gaussian import half_solve
from pathspace_graph.graph.variables import POSE
from pathspace_graph.health import SHARE_DEGRADED, Evidence
from pathspace_graph.io.map import NO_CONES
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.mapping.smoother import CurveSmoother, Gating
from pathspace_graph.mapping.state import SAMPLE

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
