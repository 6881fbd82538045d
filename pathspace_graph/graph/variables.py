"""Variables: what a GTSAM key means, and values by key in one flat vector, in the order of the keys.

    b_0   calibration of the odometry (scale error [-], yaw-rate bias [rad/s]); b_d of drive d, if several
    c_0   calibration of the sensor (`factors.sensor:SENSOR`), where it is estimated; c_s of sensor s
    l_j   control point j of the left boundary (m, m), map frame
    m_i   landmark i of the landmark graphs (m, m), map frame
    r_j   control point j of the right boundary (m, m), map frame
    x_k   pose of perception cycle k (m, m, rad), map frame
    y_0   the origin of the map frame, as a pose: the open map hangs on it, and it does not move

A control point keeps its key while its boundary grows; a curve on new knots has new keys. A pose is
`(x, y, theta)` with theta unwrapped, and it changes by addition: its unknowns are not the tangent of
`gtsam.Pose2`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final

import gtsam
import numpy as np

from pathspace_graph.copies import shallow
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.sensor import SENSOR_SIZE

CONTROL_LETTERS: Final = ("l", "r")  # by the label of the boundary (left, right)
LANDMARK_LETTER: Final = "m"
CALIBRATION_LETTER: Final = "b"
SENSOR_LETTER: Final = "c"
POSE_LETTER: Final = "x"
POSE: Final = 3  # entries of a pose: x, y, theta
POINT: Final = 2  # entries of every other variable but the sensor's calibration
INDEX_BITS: Final = 56  # low bits of a key, which hold its index; its letter is in the highest byte
UNKNOWN: Final = -1  # column of a key that a layout does not hold
NO_KEYS: Final = np.zeros(0, np.intp)


def letter_keys(letter: str) -> tuple[int, int]:
    """Return the first key of a letter, and the first key after its last one."""
    first = int(gtsam.symbol(letter, 0))
    return first, first + (1 << INDEX_BITS)


CALIBRATION_KEY: Final = letter_keys(CALIBRATION_LETTER)[0]
SENSOR_KEY: Final = letter_keys(SENSOR_LETTER)[0]
FIRST_POINT: Final = letter_keys(SENSOR_LETTER)[1]  # the keys of all points and poses are not smaller
FIRST_POSE: Final = letter_keys(POSE_LETTER)[0]  # every key from this one on belongs to a pose
ORIGIN_KEY: Final = letter_keys("y")[0]  # the origin of the map frame, a pose at (0, 0, 0) by definition
_FIRST_LANDMARK: Final = letter_keys(LANDMARK_LETTER)[0]
_FIRST_CONTROL: Final = tuple(letter_keys(letter)[0] for letter in CONTROL_LETTERS)
_SIZES: Final = (POINT, SENSOR_SIZE, POSE)
_LETTERS: Final = (CALIBRATION_LETTER, SENSOR_LETTER, *CONTROL_LETTERS, LANDMARK_LETTER, POSE_LETTER)
_PLACES: Final = {letter: 2 * k for k, letter in enumerate(_LETTERS)}  # of the ends of a letter's block
_LETTER_ENDS: Final = np.array([letter_keys(letter) for letter in _LETTERS], np.intp).ravel()


def pose_key(cycle: int) -> int:
    """Return the key `symbol('x', cycle)` of the pose at a perception cycle, counted from 0."""
    return FIRST_POSE + int(cycle)


def pose_keys(cycles: IntArray) -> IntArray:
    """Return the keys of the poses at perception cycles, in any shape."""
    return FIRST_POSE + np.asarray(cycles, np.intp)


def control_keys(label: int, numbers: IntArray) -> IntArray:
    """Return the keys of a boundary's control points by their numbers, in any shape."""
    return _FIRST_CONTROL[label] + np.asarray(numbers, np.intp)


def landmark_keys(numbers: IntArray) -> IntArray:
    """Return the keys of landmarks by their numbers, in any shape."""
    return _FIRST_LANDMARK + np.asarray(numbers, np.intp)


def indices(keys: IntArray) -> IntArray:
    """Return the index of each key: the cycle of a pose, or the number of a point."""
    return np.asarray(keys & ((1 << INDEX_BITS) - 1))


def are_poses(keys: IntArray) -> BoolArray:
    return np.asarray(keys >= FIRST_POSE)


def sizes(keys: IntArray) -> IntArray:
    """Return the number of entries of each key's variable, which its letter determines."""
    return kernels.laid_out(keys, SENSOR_KEY, FIRST_POSE, _SIZES, _LETTER_ENDS)[0]


