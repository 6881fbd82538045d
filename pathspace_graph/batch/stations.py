"""Matching of a batch's detections to the stations of its cones, in every lap."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.mapping.detections import NO_STATION, DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.stations import SIGMA_POSE, Stations
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import ahead_of

from .association import ROW_CONES, cones_of_curve, feet_of_cones

SIGMA_STATION: Final = (
    0.02  # standard deviation of a cone along a curve with a control point for each cone (m)
)


@dataclass(frozen=True, eq=False)
class StationMatches:
    """The stations of a batch's closed curves, and their unambiguous detections."""

    stations: Stations
    rows: IntArray  # (m,) detections, by row of the table
    station: IntArray  # (m,) station of each
    sigma: Array  # (m,) standard deviations along the curve, of detection and station (m)

    def used(self, detections: DetectionTable) -> tuple[IntArray, IntArray, Array]:
        """Return rows, stations and sigmas (k,) of detections in use on the boundary of their station."""
        on_boundary = detections.boundary[self.rows] == self.stations.label[self.station]
        chosen = detections.used[self.rows] & on_boundary
        return self.rows[chosen], self.station[chosen], self.sigma[chosen]


def match_stations(
    state: State, detections: DetectionTable, settings: MapperSettings
) -> StationMatches | None:
    """Match all detections to stations of closed curves, the cones of the first drive's first lap.

    None if a curve has too few cones, or detections are of lines. A lap misses its beginning by some
    decimetres, which would smear the cones of both ends and match a later lap to neighbours. So the first lap
    places the cones; revisits have aligned the later ones.
    """
    if settings.of_lines:
        return None
    places = {}
    for label in state.boundaries:
        first = detections.where(np.flatnonzero(laps_of(state, detections, label) <= 0)).of_drive(0)
        cones = cones_of_curve(state, first, label, settings)
        if len(cones.u) < ROW_CONES:
            return None
        places[label] = feet_of_cones(state, cones, label).u
    sigmas = {label: np.full(len(u), SIGMA_STATION) for label, u in places.items()}
    stations = Stations.of(state, places, sigmas)
    rows, station, sigma = [], [], []
    for curve in stations.curves:
        own = detections.used_on(curve.label)
        own = own[detections.label[own] == curve.label]
        u, poses = detections.u[own], state.variables.poses_at(detections.cycle[own])
        tangent = state.spline(curve.label).tangent_unit(u)
        along = sigma_across(tangent, detections.covariance[own], poses, 0.0)
        match = curve.matched(u, np.hypot(along, SIGMA_POSE))
        rows.append(own[match != NO_STATION])
        station.append(match[match != NO_STATION])
        sigma.append(np.hypot(along, SIGMA_STATION)[match != NO_STATION])
    return StationMatches(stations, *map(np.concatenate, (rows, station, sigma)))


def laps_of(state: State, detections: DetectionTable, label: int) -> IntArray:
    """Lap (m,) on a closed curve in which each detection's foot point was passed, from 0."""
    pose_u, length = state.pose_u[label], state.boundaries[label].length
    at = pose_u[detections.cycle]
    ahead = ahead_of(at, detections.u, length)
    return np.asarray(np.floor((at + ahead - pose_u[0]) / length), np.intp)
