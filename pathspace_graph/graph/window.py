"""The linear factors of the window: one for each cycle and a few weak priors, made anew where they are stale.

That is fluid relinearization, as iSAM2 has it (Kaess et al. 2012), on a window that is otherwise exact:
nothing in it is ever frozen.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from .gaussian import as_hessian_factor, graph_of
from .keys import CALIBRATION_LETTER, POSE, POSE_LETTER
from .odometry import OdometryChain
from .rows import LinearFactor, Rows, jacobian_factors, one_factor
from .variables import Variables

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]


class MapRows(Protocol):
    """What the engine has to know about a map: its rows, and what they hang on."""

    variables: Variables
    """Map points, calibration and poses."""
    slid: bool
    """Whether a row that was asked for last should be on an inactive map point, but is not."""

    @property
    def structure(self) -> object:
        """Another object where the weak priors are between other variables than before."""

    def changed(self) -> IntArray:
        """(k,) perception cycles whose readings in use have changed since they were linearized last."""

    def rows(self, cycles: IntArray) -> list[Rows]:
        """Rows of the readings of some cycles at the variables' values, the pose first; cycles own them."""

    def linearized(self, cycles: IntArray) -> None:
        """The rows of these cycles are those of the graph from now on."""

    def gauge(self, whole: bool) -> list[Rows]:
        """Weak priors between the active map points, or between all."""

    def linear_gauge(self, whole: bool) -> list[Rows]:
        """Those of the weak priors that are linear, so that they are made anew with the structure only."""

    def all_active(self) -> None:
        """Every map point is active again."""

    def leave(self, cycle: int) -> None:
        """The pose of a cycle, the window's oldest, has left."""


M_co = TypeVar("M_co", bound=MapRows, covariant=True)


class WindowFactors(Generic[M_co]):
    """The factors of the poses in the window and of the map, each with the values that it was linearized at.

    tolerances: a factor is linearized anew where a map point or a position in it has moved farther than the
    first (m), or a heading farther than the second (rad).
    """

    def __init__(self, track: M_co, tolerances: tuple[float, float]) -> None:
        self.map, self.variables = track, track.variables
        self.odometry = OdometryChain()
        """Between each pose of the window and the next."""
        self.exact = False
        """Whether all that has moved at all is linearized anew, as if the tolerances were zero."""
        self.of_cycle: dict[int, LinearFactor] = {}
        """Of each perception cycle: its readings, and the odometry to the next."""
        self.gauge: dict[int, LinearFactor] = {}
        """Weak priors, by their owner."""
        self._tolerances = tolerances
        self._linear_gauge = gtsam.GaussianFactorGraph()
        self._structure: object = None

    @property
    def linear(self) -> Iterator[gtsam.GaussianFactor | gtsam.GaussianFactorGraph]:
        """All of them, as they were linearized last."""
        yield self._linear_gauge
        for factor in (*self.of_cycle.values(), *self.gauge.values()):
            yield factor.linear

    def fresh(self, cycles: IntArray, whole: bool) -> list[gtsam.GaussianFactor]:
        """Those of some cycles, all linearized at the variables' values; what is kept stays as it is.

        `whole`: with the weak priors between all map points, not the active ones alone.
        """
        weak = [*self.map.gauge(whole), *self.map.linear_gauge(whole)]
        own = jacobian_factors(self._rows(cycles), self.variables)
        return [*(factor.linear for factor in own.values()), *one_factor(weak, self.variables)]

    def weak_on(self, keys: IntArray) -> list[gtsam.GaussianFactor]:
        """The weak priors that hold any of some active map points (k,), as one factor."""
        weak = [*self.map.gauge(False), *self.map.linear_gauge(False)]
        touching = [rows.where(np.asarray(np.isin(rows.keys, keys).any(axis=1))) for rows in weak]
        return [*one_factor(touching, self.variables)]

    def relinearize(self, cycles: IntArray, inactive: frozenset[int]) -> bool:
        """Make stale factors anew; False, and nothing done, where one would hold an inactive variable."""
        moved = self._moved()
        stale = self._stale(cycles, moved)
        own = jacobian_factors(self._rows(stale), self.variables)
        if self.map.slid or not all(inactive.isdisjoint(factor.keys) for factor in own.values()):
            return False
        self.of_cycle |= own
        self.map.linearized(stale)
        self._relinearize_gauge(moved)
        entries = self.variables.layout.entries(moved)
        self.variables.linearized[entries] = self.variables.values[entries]
        return True

    def drop(self, keys: frozenset[int]) -> None:
        """Forget the factors of cycles that hold any of some keys: they are made anew."""
        self.of_cycle = {cycle: own for cycle, own in self.of_cycle.items() if keys.isdisjoint(own.keys)}

    def clear(self) -> None:
        """Forget every factor: the map has other variables."""
        self.of_cycle, self._structure = {}, None

    def _rows(self, cycles: IntArray) -> list[Rows]:
        return [*self.map.rows(cycles), *self.odometry.rows(self.variables, cycles)]

    def _moved(self) -> IntArray:
        """Keys of the variables that have moved by more than the tolerance since they were linearized.

        Not the calibration: every row is linear in it.
        """
        layout = self.variables.layout
        tolerance, poses = np.zeros(layout.size), layout.block(POSE_LETTER)
        if not self.exact:
            tolerance += self._tolerances[0]
            tolerance[poses.start + POSE - 1 : poses.stop : POSE] = self._tolerances[1]
        tolerance[layout.block(CALIBRATION_LETTER)] = np.inf
        away = np.abs(self.variables.values - self.variables.linearized) > tolerance
        return layout.keys[np.logical_or.reduceat(away, layout.starts)]

    def _stale(self, cycles: IntArray, moved: IntArray) -> IntArray:
        """Cycles whose factor is missing, holds a variable that has moved, or other readings than before."""
        changed, gone = set(self.map.changed().tolist()), frozenset(moved.tolist())
        return np.array(
            [
                cycle
                for cycle in cycles.tolist()
                if cycle in changed
                or cycle not in self.of_cycle
                or not gone.isdisjoint(self.of_cycle[cycle].keys)
            ],
            np.intp,
        )

    def _relinearize_gauge(self, moved: IntArray) -> None:
        """The weak priors, where a map point has moved, or all where they are between others than before."""
        structure, gone = self.map.structure, frozenset(moved.tolist())
        if structure is not self._structure:
            self.gauge, self._structure = {}, structure
            linear = jacobian_factors(self.map.linear_gauge(False), self.variables)
            rows = graph_of(*(factor.linear for factor in linear.values()))
            self._linear_gauge = graph_of(as_hessian_factor(rows)) if linear else rows
        kept = [owner for owner, factor in self.gauge.items() if gone.isdisjoint(factor.keys)]
        if len(kept) == len(self.gauge) > 0:
            return
        stale = self.map.gauge(False)
        if kept:
            stale = [group.where(~np.isin(group.owner, kept)) for group in stale]
        self.gauge |= jacobian_factors(stale, self.variables)
