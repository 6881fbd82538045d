"""Several drives as one: their cycles are counted on from drive to drive."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.sensor import SENSOR_SIZE

Terms = Callable[[IntArray | slice, Array], Sequence[Array]]
"""Arrays (m, ...) of m places in a table, given the calibration of the sensor that saw them."""


@dataclass(frozen=True)
class Drives:
    """Where each of several drives begins, and the sensor by which it saw."""

    first: tuple[int, ...] = (0,)
    """First cycle of each drive, ascending."""
    sensors: tuple[int, ...] = (0,)
    """Number of each drive's sensor; drives of one vehicle share it."""

    def __len__(self) -> int:
        return len(self.first)

    def parts(self, count: int) -> list[slice]:
        """Return the cycles of each drive, of a number of cycles in all."""
        return [slice(*ends) for ends in pairwise((*self.first, count))]

    def of(self, cycles: IntArray) -> IntArray:
        """Return the drive (m,) of each cycle."""
        return np.searchsorted(self.first, cycles, side="right") - 1

    def begins(self, count: int) -> BoolArray:
        """Return whether each of a number of cycles but the first is the first of its drive."""
        begins = np.zeros(count, bool)
        begins[list(self.first)] = True
        return begins[1:]

    def by_sensor(self, terms: Terms, cycles: IntArray, calibrations: Array) -> Sequence[Array]:
        """Return the arrays (m, ...) of `terms`, called for the m cycles of each drive.

        It takes where these are among the cycles, and the calibration of the drive's sensor of those of all.
        """
        if len(self) == 1:
            return terms(slice(None), calibrations)
        drive = self.of(cycles)
        places = [np.flatnonzero(drive == k) for k in range(len(self))]
        parts = [terms(own, of_sensor(calibrations, self.sensors[k])) for k, own in enumerate(places)]
        back = np.argsort(np.concatenate(places))
        return [np.concatenate(columns)[back] for columns in zip(*parts, strict=True)]

    def longest(self, count: int) -> slice:
        """Return the cycles of the drive with most of them."""
        return max(self.parts(count), key=lambda part: part.stop - part.start)


ONE_DRIVE: Final = Drives()


def of_sensor(calibrations: Array, number: int) -> Array:
    """Return the calibration (5,) of a sensor, of those of all (5 s,); empty where none is estimated."""
    return calibrations[SENSOR_SIZE * number : SENSOR_SIZE * (number + 1)]
