"""The change of an open curve whose end overlaps its beginning to a periodic one (paper: Simplification)."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.settings.batch import Knots
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, refit, thin

from .registration import BEGINNING

EXTRAPOLATED: Final = 2  # knot intervals past the confirmed end that are mapped to the closed curve
JOIN_MARGIN: Final = 10.0  # length before the end of a curve, and `BEGINNING`, in which the seam lies (m)
JOIN_SHARE: Final = 0.5  # share of a short curve past which the seam lies
OVERLAP_STEP: Final = 1.0  # step at which points of the overlap are placed on the beginning (m)
OVERLAP_ROOM: Final = 4.0  # room about its expected place in which a point of the overlap is searched (m)
SEAM_MARGIN: Final = 0.5  # distance from the seam below which a cone is one of the beginning (m)


@dataclass(frozen=True, eq=False)
class Overlap:
    """The correspondence between a curve's end and its beginning."""

    period: float  # length of the closed curve in the open curve's parameter (m)
    u: Array  # (k,) increasing parameters of the open curve's end, from the seam on
    w: Array  # (k,) parameters of the same places on the beginning, from 0 on

    def new_parameter(self, u: Array) -> Array:
        """Map parameters of the open curve to those of the closed one, which are not wrapped."""
        return np.where(u < self.u[0], u, self.period + np.interp(u, self.u, self.w))


@dataclass(frozen=True, eq=False)
class PeriodicCurve:
    """The periodic curve that replaces an open one."""

    overlap: Overlap
    knots: Array  # (m + 2 p + 1,) periodic knots
    points: Array  # (m, 2) control points in m, map frame
    old_from_new: Array  # (n, m) matrix E of the change of variables: `C_old = E C_new`


def make_periodic(
    boundary: Boundary, control_points: Array, settings: MapperSettings, knots: Knots
) -> PeriodicCurve:
    """Return the periodic curve that is nearest to an open one with control points (n, 2).

    Its number of control points is a share of that of its cones, which lie at their parameters on the curve.
    """
    spline, overlap = boundary.spline(control_points), find_overlap(boundary, control_points)
    period, u = overlap.period, boundary.cone_parameters
    u = _apart(u[u < period - SEAM_MARGIN], settings.growth.merge_radius)
    size = max(settings.spline.min_size, int(settings.spline.size_share * len(u)))
    if knots == "curvature" or size >= len(u):
        breaks = curvature_weighted_breaks(spline, size, settings.spline.linear_baseline, 0.0, period)
    else:
        cones = boundary.evaluate(control_points, u)
        *_, thinned = thin(cones, u, period, True, boundary.degree, size)
        breaks = thinned.breaks
    frame = BSpline.periodic_from(breaks, np.zeros((len(breaks) - 1, 2)), boundary.degree)
    change = refit(spline, frame, overlap.new_parameter)
    return PeriodicCurve(overlap, frame.knots, change.new_from_old @ control_points, change.old_from_new)


def _apart(values: Array, distance: float) -> Array:
    """Return those of the sorted values (k,) that exceed the last returned one by more than `distance`."""
    kept: list[float] = []
    for value in values.tolist():
        if not kept or value - kept[-1] > distance:
            kept.append(value)
    return np.array(kept)


def find_overlap(boundary: Boundary, control_points: Array) -> Overlap:
    """Find the overlap of a curve's end and beginning; the seam is the beginning's foot point on the end.

    If the end does not reach the beginning, the gap between them counts as straight.
    """
    confirmed_end = boundary.confirmed_end
    late = max(confirmed_end - BEGINNING - JOIN_MARGIN, JOIN_SHARE * confirmed_end)
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
    w[0], beyond = 0.0, EXTRAPOLATED * boundary.nominal[0]
    return Overlap(seam, np.append(u, u[-1] + beyond), np.append(w, w[-1] + beyond))
