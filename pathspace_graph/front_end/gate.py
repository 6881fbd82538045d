"""The gate of the online estimators: it checks a perception cycle before the estimate changes.

A wrong stamp, shape, label or twist makes the whole cycle unusable: a ReadingError is raised and nothing
changes. An impossible detection is dropped, since a detector may fail for a single cone.
"""

from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.copies import Copyable
from pathspace_graph.errors import InputError, ReadingError
from pathspace_graph.factors import _kernels as kernels
from pathspace_graph.factors.arrays import Array, BoolArray
from pathspace_graph.io.log import (
    DETECTIONS_FILE,
    MIN_INTERVAL,
    ODOMETRY_FILE,
    ROUND_OFF,
    Detections,
    Log,
    Odometry,
)
from pathspace_graph.labels import LEFT, NAMES
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.settings.mapper import LimitSettings

TWIST: Final = {"vx": "m/s", "vy": "m/s", "wz": "rad/s"}  # units by component
KNOWN_LABELS: Final = "one of " + ", ".join(f"{label} ({name})" for label, name in enumerate(NAMES))
LATEST_STAMP: Final = 1e11  # largest stamp (s), 3000 years: stamps in nanoseconds are larger
STAMPS: Final = f"at most {LATEST_STAMP:g} s (stamps are in seconds)"
MAX_TWISTS: Final = 100_000  # largest number of twists in a cycle, which bounds its time
MOST_DETECTIONS: Final = 500  # largest number of detections in a cycle, which bounds its time
MOST_POINTS: Final = 10_000  # largest number of points of lines in a cycle, thinned to that of detections
MIN_RANGE: Final = 0.01  # least distance of a detection from the vehicle (m)
MIN_SIGMA: Final = 1e-6  # least standard deviation of a detection in any direction (m)
MAX_SIGMA: Final = 100.0  # largest standard deviation of a detection in any direction (m)


@dataclass(frozen=True, eq=False)
class Admitted:
    """A usable perception cycle, in arrays of its own."""

    odometry: Odometry  # twists in force from the newest cycle to this one
    detections: Detections  # possible detections
    dropped: int = 0  # number of impossible detections
    refused: int = 0  # number of cycles refused since the last admitted one
    notice: str = ""  # reason for dropping, in the first of successive cycles with dropped detections

    def counted(self, result: CycleResult) -> CycleResult:
        """Return the result of the cycle with the counts of the gate."""
        if not (self.dropped or self.refused):
            return result
        notice = "; ".join(filter(None, [self.notice, result.notice]))
        return replace(result, notice=notice, dropped=self.dropped, refused=self.refused)