def name(key: int) -> str:
    """Return a key as text, such as `x12`."""
    return str(gtsam.DefaultKeyFormatter(key))


def names(keys: IntArray) -> str:
    """Return the first keys of an array as text for a message."""
    return ", ".join(name(key) for key in keys[:3].tolist())


class Layout:
    """Columns of a flat vector by ascending keys (K,): their widths (K,) and first columns (K,)."""

    def __init__(self, keys: IntArray) -> None:
        self.keys = keys
        laid_out = kernels.laid_out(keys, SENSOR_KEY, FIRST_POSE, _SIZES, _LETTER_ENDS)
        self.widths, self.starts, self.size, self._letter_ends = laid_out

    @cached_property
    def ordering(self) -> gtsam.Ordering:
        return gtsam.Ordering(self.keys.tolist())

    @cached_property
    def turning(self) -> IntArray:
        """Return the columns of the x of all points and poses, which a rigid motion turns with y."""
        return np.asarray(self.starts[self.keys >= FIRST_POINT])

    @cached_property
    def headings(self) -> IntArray:
        """Return the columns of the headings of all poses."""
        return np.asarray(self.starts[are_poses(self.keys)] + POSE - 1)

    def positions(self, keys: IntArray) -> IntArray:
        """Return the index of each key, in any shape; it is UNKNOWN for a key that is not in the layout."""
        if len(self.keys) == 0:
            return np.full(np.shape(keys), UNKNOWN)
        places = np.minimum(self.keys.searchsorted(keys), len(self.keys) - 1)
        return np.where(self.keys[places] == keys, places, UNKNOWN)

    def places(self, keys: IntArray) -> IntArray:
        """Return the index of each key, in any shape; ValueError where the layout does not hold it."""
        places = self.keys.searchsorted(keys)
        known = self.keys.take(places, mode="clip") == keys
        if not known.all():
            raise ValueError(f"expected rows on known variables, found {names(keys[~known])}")
        return np.asarray(places)

    def columns(self, keys: IntArray) -> IntArray:
        """Return the first column of each key, in any shape; UNKNOWN for a key that is not in the layout."""
        places = self.positions(keys)
        return np.where(places >= 0, self.starts[places], UNKNOWN) if len(self.keys) else places

    def entries(self, keys: IntArray) -> IntArray:
        """Return all columns (n,) of keys (k,), one key after the other; ValueError for an unknown key."""
        places = self.places(keys)
        return kernels.spread(self.starts[places], self.widths[places])

    def block(self, letter: str) -> slice:
        first = _PLACES[letter]
        return slice(*self._letter_ends[first : first + 2])


def rotation_blocks(size: int, columns: IntArray, angles: Array) -> Array:
    """Return the identity (size, size) with R(angle) in the two columns from each of `columns` (k,) on."""
    matrix, c, s = np.eye(size), np.cos(angles), np.sin(angles)
    matrix[columns, columns], matrix[columns, columns + 1] = c, -s
    matrix[columns + 1, columns], matrix[columns + 1, columns + 1] = s, c
    return matrix


