"""The periodic curve that replaces an open one when the filter's loop closes (paper: Simplification)."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.batch.association import LINE_STEP
from pathspace_graph.factors.arrays import Array
from pathspace_graph.places.constellation import BEGINNING
from pathspace_graph.settings.mapper import Knots, MapperSettings
from pathspace_graph.spline.boundary import Boundary
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.knots import curvature_weighted_breaks, refit, thin

EXTRAPOLATED: Final = 2  # knot intervals past the confirmed end that map to the closed curve
JOIN_MARGIN: Final = 10.0  # with `BEGINNING`, largest distance of the seam from the end of a curve (m)
JOIN_SHARE: Final = 0.5  # least parameter of the seam on a short curve, as a share of its length
OVERLAP_STEP: Final = 1.0  # step of the points of the overlap (m)
OVERLAP_ROOM: Final = 4.0  # search range of their foot points on the beginning, about the expected ones (m)
SEAM_MARGIN: Final = 0.5  # distance before the seam within which a cone belongs to the beginning (m)


@dataclass(frozen=True, eq=False)
class Overlap:
    """The correspondence between a curve's end and its beginning."""

    period: float  # length of the closed curve in the open curve's parameter (m)
    u: Array  # (k,) increasing parameters of the open curve's end, from the seam on
    w: Array  # (k,) parameters of the corresponding points on the beginning, from 0 on

    def new_parameter(self, u: Array) -> Array:
        """Map parameters of the open curve to those of the closed one, without wrapping."""
        return np.where(u < self.u[0], u, self.period + np.interp(u, self.u, self.w))


@dataclass(frozen=True, eq=False)
class PeriodicCurve:
    """The periodic curve that replaces an open one."""

    overlap: Overlap
    knots: Array  # (m + 2 p + 1,) periodic knots
    points: Array  # (m, 2) control points in m, map frame
    old_from_new: Array  # (n, m) matrix E of the change of variables: `C_old = E C_new`


def make_periodic(
    boundary: Boundary,
    control_points: Array,
    settings: MapperSettings,
    knots: Knots,
) -> PeriodicCurve:
    """Fit a periodic curve to an open one with control points (n, 2).

    The number of its control points is a share of the number of cones, or of equivalent places on a line.
    """
    spline, overlap = boundary.spline(control_points), find_overlap(boundary, control_points)
    period, u = overlap.period, boundary.cone_parameters
    u = np.arange(0.0, period, LINE_STEP) if settings.of_lines else u
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
    """Thin sorted values (k,) so that successive ones differ by more than `distance`."""
    kept: list[float] = []
    for value in values.tolist():
        if not kept or value - kept[-1] > distance:
            kept.append(value)
    return np.array(kept)


def find_overlap(boundary: Boundary, control_points: Array) -> Overlap:
    """Find the overlap of a curve's end with its beginning; the seam is the foot point of the beginning.

    A gap between end and beginning is bridged by a straight line.
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