class Gate(Copyable):
    """Checks of each cycle, and the number of refused cycles."""

    def __init__(self, limits: LimitSettings, *, of_lines: bool = False) -> None:
        """Take limits, and whether all detections are points of lines."""
        self._most = MOST_POINTS if of_lines else MOST_DETECTIONS
        self.limits = limits
        self.refused = 0  # number of cycles refused since the last admitted one
        self._refused_at: float | None = None  # stamp (s) of the previous cycle, if it was refused
        self._dropping = False  # whether the previous cycle had impossible detections

    def admit(
        self,
        odometry: Odometry,
        detections: Detections,
        newest: float | None = None,
        twist: Array | None = None,
    ) -> Admitted:
        """Return a usable cycle; otherwise raise a ReadingError and count it as refused.

        `newest` is the stamp (s) of the newest admitted cycle, and `twist` (3,) the newest one measured. Each
        twist is held until the next one. Twists that end before the newest cycle are left out.
        """
        refused, before, said = self.refused, self._refused_at, getattr(detections, "t", None)
        now = float(said) if isinstance(said, int | float) and abs(said) < inf else None
        self.refused, self._refused_at = refused + 1, now  # undone below if all checks pass
        silence = self.limits.silence
        if now is not None and before is not None and 0.0 < now - before <= silence:
            silence = inf  # it follows the cycle just refused: two consistent cycles end a silence
        if not isinstance(detections, Detections):
            raise ReadingError("detections", "Detections", type(detections).__name__)
        try:
            t = float(detections.t)
        except (TypeError, ValueError, OverflowError):
            raise ReadingError("detections.t", "a number", type(detections.t).__name__) from None
        if not abs(t) <= LATEST_STAMP:
            raise ReadingError("detections.t", STAMPS, t)
        try:
            possible, notice = _possible_detections(detections, t, self.limits, self._most)
            stamps, twists = _checked_twists(odometry, self.limits)
            _check_order(stamps, t, newest, silence)
        except ReadingError as error:
            raise error.at(t) from None
        dropped, notice = len(detections.labels) - len(possible.labels), "" if self._dropping else notice
        self.refused, self._refused_at, self._dropping = 0, None, dropped > 0
        if newest is not None:
            first = int(stamps.searchsorted(newest, side="right")) - 1
            if first >= 0:
                stamps, twists = stamps[first:], twists[first:]
                stamps[0] = newest
            elif twist is not None:
                stamps, twists = np.append(newest, stamps), np.concatenate([twist[None], twists])
        count = len(possible.labels)
        if count > MOST_DETECTIONS:  # points of lines: one of every few
            possible = possible.where(np.arange(count) % -(-count // MOST_DETECTIONS) == 0)
        return Admitted(Odometry(stamps, twists), possible, dropped, refused, notice)

    def refuse(self) -> None:
        self.refused += 1


def check_usable(log: Log, folder: Path, limits: LimitSettings) -> None:
    """Raise an InputError of the log in a folder, with row and stamp, where a cycle is unusable."""
    gate, newest, twist = Gate(limits, of_lines=log.sensor.kind == "line"), None, None
    for odometry, detections in split_odometry(log.at_scale_one()):
        try:
            admitted = gate.admit(odometry, detections, newest, twist)
        except ReadingError as error:
            file, row = DETECTIONS_FILE, None
            if error.field.startswith("odometry"):
                file = ODOMETRY_FILE
                if error.row is not None:  # of the file, whose header is row 1
                    row = int(log.odometry.t.searchsorted(odometry.t[error.row], side="right")) + 1
            text = str(ReadingError(error.field, error.expected, error.found, t=error.t))
            raise InputError(folder / file, text, row) from error
        newest, twist = detections.t, admitted.odometry.twist[-1] if len(admitted.odometry.t) else None


def _check_order(stamps: Array, t: float, newest: float | None, silence: float) -> None:
    """Refuse a cycle at t (s) that is out of order, has later twists (`stamps` (k,)), or ends a silence."""
    if newest is not None and t <= newest:
        raise ReadingError("detections.t", "a stamp later than the newest cycle", t)
    if len(stamps) and stamps[-1] > t:
        row = int(stamps.searchsorted(t, side="right"))
        raise ReadingError("odometry.t", "none later than the cycle", float(stamps[row]), row)
    if newest is not None and t - newest < MIN_INTERVAL - ROUND_OFF:
        raise ReadingError("detections.t", f"at least {MIN_INTERVAL:g} s after the newest cycle", t)
    before = [] if newest is None else [newest]
    known = np.concatenate([before, stamps, [t]])
    steps = known[1:] - known[:-1]
    if len(steps) == 0 or steps.max() <= silence:
        return
    at = int(steps.argmax()) + 1
    expected = f"at most {silence:g} s after the reading at {known[at - 1]:.12g} s (stamps are in seconds)"
    if at == len(known) - 1:
        raise ReadingError("detections.t", expected, t)
    raise ReadingError("odometry.t", expected, float(known[at]), at - len(before))


def _checked_twists(odometry: Odometry, limits: LimitSettings) -> tuple[Array, Array]:
    """Copy the stamps (k,) and the twists (k, 3) if they are finite, possible and in order of time."""
    if not isinstance(odometry, Odometry):
        raise ReadingError("odometry", "Odometry", type(odometry).__name__)
    stamps = _array(odometry.t, "odometry.t", (-1,)).astype(np.float64)
    twists = _array(odometry.twist, "odometry.twist", (len(stamps), len(TWIST))).astype(np.float64)
    if len(stamps) > MAX_TWISTS:
        raise ReadingError("odometry.t", f"at most {MAX_TWISTS} twists", len(stamps))
    within, later = np.abs(stamps) <= LATEST_STAMP, np.ones(len(stamps), bool)
    later[1:] = stamps[1:] > stamps[:-1]
    _require(within, "odometry.t", STAMPS, stamps)
    _require(later, "odometry.t", "a stamp later than the one before", stamps)
    most = limits.speed, limits.speed, limits.yaw_rate
    good = np.abs(twists) <= most
    if not good.all():
        row, column = divmod(int(good.argmin()), len(TWIST))
        name, unit = list(TWIST.items())[column]
        expected = f"{name} from -{most[column]:g} to {most[column]:g} {unit}"
        raise ReadingError("odometry.twist", expected, float(twists[row, column]), row)
    return stamps, twists


def _require(good: BoolArray, field: str, expected: str, values: NDArray[Any]) -> None:
    if not good.all():
        row = int(good.argmin())
        raise ReadingError(field, expected, values[row].item(), row)


def _possible_detections(
    detections: Detections, t: float, limits: LimitSettings, most: int
) -> tuple[Detections, str]:
    """Return the possible detections of a cycle at t (s), and a notice about the others.

    More than `most` are refused.
    """
    points = _array(detections.points_vehicle, "detections.points_vehicle", (-1, 2)).astype(np.float64)
    count, field = len(points), "detections.labels"
    covariances = _array(detections.covariances, "detections.covariances", (count, 2, 2)).astype(np.float64)
    labels = _array(detections.labels, field, (count,), "iu", "integers").astype(np.int_)
    _require((labels >= LEFT) & (labels < len(NAMES)), field, KNOWN_LABELS, labels)
    if count > most:
        raise ReadingError("detections.points_vehicle", f"at most {most} rows", count)
    ranges, sigmas = (MIN_RANGE, limits.range_max), (MIN_SIGMA, MAX_SIGMA)
    # a covariance may differ from its transpose by 1e-6 of its larger eigenvalue, and has to have a
    # determinant of 1e-12 xx yy at least: below, doubles cannot invert it
    near, definite = kernels.usable(points, covariances, (*ranges, 1e-6, 1e-12, *sigmas))
    good = near & definite
    if good.all():
        return Detections(t, points, covariances, labels), ""
    row = int(good.argmin())
    if near[row]:
        (xx, xy), (yx, yy) = covariances[row].tolist()
        expected = f"a covariance with sigmas from {sigmas[0]:g} to {sigmas[1]:g} m"
        found = f"[[{xx:g}, {xy:g}], [{yx:g}, {yy:g}]]"
    else:
        expected = f"a distance from {ranges[0]:g} to {ranges[1]:g} m"
        found = f"[{points[row, 0]:g}, {points[row, 1]:g}]"
    dropped = f"{count - int(good.sum())} of {count} detections dropped"
    notice = f"{dropped}: expected {expected}, found {found} in row {row}"
    return Detections(t, points[good], covariances[good], labels[good]), notice


def _array(
    values: Any, field: str, shape: tuple[int, ...], kinds: str = "fiu", expected: str = "numbers"
) -> NDArray[Any]:
    """Return an array of kinds of numbers and of a required shape, whose first length may be any (-1)."""
    try:
        array = np.asarray(values)
    except ValueError:
        raise ReadingError(field, "an array", "rows of different lengths") from None
    if array.ndim != len(shape) or array.shape[1:] != shape[1:] or shape[0] not in (-1, len(array)):
        raise ReadingError(field, f"the shape {shape}".replace("-1", "m"), f"the shape {array.shape}")
    if array.size and array.dtype.kind not in kinds:
        raise ReadingError(field, expected, array.dtype)
    return array
