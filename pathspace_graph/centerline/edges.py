"""Between boundaries and a ribbon: the map of its edges, and the ribbon that boundaries tell of."""

from dataclasses import dataclass

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary, joint_covariance
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import find_line
from pathspace_graph.spline.ribbon import Ribbon


def map_of(ribbon: Ribbon, covariance: Array | None, sigma_shape: float, until: dict[int, float]) -> Map:
    """Returns the edges of a ribbon as a map, with the covariance (3m, 3m) of its control points, if known.

    `sigma_shape` (m) is added to each control point: what the edges cannot follow of the cones. `until` has
    the parameter up to which an edge is confirmed, where it is open.
    """
    edges = {label: ribbon.edge_spline(label) for label in BOUNDARIES}
    if covariance is None:
        none = {b: _boundary(spline, NO_COVARIANCE, until.get(b)) for b, (spline, _) in edges.items()}
        return Map(ribbon.periodic, none)
    by_ribbon = np.concatenate([jacobian for _, jacobian in edges.values()])
    joint = by_ribbon @ covariance @ by_ribbon.T
    joint = 0.5 * (joint + joint.T)
    boundaries, at = {}, 0
    for label, (spline, jacobian) in edges.items():
        block = slice(at, at := at + len(jacobian))
        own = joint[block, block] + sigma_shape**2 * np.eye(len(jacobian))
        boundaries[label] = _boundary(spline, own, until.get(label))
    return Map(ribbon.periodic, boundaries, joint_covariance(joint, boundaries))


def _boundary(spline: BSpline, covariance: Array, until: float | None) -> SplineBoundary:
    return SplineBoundary(spline, covariance, spline.domain[1] if until is None else until)


@dataclass(frozen=True, eq=False)
class FittedRibbon:
    """A ribbon that was fitted to the boundaries of a map."""

    ribbon: Ribbon
    covariance: Array | None
    """Covariance (3m, 3m) of its control points; None where that of the map is not known."""
    until: dict[int, float]
    """Parameter up to which an open edge is confirmed, by label."""


def ribbon_of(track: Map, settings: MapperSettings) -> FittedRibbon:
    """Return the ribbon between the boundaries of a map, with the covariance that follows from theirs.

    SettingsError is raised where the map has no two boundaries side by side.
    """
    curves = {label: track.curve(label, "a centre line") for label in BOUNDARIES}
    P = track.covariance_of(*curves.values())
    left, right = (curve.spline for curve in curves.values())
    line = find_line(left, right, left.periodic, settings.centerline.spacing)
    covariance = None if P is None else line.by_boundaries @ P @ line.by_boundaries.T
    until = {
        label: float(
            line.ribbon_parameters(side, np.array([min(curve.confirmed_until, curve.spline.domain[1])]))[0]
        )
        for side, (label, curve) in enumerate(curves.items())
        if not left.periodic
    }
    return FittedRibbon(line.ribbon, covariance, until)
