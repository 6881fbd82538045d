"""Convert a record in any order to a log, and arriving messages to cycles; count what is dropped."""

from bisect import insort
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io import log as logs
from pathspace_graph.io.covariances import is_positive_definite, ray_covariances
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo
from pathspace_graph.io.parsing import MAX_RANGE, MAX_STAMP
from pathspace_graph.labels import UNKNOWN

from . import twists
from .lines import along_lines, are_lines, count, default_spacing, in_vehicle, lines_of
from .messages import ALONE, BROKEN, DENSE, Points, points_of, stamp_of, twist_of
from .settings import Frames, LabelRule, NoiseSettings, Window

MAX_ASYMMETRY: Final = 1e-3  # largest |xy - yx| by the larger variance: messages in single precision
MAX_DISORDER: Final = 2.0  # largest fall of stamps (s) from one message to the next of one clock
SHORTEST: Final = 1e-6  # least time (s) that gives a rate; a bag of one message has 1 ns
PAUSE: Final = 1.0  # time (s) assumed to pass where a clock was reset
MOST_PLACES: Final = 5  # number of rows that are named
REPEATED: Final = 0.02  # distance (m) below which two detections of a message are one
PAIRED: Final = 0.25  # distance of two detections of one cone, by that of the next one beside them
MOST_PAIRED: Final = 0.5  # share of detections in such pairs from which each cone was reported twice
# notes of what was done
ASSUMED: Final = "detections had no covariance that can be used, and were given one"
OUTSIDE: Final = "messages with detections outside the time of the odometry were left out"
SHARED: Final = "messages with detections are at most 1 ms after another one, and are one cycle with it"


@dataclass(frozen=True, eq=False)
class Recording:
    """Drive as it was recorded, in its own order and frames."""

    t: Array  # (N,) stamps of the odometry (s)
    motion: Array  # (N, 3) twists in m/s, m/s and rad/s, or poses in m, m and rad
    scan_t: Array  # (M,) stamps of the messages with detections (s)
    scans: list[Points]  # detections of each message, sensor frame
    source: dict[str, str]  # origin of the record, in words
    notes: Counter[str] = field(default_factory=Counter)  # what was done, in words, and how often
    mounting: tuple[float, float, float] | None = None  # sensor's pose (m, m, rad), where it is stated
    are_poses: bool = False  # whether the motion is in poses
    is_held: bool = False  # whether twists are means until the next one; else they are samples
    imu: tuple[Array, Array] | None = None  # stamps (s) and yaw rates (rad/s) (k,) of an IMU
    rows: IntArray | None = None  # (N,) number of each row of the odometry in its file, by default from 1
    place: str = "odometry, row"  # what is counted by it
    units: str = ""  # option that states the units of the odometry, where there is one

    @property
    def parts(self) -> int:
        """Number of parts of the interval of two twists that are interpolated; 1 for none."""
        return 1 if self.are_poses or self.is_held else twists.parts_of(self.t)

    @property
    def numbers(self) -> IntArray:
        """Number (N,) of each row of the odometry in its file."""
        return np.arange(len(self.t)) + 1 if self.rows is None else self.rows

    def chosen(self, kept: BoolArray, seen: BoolArray) -> "Recording":
        """Keep some rows (N,) of the odometry and some messages (M,) with detections."""
        scans = [scan for scan, one in zip(self.scans, seen.tolist(), strict=True) if one]
        scan_t, t, motion = self.scan_t[seen], self.t[kept], self.motion[kept]
        return replace(self, t=t, motion=motion, rows=self.numbers[kept], scan_t=scan_t, scans=scans)

    def at(self, rows: IntArray) -> str:
        """Say where rows of the odometry are."""
        told = ", ".join(map(str, rows[:MOST_PLACES].tolist()))
        return f"{self.place} {told}{', ...' * (len(rows) > MOST_PLACES)}"


