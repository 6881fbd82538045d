"""A centre line with a width, online: the map of a ribbon, and the ribbon of a fixed-lag posterior."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import NO_COVARIANCE, Map, SplineBoundary, joint_covariance
from pathspace_graph.io.results import LapBatches, RunNoise, VehicleState
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult
from pathspace_graph.scale import at_scale
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import Ribbon, find_line


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


# --- the mapper ------------------------------------------------------------------------------------------


NAME: Final = "centerline-fixed-lag"
"""This is the estimator's name on the command line."""


@at_scale
class CenterlineMapper:
    """Maps a track online as a ribbon.

    The fixed-lag smoother holds what all readings so far say, as a joint Gaussian of both boundaries. The
    ribbon is estimated from it whenever the map is asked for, so that every reading counts as much as it does
    there, and a cycle takes the same time. Where there is no line between the boundaries, the map is theirs.
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = settings or MapperSettings()
        self.boundaries = FixedLagMapper(replace(self.settings, scale=1.0), odometry_sigma)
        """It maps both boundaries, and estimates the poses."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        """Processes one perception cycle, as `FixedLagMapper.update` does."""
        return self.boundaries.update(odometry, detections)

    def wait(self) -> None:
        """Waits for a batch, as `FixedLagMapper.wait` does."""
        self.boundaries.wait()

    def batches(self) -> LapBatches:
        """Returns when batches of the lap have ended."""
        return self.boundaries.batches()

    def noise_used(self) -> RunNoise:
        """Returns the noise that is used now, and what was measured so far."""
        return self.boundaries.noise_used()

    def map(self) -> Map:
        """Returns the edges of the ribbon, with their joint covariance."""
        return self._edges(self.boundaries.map())

    def outline(self) -> Map:
        """Returns the edges without covariances."""
        return self._edges(self.boundaries.outline())

    def vehicle_state(self) -> VehicleState:
        """Returns the newest pose and the calibration, with their joint covariance."""
        return self.boundaries.vehicle_state()

    def _edges(self, track: Map) -> Map:
        try:
            fitted = ribbon_of(track, self.settings)
        except SettingsError:
            return track
        edges = map_of(fitted.ribbon, fitted.covariance, self.settings.spline.sigma_shape, fitted.until)
        return replace(edges, points=track.points)
