"""Values by key in one flat vector, in the order of the keys."""

from __future__ import annotations

from functools import cached_property
from typing import TypeVar, cast

import gtsam
import numpy as np
from numpy.typing import NDArray

from .keys import CALIBRATION_LETTER, POSE, POSE_LETTER, are_poses, letter_keys, name, pose_key, sizes

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
T = TypeVar("T", bound=NDArray[np.generic])

UNKNOWN = -1
"""Column of a key that a layout does not hold."""


class Layout:
    """Which columns of a flat vector belong to which key; keys are in ascending order."""

    def __init__(self, keys: IntArray) -> None:
        self.keys = keys
        """(K,) ascending."""
        self.widths: IntArray = sizes(keys)
        """(K,) entries of each."""
        ends = self.widths.cumsum()
        self.starts: IntArray = ends - self.widths
        """(K,) first column of each."""
        self.size = int(ends[-1]) if len(keys) else 0
        """Columns of all."""
        self._blocks: dict[str, slice] = {}

    @cached_property
    def ordering(self) -> gtsam.Ordering:
        """The keys as GTSAM has an ordering."""
        return gtsam.Ordering(self.keys.tolist())

    def positions(self, keys: IntArray) -> IntArray:
        """Place of each key among the keys, UNKNOWN where it is not there; any shape."""
        if len(self.keys) == 0:
            return np.full(np.shape(keys), UNKNOWN)
        places = np.minimum(self.keys.searchsorted(keys), len(self.keys) - 1)
        return np.where(self.keys[places] == keys, places, UNKNOWN)

    def columns(self, keys: IntArray) -> IntArray:
        """First column of each key, UNKNOWN where it is not there; any shape."""
        places = self.positions(keys)
        return np.where(places >= 0, self.starts[places], UNKNOWN) if len(self.keys) else places

    def entries(self, keys: IntArray) -> IntArray:
        """(n,) every column of the given keys (k,), one key after the other; all must be there."""
        return spread(self.columns(keys), sizes(keys))

    def block(self, letter: str) -> slice:
        """Columns of all keys of a letter; kept for next time."""
        if letter not in self._blocks:
            self._blocks[letter] = slice(*(self.begin(key) for key in letter_keys(letter)))
        return self._blocks[letter]

    def begin(self, key: int) -> int:
        """First column of a key, or where it would be."""
        place = int(self.keys.searchsorted(key))
        return int(self.starts[place]) if place < len(self.keys) else self.size


def spread(starts: IntArray, widths: IntArray) -> IntArray:
    """(n,) the columns `start, start + 1, ...` of blocks (k,) of these widths, one after the other."""
    ends = np.cumsum(widths)
    total = int(ends[-1]) if len(ends) else 0
    return np.repeat(starts - (ends - widths), widths) + np.arange(total)


def _inserted(array: T, at: int, values: T) -> T:
    """An array with values put in before an index; `np.insert` takes ten times as long."""
    return cast(T, np.concatenate([array[:at], values, array[at:]]))