def rate(count: int, seconds: float) -> str:
    """Rate of something in words, unknown where no time (s) passed."""
    return f"{count / seconds:.3g} Hz" if count > 1 and seconds > SHORTEST else "an unknown rate"


def clock_falls(t: Array) -> Array:
    """Fall of each stamp (n,) in s where the clock was reset; elsewhere 0.

    Two messages before it and two from it on agree, unlike those of a stray stamp. Messages out of order fall
    by less than `MAX_DISORDER`.
    """
    falls, known = np.zeros(len(t)), np.flatnonzero(np.isfinite(t))
    of_known = t[known]
    lowest_before = np.minimum(of_known[:-3], of_known[1:-2])
    highest_after = np.maximum(of_known[2:-1], of_known[3:])
    is_reset = lowest_before - highest_after > MAX_DISORDER
    falls[known[2:-1]] = np.where(is_reset, of_known[1:-2] - of_known[2:-1], 0.0)
    return falls


def elapsed(t: Array) -> Array:
    """Stamps (n,) in s of a clock that advances by `PAUSE` where this one falls."""
    falls = clock_falls(t)
    return np.asarray(t + np.cumsum(falls + PAUSE * (falls > 0.0)))


def check_clock(t: Array, what: str, file: Path, chosen: BoolArray | None = None, begin: float = 0.0) -> None:
    """Raise an InputError where stamps (n,) in s fall back between `chosen` messages.

    The options `--start` and `--end` count from `begin` (s) on, as `elapsed` does.
    """
    counted = np.flatnonzero(np.ones(len(t), bool) if chosen is None else chosen)
    falls = clock_falls(t[counted])
    if not falls.any():
        return
    inside = int(np.argmax(falls > 0.0))
    before, at = counted[inside - 1], counted[inside]
    cut = elapsed(t)[before] - begin + 0.5 * PAUSE
    fall = f"the stamps fall back by {t[before] - t[at]:.3g} s at message {at + 1}"
    found = f"found that {fall}, from {t[before]:.12g} s to {t[at]:.12g} s: was the clock reset?"
    parts = f"--end {cut:.1f} takes what is before, --start {cut:.1f} what is after it"
    way_out = f"{parts}; --received takes the times of receipt"
    raise InputError(file, f"expected {what} by one clock, {found} {way_out}")


def strays(t: Array) -> BoolArray:
    """Which stamps (n,) in s are far from the two around them, which are not far from one another."""
    if len(t) < 3:
        return np.zeros(len(t), bool)
    before, after = np.append(t[1], t[:-1]), np.append(t[1:], t[-2])
    before[0], after[-1] = t[2], t[-3]
    far = twists.LIMITS.silence
    apart = np.minimum(np.abs(t - before), np.abs(t - after))
    return np.asarray((apart > far) & (np.abs(before - after) <= far))


def without_strays(record: Recording) -> Recording:
    """Leave out what has a stamp far from those around it, as a first message of a clock that isn't set."""
    of_odometry, of_scans, notes = strays(record.t), strays(record.scan_t), record.notes
    if of_odometry.any():
        where = record.at(record.numbers[of_odometry])
        far = "odometry samples have a stamp far from those around them, and were left out"
        notes[f"{far}: {where}"] += int(of_odometry.sum())
    far = "messages with detections have a stamp far from those around them, and were left out"
    notes[far] += int(of_scans.sum())
    return record.chosen(~of_odometry, ~of_scans)


