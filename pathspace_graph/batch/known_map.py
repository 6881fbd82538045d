"""A known map: the prior of the curves for a drive on an existing map."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from scipy.linalg import block_diag

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.footpoint import foot_points
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.graph.variables import POINT
from pathspace_graph.io.map import NO_CONES, Map, SplineBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT
from pathspace_graph.mapping.state import SAMPLE
from pathspace_graph.settings.mapper import MapperSettings, SplineSettings, known_settings
from pathspace_graph.spline.boundary import Boundary, boundaries_cross, sampled
from pathspace_graph.spline.bspline import BSpline, end_change_matrix

from .simplification import fit_through

KEPT: Final = 1e-3  # standard deviation of the control points of a fixed map (m)
PLACE_ROOM: Final = 0.02  # room in which the foot point of a cone is searched, by the length of an open curve
PLACE_LEAST: Final = 4.0  # added to that room (m)
INSIDE: Final = 1e-6  # least distance of a cone from the end of its curve, the seam if closed (m)
FLOOR: Final = 0.01  # standard deviation added in any other map, which makes its covariance regular (m)


@dataclass(frozen=True, eq=False)
class KnownMap:
    """Both curves of a map from before the drive, and the Gaussian of their control points."""

    splines: dict[int, BSpline]
    confirmed: dict[int, float]  # parameter up to which each curve is confirmed (m)
    covariance: Array  # (n, n) of the distinct control points, left first, in m^2
    cones: dict[int, Array]  # (k, 2) cones of each curve: parameters, and sigmas along it (m)
    kept: bool  # whether the map is fixed
    crosses: bool  # whether both curves cross elsewhere than where the left one crosses itself

    @classmethod
    def of(cls, track: Map, keep: bool = False, of_lines: bool = False) -> Self:
        """Build the known map from a map with both curves; `keep` fixes it.

        Cones are dropped for a sensor of lines. SettingsError for a map without both curves or without
        covariances.
        """
        boundaries = track.curves("a known map")
        covariance = track.covariance_of(*boundaries)
        if covariance is None:
            raise SettingsError("a known map: expected a map with covariances, found one without")
        changes, splines, confirmed, cones = [], dict[int, BSpline](), dict[int, float](), dict[int, Array]()
        for label, boundary in sorted(track.boundaries.items()):
            assert isinstance(boundary, SplineBoundary)
            splines[label], change = _floating(boundary.spline)
            changes.append(np.kron(change, np.eye(POINT)))
            confirmed[label] = min(boundary.confirmed_until, boundary.spline.domain[1])
            cones[label] = NO_CONES if of_lines else boundary.cones
        T = block_diag(*changes)
        floor = FLOOR**2 * np.eye(len(T))
        joint = KEPT**2 * np.eye(len(T)) if keep else T @ covariance @ T.T + floor
        crosses = boundaries_cross(splines, SAMPLE, sampled(splines[LEFT], SAMPLE))
        return cls(splines, confirmed, joint, cones, keep, crosses)

    @property
    def ends(self) -> dict[int, float]:
        """Return the parameter from which each curve grows (m), infinite if all of it is confirmed."""
        return {
            label: np.inf if self.kept or self.confirmed[label] >= spline.domain[1] else self.confirmed[label]
            for label, spline in self.splines.items()
        }

    @property
    def closed(self) -> bool:
        return any(spline.periodic for spline in self.splines.values())

    def boundary(self, label: int, settings: MapperSettings, first: int = 0) -> Boundary:
        """Convert a curve to a boundary; the keys of its control points begin at the number `first`."""
        spline = self.splines[label]
        own = replace(settings.spline, degree=spline.degree)
        boundary = Boundary(spline.knots, spline.periodic, own, first)
        boundary.confirmed_end = self.confirmed[label]
        if not spline.periodic:
            end = np.array([boundary.confirmed_end])
            boundary.add_cones(spline.evaluate(end), end)
        return boundary


def map_of_cones(
    left: Array, right: Array, closed: bool, sigma: float, settings: MapperSettings | None = None
) -> Map:
    """Build a map through cones (n, 2) in driving order, known with a standard deviation `sigma` (m)."""
    settings, boundaries = known_settings(settings), dict[int, SplineBoundary]()
    for label, cones in zip(BOUNDARIES, (left, right), strict=True):
        spline, _ = fit_through(cones, closed, settings, settings.batch.dense_share)
        floating = spline if closed else spline.unclamp()
        covariance = sigma**2 * np.eye(POINT * floating.size)
        placed = np.column_stack([_places(floating, cones), np.full(len(cones), sigma)])
        boundaries[label] = SplineBoundary(floating, covariance, floating.domain[1], placed)
    return Map(closed, boundaries)


def _places(spline: BSpline, cones: Array) -> Array:
    """Parameters (n,) of cones (n, 2), in driving order, on a curve that may cross itself."""
    low, high = spline.domain
    begin, end = np.full(len(cones), low), np.full(len(cones), high)
    if not spline.periodic:
        driven = path_lengths(cones)
        at, room = low + (high - low) * driven / driven[-1], PLACE_ROOM * (high - low) + PLACE_LEAST
        begin, end = np.maximum(begin, at - room), np.minimum(end, at + room)
    step = SplineSettings.search_step
    feet = foot_points(spline.tables, spline.control_points, cones, begin, end, step)
    return np.minimum(feet.u, high - INSIDE)


def _floating(spline: BSpline) -> tuple[BSpline, Array]:
    """Return the same curve with floating ends, and the change of its distinct control points."""
    if spline.periodic or spline.knots[0] < spline.knots[spline.degree]:
        return spline, np.eye(spline.size)
    floating = spline.unclamp()
    return floating, end_change_matrix(spline.knots, spline.degree, floating.knots)
