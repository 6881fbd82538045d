"""The road: everything that is estimated, and the steps of the paper that change it.

A cycle follows the paper: predict, classify, expand, update, and finally marginalize.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import gtsam

from pathspace_graph.copies import shallow
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.log import Detections
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import BOUNDARIES
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.boundary import Boundary

from .growth import GROWTH_REACH, Growth
from .motion import MeasuredMotion, predict
from .path import DrivenPath
from .smoother import FAR_STRETCH, CurveSmoother, Gating
from .tracks import OrangeDetections, orange_cones

HELD: Final = "the user's factors fix the frame of the open map: it is no longer relinearized as a whole"


@dataclass(frozen=True, eq=False)
class Classified:
    """The detections of a cycle after their association."""

    new: slice  # rows in the table of detections
    tested: Gating | None  # test of the coloured detections; None without a curve


class Road:
    """Window and prior, both curves, tentative and orange cones, and the driven path.

    A failed cycle goes back to a `copy`.
    """

    SMOOTHER: ClassVar = CurveSmoother  # class of its window and prior

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self.smoother: CurveSmoother = self.SMOOTHER(settings)
        """Variables, factors of the window, and the prior."""
        self.path = DrivenPath()
        self.growth = Growth(settings.growth)
        """Tentative tracks, through which the open curves grow."""
        self.orange = OrangeDetections()
        """Detections of orange cones, which are points of the map."""
        self.grown: frozenset[int] = frozenset()
        """Curves that grew in the newest cycle; the next one tests the whole window for them."""
        self._attach()

    def copy(self) -> Self:
        """Return an independent copy; attributes that are only replaced are shared."""
        other = shallow(self)
        other.smoother = self.smoother.copy()
        other.path = self.path.copy()
        other.growth = self.growth.copy()
        other.orange = self.orange.copy()
        other._attach()
        return other

    def _attach(self) -> None:
        self.smoother.attached = [self.smoother.map, self.path, self.growth.tentative, self.orange]

    # --- the steps of a cycle ----------------------------------------------------------------------------

    def add_factors(self, factors: Sequence[gtsam.NonlinearFactor]) -> str:
        """Check and add the user's factors; return a notice if that disables something."""
        return HELD if factors and self.smoother.add_factors(factors) else ""

    def predict(self, motion: MeasuredMotion, orange: Detections) -> None:
        """Add the pose of a cycle by the calibrated odometry, extend the path, and keep the orange cones."""
        predict(self.smoother, self.path, motion, orange.t)
        cycle, pose = self.smoother.next_cycle - 1, self.poses[-1]
        self.orange.add(orange, cycle, motion.odometry.twist, pose)

    def classify(self, detections: Detections, twist: Array, *, use: bool = True) -> Classified:
        """Add the detections of the newest pose, and use the ones that a curve explains.

        Others may expand an open curve later. Without `use`, none is used.
        """
        track, cycle = self.smoother.map, self.smoother.next_cycle - 1
        new = track.detections.append(detections, cycle, twist)
        tested = self.smoother.associate(self.grown, use) if self.boundaries else None
        if not self.closed:
            self.growth.observe(track, new, detections.t)
        return Classified(new, tested)

    def expand(self, *, solving: bool = False) -> str:
        """Grow open curves, and deactivate the part of the map behind; return a notice.

        A stretch is deactivated in a cycle that has not grown, if it can wait so long, and later while a
        batch is `solving` the drive, since its map will replace this one.
        """
        self.grown, notice = frozenset(), ""
        if not self.closed:
            path_ahead = self.path.ahead(self.poses[-1], GROWTH_REACH)
            self.grown, notice = self.growth.expand(self.smoother, path_ahead)
            if self.grown:
                self.smoother.map.lay_out_stations()  # control points are on other rows
        waiting = 4.0 if solving else 2.0 if self.grown else 1.0
        self.smoother.deactivate_distant(waiting * FAR_STRETCH)
        return notice

    def update(self) -> None:
        """Take the Gauss-Newton steps of a cycle, each linearized at the current estimate."""
        for _ in range(self.settings.steps_grown if self.grown else self.settings.steps):
            self.smoother.step(self.settings.sigma_step)

    def marginalize(self, held_from: int | None = None) -> None:
        """Marginalize poses older than the lag, except for cycles from `held_from` on."""
        self.smoother.marginalize(held_from)

    # --- the estimate ------------------------------------------------------------------------------------

    @property
    def closed(self) -> bool:
        """Whether the curves are closed, so that the map has its final size."""
        return self.smoother.map.state.closed

    @property
    def boundaries(self) -> dict[int, Boundary]:
        """Curves by label."""
        return self.smoother.map.state.boundaries

    @property
    def has_both_boundaries(self) -> bool:
        return set(self.boundaries) == set(BOUNDARIES)

    @property
    def poses(self) -> Array:
        """View of the poses (P, 3) in the window, the oldest first, map frame."""
        return self.smoother.variables.poses

    @property
    def next_cycle(self) -> int:
        return self.smoother.next_cycle

    def orange_cones(self) -> dict[int, PointBoundary]:
        """Merge the orange cones by label, with the present poses of the window."""
        seen = self.orange.copy()
        seen.place(self.smoother.first_cycle, self.poses)
        growth, shape = self.settings.growth, self.settings.spline.sigma_shape
        return orange_cones(seen, self.smoother.variables.sensor, growth, shape)

    def move(self, motion: Array) -> None:
        """Move path, tracks and cones, which are no variables, by a rigid motion (3,) of the map frame."""
        for one in self.smoother.attached:
            one.move(motion)