def windowed(record: Recording, window: Window, file: Path) -> Recording:
    """Cut a record to the window."""
    record = without_strays(record)
    notes, record = record.notes, _near(record, window.range_max, record.notes)
    scan_t = record.scan_t + window.time_offset
    clocks = elapsed(record.t), elapsed(scan_t)
    begin = float(np.nanmin(clocks[0], initial=np.inf))
    is_cut = (
        window.start > 0.0 or window.end < np.inf
    )  # else keep stamps that are not finite, which are counted later
    kept, seen = (
        (t >= begin + window.start) & (t <= begin + window.end) if is_cut else np.ones(len(t), bool)
        for t in clocks
    )
    check_clock(record.t, "odometry", file, kept, begin)
    check_clock(scan_t, "detections", file, seen, begin)
    notes["odometry samples outside --start and --end were left out"] += int((~kept).sum())
    notes["messages with detections outside --start and --end were left out"] += int((~seen).sum())
    return replace(record, scan_t=scan_t).chosen(kept, seen)


def _near(record: Recording, most: float | None, notes: Counter[str]) -> Recording:
    """Drop detections farther than `most` from the sensor (m), if it is given."""
    if most is None:
        return record
    with np.errstate(over="ignore"):
        near = [np.hypot(*scan.points.T) <= most for scan in record.scans]
    left_out = sum(int((~one).sum()) for one in near)
    notes[f"detections farther from the sensor than {most:g} m were left out"] += left_out
    return replace(record, scans=[scan.where(one) for scan, one in zip(record.scans, near, strict=True)])


def to_log(
    record: Recording, frames: Frames, noise: NoiseSettings, file: Path, spacing: float | None = None
) -> Log:
    """Convert a record to a log; InputError of `file` if nothing is usable.

    Points of lines are a spacing (m) apart, by default a share of their median range.
    """
    frames = replace(frames, mounting=frames.mounting or record.mounting)
    odometry = _odometry(record, frames, file)
    is_line = are_lines(record.scans, spacing)
    record = _with_lines(record, odometry, frames, spacing) if is_line else _without_lines(record)
    stated = noise.sigma_odometry
    return Log(
        odometry,
        _cycles(record, odometry, frames, noise, file),
        np.array(logs.SIGMA_ODOMETRY if stated is None else stated, dtype=float),
        sensor=SensorInfo(kind="line" if is_line else "cones"),
        source=record.source,
        odometry_stated=stated is not None,
        odometry_drift=None if noise.sigma_drift is None else np.array(noise.sigma_drift),
        detections_stated=noise.states_detections or not record.notes[ASSUMED],
    )


def _with_lines(record: Recording, odometry: Odometry, frames: Frames, spacing: float | None) -> Recording:
    scans = [usable(scan, record.notes) for scan in record.scans]
    return replace(record, scans=lines_of(record.scan_t, scans, odometry, frames, spacing, record.notes))


def _without_lines(record: Recording) -> Recording:
    """Drop polylines beside points that stand alone, and what was reported twice."""
    scans = [scan.where(scan.lines == ALONE) for scan in record.scans]
    notes, left_out = record.notes, count(record.scans) - count(scans)
    notes["points of polylines beside cones were left out (--spacing takes both as lines)"] += left_out
    return replace(record, scans=merged_pairs([distinct(scan, notes) for scan in scans], notes))


def _odometry(record: Recording, frames: Frames, file: Path) -> Odometry:
    """Twists in order of time, without what can't be, and interpolated where they are slow."""
    t, values, rows, notes = record.t, record.motion.copy(), record.numbers, record.notes
    if record.imu is not None:
        values[:, 2] = 0.0  # it comes from the IMU, so that none is missing
    good = np.isfinite(t) & np.isfinite(values).all(axis=1)
    notes["odometry samples that are not finite were left out"] += int((~good).sum())
    t, values, rows = t[good], values[good], rows[good]
    _check_stamps(t, "odometry", file, notes)
    order = np.argsort(t, kind="stable")
    notes["odometry samples were out of order, and were sorted"] += int((np.diff(t) < 0).sum())
    t, values, rows = t[order], values[order], rows[order]
    last = np.append(np.diff(t) > 0, True)  # of samples with one stamp the last one counts
    _check_lost(t, values, last, file)
    notes["odometry samples had the stamp of another one, and were left out"] += int((~last).sum())
    t, values, rows = t[last], values[last], rows[last]
    if record.are_poses:
        t, values, rows = _from_poses(record, t, values, rows, file)
    good = _possible(record, t, values, rows, file)
    odometry = twists.interpolated(t[good], values[good], record.parts)
    if record.parts > 1:
        told = (
            f"odometry samples at {rate(len(t), float(np.ptp(t)))} were interpolated, {record.parts} for one"
        )
        notes[f"{told} (--held takes each as in force until the next)"] += len(t)
    if record.imu is not None:
        odometry = Odometry(*twists.with_yaw_rate(odometry.t, odometry.twist, *record.imu))
        _check_stamps(odometry.t, "odometry", file, notes)
    return Odometry(odometry.t, odometry.twist * frames.flip)