class Variables:
    """A value for each key, and the reference that its unknown is counted from.

    Linear factors are functions of `value - reference`, where a variable's reference is its first value and
    never changes. So a factor of the prior holds however far its variables have moved, and is never shifted.
    """

    def __init__(self) -> None:
        self.layout = Layout(np.zeros(0, np.intp))
        """Which entries of the values are whose."""
        self.values: Array = np.zeros(0)
        """(n,) poses (m, m, rad), points (m), calibration."""
        self.reference: Array = np.zeros(0)
        """(n,) the first value of each."""
        self.linearized: Array = np.zeros(0)
        """(n,) the value of each when the factors that it is in were linearized last."""
        self.first_cycle = 0
        """Perception cycle of the oldest pose of the window; older poses are keyframes."""
        self._first_pose = self.layout, -1, 0  # where the window's poses begin; they are the last of all

    def copy(self) -> Variables:
        """The same keys with values of their own."""
        other = Variables()
        other.layout, other.reference = self.layout, self.reference
        other.values, other.linearized = self.values.copy(), self.linearized.copy()
        other.first_cycle = self.first_cycle
        return other

    @property
    def keys(self) -> IntArray:
        """(K,) all keys, ascending."""
        return self.layout.keys

    def insert(self, keys: IntArray, values: Array, reference: Array | None = None) -> None:
        """New variables: ascending keys (k,) that are not there yet, values (n,) one after the other.

        `reference`: what their unknowns are counted from where they were known before; else the values.
        """
        reference = values if reference is None else reference
        if len(keys) == 0:
            return
        if (self.layout.positions(keys) >= 0).any():
            raise ValueError(f"expected new keys, found {name(int(keys[0]))} or a later one of them known")
        place = int(self.layout.keys.searchsorted(keys[0]))
        if place != self.layout.keys.searchsorted(keys[-1]):  # the new keys lie between known ones
            half = len(keys) // 2
            width = int(sizes(keys[:half]).sum())
            self.insert(keys[:half], values[:width], reference[:width])
            self.insert(keys[half:], values[width:], reference[width:])
            return
        at = self.layout.begin(int(keys[0]))
        self.layout = Layout(_inserted(self.layout.keys, place, keys))
        self.values = _inserted(self.values, at, values)
        self.reference = _inserted(self.reference, at, reference)
        self.linearized = _inserted(self.linearized, at, values)

    def remove(self, keys: IntArray) -> None:
        """Variables (k,) that are known no more."""
        kept = np.ones(self.layout.size, bool)
        kept[self.layout.entries(keys)] = False
        stays = np.ones(len(self.layout.keys), bool)
        stays[self.layout.positions(keys)] = False
        self.layout = Layout(self.layout.keys[stays])
        self.values, self.reference = self.values[kept], self.reference[kept]
        self.linearized = self.linearized[kept]

    def of(self, keys: IntArray) -> Array:
        """(n,) values of keys (k,), one after the other: a copy."""
        return self.values[self.layout.entries(keys)]

    def change(self, columns: IntArray) -> Array:
        """`value - reference` of some entries."""
        return np.asarray(self.values[columns] - self.reference[columns])

    def block(self, letter: str) -> Array:
        """(n,) values of all keys of a letter: a view."""
        return self.values[self.layout.block(letter)]

    @property
    def calibration(self) -> Array:
        """(scale error [-], yaw-rate bias [rad/s]) of the odometry: a view."""
        return self.block(CALIBRATION_LETTER)

    @property
    def keyframes(self) -> IntArray:
        """Keys of the poses that are older than the window, oldest first."""
        first, last = self.keys.searchsorted([letter_keys(POSE_LETTER)[0], pose_key(self.first_cycle)])
        return self.keys[first:last]

    @property
    def poses(self) -> Array:
        """Poses (P, 3) of the window, oldest first: a view."""
        known = self._first_pose
        if known[0] is not self.layout or known[1] != self.first_cycle:
            begin = self.layout.begin(pose_key(self.first_cycle))
            known = self._first_pose = self.layout, self.first_cycle, begin
        return self.values[known[2] :].reshape(-1, POSE)

    def poses_at(self, cycles: IntArray) -> Array:
        """(m, 3) the window's poses at perception cycles (m,)."""
        return self.poses[cycles - self.first_cycle]

    def gtsam_values(self, keys: IntArray) -> gtsam.Values:
        """Values of keys (k,) as GTSAM has them: `Pose2` for a pose, a vector of two for the others."""
        values = gtsam.Values()
        starts, poses = self.layout.columns(keys).tolist(), are_poses(keys).tolist()
        for key, start, is_pose in zip(keys.tolist(), starts, poses, strict=True):
            if is_pose:
                values.insert(key, gtsam.Pose2(*self.values[start : start + POSE]))
            else:
                values.insert(key, self.values[start : start + 2])
        return values
