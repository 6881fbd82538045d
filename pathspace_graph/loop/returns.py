"""Search for a return to the beginning of a drive: by its cones or, of lines, by its curves."""

from math import inf
from typing import Final

from pathspace_graph.batch.start import unwrap
from pathspace_graph.copies import Copyable
from pathspace_graph.front_end.noise import NoiseLearner
from pathspace_graph.graph.relative import Revisit
from pathspace_graph.mapping.road import Road
from pathspace_graph.places.constellation import SampledCurves
from pathspace_graph.places.passes import return_to_beginning
from pathspace_graph.settings.mapper import MapperSettings

from .drive_record import DriveRecord

RETURN_CYCLES: Final = 10  # number of cycles between attempts of a vehicle that hardly moves


class ReturnFinder(Copyable):
    """Search for a return of an open road, some metres or cycles after the last attempt."""

    def __init__(self, settings: MapperSettings) -> None:
        self._settings = settings
        self._tried = -inf, 0  # path length (m) and cycle of the last attempt
        self._rests_until = 0.0  # path length of the next attempt (m)

    def rest(self, road: Road, length: float) -> None:
        """Pause the search for a length (m) from here."""
        self._rests_until = road.path.length + length

    def find(self, road: Road, record: DriveRecord, noise: NoiseLearner) -> Revisit | None:
        """Return the newest pose relative to an early one, if it is recognized there."""
        length, cycle, closing = road.path.length, road.next_cycle, self._settings.closing
        tried, tried_cycle = self._tried
        waited = length >= tried + closing.check_interval or cycle >= tried_cycle + RETURN_CYCLES
        if length < self._rests_until or not waited or not road.path.near_beginning(road.poses[-1], closing):
            return None
        self._tried = length, cycle
        curves, smoother = None, road.smoother
        if self._settings.of_lines:
            if not road.boundaries:
                return None
            smoother.transform_to_origin()
            smoother.refresh()
            ends = {label: boundary.confirmed_end for label, boundary in road.boundaries.items()}
            curves = SampledCurves.of(smoother.map.state.splines, ends)
        seen_in = record.seen_in(smoother.variables.sensor, noise)
        poses = unwrap(record.poses) if curves is None else record.with_window(road)
        return return_to_beginning(seen_in, poses, smoother.newest_covariance(), road.settings, curves)