def _from_poses(
    record: Recording, t: Array, poses: Array, rows: IntArray, file: Path
) -> tuple[Array, Array, IntArray]:
    """Twists (n, 3) that lead from pose to pose, and the stamps (n,) and rows (n,) where they begin."""
    if len(t) < 2:
        raise InputError(file, f"expected two poses at least, found {len(t)}")
    turns = np.abs(np.diff(poses[:, 2])) / np.diff(t)
    often = float(np.quantile(turns, 0.9))
    if often > twists.LIMITS.yaw_rate:
        found = f"found poses that turn by more than {often:.3g} rad/s in a tenth of the intervals"
        unit = " (--units angle=deg)" * bool(record.units)
        raise InputError(file, f"expected the yaw of poses in rad, {found}: is it in degrees{unit}?")
    new = twists.measured_anew(t, poses)
    notes = record.notes
    notes["odometry samples repeat the pose before them, and were left out"] += int((~new).sum())
    t, poses, rows = t[new], poses[new], rows[new]
    notes["odometry samples are differences of poses, whose noise is not white"] += len(t) - 1
    return t[:-1], twists.twists_between(t, poses), rows[:-1]


def _possible(record: Recording, t: Array, values: Array, rows: IntArray, file: Path) -> BoolArray:
    """Which twists (n, 3) can be; an InputError where many can't, a note that names a few that can't.

    What is left out is a gap: the twist before it is held, and estimators doubt it the longer the more.
    """
    beyond, off = twists.beyond_limits(values), twists.jumps(t, values)
    if beyond.any(axis=1).mean() > twists.MOST_WRONG:
        first, column = np.argwhere(beyond)[0].tolist()
        limits = (
            f"speeds of at most {twists.LIMITS.speed:g} m/s and yaw rates of {twists.LIMITS.yaw_rate:g} rad/s"
        )
        found = f"{beyond.any(axis=1).sum()} of {len(t)} beyond, at first {_told(values[first], column)}"
        unit = f" ({record.units})" if record.units else ""
        where = record.at(rows[first : first + 1])
        raise InputError(file, f"expected {limits}, found {found} in {where}: is the unit right{unit}?")
    jumped = (off != 0.0).any(axis=1)
    wrong = beyond.any(axis=1)
    if jumped.sum() <= max(twists.MOST_WRONG * len(t), twists.FEW):  # else it is how this odometry is
        wrong = wrong | jumped
    if not wrong.any():
        return np.asarray(~wrong)
    first = int(np.argmax(wrong))
    column = int(
        np.argmax(beyond[first] if beyond[first].any() else np.abs(off[first]) / twists.ACCELERATIONS)
    )
    dt = float(np.median(np.diff(t)))
    turn = abs(off[first, 2]) * dt / np.pi
    cause = "a position jumps" if column < 2 else "a value jumps"
    if column == 2 and min(abs(turn - 1.0), abs(turn - 2.0)) < 1.0 - twists.WRAP_SHARE:
        cause = "the yaw was differenced where it wraps by a whole turn"
    told, notes = "odometry samples can't be, and were left out as a gap", record.notes
    notes[f"{told}: {_told(values[first], column)}, where {cause}, in {record.at(rows[wrong])}"] += int(
        wrong.sum()
    )
    return np.asarray(~wrong)


