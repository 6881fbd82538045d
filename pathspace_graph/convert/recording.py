"""A drive as it was recorded, in any order, as a log; what is dropped or assumed is counted in words."""

from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final

import gtsam
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.se2 import path_lengths, relative, rotation
from pathspace_graph.io import log as logs
from pathspace_graph.io.log import Detections, Log, Odometry, SensorInfo
from pathspace_graph.io.parsing import MAX_RANGE, MAX_STAMP
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.settings.mapper import LimitSettings

from .messages import ALONE, Points
from .settings import LEAST_SPACING, Frames, NoiseSettings, Window

APART: Final = 1e6  # distance (m) of two messages where places are compared; no detection is as far
# notes of what was done
ASSUMED: Final = "detections had no covariance that can be used, and were given one"
OUTSIDE: Final = "messages with detections outside the time of the odometry were left out"


@dataclass(frozen=True, eq=False)
class Recording:
    """Drive as it was recorded, in its own order and frames."""

    t: Array  # (N,) stamps of the odometry (s)
    motion: Array  # (N, 3) twists in m/s, m/s and rad/s, or poses in m, m and rad
    scan_t: Array  # (M,) stamps of the messages with detections (s)
    points: Points  # detections of all messages, sensor frame
    source: dict[str, str]  # origin of the record, in words
    rows: IntArray  # (N,) number of each row of the odometry in its file
    place: str  # what is counted by it
    notes: Counter[str] = field(default_factory=Counter)  # what was done, in words, and how often
    mounting: tuple[float, float, float] | None = None  # sensor's pose (m, m, rad), where it is stated
    are_poses: bool = False  # whether the motion is in poses
    is_held: bool = False  # whether twists are means until the next one; else they are samples
    imu: tuple[Array, Array] | None = None  # stamps (s) and yaw rates (rad/s) (k,) of an IMU
    units: str = ""  # option that states other units, where there is one

    @property
    def parts(self) -> int:
        """Number of parts of the interval of two twists that are interpolated; 1 for none."""
        return 1 if self.are_poses or self.is_held else parts_of(self.t)

    def chosen(self, kept: BoolArray, seen: BoolArray) -> "Recording":
        """Keep some rows (N,) of the odometry and some messages (M,) with detections."""
        points = self.points.where(seen[self.points.message])
        points = points._replace(message=(np.cumsum(seen) - 1)[points.message])
        scan_t, t, motion = self.scan_t[seen], self.t[kept], self.motion[kept]
        return replace(self, t=t, motion=motion, rows=self.rows[kept], scan_t=scan_t, points=points)

    def at(self, rows: IntArray) -> str:
        """Say where rows of the odometry are."""
        return f"{self.place} {', '.join(map(str, rows[:5].tolist()))}{', ...' * (len(rows) > 5)}"


def chosen_motion(
    twists: Array | None, poses: Array | None, name: str, file: Path, *, from_poses: bool
) -> tuple[Array, bool]:
    """Twists (N, 3), or poses (N, 3) where there are none or `from_poses` is stated; and which of both."""
    if from_poses or twists is None:
        if poses is None:
            raise InputError(file, f"--from-poses: expected poses, found {name}")
        return poses, True
    if poses is not None and not np.nan_to_num(twists).any() and np.ptp(poses, axis=0).any():
        found = "found zeros while the pose moves; --from-poses makes the twists from the poses"
        raise InputError(file, f"{name}: expected twists, {found}")
    return twists, False


def rate(count: int, seconds: float) -> str:
    """Rate of something in words, unknown where no time (s) passed."""
    return f"{count / seconds:.3g} Hz" if count > 1 and seconds > 1e-6 else "an unknown rate"


