"""The curves for the engine: rows of detections (paper: Update) and of weak priors, on keys."""

from collections.abc import Callable
from typing import Final, Self

import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import huber_weights
from pathspace_graph.factors.residuals import pair_residuals
from pathspace_graph.graph.rows import Rows, stacked_rows
from pathspace_graph.graph.variables import FIRST_POSE, SENSOR_KEY, control_keys
from pathspace_graph.io.map import NO_CONES
from pathspace_graph.settings.mapper import MapperSettings

from .detection_rows import Stations
from .detections import NO_STATION, DetectionTable
from .state import State, factor_numbers

SIGHTINGS_IN_WINDOW: Final = 20.0  # typical number of a cone's detections in a window


class CurveMap:
    """Both boundaries with the detections of the window's poses, and the rows of both."""

    def __init__(self, settings: MapperSettings, state: State | None = None) -> None:
        self.settings = settings
        self.state = state or State()  # curves and all variables
        self.variables = self.state.variables
        self.detections = DetectionTable()  # detections of the poses in the window
        self.held_by_prior = False  # whether the prior determines the curves' spacing and shape
        self.scatter: dict[int, Array] = {}  # (m,) sigma of cones at each control point, if known (m)
        self.cones: dict[int, Array] = {}  # (k, 2) cones of a boundary, if known: parameters, and sigmas (m)
        self.stations: Stations | None = None  # these cones, if they constrain detections along the curves
        self.reached_inactive = False  # whether the latest `rows` reach inactive control points
        self._refined: tuple[IntArray, Array] = (np.zeros(0, np.intp), np.zeros(0))

    def copy(self) -> Self:
        """Return an independent copy."""
        other = shallow(self)
        other.state = self.state.copy()
        other.variables = other.state.variables
        other.detections = self.detections.copy()
        return other

    # --- detections --------------------------------------------------------------------------------------

    def changed(self) -> IntArray:
        """Cycles (k,) of associations that have changed since the last linearization."""
        return self.detections.cycle[self.detections.changed]

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Linearize `w_i n_i . (R z_i + t - S(u_i)) / sigma_i` for the used detections of ascending cycles.

        The keys are [pose | control points of the span]; w is the root of the Huber weight, and zero if the
        foot point is not interior. `linearized` stores the refined parameters u.
        """
        state, detections = self.state, self.detections
        if not state.boundaries or len(cycles) == 0:
            return []
        curves, variables, s = state.curves, self.variables, self.settings.spline
        rows, u, self.reached_inactive, parts = kernels.curve_rows(
            curves.searched,
            (state.map_points, curves.labels, curves.keys, curves.trusted, curves.active_from),
            detections.associated,
            cycles,
            variables.poses,
            variables.first_cycle,
            variables.sensor,
            (s.refine_room, s.refine_iterations, s.sigma_model, self.settings.gate.huber),
            (FIRST_POSE, SENSOR_KEY),
        )
        self._refined = rows, u
        return [Rows(*parts), *self._along(rows)]

    def _along(self, rows: IntArray) -> list[Rows]:
        """Linearize `w t . (R z + t - S(u)) / sigma` for the detections (m,) with a station u."""
        detections, stations = self.detections, self.stations
        rows = rows[detections.station[rows] != NO_STATION]
        if stations is None or len(rows) == 0:
            return []
        seen = stations.rows(self.state, detections, rows)
        weights = huber_weights(seen.whitened, self.settings.gate.huber)
        return [seen.weighted(weights, detections.cycle[rows])]

    def correct(self) -> None:
        """Do nothing: detections are corrected on access."""

    def linearized(self, cycles: IntArray) -> None:
        """Accept the latest `rows`, of these cycles, which the graph has from now on."""
        if len(cycles) and self.state.boundaries:
            self.detections.refine(*self._refined)
            self.detections.mark_linearized()

    def activate(self, keys: IntArray) -> None:
        """Activate control points that are next to the active ones."""
        self.state.activate(keys)

    def move(self, motion: Array) -> None:
        """Move the cones that the curves were grown through by a rigid motion (3,) of the map frame."""
        for boundary in self.state.boundaries.values():
            boundary.move(motion)

    def activate_all(self) -> None:
        self.state.activate_only({})

    def drop_cycle(self, cycle: int) -> None:
        """Remove the detections of the oldest pose, which has left the window."""
        self.detections.keep_from(cycle + 1)
        self.state.drop_oldest_pose_u()

    def replaced_by(
        self, scatter: dict[int, Array], cones: dict[int, Array], held_by_prior: bool = True
    ) -> None:
        """Take over the scatter and the cones, by label, from the batch that made curves and prior.

        Cones (k, 2) are their parameters and standard deviations along the curves (m).
        """
        self.held_by_prior, self.scatter, self.cones = held_by_prior, scatter, cones
        self.lay_out_stations()

    def lay_out_stations(self) -> None:
        """Make the cones stations on the present curves, if all curves have some."""
        labels = [*self.state.boundaries] if self.settings.stations else []
        known = labels and all(len(self.cones.get(label, ())) for label in labels)
        self.stations = Stations.of(self.state, self.cones, SIGHTINGS_IN_WINDOW) if known else None

    def forget_cones(self, label: int, is_gone: Callable[[Array], BoolArray]) -> None:
        """Remove the cones of a curve that are gone, by their parameters (k,)."""
        own = self.cones.get(label, NO_CONES)
        self.cones = {**self.cones, label: own[~is_gone(own[:, 0])]}
        self.lay_out_stations()

    # --- weak priors -------------------------------------------------------------------------------------

    @property
    def structure(self) -> object:
        """Token whose identity changes with the control points that have weak priors."""
        return self.state.curves.keys if self.state.boundaries else None

    def gauge(self, whole: bool) -> list[Rows]:
        """Linearize `(|c_{j+1} - c_j| - nominal_j) / (sigma_spacing nominal_j)`, on all points if `whole`."""
        if not self.state.boundaries or self.held_by_prior:
            return []
        pairs, nominal, keys, owner = (self.state.whole_curves if whole else self.state.curves).pairs
        points, sigma = self.state.map_points, self.settings.gauge.sigma_spacing * nominal
        off, direction = pair_residuals(points[pairs[:, 0]], points[pairs[:, 1]], nominal)
        jacobian = np.concatenate([-direction, direction], axis=1) / sigma[:, None]
        return [Rows(keys, jacobian, off / sigma, owner)]

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """Rows of smoothness `D c / (sigma_smoothness spacing)` and anchors, on all points if `whole`.

        An anchor is a prior of a control point at its present position, so weak that it only keeps the system
        regular.
        """
        smooth, anchors = [], []
        for label, boundary in self.state.boundaries.items():
            gauge = boundary.gauge_on(boundary.everything if whole else self.state.active(label))
            if not self.held_by_prior:
                points = self.state.control_points(label)[gauge.triples]
                bent = (gauge.bending[:, :, None] * points).sum(axis=1)
                smooth.append(self._rows(label, gauge.triples, _by_axis(gauge.bending), bent.ravel()))
            active = gauge.points[:, None]
            held = np.tile(np.eye(2) / self.settings.gauge.sigma_anchor, (len(active), 1))
            anchors.append(self._rows(label, active, held, np.zeros(len(held))))
        return [stacked_rows(groups) for groups in (smooth, anchors) if groups]

    def _rows(self, label: int, points: IntArray, jacobian: Array, residual: Array) -> Rows:
        """Build rows, equally many for each row of `points` (m, k); neighbouring points share an owner."""
        repeated = np.repeat(points, len(residual) // max(len(points), 1), axis=0)
        keys = control_keys(label, self.state.boundaries[label].first + repeated)
        return Rows(keys, jacobian, residual, factor_numbers(repeated[:, 0], label))


def _by_axis(coefficients: Array) -> Array:
    """Expand coefficients (m, k) of k points to (2 m, 2 k), once for x and once for y."""
    both = np.zeros((len(coefficients), 2, coefficients.shape[1], 2))
    both[:, 0, :, 0] = both[:, 1, :, 1] = coefficients
    return both.reshape(2 * len(coefficients), 2 * coefficients.shape[1])
