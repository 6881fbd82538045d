"""Between boundaries and a ribbon: the map of its edges, and the ribbon that boundaries tell of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pathspace_graph.factors.footpoint import refine_foot_points
from pathspace_graph.factors.gauge import greville
from pathspace_graph.factors.ribbon import RIBBON, beyond_edge
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary, joint_covariance
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.ribbon import DEGREE, SIDE, Ribbon, along_ribbon, ribbon_between

Array = NDArray[np.float64]

LOOSE = 100.0
"""Second differences of the line have this standard deviation, as a share of the spacing. The boundaries have
their own prior on them, which must not count twice."""
SHARE = 0.5
"""Points that measure an edge are this share of the ribbon's knot interval apart."""
ITERATIONS = 4
"""A ribbon is fitted to boundaries by this number of Gauss-Newton steps."""


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
    """Holds a ribbon that was fitted to the boundaries of a map."""

    ribbon: Ribbon
    """This is the ribbon."""
    covariance: Array | None
    """This is the covariance (3m, 3m) of its control points; None where that of the map is not known."""
    until: dict[int, float]
    """Each edge is confirmed up to this parameter."""


def ribbon_of(track: Map, settings: MapperSettings) -> FittedRibbon:
    """Returns the ribbon nearest to the boundaries of a map, with the covariance that follows from theirs.

    Points of the boundaries, evenly spaced, are measurements with the residual of `beyond_edge`, all with the
    standard deviation `centerline.sigma_edge`, that of what an edge cannot follow. To weigh them by the
    covariance of the boundaries would be right if a ribbon could follow these exactly. As it can't, misfits
    of centimetres would turn and shift an open map, which is known to metres as a whole, and to millimetres
    in its shape. SettingsError is raised where the map has no two boundaries side by side.
    """
    curves = {label: track.curve(label, "a centre line") for label in BOUNDARIES}
    P = track.covariance_of(*curves.values())
    left, right = (curve.spline for curve in curves.values())
    ribbon, *tables = ribbon_between(left, right, left.periodic, settings.centerline.spacing)
    measured = [
        _Edge(spline, SIDE[label], table, ribbon)
        for label, spline, table in zip(BOUNDARIES, (left, right), tables, strict=True)
    ]
    sigma = settings.centerline.sigma_edge
    for _ in range(ITERATIONS):
        rows = [edge.rows(ribbon) for edge in measured]
        residual, by_ribbon = (np.concatenate([row[k] for row in rows]) / sigma for k in range(2))
        D, e = _shape_rows(ribbon, settings)
        inverse = np.linalg.inv(by_ribbon.T @ by_ribbon + D.T @ D)
        change = inverse @ (by_ribbon.T @ residual + D.T @ e)
        ribbon = ribbon.with_points(ribbon.distinct - change.reshape(-1, RIBBON))
    covariance = None
    if P is not None:
        by_boundary = inverse @ by_ribbon.T @ block_diag(*(row[2] for row in rows)) / sigma
        covariance = by_boundary @ P @ by_boundary.T + inverse
    until = {
        label: _confirmed(curve, table, ribbon)
        for (label, curve), table in zip(curves.items(), tables, strict=True)
        if not ribbon.periodic
    }
    return FittedRibbon(ribbon, covariance, until)


def _confirmed(curve: SplineBoundary, table: Array, ribbon: Ribbon) -> float:
    """Returns the parameter of a ribbon beside the confirmed end of an open boundary."""
    until = np.array([min(curve.confirmed_until, curve.spline.domain[1])])
    return float(along_ribbon(table, until, curve.spline, ribbon)[0])


class _Edge:
    """Holds points of a boundary that measure an edge."""

    def __init__(self, spline: BSpline, side: float, table: Array, ribbon: Ribbon) -> None:
        low, high = spline.domain
        begin, end = (low, high) if spline.periodic else (table[0, 0], table[-1, 0])
        count = max(int(np.ceil(spline.length() / (SHARE * ribbon.spacing))), 1)
        u = np.linspace(begin, end, count + 1)[: count if spline.periodic else None]
        self.side = side
        self.points = spline.evaluate(u)
        self.basis = spline.basis_matrix(u)
        self.begin = along_ribbon(table, u, spline, ribbon)

    def rows(self, ribbon: Ribbon) -> tuple[Array, Array, Array]:
        """Returns residuals (k,), and derivatives by the ribbon (k, 3m) and by the boundary (k, 2m')."""
        count, room = len(self.begin), ribbon.spacing
        centre = np.ascontiguousarray(ribbon.control_points[:, :2])
        foot = refine_foot_points(
            ribbon.tables, centre, self.points, self.begin, self.begin - room, self.begin + room
        )
        sides = np.full(count, self.side)
        rows = beyond_edge(ribbon.tables, ribbon.control_points, sides, foot)
        usable = foot.interior.astype(float)
        columns = (foot.span[:, None] + np.arange(-DEGREE, 1)) % ribbon.size
        by_ribbon = np.zeros((count, ribbon.size, RIBBON))
        np.add.at(by_ribbon, (np.arange(count)[:, None], columns), rows.by_control)
        by_boundary = self.basis[:, :, None] * rows.by_point[:, None]
        return (
            usable * rows.residual,
            usable[:, None] * by_ribbon.reshape(count, -1),
            usable[:, None] * by_boundary.reshape(count, -1),
        )


def _shape_rows(ribbon: Ribbon, settings: MapperSettings) -> tuple[Array, Array]:
    """Returns the whitened rows (r, 3m) and residuals (r,) of the weak priors on what no point measures.

    Control points slide along the line by `batch.sigma_slide` from where they are.
    """
    sigma_bend = LOOSE * ribbon.spacing
    sigmas = np.array([sigma_bend, sigma_bend, settings.centerline.sigma_width])
    rows = np.zeros((len(ribbon.bending), RIBBON, ribbon.size, RIBBON))
    for j, row in enumerate(ribbon.bending):
        for k, weight in enumerate(row):
            rows[j, range(RIBBON), (j + k) % ribbon.size, range(RIBBON)] = weight / sigmas
    bend = rows.reshape(-1, ribbon.size * RIBBON)
    tangent = ribbon.centre.tangent_unit(greville(ribbon.knots, DEGREE)[: ribbon.size])
    slide = np.zeros((ribbon.size, ribbon.size, RIBBON))
    slide[np.arange(ribbon.size), np.arange(ribbon.size), :2] = tangent / settings.batch.sigma_slide
    residual = np.concatenate([bend @ ribbon.distinct.ravel(), np.zeros(ribbon.size)])
    return np.concatenate([bend, slide.reshape(ribbon.size, -1)]), residual