def check_clock(t: Array, what: str, file: Path) -> None:
    """Raise an InputError where stamps (n,) in s fall back since the clock was reset.

    Two messages before it and two from it on agree, unlike those of a stray stamp. Messages out of order fall
    by less than 2 s.
    """
    known = np.flatnonzero(np.isfinite(t))
    stamps = t[known]
    lowest_before = np.minimum(stamps[:-3], stamps[1:-2])
    highest_after = np.maximum(stamps[2:-1], stamps[3:])
    resets = np.flatnonzero(lowest_before - highest_after > 2.0) + 2
    if len(resets):
        before, after = stamps[resets[0] - 1], stamps[resets[0]]
        fall = f"the stamps fall back by {before - after:.3g} s at message {known[resets[0]] + 1}"
        found = f"found that {fall}, from {before:.12g} s to {after:.12g} s: was the clock reset?"
        way_out = "--start and --end take a part, --received takes the times of receipt"
        raise InputError(file, f"expected {what} by one clock, {found} {way_out}")


def strays(t: Array) -> BoolArray:
    """Which stamps (n,) in s are far from the two around them, which are not far from one another."""
    if len(t) < 3:
        return np.zeros(len(t), bool)
    before, after = np.append(t[1], t[:-1]), np.append(t[1:], t[-2])
    before[0], after[-1] = t[2], t[-3]
    apart = np.minimum(np.abs(t - before), np.abs(t - after))
    return np.asarray((apart > LIMITS.silence) & (np.abs(before - after) <= LIMITS.silence))


def windowed(record: Recording, window: Window, file: Path) -> Recording:
    """Cut a record to the window, without stamps as of a first message of a clock that isn't set."""
    of_odometry, of_scans, notes = strays(record.t), strays(record.scan_t), record.notes
    far = "have a stamp far from those around them, and were left out"
    if of_odometry.any():
        where = record.at(record.rows[of_odometry])
        notes[f"odometry samples {far}: {where}"] += int(of_odometry.sum())
    notes[f"messages with detections {far}"] += int(of_scans.sum())
    record, most = record.chosen(~of_odometry, ~of_scans), window.range_max
    if most is not None:
        with np.errstate(over="ignore"):
            near = np.hypot(*record.points.points.T) <= most
        notes[f"detections farther from the sensor than {most:g} m were left out"] += int((~near).sum())
        record = replace(record, points=record.points.where(near))
    record = replace(record, scan_t=record.scan_t + window.time_offset)
    if window.start > 0.0 or window.end < np.inf:  # else stamps that are not finite stay, and are counted
        begin = float(np.nanmin(record.t, initial=np.inf))
        kept, seen = (
            (t >= begin + window.start) & (t <= begin + window.end) for t in (record.t, record.scan_t)
        )
        notes["odometry samples outside --start and --end were left out"] += int((~kept).sum())
        notes["messages with detections outside --start and --end were left out"] += int((~seen).sum())
        record = record.chosen(kept, seen)
    check_clock(record.t, "odometry", file)
    check_clock(record.scan_t, "detections", file)
    return record


def to_log(
    record: Recording, frames: Frames, noise: NoiseSettings, file: Path, spacing: float | None = None
) -> Log:
    """Convert a record to a log; InputError of `file` if nothing is usable.

    Points are of lines where a spacing (m) is stated, or none stands alone; they are so far apart, by default
    a share of their median range. Else polylines are dropped, and so is what was reported twice.
    """
    frames, notes = replace(frames, mounting=frames.mounting or record.mounting), record.notes
    odometry = _odometry(record, frames, file)
    points, t = record.points, record.scan_t
    is_line = spacing is not None or bool(len(points.lines) and (points.lines != ALONE).all())
    if is_line:
        points = lines_of(t, usable(points, notes), odometry, frames, spacing, notes)
    else:
        points = points.where(points.lines == ALONE)
        told = "points of polylines beside cones were left out (--spacing takes both as lines)"
        notes[told] += len(record.points.labels) - len(points.labels)
        points = merged_pairs(distinct(points, notes), notes)
    cycles = _cycles(t, points, odometry, frames, noise, notes, file)
    return Log(
        odometry,
        cycles,
        np.array(logs.SIGMA_ODOMETRY if noise.sigma_odometry is None else noise.sigma_odometry, dtype=float),
        sensor=SensorInfo(kind="line" if is_line else "cones"),
        source=record.source,
        odometry_stated=noise.sigma_odometry is not None,
        odometry_drift=None if noise.sigma_drift is None else np.array(noise.sigma_drift),
        detections_stated=any(own is not None for own in noise.of_detections) or not notes[ASSUMED],
    )


