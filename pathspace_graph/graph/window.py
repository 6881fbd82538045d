"""The window's linear factors: one for each cycle and a few weak priors, relinearized where they are stale.

This is the fluid relinearization of iSAM2 (Kaess et al. 2012). No linearization point in the window is ever
frozen.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import as_hessian_factor, graph_of
from .keys import CALIBRATION_LETTER, POSE, POSE_LETTER, SENSOR_LETTER
from .odometry import OdometryChain
from .rows import LinearFactor, Rows, jacobian_factors, stacked_factor
from .variables import Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


SENSOR_LEVER = 10.0
"""A change of the sensor's calibration moves detections by about this much (m by its unit): they are ten
metres away, and the vehicle drives at ten metres a second."""


class MapRows(Protocol):
    """States what the engine must know about a map: its rows, and the variables that they depend on."""

    variables: Variables
    """These are the map points, the calibration and the poses."""
    reached_inactive: bool
    """If true, a row of the last call of `rows` should be on an inactive map point, but is not."""

    @property
    def structure(self) -> object:
        """Returns an object that is replaced by another one when the weak priors get other variables."""

    def changed(self) -> IntArray:
        """Returns the cycles (k,) whose detections in use have changed since the last linearization."""

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Returns rows of the detections of some cycles at the variables' values.

        The pose is the first key of a row, and the cycle is its owner.
        """

    def correct(self) -> None:
        """Corrects the detections by the present calibration of the sensor."""

    def linearized(self, cycles: IntArray) -> None:
        """Notes that the graph now holds the rows that were returned last, which are of these cycles."""

    def gauge(self, whole: bool) -> list[Rows]:
        """Returns the nonlinear weak priors on the active map points, or on all if `whole`."""

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """Returns the linear weak priors, which are made again only when `structure` changes."""

    def activate(self, keys: IntArray) -> None:
        """Makes some map points active, which lie next to the active ones."""

    def activate_all(self) -> None:
        """Makes every map point active."""

    def drop_cycle(self, cycle: int) -> None:
        """Notes that the pose of a cycle, the window's oldest, has been marginalized."""


M_co = TypeVar("M_co", bound=MapRows, covariant=True)


