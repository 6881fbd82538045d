"""The mapper on GTSAM's `IncrementalFixedLagSmoother`, which shows what a frozen linearization costs.

Classification, growth, closing and simplification are the mapper's own, and the factors are the same ones in
GTSAM's classes. When a pose leaves the window, GTSAM freezes the linearization point of every variable that
its marginal touches; these are control points, and they are never relinearized again. When the loop closes, a
new smoother starts from the prior, because moved poses and new variables cannot be passed to the old one.
"""

from __future__ import annotations

from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.gtsam_factors import pose_array
from pathspace_graph.factors.measured_noise import KnownNoise
from pathspace_graph.graph.gaussian import factors_of, keys_of
from pathspace_graph.graph.keys import POSE, SENSOR_KEY, are_poses, control_keys, indices, pose_key
from pathspace_graph.graph.odometry import odometry_factor
from pathspace_graph.graph.user_factors import as_nonlinear
from pathspace_graph.mapping.curve_map import CurveSmoother
from pathspace_graph.settings.mapper import MapperSettings

from .fixed_lag import FixedLagMapper
from .nonlinear_graph import detection_factors, gauge_factors

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

SIGMA_ANCHOR = 1.0
"""A prior holds each control point at its first position with this standard deviation (m). The mapper damps
each step instead, which GTSAM's smoother cannot; undamped, control points slide along the curve until it
breaks."""


def incremental_fixed_lag(
    settings: MapperSettings | None = None, odometry_sigma: Array | KnownNoise | None = None
) -> FixedLagMapper:
    """Returns a `FixedLagMapper` whose window is solved by GTSAM's smoother; it takes no user factors."""
    settings = settings or MapperSettings()
    return FixedLagMapper(settings, odometry_sigma, IncrementalSolver(settings))


class IncrementalSolver:
    """Estimates the window by GTSAM's `IncrementalFixedLagSmoother`, which is kept from cycle to cycle.

    The mapper's window is linearized and factorized, but not solved: the factor gives the joint uncertainty
    that gates detections, and the prior from which a new smoother starts when the loop closes.
    """

    def __init__(self, settings: MapperSettings) -> None:
        self.settings = settings
        self._epoch = -1

    def step(self, smoother: CurveSmoother, sigma_step: float) -> None:
        """Updates GTSAM's smoother with all new factors, and moves the variables to its estimate."""
        smoother.factorize(sigma_step)
        if smoother.epoch != self._epoch:
            self._restart(smoother)
        self._add_poses(smoother)
        for label in smoother.map.state.boundaries:
            self._add_control_points(smoother, label)
            self._add_detections(smoother, label)
        self._solve(smoother)

    def _restart(self, smoother: CurveSmoother) -> None:
        """Creates a GTSAM smoother that holds the prior, linearized at the present estimate."""
        self._epoch = smoother.epoch
        self._gtsam = gtsam.IncrementalFixedLagSmoother(self.settings.lag, _parameters())
        self._values, self._graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        self._known: set[int] = set()
        self._anchored: set[int] = set()
        self._marginalized: set[int] = set()
        self._held: set[tuple[int, int]] = set()
        self._sizes = dict.fromkeys(smoother.map.state.boundaries, 0)
        self._odometry_until = smoother.first_cycle
        for key in keys_of(smoother.prior).tolist():
            self._insert(smoother, key)
        for factor in factors_of(smoother.prior):
            self._graph.add(as_nonlinear(factor, smoother.variables))

    def _insert(self, smoother: CurveSmoother, key: int) -> None:
        """Inserts a variable into the next update, if GTSAM's smoother does not have it."""
        if key not in self._known:
            self._known.add(key)
            self._values.insert(smoother.variables.gtsam_values(np.array([key])))

    # --- factors -----------------------------------------------------------------------------------------

    def _add_poses(self, smoother: CurveSmoother) -> None:
        """Adds new poses, each with the odometry factor from the one before."""
        intervals = smoother.window.odometry.intervals
        self._insert(smoother, pose_key(smoother.first_cycle))
        for cycle in range(self._odometry_until + 1, smoother.next_cycle):
            self._insert(smoother, pose_key(cycle))
            self._graph.add(odometry_factor(cycle - 1, intervals[cycle - 1 - smoother.first_cycle]))
        self._odometry_until = smoother.next_cycle - 1

    def _add_control_points(self, smoother: CurveSmoother, label: int) -> None:
        """Adds new control points, and the gauge factors between them and their neighbours."""
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
            self._insert(smoother, key)
        fresh = set(keys[old:]) if not boundary.periodic else set(keys)
        for factor in gauge_factors(label, boundary, boundary.everything, self.settings.gauge):
            if not fresh.isdisjoint(factor.keys()):
                self._graph.add(factor)
        self._sizes[label] = boundary.size

    def _add_detections(self, smoother: CurveSmoother, label: int) -> None:
        """Adds a spline-projection factor for each pose whose detections have come into use."""
        detections, boundary = smoother.map.detections, smoother.map.state.boundaries[label]
        rows = detections.used_on(label)
        number = rows - detections.cycle.searchsorted(detections.cycle[rows])
        identities = list(zip(detections.cycle[rows].tolist(), number.tolist(), strict=True))
        marginalized = np.array([indices(np.array(key)) for key in self._marginalized], np.intp)
        fresh = np.array([identity not in self._held for identity in identities], bool)
        self._held.update(identities)
        rows = rows[fresh & ~np.isin(detections.cycle[rows], marginalized)]
        room = np.full(len(rows), self.settings.spline.refine_room)
        sensor_key = smoother.variables.sensor_key
        for factor in detection_factors(
            label, boundary, detections, rows, self.settings, (room, room), sensor_key
        ):
            self._graph.add(factor)

    # --- the estimate ------------------------------------------------------------------------------------

    def _solve(self, smoother: CurveSmoother) -> None:
        """Passes on all new factors and variables; map and calibration get the newest stamp, so they stay."""
        now = smoother.times[-1]
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {
            key: now for key in self._known if not are_poses(np.array(key))
        }
        poses = {pose_key(smoother.first_cycle + slot): t for slot, t in enumerate(smoother.times)}
        stamps |= {key: t for key, t in poses.items() if key not in self._marginalized}
        self._gtsam.update(self._graph, self._values, stamps)
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._read(smoother, self._gtsam.calculateEstimate())

    def _read(self, smoother: CurveSmoother, estimate: gtsam.Values) -> None:
        """Moves the variables to GTSAM's estimate; headings are unwrapped about their old values."""
        variables = smoother.variables
        starts = variables.layout.starts.tolist()
        for key, start in zip(variables.keys.tolist(), starts, strict=True):
            if not estimate.exists(key):
                self._marginalized.add(key)
            elif are_poses(np.array(key)):
                pose = pose_array(estimate.atPose2(key))
                turns = np.round((variables.values[start + POSE - 1] - pose[2]) / (2.0 * np.pi))
                variables.values[start : start + POSE] = pose + np.array([0.0, 0.0, 2.0 * np.pi * turns])
            else:
                own = estimate.atVector(key) if key == SENSOR_KEY else estimate.atPoint2(key)
                variables.values[start : start + len(own)] = own
        smoother.map.correct()


def _parameters() -> gtsam.ISAM2Params:
    """Returns parameters that relinearize every variable that is not frozen in every update."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.0)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    parameters.setFactorization("QR")  # the first pose is known 1e7 times better than an unseen control point
    return parameters