# --- odometry ----------------------------------------------------------------------------------------------

LIMITS: Final = LimitSettings()  # beyond which no estimator uses a twist
ACCELERATIONS: Final = np.array([20.0, 20.0, 15.0])  # that no vehicle exceeds (m/s^2, m/s^2, rad/s^2)
AROUND: Final = 5  # number of rows before a row, and after it, whose medians it is compared with
WRAP_SHARE: Final = 0.7  # share of half a turn in a row that marks a yaw that was differenced where it wraps
MOST_WRONG: Final = 0.05  # largest share of rows that are mistakes of single rows


def _odometry(record: Recording, frames: Frames, file: Path) -> Odometry:
    """Twists in order of time, without what can't be, and interpolated where they are slow."""
    notes = record.notes

    def keep(good: BoolArray, told: str) -> Array:
        notes[told] += int((~good).sum())
        return rows[good]

    rows = np.column_stack([record.rows, record.t, record.motion])  # number, stamp and motion
    if record.imu is not None:
        rows[:, 4] = 0.0  # it comes from the IMU, so that none is missing
    rows = keep(
        np.asarray(np.isfinite(rows).all(axis=1)), "odometry samples that are not finite were left out"
    )
    wrong = record.at(rows[np.abs(rows[:, 1]) > MAX_STAMP, 0].astype(int))
    _check_stamps(rows[:, 1], "odometry", file, notes, f" in {wrong}")
    notes["odometry samples were out of order, and were sorted"] += int((np.diff(rows[:, 1]) < 0).sum())
    rows = rows[np.argsort(rows[:, 1], kind="stable")]
    last = np.diff(rows[:, 1], append=np.inf) > 0  # of samples with one stamp the last one counts
    lost = ~last[:-1] & (rows[1:, 2:] != rows[:-1, 2:]).any(axis=1)
    if 2 * lost.sum() > len(rows):
        found = f"found the stamp of another one in {lost.sum()} of {len(rows)}"
        raise InputError(file, f"expected odometry samples with stamps of their own, {found}")
    rows = keep(last, "odometry samples had the stamp of another one, and were left out")
    if record.are_poses:
        if len(rows) < 2:
            raise InputError(file, f"expected two poses at least, found {len(rows)}")
        told = "odometry samples repeat the pose before them, and were left out"
        rows = keep(measured_anew(rows[:, 1], rows[:, 2:]), told)
        notes["odometry samples are differences of poses, whose noise is not white"] += len(rows) - 1
        # the constant twists that lead from each pose to the next
        moves = [gtsam.Pose2(*relative(one, other)) for one, other in pairwise(rows[:, 2:])]
        moved = np.array([gtsam.Pose2.Logmap(move) for move in moves]).reshape(-1, 3)
        rows = np.column_stack([rows[:-1, :2], moved / np.diff(rows[:, 1])[:, None]])
    rows = rows[_possible(record, rows, file)]
    odometry = interpolated(rows[:, 1], rows[:, 2:], record.parts)
    if record.parts > 1:
        slow = rate(len(rows), float(np.ptp(rows[:, 1])))
        hardly = ", and hardly show the bends" * (record.parts >= 10)  # half a second apart
        told = f"odometry samples at {slow} were interpolated, {record.parts} for one{hardly}"
        notes[f"{told} (--held takes each as in force until the next)"] += len(rows)
    if record.imu is not None:
        odometry = Odometry(*with_yaw_rate(odometry.t, odometry.twist, *record.imu))
        _check_stamps(odometry.t, "odometry", file, notes)
    return Odometry(odometry.t, odometry.twist * frames.flip)


