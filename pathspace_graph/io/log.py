"""A log: odometry, perception cycles and, where known, the truth; `log_files` reads and writes its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from pathspace_graph.brief import Brief, Shown
from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array, BoolArray, IntArray
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.labels import NAMES, UNKNOWN, Kind, label_from_name
from pathspace_graph.lengths import POSE_LENGTHS, scaled

from . import parsing as limits
from .parsing import Column, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOG_FILE: Final = "log.toml"
ODOMETRY_FILE: Final = "odometry.csv"
DETECTIONS_FILE: Final = "detections.csv"
TRUTH_POSES_FILE: Final = "truth_poses.csv"
TRUTH_CONES_FILE: Final = "truth_cones.csv"
TRUTH_ASSOCIATIONS_FILE: Final = "truth_associations.csv"

_STAMP: Final = {"t": Column(limits.MAX_STAMP, "s")}
_POINT: Final = {"x": Column(unit="m"), "y": Column(unit="m")}
_LABEL: Final = Column(len(NAMES) - 1)
_SPEED: Final = Column(1e3, "m/s")
_RANGE: Final = Column(limits.MAX_RANGE, "m")
COLUMNS: Final[dict[str, dict[str, Column]]] = {  # of each table, in the order of the file
    ODOMETRY_FILE: {**_STAMP, "vx": _SPEED, "vy": _SPEED, "wz": Column(1e3, "rad/s")},
    DETECTIONS_FILE: {
        **_STAMP,
        **{"x": _RANGE, "y": _RANGE, "label": _LABEL},
        **dict.fromkeys(("xx", "xy", "yy"), Column(limits.MAX_RANGE**2, "m^2")),
    },
    TRUTH_POSES_FILE: {**_STAMP, **_POINT, "theta": Column(1e6, "rad")},
    TRUTH_CONES_FILE: {**_POINT, "label": _LABEL},
    TRUTH_ASSOCIATIONS_FILE: {"cone": Column()},
}
TRUTH_FILES: Final = (TRUTH_POSES_FILE, TRUTH_CONES_FILE, TRUTH_ASSOCIATIONS_FILE)  # which are optional
FILES: Final = (LOG_FILE, *COLUMNS)

SIGMA_ODOMETRY: Final = (0.25, 0.12, 0.035)  # of a twist (m/s, m/s, rad/s) where nothing is known
SIGMA_DETECTIONS: Final = (0.05, 0.012, np.pi / 200.0)  # (m, m/m, rad) where nothing is known
MIN_INTERVAL: Final = 1e-3  # s between perception cycles; below, the odometry is too certain for doubles
ROUND_OFF: Final = 1e-6  # s, of the difference of two stamps: doubles resolve those since 1970 to 2.4e-7 s
MAX_HOLD: Final = 1.0  # s; a perception cycle later after the last twist has no odometry


@dataclass(frozen=True, eq=False, repr=False)
class Odometry(Brief):
    """Measured body twists, each of which is held until the next."""

    LENGTHS: ClassVar = {"twist": POSE_LENGTHS}

    t: Array
    """Stamps (N,) in s, strictly increasing."""
    twist: Array
    """Twists [vx, vy, wz] (N, 3) in m/s, m/s, rad/s, vehicle frame."""

    def between(self, start: float, end: float) -> Odometry:
        """Twists in force from `start` (s) to `end` (s); before the first row nothing moves."""
        start = max(start, float(self.t[0]))
        first = int(np.searchsorted(self.t, start, side="right")) - 1
        stop = max(first, int(np.searchsorted(self.t, end, side="left"))) if end > start else first
        return Odometry(np.maximum(self.t[first:stop], start), self.twist[first:stop])

    def poses(self) -> Array:
        """Poses (N, 3) at the stamps by dead reckoning, from the origin at the first."""
        return np.vstack([np.zeros((1, 3)), integrate_poses(np.diff(self.t), self.twist[:-1])])

    def followed_by(self, later: Odometry) -> Odometry:
        """Append the later twists that are newer."""
        new = later.t > self.t[-1] if len(self.t) else np.ones(len(later.t), bool)
        return Odometry(np.append(self.t, later.t[new]), np.concatenate([self.twist, later.twist[new]]))


@dataclass(frozen=True, eq=False, repr=False)
class Detections(Brief):
    """Boundary points detected in one perception cycle."""

    LENGTHS: ClassVar = {"points_vehicle": 1, "covariances": 2}

    t: float
    """Stamp of the cycle, s."""
    points_vehicle: Array
    """Detected points (m, 2) in m, vehicle frame."""
    covariances: Array
    """Their covariances (m, 2, 2) in m^2, vehicle frame."""
    labels: IntArray
    """Their labels (m,): LEFT, RIGHT, UNKNOWN, ORANGE or BIG_ORANGE."""

    def where(self, chosen: BoolArray) -> Detections:
        if chosen.all():
            return self
        return Detections(self.t, self.points_vehicle[chosen], self.covariances[chosen], self.labels[chosen])

    def with_others(self, other: Detections) -> Detections:
        """Append other detections of the same cycle."""
        if len(other.labels) == 0:
            return self
        names = ("points_vehicle", "covariances", "labels")
        return Detections(
            self.t, *(np.concatenate([getattr(of, name) for of in (self, other)]) for name in names)
        )


@dataclass(frozen=True)
class SensorInfo:
    """What is known of the sensor; None where the log does not say."""

    LENGTHS: ClassVar = {"range_max": 1}

    range_max: float | None = None
    """Greatest range, m."""
    fov: float | None = None
    """Field of view, the whole angle, rad."""
    rate: float | None = None
    """Perception cycles per second, Hz."""
    kind: Kind | None = None
    """What detections are of."""
    sigma_range_scale: float | None = None
    """Standard deviation of the scale error of the ranges (-): how well the sensor is calibrated."""


@dataclass(frozen=True, eq=False, repr=False)
class Truth(Brief):
    """What a simulator or a survey knows, for evaluation only; what is not known has no rows."""

    LENGTHS: ClassVar = {
        **{"poses": POSE_LENGTHS, "cones": 1, "sensor": (0, 1, 0, 0, 1), "noise": (1, 1, 0, 0, 0, 0)},
        **{"bend": (-1, 1), "rays": (1, 0, 0)},
    }

    pose_t: Array
    """Stamps of the true poses (N,) in s."""
    poses: Array
    """True poses [x, y, theta] (N, 3) in m, m, rad, map frame."""
    cones: Array
    """True cones (M, 2) in m, map frame."""
    cone_labels: IntArray
    """Their labels (M,)."""
    associations: IntArray | None = None
    """Index of the true cone of each detection in file order (R,), -1 for none."""
    calibration: Array | None = None
    """Calibration of the odometry (2,): scale error of the speeds (-), bias of the yaw rate (rad/s)."""
    sensor: Array | None = None
    """Constant errors of the sensor (5,): yaw (rad), lateral offset (m), age of detections at their stamps
    (s), scale error (-) and bias (m) of ranges."""
    noise: Array | None = None
    """Noise that is not white (6,): the sigmas of white noise of a twist that drifts as much (m/s, m/s,
    rad/s), the shares of a range's and a bearing's variance that stay with a cone (-), and the correlation
    time of those (s)."""
    bend: Array | None = None
    """Bend k of the ranges (1/m) and its begin b (m) (2,): a range r reads `k (r - b)^2` longer beyond b."""
    rays: Array | None = None
    """Sigmas of single detections (3,) where the log doesn't state them: of the range at 0 (m), its growth
    (m/m), and of the bearing (rad)."""


@dataclass(frozen=True, eq=False, repr=False)
class Log(Shown):
    """All that a vehicle recorded on one drive."""

    LENGTHS: ClassVar = {
        **dict.fromkeys(("odometry", "cycles", "sensor", "measured", "truth"), 0),
        **dict.fromkeys(("odometry_sigma", "odometry_drift"), POSE_LENGTHS),
        "scale": 1,
    }

    odometry: Odometry
    cycles: tuple[Detections, ...]
    """Perception cycles in order of time."""
    odometry_sigma: Array
    """Standard deviations (3,) of a twist in m/s, m/s, rad/s, white from sample to sample."""
    sensor: SensorInfo = SensorInfo()
    source: Mapping[str, str] = field(default_factory=dict)
    """Free texts that say where the log comes from."""
    odometry_stated: bool = True
    """Whether somebody has stated the noise of the odometry; otherwise it was measured or assumed."""
    detections_stated: bool = True
    """Whether somebody has stated the covariances of the detections."""
    odometry_drift: Array | None = None
    """Stated drift (3,) of the odometry in m, m and rad by root of s, a random walk of the integrated pose.
    None where nobody has stated it: the white noise says nothing of it."""
    measured: MeasuredNoise | None = None
    """Noise and constant errors of the sensor, as the readings themselves show them."""
    truth: Truth | None = None
    scale: float = 1.0
    """Size of the scene by that of a Formula Student track: 0.1 for a model car of 1:10, 3 for a road."""

    def __repr__(self) -> str:
        t, noise = self.odometry.t, ("their noise measured", "their noise stated")
        detections = sum(len(cycle.labels) for cycle in self.cycles)
        return (
            f"Log({t[-1] - t[0]:.1f} s: {len(t)} twists, {noise[self.odometry_stated]};\n"
            f"    {len(self.cycles)} cycles with {detections} detections, {noise[self.detections_stated]};\n"
            f"    {'no truth' if self.truth is None else 'with truth'})"
        )

    def plot(self, **options: Any) -> Figure:
        """Draw the log; the options are those of `eval.figures.drawing.plot_log`."""
        figure: Figure = import_module("pathspace_graph.eval.figures.drawing").plot_log(self, **options)
        return figure

    @classmethod
    def from_arrays(
        cls,
        t: ArrayLike,
        twist: ArrayLike,
        detection_t: ArrayLike,
        points: ArrayLike,
        *,
        labels: Iterable[int | str] | None = None,
        covariances: ArrayLike | None = None,
        odometry_sigma: ArrayLike | None = None,
        odometry_drift: ArrayLike | None = None,
        kind: Kind | None = None,
    ) -> Log:
        """Make the log of body twists (N, 3) at t (N,) and of points (m, 2) detected at detection_t (m,).

        Units are s, m and rad, points are in the vehicle frame, and each twist is held until the next.
        Detections of one stamp are one cycle. A label is a number or a word, by default unknown.
        Noise that is not given, covariances (m, 2, 2) or sigmas (3,) of a twist, is measured when the log is
        mapped; a drift (3,) that is not given beside sigmas is assumed. An InputError names the argument and
        the row, from 1.
        """
        points, (m, s) = np.asarray(points, float).reshape(-1, 2), (covariances, odometry_sigma)
        K = np.asarray(ray_covariances(points, SIGMA_DETECTIONS) if m is None else m, float).reshape(-1, 4)
        words = [label_from_name(one) if isinstance(one, str) else one for one in labels or ()]
        labelled = words if labels is not None else np.full(len(points), UNKNOWN)
        odometry = odometry_of(Table.of_arrays(Path("odometry"), COLUMNS[ODOMETRY_FILE], t, twist))
        columns = COLUMNS[DETECTIONS_FILE]
        found = Table.of_arrays(Path("detections"), columns, detection_t, points, labelled, K[:, [0, 1, 3]])
        return cls(
            odometry,
            cycles_in(found, float(odometry.t[0]), float(odometry.t[-1])),
            np.array(SIGMA_ODOMETRY if s is None else s, float),
            SensorInfo(kind=kind),
            odometry_stated=s is not None,
            detections_stated=m is not None,
            odometry_drift=None if odometry_drift is None else np.array(odometry_drift, float),
        )

    def with_covariances(self, of: Callable[[Array], Array | None]) -> Log:
        """Replace covariances by those `of` points (m, 2), except of cycles for which there are none."""
        known = ((cycle, of(cycle.points_vehicle)) for cycle in self.cycles)
        cycles = (cycle if K is None else replace(cycle, covariances=K) for cycle, K in known)
        return replace(self, cycles=tuple(cycles))

    def at_scale_one(self) -> Log:
        """Divide all lengths by the scale of the scene."""
        return scaled(self, 1.0 / self.scale)

    @property
    def noise(self) -> KnownNoise:
        """Noise as an estimator takes it, divided by the scale of the scene."""
        stated = self.odometry_stated, self.detections_stated
        scale, drift = self.sensor.sigma_range_scale, self.odometry_drift
        return scaled(KnownNoise(self.odometry_sigma, *stated, self.measured, scale, drift), 1.0 / self.scale)


def odometry_of(table: Table) -> Odometry:
    """Check and take the odometry of a table."""
    if not len(table):
        raise InputError(table.file, "expected at least one row, found a header only", 2)
    t, speeds = increasing_times(table), table.stack(("vx", "vy"))
    held = np.abs(speeds[:-1]).max(axis=1) * np.diff(t)
    too_far = f"expected a twist that moves the vehicle by at most {limits.MAX_HELD:g} m until the next row"
    table.require(np.append(held <= limits.MAX_HELD, True), too_far)
    too_long = f"expected a drive of at most {limits.MAX_DRIVE:g} m up to the next row"
    table.require(np.append(np.cumsum(held) <= limits.MAX_DRIVE, True), too_long)
    return Odometry(t, np.column_stack([speeds, table.numbers("wz")]))


def increasing_times(table: Table) -> Array:
    """Check and take the stamps (rows,) of a table, each later than the one before (s)."""
    t = table.numbers("t")
    table.require(np.diff(t, prepend=-np.inf) > 0, "expected a time later than the row before")
    return t


def cycles_in(table: Table, t_first: float, t_last: float) -> tuple[Detections, ...]:
    """Check and take the cycles of a table, beside an odometry from `t_first` to `t_last` (s)."""
    t = table.numbers("t")
    table.require(np.diff(t, prepend=t[:1]) >= 0, "expected a time not earlier than the row before")
    table.require(t >= t_first, f"expected a time not before the first odometry row ({t_first:g} s)")
    late = f"expected a time at most {MAX_HOLD:g} s after the last odometry row ({t_last:g} s)"
    table.require(t <= t_last + MAX_HOLD, late)
    points, entries = table.stack(("x", "y")), table.stack(("xx", "xy", "yy")).T
    wrong = "expected a positive definite covariance (xx > 0, xx yy > xy^2)"
    table.require(is_positive_definite(*entries), wrong)
    cycles = cycles_of(t, points, covariances_of(*entries), labels_of(table))
    counts = [len(cycle.labels) for cycle in cycles]
    if max(counts, default=0) > limits.MAX_DETECTIONS:
        first = sum(counts[: int(np.argmax(counts))])
        expected = f"expected at most {limits.MAX_DETECTIONS} detections in a cycle, found more"
        raise InputError(table.file, expected, int(table.rows[first]))
    return cycles


def cycles_of(t: Array, points: Array, covariances: Array, labels: IntArray) -> tuple[Detections, ...]:
    """Group detections (m,) at stamps (s) to perception cycles, see `is_one_cycle`."""
    starts: list[int] = []
    for row in np.flatnonzero(np.diff(t, prepend=np.nan)).tolist():  # of rows with another stamp
        if not starts or not is_one_cycle(t[row], t[starts[-1]]):
            starts.append(row)
    spans = [slice(a, b) for a, b in pairwise([*starts, len(t)])]
    return tuple(Detections(float(t[s.start]), points[s], covariances[s], labels[s]) for s in spans)


def is_one_cycle(t: float, begin: float) -> bool:
    """Whether detections at t (s) belong to the cycle that begins at a stamp (s), and has that stamp.

    Several cameras, and stamps that were rounded to milliseconds, differ by `MIN_INTERVAL` or less.
    """
    return abs(t - begin) <= MIN_INTERVAL + ROUND_OFF


def labels_of(table: Table) -> IntArray:
    """Labels (rows,) of words or of numbers."""
    column = table.columns["label"]
    if column.dtype != object:
        return table.numbers("label").astype(int)
    known = {word: label_from_name(word) for word in set(column)}
    return np.array([known[word] for word in column], dtype=int)


# --- covariances of detections ---------------------------------------------------------------------------


def covariances_of(xx: Array, xy: Array, yy: Array) -> Array:
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)


def polar_covariances(bearings: Array, along: Array, across: Array) -> Array:
    """`R(b) diag(along, across) R(b)^T` (m, 2, 2) of variances (m,) along rays and across them."""
    c, s = np.cos(bearings), np.sin(bearings)
    xx, yy = c * c * along + s * s * across, s * s * along + c * c * across
    return covariances_of(xx, c * s * (along - across), yy)


def ray_covariances(points: Array, sigmas: Iterable[float]) -> Array:
    """Covariances (m, 2, 2) by (s_range, s_growth, s_bearing) of points (m, 2) at ranges r.

    `(s_range + s_growth r)^2` along the ray, `(r s_bearing)^2` across it.
    """
    ranges, bearings = np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])
    begin, growth, bearing = sigmas
    across = (np.maximum(ranges, 1.0) * bearing) ** 2  # K > 0 at the sensor, too
    return polar_covariances(bearings, (begin + growth * ranges) ** 2, across)


def is_positive_definite(xx: Array, xy: Array, yy: Array) -> BoolArray:
    """Which covariances (m,) are positive definite, by their entries."""
    with np.errstate(over="ignore", invalid="ignore"):
        good = (xx > 0) & (yy > 0) & (xx * yy - xy * xy > 1e-12 * xx * yy)  # singular to doubles below
    return np.asarray(good)
