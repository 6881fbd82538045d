"""A drive as it was recorded, in any order, as a log; what is dropped or assumed is counted in words."""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

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
from .lines import are_lines, in_vehicle, lines_of
from .messages import ALONE, Points
from .settings import Frames, NoiseSettings, Window

MAX_ASYMMETRY: Final = 1e-3  # largest |xy - yx| by the larger variance: messages in single precision
MAX_DISORDER: Final = 2.0  # largest fall of stamps (s) from one message to the next of one clock
SHORTEST: Final = 1e-6  # least time (s) that gives a rate; a bag of one message has 1 ns
MOST_PLACES: Final = 5  # number of rows that are named
REPEATED: Final = 0.02  # distance (m) below which two detections of a message are one
PAIRED: Final = 0.25  # distance of two detections of one cone, by that of the next one beside them
APART: Final = 1e6  # distance (m) of two messages where places are compared; no detection is as far
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
    points: Points  # detections of all messages, sensor frame
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
        points = self.points.where(seen[self.points.message])
        points = points._replace(message=(np.cumsum(seen) - 1)[points.message])
        scan_t, t, motion = self.scan_t[seen], self.t[kept], self.motion[kept]
        return replace(self, t=t, motion=motion, rows=self.numbers[kept], scan_t=scan_t, points=points)

    def at(self, rows: IntArray) -> str:
        """Say where rows of the odometry are."""
        told = ", ".join(map(str, rows[:MOST_PLACES].tolist()))
        return f"{self.place} {told}{', ...' * (len(rows) > MOST_PLACES)}"


def rate(count: int, seconds: float) -> str:
    """Rate of something in words, unknown where no time (s) passed."""
    return f"{count / seconds:.3g} Hz" if count > 1 and seconds > SHORTEST else "an unknown rate"


def check_clock(t: Array, what: str, file: Path) -> None:
    """Raise an InputError where stamps (n,) in s fall back since the clock was reset.

    Two messages before it and two from it on agree, unlike those of a stray stamp. Messages out of order fall
    by less than `MAX_DISORDER`.
    """
    known = np.flatnonzero(np.isfinite(t))
    stamps = t[known]
    lowest_before = np.minimum(stamps[:-3], stamps[1:-2])
    highest_after = np.maximum(stamps[2:-1], stamps[3:])
    resets = np.flatnonzero(lowest_before - highest_after > MAX_DISORDER) + 2
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
    far = twists.LIMITS.silence
    apart = np.minimum(np.abs(t - before), np.abs(t - after))
    return np.asarray((apart > far) & (np.abs(before - after) <= far))