def _possible(record: Recording, rows: Array, file: Path) -> BoolArray:
    """Which rows [number, t, vx, vy, wz] (n, 5) can be; an InputError where many can't, else a note.

    What is left out is a gap: the twist before it is held, and estimators doubt it the longer the more.
    """
    numbers, t, values = rows[:, 0].astype(int), rows[:, 1], rows[:, 2:]
    beyond, off = beyond_limits(values), jumps(t, values)
    notes = record.notes

    def told(row: int, column: int) -> str:
        name, unit = (("vx", "m/s"), ("vy", "m/s"), ("wz", "rad/s"))[column]
        return f"{name} = {values[row, column]:.4g} {unit}"

    wrong, jumped = beyond.any(axis=1), (off != 0.0).any(axis=1)
    if wrong.mean() > MOST_WRONG:
        first, column = np.argwhere(beyond)[0].tolist()
        most = LIMITS
        limits = f"speeds of at most {most.speed:g} m/s and yaw rates of {most.yaw_rate:g} rad/s"
        where = f"at first {told(first, column)} in {record.at(numbers[first : first + 1])}"
        found = f"found {wrong.sum()} of {len(t)} beyond, {where}"
        raise InputError(file, f"expected {limits}, {found}{record.units and f' ({record.units})'}")
    if jumped.sum() <= max(MOST_WRONG * len(t), 6):  # else it is how this odometry is
        wrong = wrong | jumped
    if wrong.any():
        first = int(np.argmax(wrong))
        size = beyond[first] if beyond[first].any() else np.abs(off[first]) / ACCELERATIONS
        column = int(np.argmax(size))
        cause = "a position jumps" if column < 2 else "a value jumps"
        turn = abs(off[first, 2]) * float(np.median(np.diff(t))) / np.pi
        if column == 2 and min(abs(turn - 1.0), abs(turn - 2.0)) < 1.0 - WRAP_SHARE:
            cause = "the yaw was differenced where it wraps by a whole turn"
        where = f"{told(first, column)}, where {cause}, in {record.at(numbers[wrong])}"
        notes[f"odometry samples can't be, and were left out as a gap: {where}"] += int(wrong.sum())
    return np.asarray(~wrong)


def _check_stamps(t: Array, what: str, file: Path, notes: Counter[str], where: str = "") -> None:
    if len(t) == 0:
        raise InputError(file, "; ".join([f"expected {what} with stamps, found none", *_why(notes, what)]))
    worst = float(np.abs(t).max())
    if worst > MAX_STAMP:
        raise InputError(
            file, f"expected stamps of {what} in s, at most {MAX_STAMP:g}, found {worst:g}{where}"
        )


def _why(notes: Counter[str], what: str = "detections") -> list[str]:
    return [f"{number} {text}" for text, number in notes.items() if number and what in text]


def measured_anew(t: Array, poses: Array) -> BoolArray:
    """Which poses (n, 3) at t (n,) in s differ from the one before, or stay for longer than 1.2 s.

    A slow receiver's pose is often repeated at the rate of a faster sensor: differences would be 0, 0, 5 v.
    """
    new = np.append(True, (np.diff(poses, axis=0) != 0.0).any(axis=1))
    since = t - t[np.maximum.accumulate(np.where(new, np.arange(len(t)), 0))]
    return np.asarray(new | (since > 1.2))


def with_yaw_rate(t: Array, twists: Array, imu_t: Array, rates: Array) -> tuple[Array, Array]:
    """Replace the yaw rate of twists at t (n,) in s, in order, by the mean of an IMU until the next twist."""
    turn = np.argsort(imu_t, kind="stable")
    turn = turn[np.isfinite(rates[turn])]
    imu_t, rates = imu_t[turn], rates[turn]
    inside = (t >= imu_t[0]) & (t <= imu_t[-1]) if len(imu_t) else np.zeros(len(t), bool)
    t, twists = t[inside], twists[inside]
    if len(t) < 2:
        return t, twists
    heading = np.append(0.0, np.cumsum(rates[:-1] * np.diff(imu_t)))
    steps, turned = np.diff(t), np.diff(np.interp(t, imu_t, heading))
    last = rates[np.searchsorted(imu_t, t[-1], side="right") - 1]
    mean = np.interp(t[:-1], imu_t, rates)  # where no time passes
    np.divide(turned, steps, out=mean, where=steps > 0)
    twists[:, 2] = np.append(mean, last)
    return t, twists


