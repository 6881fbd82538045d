"""The mapper's window in GTSAM's own `IncrementalFixedLagSmoother`, which freezes what a marginal touches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gauge import smoothness_matrix
from pathspace_graph.factors.gtsam_factors import (
    calibrated_odometry_factor,
    pose_array,
    smoothness_factors,
    spacing_factors,
    spline_projection_factor,
)
from pathspace_graph.factors.linear_graph import (
    CALIBRATION_KEY,
    WindowKeys,
    linear_graph,
    prior_rows,
    window_keys,
)

from .labels import LEFT, RIGHT
from .settings import MapperSettings
from .smoother import Smoother

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIGMA_ANCHOR = 1.0
"""How surely a control point is held where it began (m, one sigma). The mapper damps each step instead, which
GTSAM's smoother can't; undamped, control points slide along the curve until it breaks."""


class IncrementalSmoother(Smoother):
    """The same state, readings and factors as `Smoother`; the estimate is that of GTSAM's smoother.

    The step of the parent is taken too, for what gates readings (the joint uncertainty) and for the prior
    that a new GTSAM smoother starts from where the loop closes; what it estimates is not used.
    """

    def __init__(self, settings: MapperSettings) -> None:
        super().__init__(settings)
        self._restart()

    def _restart(self) -> None:
        """A new GTSAM smoother, which knows nothing yet."""
        self._gtsam = gtsam.IncrementalFixedLagSmoother(self.settings.lag, _parameters())
        self._values = gtsam.Values()
        self._graph = gtsam.NonlinearFactorGraph()
        self._known: set[int] = set()
        self._anchored: set[int] = set()
        self._left: set[int] = set()
        self._held: set[tuple[int, int]] = set()
        self._sizes = {LEFT: 0, RIGHT: 0}
        self._written: Array = np.zeros((0, 3))
        self._written_from = self.first_cycle
        self._periodic = False
        self._odometry_until = self.first_cycle

    # --- where the parent is told otherwise --------------------------------------------------------------

    def begin(self, t: float, pose: Array, covariance: Array) -> None:
        """The first pose; no history is kept, since nothing is relinearized when the loop closes."""
        super().begin(t, pose, covariance)
        self.history = None

    def part(self, near: dict[int, IntArray]) -> None:
        """Every control point stays in the system."""

    def forget(self, label: int, first: int) -> None:
        """GTSAM's smoother can't: a new one starts from the prior that has forgotten."""
        super().forget(label, first)
        self._restart()

    def step(self, sigma_step: float) -> None:
        """One update of GTSAM's smoother with what is new; the estimate is its own."""
        estimate = self.state.vector.copy()
        super().step(sigma_step)
        self.state.vector = estimate
        if self._moved():
            self._restart()
        self._add_prior()
        self._add_odometry()
        for label in self.state.boundaries:
            self._add_control_points(label)
            self._add_readings(label)
        self._solve()

    def settle(self) -> None:
        """The parent's step, estimate included.

        One undamped step through the whole loop, which is what a new smoother begins with, may throw a curve
        off for good.
        """
        super().step(self.settings.closing.sigma_step)

    def _moved(self) -> bool:
        """Whether the poses were moved, or a curve closed, since the last step: the loop is being closed."""
        periodic = any(boundary.periodic for boundary in self.state.boundaries.values())
        known = self._written[self.first_cycle - self._written_from :]
        moved = bool((self.state.poses[: len(known)] != known).any())
        return moved or periodic != self._periodic

    # --- factors -----------------------------------------------------------------------------------------

    def _window(self) -> WindowKeys:
        """Keys of the state's entries."""
        sizes = [self.state.boundaries[b].size if b in self.state.boundaries else 0 for b in (LEFT, RIGHT)]
        return window_keys((sizes[0], sizes[1]), 2, self.state.poses, self.first_cycle)

    def _add_prior(self) -> None:
        """What the prior says, where the smoother is new, linearized where the estimate is."""
        if self._known:
            return
        window, q = self._window(), len(self.prior.point)
        descent = self.prior.descent_at(self.state.vector)
        graph = linear_graph([prior_rows(self.prior.information, descent)], window)
        stops = np.cumsum(window.dims)
        for key, stop, dim in zip(window.keys, stops, window.dims, strict=True):
            if stop <= q:
                self._take_up(int(key), self.state.vector[stop - dim : stop])
        self._periodic = any(boundary.periodic for boundary in self.state.boundaries.values())
        for index in range(graph.size()):
            self._graph.add(gtsam.LinearContainerFactor(graph.at(index), self._values))

    def _take_up(self, key: int, value: Array) -> None:
        """A new variable."""
        self._known.add(key)
        self._values.insert(key, gtsam.Pose2(*value) if len(value) == 3 else value.copy())

    def _add_odometry(self) -> None:
        """The poses that are new, each with the odometry from the one before."""
        for slot, pose in enumerate(self.state.poses):
            cycle = self.first_cycle + slot
            key = gtsam.symbol("x", cycle)
            if key not in self._known:
                self._take_up(key, pose)
            if slot and cycle > self._odometry_until:
                before = gtsam.symbol("x", cycle - 1)
                odometry = self.odometry[slot - 1]
                self._graph.add(calibrated_odometry_factor(before, key, CALIBRATION_KEY, odometry))
                self._odometry_until = cycle

    def _add_control_points(self, label: int) -> None:
        """The control points that are new, and the gauge between them and their neighbours."""
        boundary, gauge = self.state.boundaries[label], self.settings.gauge
        old, size = self._sizes[label], boundary.size
        if size == old:
            return
        keys, points = _control_keys(label, size), self.state.control_points(label)
        anchor = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_ANCHOR)
        for key, point in zip(keys, points, strict=True):
            if key not in self._anchored:
                self._anchored.add(key)
                self._graph.add(gtsam.PriorFactorPoint2(key, point, anchor))
            if key not in self._known:
                self._take_up(key, point)
        nominal = boundary.nominal
        spacing = spacing_factors(keys, nominal, gauge.sigma_spacing * nominal, boundary.periodic)
        length = boundary.length if boundary.periodic else None
        sigma = gauge.sigma_smoothness * float(np.mean(nominal))
        smooth = smoothness_factors(keys, smoothness_matrix(boundary.abscissae, length), sigma)
        for factor in [*spacing[max(old - 1, 0) :], *smooth[max(old - 2, 0) :]]:
            self._graph.add(factor)
        self._sizes[label] = size

    def _add_readings(self, label: int) -> None:
        """A spline-projection factor for the readings of each pose that are newly in use."""
        readings, boundary = self.readings, self.state.boundaries[label]
        keys, room = _control_keys(label, boundary.size), self.settings.spline.refine_room
        rows = readings.used_on(label)
        first = np.searchsorted(readings.slot, readings.slot[rows])
        cycles = self.first_cycle + readings.slot[rows]
        names = list(zip(cycles.tolist(), (rows - first).tolist(), strict=True))
        fresh = np.array([name not in self._held for name in names], bool)
        self._held.update(names)
        for slot in np.unique(readings.slot[rows[fresh]]):
            if gtsam.symbol("x", self.first_cycle + int(slot)) in self._left:
                continue
            own = rows[fresh][readings.slot[rows[fresh]] == slot]
            self._graph.add(
                spline_projection_factor(
                    gtsam.symbol("x", self.first_cycle + int(slot)),
                    keys,
                    boundary.tables,
                    points_vehicle=readings.point[own],
                    covariances=readings.covariance[own],
                    low=readings.u[own] - room,
                    high=boundary.believed(readings.u[own] + room),
                    sigma_model=self.settings.spline.sigma_model,
                    huber=self.settings.gate.huber,
                )
            )

    # --- the estimate ------------------------------------------------------------------------------------

    def _solve(self) -> None:
        """Hand over what is new; the map and the calibration are kept alive by the newest stamp."""
        now = self.times[-1]
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {
            key: now for key in self._known if gtsam.symbolChr(key) != ord("x")
        }
        poses = {gtsam.symbol("x", self.first_cycle + slot): t for slot, t in enumerate(self.times)}
        stamps |= {key: t for key, t in poses.items() if key not in self._left}
        self._gtsam.update(self._graph, self._values, stamps)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._read(self._gtsam.calculateEstimate())

    def _read(self, estimate: gtsam.Values) -> None:
        """The state is GTSAM's estimate; headings are unwrapped about what they were."""
        window, state = self._window(), self.state
        stops = np.cumsum(window.dims)
        for key, stop, dim in zip(window.keys, stops, window.dims, strict=True):
            block = slice(stop - dim, stop)
            if not estimate.exists(key):
                self._left.add(key)
            elif dim == 3:
                pose = pose_array(estimate.atPose2(key))
                turns = np.round((state.vector[stop - 1] - pose[2]) / (2.0 * np.pi))
                state.vector[block] = pose + np.array([0.0, 0.0, 2.0 * np.pi * turns])
            else:
                state.vector[block] = estimate.atPoint2(key)
        self._written, self._written_from = state.poses.copy(), self.first_cycle


def _control_keys(label: int, size: int) -> Sequence[int]:
    """Keys of a boundary's control points."""
    return [gtsam.symbol("lr"[label], j) for j in range(size)]


def _parameters() -> gtsam.ISAM2Params:
    """Every variable that isn't frozen is relinearized in every update; unused factor slots are filled."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.0)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    parameters.setFactorization("QR")  # the first pose is known 1e7 times better than an unseen control point
    return parameters