def windowed(record: Recording, window: Window, file: Path) -> Recording:
    """Cut a record to the window, without stamps as of a first message of a clock that isn't set."""
    of_odometry, of_scans, notes = strays(record.t), strays(record.scan_t), record.notes
    far = "have a stamp far from those around them, and were left out"
    if of_odometry.any():
        where = record.at(record.numbers[of_odometry])
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

    Points of lines are a spacing (m) apart, by default a share of their median range. Polylines beside points
    that stand alone are dropped, and so is what was reported twice.
    """
    frames, notes = replace(frames, mounting=frames.mounting or record.mounting), record.notes
    odometry = _odometry(record, frames, file)
    points, t = record.points, record.scan_t
    is_line = are_lines(points, spacing)
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
        detections_stated=noise.states_detections or not notes[ASSUMED],
    )


# --- odometry ----------------------------------------------------------------------------------------------


def _odometry(record: Recording, frames: Frames, file: Path) -> Odometry:
    """Twists in order of time, without what can't be, and interpolated where they are slow."""
    notes = record.notes

    def keep(good: BoolArray, told: str) -> Array:
        notes[told] += int((~good).sum())
        return rows[good]

    rows = np.column_stack([record.numbers, record.t, record.motion])  # number, stamp and motion
    if record.imu is not None:
        rows[:, 4] = 0.0  # it comes from the IMU, so that none is missing
    rows = keep(
        np.asarray(np.isfinite(rows).all(axis=1)), "odometry samples that are not finite were left out"
    )
    _check_stamps(rows[:, 1], "odometry", file, notes)
    notes["odometry samples were out of order, and were sorted"] += int((np.diff(rows[:, 1]) < 0).sum())
    rows = rows[np.argsort(rows[:, 1], kind="stable")]
    last = np.diff(rows[:, 1], append=np.inf) > 0  # of samples with one stamp the last one counts
    lost = ~last[:-1] & (rows[1:, 2:] != rows[:-1, 2:]).any(axis=1)
    if 2 * lost.sum() > len(rows):
        found = f"found the stamp of another one in {lost.sum()} of {len(rows)}"
        whole = ": are these whole seconds (--columns t=SECONDS+NANOSECONDS)?"
        told = found + whole * bool((rows[:, 1] == np.floor(rows[:, 1])).all())
        raise InputError(file, f"expected odometry samples with stamps of their own, {told}")
    rows = keep(last, "odometry samples had the stamp of another one, and were left out")
    if record.are_poses:
        if len(rows) < 2:
            raise InputError(file, f"expected two poses at least, found {len(rows)}")
        often = float(np.quantile(np.abs(np.diff(rows[:, 4])) / np.diff(rows[:, 1]), 0.9))
        if often > twists.LIMITS.yaw_rate:
            found = f"found poses that turn by more than {often:.3g} rad/s in a tenth of the intervals"
            unit = " (--units angle=deg)" * bool(record.units)
            raise InputError(file, f"expected the yaw of poses in rad, {found}: is it in degrees{unit}?")
        rows = keep(
            twists.measured_anew(rows[:, 1], rows[:, 2:]),
            "odometry samples repeat the pose before them, and were left out",
        )
        notes["odometry samples are differences of poses, whose noise is not white"] += len(rows) - 1
        moved = twists.twists_between(rows[:, 1], rows[:, 2:])
        rows = np.column_stack([rows[:-1, :2], moved])
    rows = rows[_possible(record, rows, file)]
    odometry = twists.interpolated(rows[:, 1], rows[:, 2:], record.parts)
    if record.parts > 1:
        slow = rate(len(rows), float(np.ptp(rows[:, 1])))
        hardly = ", and hardly show the bends" * (record.parts >= 10)  # half a second apart
        told = f"odometry samples at {slow} were interpolated, {record.parts} for one{hardly}"
        notes[f"{told} (--held takes each as in force until the next)"] += len(rows)
    if record.imu is not None:
        odometry = Odometry(*twists.with_yaw_rate(odometry.t, odometry.twist, *record.imu))
        _check_stamps(odometry.t, "odometry", file, notes)
    return Odometry(odometry.t, odometry.twist * frames.flip)


def _possible(record: Recording, rows: Array, file: Path) -> BoolArray:
    """Which rows [number, t, vx, vy, wz] (n, 5) can be; an InputError where many can't, else a note.

    What is left out is a gap: the twist before it is held, and estimators doubt it the longer the more.
    """
    numbers, t, values = rows[:, 0].astype(int), rows[:, 1], rows[:, 2:]
    beyond, off = twists.beyond_limits(values), twists.jumps(t, values)
    notes = record.notes

    def told(row: int, column: int) -> str:
        name, unit = (("vx", "m/s"), ("vy", "m/s"), ("wz", "rad/s"))[column]
        return f"{name} = {values[row, column]:.4g} {unit}"

    wrong, jumped = beyond.any(axis=1), (off != 0.0).any(axis=1)
    if wrong.mean() > twists.MOST_WRONG:
        first, column = np.argwhere(beyond)[0].tolist()
        most = twists.LIMITS
        limits = f"speeds of at most {most.speed:g} m/s and yaw rates of {most.yaw_rate:g} rad/s"
        where = f"at first {told(first, column)} in {record.at(numbers[first : first + 1])}"
        unit = f" ({record.units})" if record.units else ""
        found = f"found {wrong.sum()} of {len(t)} beyond, {where}: is the unit right{unit}?"
        raise InputError(file, f"expected {limits}, {found}")
    if jumped.sum() <= max(twists.MOST_WRONG * len(t), twists.FEW):  # else it is how this odometry is
        wrong = wrong | jumped
    if wrong.any():
        first = int(np.argmax(wrong))
        size = beyond[first] if beyond[first].any() else np.abs(off[first]) / twists.ACCELERATIONS
        column = int(np.argmax(size))
        cause = "a position jumps" if column < 2 else "a value jumps"
        turn = abs(off[first, 2]) * float(np.median(np.diff(t))) / np.pi
        if column == 2 and min(abs(turn - 1.0), abs(turn - 2.0)) < 1.0 - twists.WRAP_SHARE:
            cause = "the yaw was differenced where it wraps by a whole turn"
        where = f"{told(first, column)}, where {cause}, in {record.at(numbers[wrong])}"
        notes[f"odometry samples can't be, and were left out as a gap: {where}"] += int(wrong.sum())
    return np.asarray(~wrong)