def beyond_limits(twists: Array) -> BoolArray:
    """Which entries of twists (n, 3) are beyond what an estimator uses."""
    return np.asarray(np.abs(twists) > [LIMITS.speed, LIMITS.speed, LIMITS.yaw_rate])


def jumps(t: Array, twists: Array) -> Array:
    """How far single rows of twists (n, 3) at t (n,) in s jump, and 0 for the others (n, 3).

    A row x jumps if it lies outside the medians a and b of the rows before and after it by more than a
    vehicle accelerates meanwhile, and more than the rows' noise:

        max(x - max(a, b), min(a, b) - x) > AROUND A dt / 2 + 6 sigma

    Up to two rows in turn can jump. A yaw rate may leave the medians by less than a share of pi / dt: one
    that was differenced where the yaw wraps leaves them by 2 pi / dt, or in two rows by pi / dt.
    """
    if len(t) <= 2 * AROUND:
        return np.zeros(twists.shape)
    steps = np.diff(t)
    dt = float(np.median(steps))
    apart = np.maximum(np.maximum(np.append(dt, steps), np.append(steps, dt)), dt)  # more beside a gap
    rows = np.pad(twists, ((AROUND, AROUND), (0, 0)), mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(rows, AROUND, axis=0)
    before, after = np.median(windows[: len(t)], axis=-1), np.median(windows[AROUND + 1 :], axis=-1)
    low, high = np.minimum(before, after), np.maximum(before, after)
    off = twists - np.clip(twists, low, high)
    middle = 0.5 * (twists[:-2] + twists[2:])
    sigma = 1.4826 * np.median(np.abs(twists[1:-1] - middle), axis=0) / np.sqrt(1.5)
    most = 0.5 * AROUND * ACCELERATIONS * apart[:, None] + 6.0 * sigma
    most[:, 2] = np.where(apart < 1.5 * dt, np.minimum(most[:, 2], WRAP_SHARE * np.pi / dt), most[:, 2])
    return np.where(np.abs(off) > most, off, 0.0)


def parts_of(t: Array) -> int:
    """Number of parts of an interval of sampled twists at t (n,) in s, each 0.05 s long at most.

    It is 1 for periods up to 0.12 s, which can be held, for those of another unit than s, and for too few
    samples to know their period.
    """
    steps = np.diff(np.unique(t[np.isfinite(t)]))
    period = float(np.median(steps)) if len(steps) >= 20 else 0.0
    return int(np.ceil(period / 0.05 - 1e-6)) if 0.12 < period < 5.0 else 1


def interpolated(t: Array, twists: Array, parts: int) -> Odometry:
    """Interpolate sampled twists (n, 3) at t (n,) in s: the mean of each of the parts of an interval.

    A log holds each twist until the next one, so that a slow one would lag by half its period. Cubic splines
    go through the samples between gaps, where the last twist is held.
    """
    if parts == 1 or len(t) < 2:
        return Odometry(t, twists)
    steps = np.diff(t)
    ends = np.flatnonzero(steps > 2.5 * np.median(steps)) + 1  # of gaps
    stamps, values = [], []
    for run in np.split(np.arange(len(t)), ends):
        at, own = t[run], twists[run]
        if len(run) > 1:
            begins = (at[:-1, None] + np.diff(at)[:, None] * (np.arange(parts) / parts)).ravel()
            whole = CubicSpline(at, own).antiderivative()(np.append(begins, at[-1]))
            stamps.append(begins)
            values.append(np.diff(whole, axis=0) / np.diff(np.append(begins, at[-1]))[:, None])
        stamps.append(at[-1:])
        values.append(own[-1:])
    return Odometry(np.concatenate(stamps), np.concatenate(values))


# --- detections --------------------------------------------------------------------------------------------


def _cycles(
    t: Array,
    points: Points,
    odometry: Odometry,
    frames: Frames,
    noise: NoiseSettings,
    notes: Counter[str],
    file: Path,
) -> tuple[Detections, ...]:
    """Make cycles of the points of messages at stamps t (M,) in s, in order of time."""
    _check_stamps(t, "detections", file, notes)
    notes["messages with detections were out of order, and were sorted"] += int((np.diff(t) < 0).sum())
    begin, end = float(odometry.t[0]), float(odometry.t[-1]) + logs.MAX_HOLD
    messages = points.apart(len(t))
    found: dict[float, list[Points]] = {}
    cycle = -np.inf
    for index in np.argsort(t, kind="stable"):
        points = messages[index]
        if not len(points.labels):
            notes["messages without any detection give no cycle"] += 1
            continue
        if not begin <= t[index] <= end:
            notes[OUTSIDE] += 1
            continue
        if not logs.is_one_cycle(t[index], cycle):
            cycle = float(t[index])
        scans = found.setdefault(cycle, [])
        alike = [one for one in scans if np.array_equal(one.points, points.points)]
        if any(np.array_equal(one.labels, points.labels) for one in alike):
            notes["messages with detections were repetitions, and were left out"] += 1
            continue
        told = "messages with detections are at most 1 ms after another one, and are one cycle with it"
        notes[told] += bool(scans)
        scans.append(points)
    if not found and notes[OUTSIDE]:
        span = f"{begin:.9g} s to {end - logs.MAX_HOLD:.9g} s"
        stamps = f"from {t.min():.9g} s to {t.max():.9g} s: do both have the same clock?"
        expected = f"expected detections in the time of the odometry, {span}"
        raise InputError(file, f"{expected}, found them {stamps}")
    if not found:
        expected = f"expected detections that can be used, found {len(t)} messages without any"
        raise InputError(file, "; ".join([expected, *_why(notes)]))
    joined = ((stamp, Points.joined(scans)) for stamp, scans in found.items())
    return tuple(in_vehicle_frame(stamp, points, frames, noise, notes) for stamp, points in joined)


def usable(points: Points, notes: Counter[str]) -> Points:
    finite = np.isfinite(points.points).all(axis=1)
    good = np.asarray((np.abs(points.points) <= MAX_RANGE).all(axis=1))
    notes["detections that are not finite were left out"] += int((~finite).sum())
    notes[f"detections farther than {MAX_RANGE:g} m were left out"] += int((finite & ~good).sum())
    return points.where(good)


def distinct(found: Points, notes: Counter[str]) -> Points:
    """Usable detections, each cone once in a message.

    Of those at one place one stays, with a label and a covariance rather than without: an array of markers
    often has a cylinder and an ellipse for each cone.
    """
    found = usable(found, notes)
    without = ~np.isfinite(found.covariances).all(axis=(1, 2))
    order = np.lexsort((without, found.labels == UNKNOWN))
    pairs = KDTree(_places(found)[order]).query_pairs(0.02, output_type="ndarray")
    if not len(pairs):
        return found
    repeats = order[np.unique(pairs.max(axis=1))]
    notes["detections were at the place of another one of their message, and were left out"] += len(repeats)
    return found.where(np.delete(np.arange(len(order)), repeats))


def _places(points: Points) -> Array:
    """Places (m, 3) in m that are near one another in a message only."""
    return np.column_stack([points.points, APART * points.message])


def merged_pairs(found: Points, notes: Counter[str]) -> Points:
    """Merge two detections of each cone to their mean, where most cones were reported twice.

    These are nearer to one another than by a quarter of the distance of the next detection.
    """
    if len(found.labels) < 3:
        return found
    tree = KDTree(_places(found))
    first, second = np.asarray(tree.query(tree.data, 3)[0])[:, 1:].T
    paired = (first < 0.25 * second) & (second < APART)
    if 2 * paired.sum() <= len(paired):
        return found
    usual = float(np.median(first[paired]))
    pairs = tree.query_pairs(2.0 * usual, output_type="ndarray")
    of_one_pair = np.bincount(pairs.ravel(), minlength=len(paired)) == 1
    one, other = pairs[of_one_pair[pairs].all(axis=1)].T
    told = f"detections lie in pairs, {usual:.2g} m apart, and were merged to one a cone"
    notes[told] += 2 * len(one)
    labels, points, covariances = found.labels.copy(), found.points.copy(), found.covariances.copy()
    labels[one] = np.where(labels[one] == UNKNOWN, labels[other], labels[one])
    points[one] = 0.5 * (points[one] + points[other])
    missing = ~np.isfinite(covariances[one]).all(axis=(1, 2))
    covariances[one[missing]] = covariances[other[missing]]
    merged = found._replace(points=points, covariances=covariances, labels=labels)
    return merged.where(np.delete(np.arange(len(labels)), other))


def from_sensor(points: Array, frames: Frames) -> Array:
    """Transform points (m, 2) of the sensor to the vehicle frame."""
    x, y, yaw = frames.mounting or (0.0, 0.0, 0.0)
    return np.asarray((points * frames.sides) @ rotation(yaw).T + np.array([x, y]))


def in_vehicle_frame(
    t: float, found: Points, frames: Frames, noise: NoiseSettings, notes: Counter[str]
) -> Detections:
    """Make a perception cycle of detections, in the vehicle frame.

    A point `q` with covariance `K` is at `R(yaw) q + (x, y)` with `R K R^T`. Where a covariance is missing or
    not positive definite, it is made from range and bearing at the sensor.
    """
    covariances = found.covariances * np.outer(frames.sides, frames.sides)
    xx, xy, yx, yy = covariances.reshape(-1, 4).T
    with np.errstate(over="ignore", invalid="ignore"):
        known = np.isfinite(covariances).all(axis=(1, 2)) & logs.is_positive_definite(xx, xy, yy)
        known &= np.abs(xy - yx) <= 1e-3 * np.maximum(xx, yy)  # messages in single precision
        known &= (np.maximum(xx, yy) < MAX_RANGE**2) & (not noise.replace_covariances)
    notes[ASSUMED] += int((~known).sum())
    assumed = logs.ray_covariances(found.points * frames.sides, noise.sigmas)
    covariances = np.where(known[:, None, None], covariances, assumed)
    turn = rotation((frames.mounting or (0.0, 0.0, 0.0))[2])
    turned = turn @ covariances @ turn.T
    symmetric = 0.5 * (turned + turned.transpose(0, 2, 1))
    return Detections(t, from_sensor(found.points, frames), symmetric, found.labels)


# --- points of lines, kerbs or walls: evenly spaced, and labelled by their side of the driven path ----------


def default_spacing(points: Points) -> float:
    """Spacing (m) of a record that states none, by the median range, which has the size of the scene."""
    return max(0.15 * float(np.median(np.hypot(*points.points.T))), LEAST_SPACING)


def lines_of(
    t: Array,
    points: Points,
    odometry: Odometry,
    frames: Frames,
    spacing: float | None,
    notes: Counter[str],
) -> Points:
    """Space the points of messages at the stamps t (n,) in s evenly (m), and label them by the driven path.

    A label that a point has stays. Points farther from the path than a boundary are dropped.
    """
    spacing = spacing or default_spacing(points)
    scans = [along_lines(scan, spacing) for scan in points.apart(len(t))]
    found = Points.joined(scans)
    told = (
        f"points of lines are {spacing:.2g} m apart (--spacing), of {len(points.labels)} that were recorded"
    )
    notes[told] += len(found.labels)
    path = ReckonedPath.of(odometry, 0.5 * spacing)
    places = [from_sensor(scan.points, frames) for scan in scans]
    lateral = [path.lateral(float(at), own) for at, own in zip(t, places, strict=True)]
    kept = np.concatenate([nearest_lines(scan.lines, own) for scan, own in zip(scans, lateral, strict=True)])
    away = np.concatenate(lateral)
    known = np.abs(away[np.isfinite(away)])
    if len(known):
        kept &= ~(np.abs(away) > 3.0 * np.median(known))
    labels = np.select(
        [found.labels != UNKNOWN, away > 0.0, away < 0.0], [found.labels, LEFT, RIGHT], UNKNOWN
    )
    notes["points of lines were too far from the driven path, and were left out"] += int((~kept).sum())
    return found._replace(labels=labels).where(kept)


def nearest_lines(lines: IntArray, lateral: Array) -> BoolArray:
    """Which points (m,) are of the polylines nearest to the path on their side, or of none."""
    kept = np.ones(len(lines), bool)
    numbers = np.unique(lines[lines >= 0])
    beside = (lateral[(lines == line) & ~np.isnan(lateral)] for line in numbers)  # empty beyond the path
    middles = np.array([np.median(own) if len(own) else np.nan for own in beside])
    for side in (1.0, -1.0):
        away = np.where(side * middles > 0.0, side * middles, np.inf)
        far = numbers[(away > 1.5 * away.min(initial=np.inf)) & np.isfinite(away)]
        kept &= ~np.isin(lines, far)
    return kept


def along_lines(points: Points, spacing: float) -> Points:
    """Interpolate polylines and thin dense points to a spacing (m)."""
    parts = [points.where(spaced_apart(points.points, spacing, points.lines < 0))]
    for line in np.unique(points.lines[points.lines >= 0]):
        own = points.where(points.lines == line)
        s = path_lengths(own.points)
        at = np.arange(0.0, s[-1] + 1e-9 * spacing, spacing)  # the multiples of the spacing
        placed = np.column_stack([np.interp(at, s, axis) for axis in own.points.T])
        labels = np.full(len(placed), own.labels[0])
        parts.append(Points.of(placed, labels, lines=np.full(len(placed), line)))
    return Points.joined(parts)


def spaced_apart(points: Array, spacing: float, chosen: BoolArray) -> IntArray:
    """Indices of chosen points (m, 2) no two of which are nearer than the spacing (m).

    They are chosen by bearing, since by range the noise of the ranges would choose.
    """
    left = np.flatnonzero(chosen)
    left = left[np.argsort(np.arctan2(points[left, 1], points[left, 0]), kind="stable")]
    kept = []
    while len(left):
        kept.append(left[0])
        left = left[np.hypot(*(points[left] - points[left[0]]).T) >= spacing]
    return np.array(kept, dtype=int)


@dataclass(frozen=True, eq=False)
class ReckonedPath:
    """The path driven, by dead reckoning from the pose at the first twist."""

    t: Array  # (N,) stamps (s)
    poses: Array  # (N, 3) poses in m, m and rad
    s: Array  # (N,) path length (m)
    points: Array  # (k, 2) points of the path, evenly spaced
    at: Array  # (k,) their path lengths (m)

    @classmethod
    def of(cls, odometry: Odometry, step: float) -> "ReckonedPath":
        poses = odometry.poses()
        s = path_lengths(poses)
        at = np.linspace(0.0, s[-1], int(min(np.ceil(s[-1] / step), 1_000_000)) + 1)
        moved = np.diff(s, prepend=-1.0) > 0.0
        points = np.column_stack([np.interp(at, s[moved], poses[moved, k]) for k in range(2)])
        return cls(odometry.t, poses, s, points, at)

    def lateral(self, t: float, points: Array) -> Array:
        """Distances (m,) of points (m, 2) to the left of the path, seen in the vehicle frame at t.

        Each is measured on the stretch around the vehicle within its range, since the path may return later.
        A point before the beginning or beyond the end of the path has NaN.
        """
        x, y, heading, here = (np.interp(t, self.t, of) for of in (*self.poses.T, self.s))
        placed = points @ rotation(float(heading)).T + np.array([x, y])
        reach = 2.0 * np.hypot(*points.T)  # along the path, ahead and behind
        near = np.abs(self.at - here) <= reach.max(initial=0.0)
        path, at = self.points[near], self.at[near]
        if len(path) < 2:
            return np.full(len(points), np.nan)
        offset = placed[:, None] - path
        distances = np.hypot(offset[..., 0], offset[..., 1])
        distances[np.abs(at - here) > reach[:, None]] = np.inf
        foot = distances.argmin(axis=1)
        along, away = np.gradient(path, axis=0)[foot], offset[np.arange(len(foot)), foot]
        side = np.sign(along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0])
        forward = (along * away).sum(axis=1)
        first, last = at[foot] == self.at[0], at[foot] == self.at[-1]
        outside = (first & (forward < 0.0)) | (last & (forward > 0.0))
        return np.where(outside, np.nan, side * distances.min(axis=1))
