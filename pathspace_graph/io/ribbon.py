"""A map of one centre line with a width, made of any map of two boundaries."""

from dataclasses import replace

import numpy as np

from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.spline.centre_line import Ribbon, find_line

from .map import NO_COVARIANCE, Map, SplineBoundary


def as_ribbon(track: Map, sigma_shape: float) -> Map:
    """Replace the boundaries of a map by the edges of its ribbon; SettingsError where none fits.

    `sigma_shape` (m) is what a ribbon cannot follow, one sigma, added to each control point of its edges.
    """
    ribbon, covariance, until = ribbon_of(track)
    return replace(map_of(ribbon, covariance, sigma_shape, until), points=track.points)


def ribbon_of(track: Map) -> tuple[Ribbon, Array | None, dict[int, float]]:
    """Fit the ribbon between the boundaries of a map; SettingsError where none fits.

    With it come its covariance (3m, 3m), if known, and the parameter up to which each open edge is confirmed.
    """
    curves = {label: track.curve(label, "a centre line") for label in BOUNDARIES}
    P = track.covariance_of(*curves.values())
    left, right = (curve.spline for curve in curves.values())
    line, until = find_line(left, right), {}
    for side, (label, curve) in enumerate(curves.items()):
        if not left.periodic:
            end = np.array([min(curve.confirmed_until, curve.spline.domain[1])])
            until[label] = float(line.ribbon_parameters(side, end)[0])
    return line.ribbon, None if P is None else line.by_boundaries @ P @ line.by_boundaries.T, until


def map_of(ribbon: Ribbon, covariance: Array | None, sigma_shape: float, until: dict[int, float]) -> Map:
    """Build the map of the edges of a ribbon, with the covariance (3m, 3m) of its control points, if known.

    `sigma_shape` (m) is added to each control point. Open edges are confirmed up to the parameters `until`.
    """
    edges, joint, at = {label: ribbon.edge_spline(label) for label in BOUNDARIES}, None, 0
    if covariance is not None:
        by_ribbon = np.concatenate([jacobian for _, jacobian in edges.values()])
        joint = by_ribbon @ covariance @ by_ribbon.T
        joint = 0.5 * (joint + joint.T) + sigma_shape**2 * np.eye(len(joint))
    boundaries = {}
    for label, (spline, jacobian) in edges.items():
        block = slice(at, at := at + len(jacobian))
        own = NO_COVARIANCE if joint is None else joint[block, block].copy()
        boundaries[label] = SplineBoundary(spline, own, until.get(label, spline.domain[1]))
    return Map(ribbon.periodic, boundaries, joint)