class WindowFactors(Generic[M_co]):
    """Holds the factors of the poses in the window and of the map.

    A factor is linearized again where a map point or a position in it has moved farther than the first
    tolerance (m) since the last linearization, or a heading farther than the second (rad).
    """

    def __init__(self, map_rows: M_co, tolerances: tuple[float, float]) -> None:
        self.map, self.variables = map_rows, map_rows.variables
        self.odometry = OdometryChain()
        """This is the odometry between each pose of the window and the next."""
        self.exact = False
        """If true, the tolerances are zero: factors of all variables that moved are linearized again."""
        self.of_cycle: dict[int, LinearFactor] = {}
        """Each perception cycle has a factor with its detections and the odometry to the next cycle."""
        self.gauge: dict[int, LinearFactor] = {}
        """These are the nonlinear weak priors by owner."""
        self._tolerances = tolerances
        self._linear_gauge = gtsam.GaussianFactorGraph()
        self._structure: object = None

    @property
    def linear(self) -> Iterator[gtsam.GaussianFactor | gtsam.GaussianFactorGraph]:
        """Yields all factors as they were linearized last."""
        yield self._linear_gauge
        for factor in (*self.of_cycle.values(), *self.gauge.values()):
            yield factor.linear

    def fresh(self, cycles: IntArray, whole: bool) -> list[gtsam.GaussianFactor]:
        """Returns factors of some cycles and weak priors, linearized at the variables' values.

        The factors that are kept do not change. The weak priors are on the active map points, or on all if
        `whole`.
        """
        weak = [*self.map.gauge(whole), *self.map.linear_gauge(whole)]
        own = jacobian_factors(self._rows(cycles), self.variables)
        return [*(factor.linear for factor in own.values()), *stacked_factor(weak, self.variables)]

    def weak_on(self, keys: IntArray) -> list[gtsam.GaussianFactor]:
        """Returns the weak priors that hold any of some active map points (k,), as one factor."""
        weak = [*self.map.gauge(False), *self.map.linear_gauge(False)]
        touching = [rows.where(np.asarray(np.isin(rows.keys, keys).any(axis=1))) for rows in weak]
        return [*stacked_factor(touching, self.variables)]

    def relinearize(self, cycles: IntArray, inactive: frozenset[int]) -> bool:
        """Linearizes stale factors again, and returns true.

        Where one of them would hold an inactive variable, it changes nothing and returns false.
        """
        moved = self._moved()
        stale = self._stale(cycles, moved)
        own = jacobian_factors(self._rows(stale), self.variables)
        if self.map.reached_inactive or not all(inactive.isdisjoint(factor.keys) for factor in own.values()):
            return False
        self.of_cycle |= own
        self.map.linearized(stale)
        self._relinearize_gauge(moved)
        entries = self.variables.layout.entries(moved)
        self.variables.linearized[entries] = self.variables.values[entries]
        return True

    def drop(self, keys: frozenset[int]) -> None:
        """Drops the factors of cycles that hold any of some keys, so that they are linearized again."""
        self.of_cycle = {cycle: own for cycle, own in self.of_cycle.items() if keys.isdisjoint(own.keys)}

    def clear(self) -> None:
        """Drops every factor, since the map has other variables."""
        self.of_cycle, self._structure = {}, None

    def _rows(self, cycles: IntArray) -> list[Rows]:
        """Returns the rows of the detections and of the odometry of some cycles."""
        return [*self.map.rows(cycles), *self.odometry.rows(self.variables, cycles)]

    def _moved(self) -> IntArray:
        """Returns the keys of variables that moved by more than the tolerance since their linearization.

        The odometry's calibration is never among them, since every row is linear in it. That of the sensor
        moves the foot points of detections.
        """
        layout = self.variables.layout
        tolerance, poses = np.zeros(layout.size), layout.block(POSE_LETTER)
        if not self.exact:
            tolerance += self._tolerances[0]
            tolerance[poses.start + POSE - 1 : poses.stop : POSE] = self._tolerances[1]
            tolerance[layout.block(SENSOR_LETTER)] = self._tolerances[0] / SENSOR_LEVER
        tolerance[layout.block(CALIBRATION_LETTER)] = np.inf
        moved = np.abs(self.variables.values - self.variables.linearized) > tolerance
        return layout.keys[np.logical_or.reduceat(moved, layout.starts)]

    def _stale(self, cycles: IntArray, moved: IntArray) -> IntArray:
        """Returns the cycles whose factor is missing, holds a moved variable, or has other detections now."""
        changed, moved_keys = set(self.map.changed().tolist()), frozenset(moved.tolist())
        return np.array(
            [
                cycle
                for cycle in cycles.tolist()
                if cycle in changed
                or cycle not in self.of_cycle
                or not moved_keys.isdisjoint(self.of_cycle[cycle].keys)
            ],
            np.intp,
        )

    def _relinearize_gauge(self, moved: IntArray) -> None:
        """Linearizes weak priors on moved map points again, or all priors if they are on other points now."""
        structure, moved_keys = self.map.structure, frozenset(moved.tolist())
        if structure is not self._structure:
            self.gauge, self._structure = {}, structure
            linear = jacobian_factors(self.map.linear_gauge(False), self.variables)
            graph = graph_of(*(factor.linear for factor in linear.values()))
            self._linear_gauge = graph_of(as_hessian_factor(graph)) if linear else graph
        kept = [owner for owner, factor in self.gauge.items() if moved_keys.isdisjoint(factor.keys)]
        if len(kept) == len(self.gauge) > 0:
            return
        stale = self.map.gauge(False)
        if kept:
            stale = [group.where(~np.isin(group.owner, kept)) for group in stale]
        self.gauge |= jacobian_factors(stale, self.variables)
