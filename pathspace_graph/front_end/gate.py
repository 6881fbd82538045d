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
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
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
from pathspace_graph.settings.online import LimitSettings

TWIST: Final = {"vx": "m/s", "vy": "m/s", "wz": "rad/s"}  # units by component
LATEST_STAMP: Final = 1e11  # largest stamp (s), 3000 years: stamps in nanoseconds are larger
IN_SECONDS: Final = "stamps are in seconds"  # hint for stamps in milli- or nanoseconds
STAMPS: Final = f"at most {LATEST_STAMP:g} s ({IN_SECONDS})"
MAX_TWISTS: Final = 100_000  # largest number of twists in a cycle, which bounds its time
MOST_DETECTIONS: Final = 500  # largest number of detections in a cycle, which bounds its time
MOST_POINTS: Final = 10_000  # largest number of points of lines in a cycle, thinned to that of detections
MIN_RANGE: Final = 0.01  # least distance of a detection from the vehicle (m)
MIN_SIGMA: Final = 1e-6  # least standard deviation of a detection in any direction (m)
MAX_SIGMA: Final = 100.0  # largest standard deviation of a detection in any direction (m)
MIN_DETERMINANT: Final = 1e-12  # least det / (xx yy) of a covariance: below, doubles cannot invert it
MOST_ASYMMETRY: Final = 1e-6  # largest |xy - yx| of a covariance over its larger eigenvalue
_KNOWN_LABELS: Final = "one of " + ", ".join(f"{label} ({name})" for label, name in enumerate(NAMES))


