"""The mapper on GTSAM's `IncrementalFixedLagSmoother`: what a frozen linearization costs.

Classification, growth, closing and simplification are the mapper's own; factors are the same, as GTSAM has
them. When a pose leaves, GTSAM keeps its marginal at the linearization point of every variable that it
touches, which are control points, and these are never relinearized again. Where the loop closes, the smoother
starts anew from the prior, since neither moved poses nor other variables can be handed to it.
"""

from __future__ import annotations

from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import pose_array
from pathspace_graph.graph.gaussian import factors_of, keys_of
from pathspace_graph.graph.keys import POSE, are_poses, control_keys, indices, pose_key
from pathspace_graph.graph.odometry import odometry_factor
from pathspace_graph.graph.user_factors import as_nonlinear
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.settings.mapper import MapperSettings

from .fixed_lag import FixedLagMapper
from .nonlinear_graph import detection_factors, gauge_factors

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIGMA_ANCHOR = 1.0
"""How surely a control point is held where it began (m, one sigma). The mapper damps each step instead, which
GTSAM's smoother cannot; undamped, control points slide along the curve until it breaks."""


def incremental_fixed_lag(
    settings: MapperSettings | None = None, odometry_sigma: Array | None = None
) -> FixedLagMapper:
    """`FixedLagMapper`, its window solved by GTSAM's smoother. It takes no factors of the user's."""
    settings = settings or MapperSettings()
    return FixedLagMapper(settings, odometry_sigma, IncrementalSolver(settings))


class IncrementalSolver:
    """The estimate of a window by GTSAM's `IncrementalFixedLagSmoother`, kept from cycle to cycle.

    The window of the mapper is linearized and factorized, for the joint uncertainty that gates readings and
    for the prior from which a new smoother begins where the loop closes; it is not solved.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self._epoch = -1

    def step(self, smoother: CurveSmoother, sigma_step: float) -> None:
        """One update of GTSAM's smoother with what is new; the variables are at its estimate then."""
        smoother.factorize(sigma_step)
        if smoother.epoch != self._epoch:
            self._restart(smoother)
        self._add_odometry(smoother)
        for label in smoother.map.state.boundaries:
            self._add_control_points(smoother, label)
            self._add_detections(smoother, label)
        self._solve(smoother)

    def _restart(self, smoother: CurveSmoother) -> None:
        """A new GTSAM smoother, which knows the prior, linearized where the estimate is."""
        self._epoch = smoother.epoch
        self._gtsam = gtsam.IncrementalFixedLagSmoother(self.settings.lag, _parameters())
        self._values, self._graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        self._known: set[int] = set()
        self._anchored: set[int] = set()
        self._left: set[int] = set()
        self._held: set[tuple[int, int]] = set()
        self._sizes = dict.fromkeys(smoother.map.state.boundaries, 0)
        self._odometry_until = smoother.first_cycle
        for key in keys_of(smoother.prior).tolist():
            self._take_up(smoother, key)
        for factor in factors_of(smoother.prior):
            self._graph.add(as_nonlinear(factor, smoother.variables))

    def _take_up(self, smoother: CurveSmoother, key: int) -> None:
        """A variable that may be new."""
        if key not in self._known:
            self._known.add(key)
            self._values.insert(smoother.variables.gtsam_values(np.array([key])))

    # --- factors -----------------------------------------------------------------------------------------

    def _add_odometry(self, smoother: CurveSmoother) -> None:
        """The poses that are new, each with the odometry from the one before."""
        intervals = smoother.window.odometry.intervals
        self._take_up(smoother, pose_key(smoother.first_cycle))
        for cycle in range(self._odometry_until + 1, smoother.next_cycle):
            self._take_up(smoother, pose_key(cycle))
            self._graph.add(odometry_factor(cycle - 1, intervals[cycle - 1 - smoother.first_cycle]))
        self._odometry_until = smoother.next_cycle - 1

    def _add_control_points(self, smoother: CurveSmoother, label: int) -> None:
        """The control points that are new, and the gauge between them and their neighbours."""
        state = smoother.map.state
        boundary, old = state.boundaries[label], self._sizes.get(label, 0)
        if boundary.size == old:
            return
        keys, points = control_keys(label, boundary.numbers).tolist(), state.control_points(label)
        anchor = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_ANCHOR)
        for key, point in zip(keys, points, strict=True):
            if key not in self._anchored:
                self._anchored.add(key)
                self._graph.add(gtsam.PriorFactorPoint2(key, point, anchor))
            self._take_up(smoother, key)
        fresh = set(keys[old:]) if not boundary.periodic else set(keys)
        for factor in gauge_factors(label, boundary, boundary.everything, self.settings.gauge):
            if not fresh.isdisjoint(factor.keys()):
                self._graph.add(factor)
        self._sizes[label] = boundary.size

    def _add_detections(self, smoother: CurveSmoother, label: int) -> None:
        """A spline-projection factor for the readings of each pose that are newly in use."""
        detections, boundary = smoother.map.detections, smoother.map.state.boundaries[label]
        rows = detections.used_on(label)
        number = rows - detections.cycle.searchsorted(detections.cycle[rows])
        names = list(zip(detections.cycle[rows].tolist(), number.tolist(), strict=True))
        gone = np.array([indices(np.array(key)) for key in self._left], np.intp)
        fresh = np.array([name not in self._held for name in names], bool)
        self._held.update(names)
        rows = rows[fresh & ~np.isin(detections.cycle[rows], gone)]
        room = np.full(len(rows), self.settings.spline.refine_room)
        for factor in detection_factors(label, boundary, detections, rows, self.settings, (room, room)):
            self._graph.add(factor)

    # --- the estimate ------------------------------------------------------------------------------------

    def _solve(self, smoother: CurveSmoother) -> None:
        """Hand over what is new; the map and the calibration are kept alive by the newest stamp."""
        now = smoother.times[-1]
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {
            key: now for key in self._known if not are_poses(np.array(key))
        }
        poses = {pose_key(smoother.first_cycle + slot): t for slot, t in enumerate(smoother.times)}
        stamps |= {key: t for key, t in poses.items() if key not in self._left}
        self._gtsam.update(self._graph, self._values, stamps)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._read(smoother, self._gtsam.calculateEstimate())

    def _read(self, smoother: CurveSmoother, estimate: gtsam.Values) -> None:
        """The variables are at GTSAM's estimate; headings are unwrapped about what they were."""
        variables = smoother.variables
        starts = variables.layout.starts.tolist()
        for key, start in zip(variables.keys.tolist(), starts, strict=True):
            if not estimate.exists(key):
                self._left.add(key)
            elif are_poses(np.array(key)):
                pose = pose_array(estimate.atPose2(key))
                turns = np.round((variables.values[start + POSE - 1] - pose[2]) / (2.0 * np.pi))
                variables.values[start : start + POSE] = pose + np.array([0.0, 0.0, 2.0 * np.pi * turns])
            else:
                variables.values[start : start + 2] = estimate.atPoint2(key)


def _parameters() -> gtsam.ISAM2Params:
    """Every variable that is not frozen is relinearized in every update; unused factor slots are filled."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.0)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    parameters.setFactorization("QR")  # the first pose is known 1e7 times better than an unseen control point
    return parameters