def _check_stamps(t: Array, what: str, file: Path, notes: Counter[str]) -> None:
    if len(t) == 0:
        raise InputError(file, "; ".join([f"expected {what} with stamps, found none", *_why(notes, what)]))
    worst = float(np.abs(t).max())
    if worst > MAX_STAMP:
        raise InputError(file, f"expected stamps of {what} in s, at most {MAX_STAMP:g}, found {worst:g}")


def _why(notes: Counter[str], what: str = "detections") -> list[str]:
    return [f"{number} {text}" for text, number in notes.items() if number and what in text]


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
    pairs = KDTree(_places(found)[order]).query_pairs(REPEATED, output_type="ndarray")
    if not len(pairs):
        return found
    repeats = order[np.unique(pairs.max(axis=1))]
    notes["detections were at the place of another one of their message, and were left out"] += len(repeats)
    return found.where(np.delete(np.arange(len(order)), repeats))


def _places(points: Points) -> Array:
    """Places (m, 3) in m that are near one another in a message only."""
    return np.column_stack([points.points, APART * points.message])


def pairs_of_cones(points: Points, most: float | None = None) -> IntArray:
    """Pairs (k, 2) of points nearest to one another, and far from all others, or `most` apart (m)."""
    if len(points.labels) < 3:
        return np.zeros((0, 2), int)
    found = KDTree(_places(points)).query(_places(points), 3)
    (_, first, second), (_, other, _) = np.asarray(found[0]).T, np.asarray(found[1]).T
    own, close = np.arange(len(other)), first < (PAIRED * second if most is None else most)
    mutual = close & close[other] & (other[other] == own) & (own < other) & (second < APART)
    return np.asarray(np.column_stack([own, other])[mutual])


def merged_pairs(found: Points, notes: Counter[str]) -> Points:
    """Merge two detections of each cone to their mean, where most cones were reported twice."""
    pairs = pairs_of_cones(found)
    if 2 * len(pairs) <= MOST_PAIRED * len(found.labels):
        return found
    usual = float(np.median(np.hypot(*(found.points[pairs[:, 1]] - found.points[pairs[:, 0]]).T)))
    one, other = pairs_of_cones(found, 2.0 * usual).T
    told = f"detections lie in pairs, {usual:.2g} m apart, and were merged to one a cone"
    notes[told] += 2 * len(one)
    labels, points, covariances = found.labels.copy(), found.points.copy(), found.covariances.copy()
    labels[one] = np.where(labels[one] == UNKNOWN, labels[other], labels[one])
    points[one] = 0.5 * (points[one] + points[other])
    missing = ~np.isfinite(covariances[one]).all(axis=(1, 2))
    covariances[one[missing]] = covariances[other[missing]]
    merged = found._replace(points=points, covariances=covariances, labels=labels)
    return merged.where(np.delete(np.arange(len(labels)), other))


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