class Variables:
    """Value for each key, and the reference that its unknown is measured from.

    Linear factors are functions of `value - reference`. The reference is the first value and never changes,
    so the factors of the prior need no shift when their variables move.
    """

    def __init__(self) -> None:
        self.layout = Layout(NO_KEYS)
        self.values: Array = np.zeros(0)  # (n,) calibrations, points (m) and poses (m, m, rad)
        self.reference: Array = np.zeros(0)  # (n,) first values
        self.linearized: Array = np.zeros(0)  # (n,) values at which the factors were linearized last
        self.first_cycle = 0  # of the window's oldest pose; older poses are keyframes
        self._first_pose = self.layout, -1, 0  # layout, first cycle, and where the window's poses begin

    def copy(self) -> Variables:
        """Return variables with the same keys and copies of the values."""
        other = shallow(self)
        other.values, other.linearized = self.values.copy(), self.linearized.copy()
        return other

    @property
    def keys(self) -> IntArray:
        return self.layout.keys

    def insert(self, keys: IntArray, values: Array, reference: Array | None = None) -> None:
        """Insert ascending, new keys (k,) with their values (n,); ValueError where a key is known already.

        References are the values, unless `reference` (n,) is given for variables that come back.
        """
        if len(keys) == 0:
            return
        known, added = self.layout, Layout(keys)
        both = np.concatenate([known.keys, keys])
        order = both.argsort(kind="stable")
        ascending = both[order]
        if (ascending[1:] == ascending[:-1]).any():
            raise ValueError(f"expected new keys, found {name(int(keys[0]))} or a later one of them known")
        starts = np.concatenate([known.starts, added.starts + known.size])
        entries = kernels.spread(starts[order], np.concatenate([known.widths, added.widths])[order])
        self.layout, reference = Layout(ascending), values if reference is None else reference
        self.values = np.concatenate([self.values, values])[entries]
        self.reference = np.concatenate([self.reference, reference])[entries]
        self.linearized = np.concatenate([self.linearized, values])[entries]

    def remove(self, keys: IntArray) -> None:
        if len(keys) == 0:
            return
        kept_keys = np.ones(len(self.layout.keys), bool)
        kept_keys[self.layout.places(keys)] = False
        kept_entries = kept_keys.repeat(self.layout.widths)
        self.layout = Layout(self.layout.keys[kept_keys])
        self.values, self.reference = self.values[kept_entries], self.reference[kept_entries]
        self.linearized = self.linearized[kept_entries]

    @contextmanager
    def looked_at(self) -> Iterator[None]:
        """Restore all values at the end, since looking at the estimate must not change it."""
        values = self.values.copy()
        try:
            yield
        finally:
            self.values[:] = values

    def of(self, keys: IntArray) -> Array:
        """Return a copy of the values (n,) of keys (k,), one after the other."""
        return self.values[self.layout.entries(keys)]

    def change(self, columns: IntArray | slice) -> Array:
        """Return `value - reference`, the unknowns, at some entries."""
        return np.asarray(self.values[columns] - self.reference[columns])

    def block(self, letter: str) -> Array:
        """Return a view of the values (n,) of all keys of a letter."""
        return self.values[self.layout.block(letter)]

    @property
    def calibration(self) -> Array:
        """Return a view of the odometry's calibration: scale error (-) and yaw-rate bias (rad/s)."""
        return self.block(CALIBRATION_LETTER)

    @property
    def calibrations(self) -> Array:
        """Return a view of the calibrations of the odometry and, where it is estimated, of the sensor."""
        first, last = self.layout.block(CALIBRATION_LETTER), self.layout.block(SENSOR_LETTER)
        return self.values[first.start : last.stop]

    @property
    def sensor_key(self) -> int | None:
        """Return the key of the sensor's calibration, if it is estimated."""
        return SENSOR_KEY if len(self.sensor) else None

    @property
    def calibration_keys(self) -> IntArray:
        """Return the keys of the calibrations: the odometry's, and the sensor's if it is estimated."""
        return np.asarray(self.keys[self.keys < FIRST_POINT])

    def insert_calibrations(self, values: Array) -> None:
        """Insert the calibration of the odometry (2,), or of odometry and sensor (7,)."""
        self.insert(np.array([CALIBRATION_KEY, SENSOR_KEY])[: 1 if len(values) == POINT else 2], values)

    @property
    def sensor(self) -> Array:
        """Return a view of the sensor's calibration (5,), which is empty where it is not estimated."""
        return self.block(SENSOR_LETTER)

    @property
    def keyframes(self) -> IntArray:
        """Return the keys of the poses that are older than the window, oldest first."""
        first, last = self.keys.searchsorted([FIRST_POSE, pose_key(self.first_cycle)])
        return self.keys[first:last]

    @property
    def poses(self) -> Array:
        """Return a view of the window's poses (P, 3), oldest first."""
        known = self._first_pose
        if known[0] is not self.layout or known[1] != self.first_cycle:
            count = len(self.keys) - int(self.keys.searchsorted(pose_key(self.first_cycle)))
            begin = self.layout.size - POSE * count
            known = self._first_pose = self.layout, self.first_cycle, begin
        return self.values[known[2] :].reshape(-1, POSE)

    def poses_at(self, cycles: IntArray) -> Array:
        """Return the window's poses (m, 3) at perception cycles (m,)."""
        return self.poses[cycles - self.first_cycle]

    def gtsam_values(self, keys: IntArray) -> gtsam.Values:
        """Return the values of keys (k,) for GTSAM: a pose is a `Pose2`, any other variable a vector."""
        values = gtsam.Values()
        own = np.split(self.of(keys), sizes(keys).cumsum()[:-1])
        for key, value in zip(keys.tolist(), own if len(keys) else [], strict=True):
            values.insert(key, gtsam.Pose2(*value) if key >= FIRST_POSE else value)
        return values


# --- several drives --------------------------------------------------------------------------------------


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
