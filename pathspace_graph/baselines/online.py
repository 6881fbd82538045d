"""Base of the online baselines: the mapper's front end."""

from abc import abstractmethod
from typing import Final

from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunNoise
from pathspace_graph.mapping.motion import known_noise
from pathspace_graph.run import CycleResult, Stopwatch
from pathspace_graph.settings.mapper import MapperSettings, known_settings

FRONT_END: Final = ("closing", "gate", "growth", "motion", "noise", "sides", "spline")
"""Settings of the front end and of the growth of landmarks."""


class OnlineBaseline:
    """Online estimator; a subclass maps the readings of the front end.

    `odometry_sigma` (3,) is the standard deviation of a twist reading (m/s, m/s, rad/s).
    """

    def __init__(
        self, settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
    ) -> None:
        self.settings = known_settings(settings)
        self.front_end = FrontEnd(self.settings, known_noise(odometry_sigma))
        self._begin()

    @abstractmethod
    def _begin(self) -> None:
        """Initialize the subclass."""

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        watch = Stopwatch()
        cycle = self.front_end.admit(odometry, detections)
        reading = self.front_end.update(cycle.odometry, cycle.detections)
        return cycle.counted(self._process(reading, watch))

    @abstractmethod
    def _process(self, reading: Reading, watch: Stopwatch) -> CycleResult:
        """Map a cycle."""

    @abstractmethod
    def _map(self, with_covariance: bool) -> Map:
        """Return a copy of the map."""

    def map(self) -> Map:
        return self._map(True)

    def outline(self) -> Map:
        return self._map(False)

    def noise_used(self) -> RunNoise:
        return self.front_end.noise_used
