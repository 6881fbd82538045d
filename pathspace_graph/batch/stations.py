"""Matching of a batch's detections to the stations of its cones, in every lap."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.residuals import sigma_across
from pathspace_graph.factors.se2 import path_lengths
from pathspace_graph.mapping.detections import NO_STATION, DetectionTable
from pathspace_graph.mapping.state import State
from pathspace_graph.mapping.stations import SIGMA_POSE, CurveStations, Stations
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import ahead_of

from .association import ROW_CONES, cones_of_curve, feet_of_cones

SIGMA_STATION: Final = (
    0.02  # standard deviation of a cone along a curve with a control point for each cone (m)
)
SHIFT_BLOCK: Final = 20.0  # length of the stretches of a later lap that shift together (m)
DRIVES_APART: Final = (
    3.0 * SHIFT_BLOCK
)  # added between drives, so that no neighbouring stretches are of both (m)
SHIFT_REACH: Final = 4.0  # largest shift (m)
SHIFT_STEP: Final = 0.1  # step of the shifts (m)
SIGMA_SHIFT: Final = 1.0  # prior standard deviation of a shift (m)
SHIFT_STRAY: Final = 0.05  # likelihood of a detection far from any cone, relative to one at a cone
SHIFT_APART: Final = 0.5  # least difference of contradicting shifts (m)
SHIFT_ODDS: Final = 20.0  # least odds of a shift against each contradicting one


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
    places the cones, and each stretch of a later lap is shifted along the curves to them. If two shifts are
    about as likely, the detections of the stretch are not matched.
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
    seen = [SeenAgain.of(state, detections, curve) for curve in stations.curves]
    shift = np.append(shifts(seen), 0.0)  # none for the block -1
    rows, station, sigma = [], [], []
    for one in seen:
        match = one.curve.matched(one.u + shift[one.block], np.hypot(one.sigma, SIGMA_POSE))
        rows.append(one.rows[match != NO_STATION])
        station.append(match[match != NO_STATION])
        sigma.append(np.hypot(one.sigma, SIGMA_STATION)[match != NO_STATION])
    return StationMatches(stations, *map(np.concatenate, (rows, station, sigma)))


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """The m used detections of a closed curve's colour, and the stretch of a later lap of each."""

    curve: CurveStations
    rows: IntArray  # (m,) rows in the table of detections
    u: Array  # (m,) parameters of the foot points (m)
    sigma: Array  # (m,) standard deviations along the curve (m)
    block: IntArray  # (m,) stretch of the driven path at the detection, -1 in the first lap

    @classmethod
    def of(cls, state: State, detections: DetectionTable, curve: CurveStations) -> Self:
        """Select the detections in use on a curve."""
        label = curve.label
        rows = detections.used_on(label)
        rows = rows[detections.label[rows] == label]
        u, cycle = detections.u[rows], detections.cycle[rows]
        tangent, poses = state.spline(label).tangent_unit(u), state.variables.poses_at(cycle)
        sigma = sigma_across(tangent, detections.covariance[rows], poses, 0.0)
        again = laps_of(state, detections, label)[rows] > 0
        driven = path_lengths(state.poses)[cycle] + DRIVES_APART * state.drives.of(cycle)
        block = (driven // SHIFT_BLOCK).astype(np.intp)
        return cls(curve, rows, u, sigma, np.where(again, block, -1))


def laps_of(state: State, detections: DetectionTable, label: int) -> IntArray:
    """Lap (m,) on a closed curve in which each detection's foot point was passed, from 0."""
    pose_u, length = state.pose_u[label], state.boundaries[label].length
    at = pose_u[detections.cycle]
    ahead = ahead_of(at, detections.u, length)
    return np.asarray(np.floor((at + ahead - pose_u[0]) / length), np.intp)


def shifts(seen: Sequence[SeenAgain]) -> Array:
    """Estimate the shift (m) of each block (k,) of a later lap along the curves; NaN if ambiguous.

    It is a shift of the vehicle, common to all curves. Its likelihood is that of the cones detected in the
    block and its neighbours, at their stations; each cone counts once.
    """
    count = 1 + max(int(one.block.max(initial=-1)) for one in seen)
    tries = np.arange(-SHIFT_REACH, SHIFT_REACH + 0.5 * SHIFT_STEP, SHIFT_STEP)
    score = np.zeros((len(tries), count + 2))
    for one in seen:
        again = one.block >= 0
        u, block = one.u[again], one.block[again]
        sigma = np.hypot(one.sigma[again], SIGMA_POSE)
        beyond = one.curve.nearest(u + tries[:, None])[1]
        likelihood = np.log(SHIFT_STRAY + np.exp(-0.5 * (beyond / sigma) ** 2))
        cone = block * len(one.curve.u) + one.curve.nearest(u)[0]
        likelihood /= np.bincount(cone)[cone]
        score[:, 1:-1] += [np.bincount(block, row, count) for row in likelihood]
    score = score[:, :-2] + score[:, 1:-1] + score[:, 2:] - 0.5 * (tries[:, None] / SIGMA_SHIFT) ** 2
    best = tries[score.argmax(axis=0)]
    rival = np.where(np.abs(tries[:, None] - best) > SHIFT_APART, score, -np.inf).max(axis=0)
    return np.where(score.max(axis=0) - rival > np.log(SHIFT_ODDS), best, np.nan)