def _told(twist: Array, column: int) -> str:
    name, unit = (("vx", "m/s"), ("vy", "m/s"), ("wz", "rad/s"))[column]
    return f"{name} = {twist[column]:.4g} {unit}"


def _why(notes: Counter[str], what: str = "detections") -> list[str]:
    return [f"{number} {text}" for text, number in notes.items() if number and what in text]


def _check_lost(t: Array, values: Array, last: BoolArray, file: Path) -> None:
    """Raise an InputError where most samples would be lost, as they differ but share stamps (n,) in s."""
    lost = ~last[:-1] & (values[1:] != values[:-1]).any(axis=1)
    if 2 * lost.sum() > len(t):
        found = f"found the stamp of another one in {lost.sum()} of {len(t)}"
        whole = ": are these whole seconds (--columns t=SECONDS+NANOSECONDS)?" * bool(
            (t == np.floor(t)).all()
        )
        raise InputError(file, f"expected odometry samples with stamps of their own, {found}{whole}")


def _check_stamps(t: Array, what: str, file: Path, notes: Counter[str]) -> None:
    if len(t) == 0:
        raise InputError(file, "; ".join([f"expected {what} with stamps, found none", *_why(notes, what)]))
    worst = float(np.abs(t).max())
    if worst > MAX_STAMP:
        raise InputError(file, f"expected stamps of {what} in s, at most {MAX_STAMP:g}, found {worst:g}")


def _cycles(
    record: Recording, odometry: Odometry, frames: Frames, noise: NoiseSettings, file: Path
) -> tuple[Detections, ...]:
    t, notes = record.scan_t, record.notes
    _check_stamps(t, "detections", file, notes)
    notes["messages with detections were out of order, and were sorted"] += int((np.diff(t) < 0).sum())
    begin, end = float(odometry.t[0]), float(odometry.t[-1]) + logs.MAX_HOLD
    found: dict[float, list[Points]] = {}
    cycle = -np.inf
    for index in np.argsort(t, kind="stable"):
        points = record.scans[index]
        if not len(points.labels):
            notes["messages without any detection give no cycle"] += 1
            continue
        if not begin <= t[index] <= end:
            notes[OUTSIDE] += 1
            continue
        if not logs.is_one_cycle(t[index], cycle):
            cycle = float(t[index])
        scans = found.setdefault(cycle, [])
        if any(map(points.equals, scans)):
            notes["messages with detections were repetitions, and were left out"] += 1
            continue
        notes[SHARED] += bool(scans)
        scans.append(points)
    if not found and notes[OUTSIDE]:
        span = f"{begin:.9g} s to {end - logs.MAX_HOLD:.9g} s"
        stamps = f"from {t.min():.9g} s to {t.max():.9g} s: do both have the same clock?"
        expected = f"expected detections in the time of the odometry, {span}"
        raise InputError(file, f"{expected}, found them {stamps}")
    if not found:
        expected = f"expected detections that can be used, found {len(t)} messages without any"
        raise InputError(file, "; ".join([expected, *_why(notes)]))
    joined = {stamp: Points(*map(np.concatenate, zip(*scans, strict=True))) for stamp, scans in found.items()}
    return tuple(in_vehicle_frame(stamp, points, frames, noise, notes) for stamp, points in joined.items())


def usable(points: Points, notes: Counter[str]) -> Points:
    finite = np.isfinite(points.points).all(axis=1)
    good = np.asarray((np.abs(points.points) <= MAX_RANGE).all(axis=1))
    notes["detections that are not finite were left out"] += int((~finite).sum())
    notes[f"detections farther than {MAX_RANGE:g} m were left out"] += int((finite & ~good).sum())
    return points.where(good)