@dataclass(frozen=True, eq=False)
class Newest:
    """Stamp and twist of the newest admitted cycle; None before the first one."""

    t: float | None = None  # stamp (s)
    twist: Array | None = None  # (3,) newest measured twist (m/s, m/s, rad/s)


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

    def admit(self, odometry: Odometry, detections: Detections, newest: Newest) -> Admitted:
        """Return a usable cycle; otherwise raise a ReadingError and count it as refused.

        Each twist is held until the next one. Twists that end before the newest cycle are left out.
        """
        refused, before, said = self.refused, self._refused_at, getattr(detections, "t", None)
        now = float(said) if isinstance(said, int | float) and abs(said) < inf else None
        self.refused, self._refused_at = refused + 1, now  # undone below if all checks pass
        silence = self.limits.silence
        if now is not None and before is not None and 0.0 < now - before <= silence:
            silence = inf  # it follows the cycle just refused: two consistent cycles end a silence
        t = _stamp(_of_type(Detections, detections, "detections").t)
        try:
            possible, notice = possible_detections(detections, t, self.limits, self._most)
            stamps, twists = _checked_twists(_of_type(Odometry, odometry, "odometry"), self.limits)
            _check_order(stamps, t, newest.t, silence)
        except ReadingError as error:
            raise error.at(t) from None
        dropped, notice = len(detections.labels) - len(possible.labels), "" if self._dropping else notice
        self.refused, self._refused_at, self._dropping = 0, None, dropped > 0
        since = _since(Odometry(stamps, twists), newest)
        count = len(possible.labels)
        one_of = max(-(-count // MOST_DETECTIONS), 1)  # of every few, where there are more than the most
        possible = possible.where(np.arange(count) % one_of == 0)
        return Admitted(since, possible, dropped, refused, notice)

    def refuse(self) -> None:
        self.refused += 1


def check_usable(log: Log, folder: Path, limits: LimitSettings) -> None:
    """Raise an InputError of the log in a folder, with row and stamp, where a cycle is unusable."""
    gate, newest = Gate(limits, of_lines=log.sensor.kind == "line"), Newest()
    for odometry, detections in split_odometry(log.at_scale_one()):
        try:
            admitted = gate.admit(odometry, detections, newest)
        except ReadingError as error:
            file, row = DETECTIONS_FILE, None
            if error.field.startswith("odometry"):
                file = ODOMETRY_FILE
                if error.row is not None:  # of the file, whose header is row 1
                    row = int(log.odometry.t.searchsorted(odometry.t[error.row], side="right")) + 1
            text = str(ReadingError(error.field, error.expected, error.found, t=error.t))
            raise InputError(folder / file, text, row) from error
        newest = Newest(detections.t, admitted.odometry.twist[-1] if len(admitted.odometry.t) else None)


def _stamp(value: Any) -> float:
    try:
        t = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ReadingError("detections.t", "a number", type(value).__name__) from None
    if not abs(t) <= LATEST_STAMP:
        raise ReadingError("detections.t", STAMPS, t)
    return t


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
    expected = f"at most {silence:g} s after the reading at {known[at - 1]:.12g} s ({IN_SECONDS})"
    if at == len(known) - 1:
        raise ReadingError("detections.t", expected, t)
    raise ReadingError("odometry.t", expected, float(known[at]), at - len(before))


def _checked_twists(odometry: Odometry, limits: LimitSettings) -> tuple[Array, Array]:
    """Return the stamps (k,) and the twists (k, 3) if they are finite, possible and in order of time."""
    stamps = _numbers(odometry.t, "odometry.t", (-1,))
    twists = _numbers(odometry.twist, "odometry.twist", (len(stamps), len(TWIST)))
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


def _since(odometry: Odometry, newest: Newest) -> Odometry:
    """Return the twists in force since the newest cycle; the first one starts there."""
    if newest.t is None:
        return odometry
    stamps, twists = odometry.t, odometry.twist
    first = int(stamps.searchsorted(newest.t, side="right")) - 1
    if first >= 0:
        stamps, twists = stamps[first:], twists[first:]
        stamps[0] = newest.t
    elif newest.twist is not None:
        stamps, twists = np.append(newest.t, stamps), np.concatenate([newest.twist[None], twists])
    return Odometry(stamps, twists)


def possible_detections(
    detections: Detections, t: float, limits: LimitSettings, most: int = MOST_DETECTIONS
) -> tuple[Detections, str]:
    """Return the possible detections of a cycle at t (s), and a notice about the others.

    More than `most` are refused.
    """
    points = _numbers(detections.points_vehicle, "detections.points_vehicle", (-1, 2))
    count = len(points)
    covariances = _numbers(detections.covariances, "detections.covariances", (count, 2, 2))
    labels = _labels(detections.labels, count)
    if count > most:
        raise ReadingError("detections.points_vehicle", f"at most {most} rows", count)
    ranges, sigmas = (MIN_RANGE, limits.range_max), (MIN_SIGMA, MAX_SIGMA)
    near, definite = kernels.usable(points, covariances, (*ranges, MOST_ASYMMETRY, MIN_DETERMINANT, *sigmas))
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


def _labels(values: Any, count: int) -> IntArray:
    field = "detections.labels"
    labels = _array(values, field, (count,))
    if count and labels.dtype.kind not in "iu":
        raise ReadingError(field, "integers", labels.dtype)
    _require((labels >= LEFT) & (labels < len(NAMES)), field, _KNOWN_LABELS, labels)
    return labels.astype(np.int_)


def _numbers(values: Any, field: str, shape: tuple[int, ...]) -> Array:
    """Copy numbers of a required shape, in which -1 matches any length, to an array."""
    array = _array(values, field, shape)
    if array.dtype.kind not in "fiu":
        raise ReadingError(field, "numbers", array.dtype)
    return array.astype(np.float64)


def _array(values: Any, field: str, shape: tuple[int, ...]) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError:
        raise ReadingError(field, "an array", "rows of different lengths") from None
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        raise ReadingError(field, f"the shape {shape}".replace("-1", "m"), f"the shape {array.shape}")
    return array


def _of_type(kind: type[Any], value: Any, field: str) -> Any:
    if not isinstance(value, kind):
        raise ReadingError(field, kind.__name__, type(value).__name__)
    return value
