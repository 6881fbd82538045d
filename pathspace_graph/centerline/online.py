"""A centre line with a width, online: the ribbon that the fixed-lag posterior of the boundaries tells of."""

from dataclasses import replace
from typing import Final

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import LapBatches, RunNoise, VehicleState
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import CycleResult
from pathspace_graph.scale.door import at_scale
from pathspace_graph.settings.mapper import MapperSettings

from .edges import map_of, ribbon_of

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