def distinct(found: Points, notes: Counter[str]) -> Points:
    """Usable detections of a message, each cone once.

    Of those at one place one stays, with a label and a covariance rather than without: an array of markers
    often has a cylinder and an ellipse for each cone.
    """
    found = usable(found, notes)
    without = ~np.isfinite(found.covariances).all(axis=(1, 2))
    order = np.lexsort((without, found.labels == UNKNOWN))
    pairs = KDTree(found.points[order]).query_pairs(REPEATED, output_type="ndarray")
    if not len(pairs):
        return found
    repeats = order[np.unique(pairs.max(axis=1))]
    notes["detections were at the place of another one of their message, and were left out"] += len(repeats)
    return found.where(np.delete(np.arange(len(order)), repeats))


def pairs_of_cones(points: Array, most: float | None = None) -> IntArray:
    """Pairs (k, 2) of points (m, 2) nearest to one another, and far from all others, or `most` apart (m)."""
    if len(points) < 3:
        return np.zeros((0, 2), int)
    found = KDTree(points).query(points, 3)
    (_, first, second), (_, other, _) = np.asarray(found[0]).T, np.asarray(found[1]).T
    own, close = np.arange(len(points)), first < (PAIRED * second if most is None else most)
    mutual = close & close[other] & (other[other] == own) & (own < other)
    return np.asarray(np.column_stack([own, other])[mutual])


def merged_pairs(scans: list[Points], notes: Counter[str]) -> list[Points]:
    """Merge two detections of each cone to their mean, where most cones were reported twice."""
    pairs = [pairs_of_cones(scan.points) for scan in scans]
    if 2 * sum(map(len, pairs)) <= MOST_PAIRED * count(scans):
        return scans
    ends = [scan.points[two] for scan, two in zip(scans, pairs, strict=True)]
    usual = float(np.median(np.concatenate([np.hypot(*(two[:, 1] - two[:, 0]).T) for two in ends])))
    pairs = [pairs_of_cones(scan.points, 2.0 * usual) for scan in scans]
    told = f"detections lie in pairs, {usual:.2g} m apart, and were merged to one a cone"
    notes[told] += 2 * sum(map(len, pairs))
    merged = []
    for scan, two in zip(scans, pairs, strict=True):
        one, other = two.T
        labels, points, covariances = scan.labels.copy(), scan.points.copy(), scan.covariances.copy()
        labels[one] = np.where(labels[one] == UNKNOWN, labels[other], labels[one])
        points[one] = 0.5 * (points[one] + points[other])
        missing = ~np.isfinite(covariances[one]).all(axis=(1, 2))
        covariances[one[missing]] = covariances[other[missing]]
        kept = np.delete(np.arange(len(labels)), other)
        merged.append(Points(points, covariances, labels, scan.lines).where(kept))
    return merged


def in_vehicle_frame(
    t: float, found: Points, frames: Frames, noise: NoiseSettings, notes: Counter[str]
) -> Detections:
    """Make a perception cycle of detections, in the vehicle frame.

    A point `q` with covariance `K` is at `R(yaw) q + (x, y)` with `R K R^T`. Where a covariance is missing or
    not positive definite, it is made from range and bearing at the sensor.
    """
    covariances = found.covariances * np.outer(frames.sides, frames.sides)
    known = positive_definite(covariances) & (not noise.replace_covariances)
    notes[ASSUMED] += int((~known).sum())
    assumed = ray_covariances(found.points * frames.sides, noise.sigmas)
    covariances = np.where(known[:, None, None], covariances, assumed)
    turn = rotation((frames.mounting or (0.0, 0.0, 0.0))[2])
    turned = turn @ covariances @ turn.T
    symmetric = 0.5 * (turned + turned.transpose(0, 2, 1))
    return Detections(t, in_vehicle(found.points, frames), symmetric, found.labels)


def positive_definite(covariances: Array) -> BoolArray:
    """Which covariances (m, 2, 2) are finite, symmetric and positive definite, as the format asks."""
    xx, xy, yx, yy = covariances.reshape(-1, 4).T
    with np.errstate(over="ignore", invalid="ignore"):
        good = np.isfinite(covariances).all(axis=(1, 2)) & is_positive_definite(xx, xy, yy)
        good &= np.abs(xy - yx) <= MAX_ASYMMETRY * np.maximum(xx, yy)
        good &= np.maximum(xx, yy) < MAX_RANGE**2
    return np.asarray(good)


MAX_BUFFERED: Final = 10_000  # largest number of twists that wait for a perception cycle


class MessageStream:
    """Buffer of messages, which gives cycles in order, each with its twists; refused ones are counted.

    A cycle waits for older ones until a message is newer by `wait` (s), since estimators refuse late ones.
    """

    def __init__(self, frames: Frames | None = None, wait: float = 0.0) -> None:
        self.frames, self.noise, self.rule = frames or Frames(), NoiseSettings(), LabelRule()
        self.refused: Counter[str] = Counter()  # number of messages for each reason
        self._twists: deque[tuple[float, list[float]]] = deque(maxlen=MAX_BUFFERED)
        self._first = np.inf  # the stamp (s) of the first twist
        self._wait = wait
        self._waiting = list[Detections]()  # in order of their stamps
        self._newest = -np.inf  # the stamp (s) of the newest message with detections

    @property
    def newest_twist(self) -> Array:
        """The newest twist (3,) in m/s, m/s and rad/s."""
        return np.array(self._twists[-1][1])

    def take_odometry(self, message: Any, received: float) -> bool:
        """Buffer the twist of a message that was received at this time (s); return whether it is usable."""
        try:
            t, twist = stamp_of(message) or received, twist_of(message)
            if twist is None:
                raise ValueError("odometry: expected a message with a twist, found a pose alone")
            twist = twist * self.frames.flip
            if not np.isfinite([t, *twist]).all() or (self._twists and t <= self._twists[-1][0]):
                raise ValueError("odometry: expected finite numbers and a stamp later than the one before")
            if twists.beyond_limits(twist).any():  # an estimator would refuse each cycle that holds it
                raise ValueError("odometry: expected a speed and a yaw rate that a vehicle can have")
            self._twists.append((t, twist.tolist()))
            self._first = min(self._first, t)
        except BROKEN as error:
            self.refused[str(error)] += 1
            return False
        return True

    def take_detections(self, message: Any, received: float) -> Iterator[tuple[Odometry, Detections]]:
        """Yield the cycles that have waited for long enough, with the twists since the last in `use`."""
        try:
            points = points_of(message, self.rule)
            points = points.where(points.lines < 0)  # polylines beside cones are decoration
            if (points.lines == DENSE).any():
                points = usable(points, self.refused)
                points = along_lines(points, default_spacing([points]))
            else:
                points = distinct(points, self.refused)
            t = stamp_of(message) or received
            if not self._first <= t < np.inf:
                raise ValueError("detections: expected a stamp not before that of the first odometry")
            cycle = in_vehicle_frame(t, points, self.frames, self.noise, self.refused)
        except BROKEN as error:
            self.refused[str(error)] += 1
            return
        self._newest = max(self._newest, t)
        insort(self._waiting, cycle, key=lambda one: one.t)
        while self._waiting and self._waiting[0].t <= self._newest - self._wait:
            yield self._with_twists(self._waiting.pop(0))

    def _with_twists(self, cycle: Detections) -> tuple[Odometry, Detections]:
        rows = [row for row in self._twists if row[0] <= cycle.t]
        twists = np.array([twist for _, twist in rows]).reshape(-1, 3)
        return Odometry(np.array([stamp for stamp, _ in rows]), twists), cycle

    def use(self, t: float) -> None:
        """Drop the twists that a cycle at t (s) has used, except the last one, which is held."""
        while len(self._twists) > 1 and self._twists[1][0] <= t:
            self._twists.popleft()
