"""`convert`: a ROS bag, CSV files of one's own or a known data set as a log."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from rich.console import Console
from tyro.conf import Positional, arg

from pathspace_graph.convert.bag import BagOptions, read_bag
from pathspace_graph.convert.csv_files import Columns, Units, read_csv
from pathspace_graph.convert.recording import Recording, to_log, windowed
from pathspace_graph.convert.settings import Frames, LabelRule, NoiseSettings, Side, Window
from pathspace_graph.convert.victoria_park import read_victoria_park
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.io.files import check_target
from pathspace_graph.io.log import LOG_FILE, Log, write_log
from pathspace_graph.labels import NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.plausibility.diagnosis import measured_line
from pathspace_graph.plausibility.hint import because
from pathspace_graph.plausibility.judge import hints
from pathspace_graph.progress import progress
from pathspace_graph.scale.scene import scale_of

from .online import tell
from .simulate import describe

Kind = Literal["bag", "csv", "victoria-park"]


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Writes a ROS bag, two CSV files or a known data set as a log, in order of time and in the vehicle
    frame. It says what was left out, and why."""

    source: Positional[Path | None] = None
    """The record is read from this bag (a file, or a folder with metadata.yaml), or from this folder of CSV
    files. `victoria-park` needs none, since GTSAM brings its file."""
    out: Path
    """The log is written to this folder; an earlier log there is kept as a numbered backup."""
    kind: Annotated[Kind, arg(name="from")] = "bag"
    """The record is a ROS bag, CSV files, or the data set Victoria Park."""
    odometry: str | None = None
    """This is the topic of the odometry in a bag: nav_msgs/Odometry, geometry_msgs/TwistStamped or
    TwistWithCovarianceStamped; with --imu also std_msgs/Float32, Float64 or
    ackermann_msgs/AckermannDriveStamped, whose number is the speed. For CSV it is a file in the folder, by
    default odometry.csv."""
    detections: str | None = None
    """This is the topic of the detections in a bag: sensor_msgs/PointCloud2 with a field for the label,
    visualization_msgs/MarkerArray (blue is left, yellow is right), or any message with lists of cones. For
    CSV it is a file in the folder, by default detections.csv."""
    imu: str | None = None
    """The yaw rate is of this topic of sensor_msgs/Imu, whose z axis points up."""
    definition: tuple[str, ...] = ()
    """These files define messages that the bag does not define itself, as PACKAGE/msg/NAME=FILE or as a path
    that ends in PACKAGE/msg/NAME.msg."""
    label_field: str | None = None
    """The label of a detection in a bag is in this field; `none` means that there are no labels."""
    labels: tuple[str, ...] = ()
    """These values mean a label: left=0 right=1 is the default. Words are read as well, blue as left and
    yellow as right; anything else is unknown."""
    columns: tuple[str, ...] = ()
    """These columns of the CSV files hold a quantity: t=stamp vx=speed vy=v wz=yaw_rate of the odometry, t,
    x, y (or range and bearing), label, xx, xy and yy of the detections. A minus changes the sign
    (wz=-yaw_rate). Where both files name t in another way, detections.t=time is of one of them."""
    units: tuple[str, ...] = ()
    """The CSV files have these units: length=mm angle=deg time=ns, also speed=km/h and yaw_rate=deg/s, which
    otherwise follow length and angle. Without them it is m, rad and s."""
    mounting: tuple[float, float, float] | None = None
    """The sensor has this pose X Y YAW (m, m, rad) in the vehicle frame: x forward, y left, yaw
    counterclockwise. Detections and their covariances are moved by it."""
    y: Side = "left"
    """The y axis of the record points to this side. With `right`, angles are positive clockwise, so that y,
    vy, wz and bearings change their sign."""
    y_odometry: Side | None = None
    """The y axis of the odometry points to this side, where it is another one than `y`."""
    from_poses: bool = False
    """The twists are made from the poses of nav_msgs/Odometry, for a publisher that leaves its twist zero."""
    received: bool = False
    """Stamps are the times at which messages were received, also where they have a stamp of their own."""
    range_max: float | None = None
    """Detections farther from the sensor than this (m) are left out."""
    time_offset: float = 0.0
    """This time (s) is added to the stamps of the detections: it is negative where they are too late."""
    noise: Annotated[NoiseSettings, arg(name="")] = field(default_factory=NoiseSettings)
    """These settings describe noise that the record does not state."""

    def run(self) -> None:
        """Reads, converts, writes and reports."""
        check_target(self.out, LOG_FILE)
        frames = Frames(self.mounting or (0.0, 0.0, 0.0), self.y_odometry or self.y, self.y)
        rule, window = LabelRule(self.labels), Window(self.range_max, self.time_offset)
        with progress("converting"):
            record = windowed(self._read(rule), window)
            file = self.source or Path(self.kind)
            log = with_measured_noise(to_log(record, frames, self.noise, file))
            write_checked(log, self.out, file)
        report(record.notes, log, self.out)
        tell(hints(log))

    def _read(self, rule: LabelRule) -> Recording:
        if self.kind == "victoria-park":
            return read_victoria_park(self.source)
        if self.source is None:
            raise SettingsError(
                f"convert: expected a SOURCE to read, which --from {self.kind} needs, found none"
            )
        if self.kind == "csv":
            odometry, detections = self.odometry or "odometry.csv", self.detections or "detections.csv"
            columns, units = Columns(self.columns), Units(self.units)
            return read_csv(self.source / odometry, self.source / detections, columns, units, rule)
        return read_bag(self.source, self._bag_options(), rule)

    def _bag_options(self) -> BagOptions:
        return BagOptions(
            odometry=self.odometry,
            detections=self.detections,
            imu=self.imu,
            definitions=self.definition,
            label_field=self.label_field,
            from_poses=self.from_poses,
            received=self.received,
            mounted=self.mounting is not None,
        )


def with_measured_noise(log: Log) -> Log:
    """Returns a log whose noise is measured where nobody has stated it."""
    if log.odometry_stated and log.detections_stated:
        return log
    scale = scale_of(log)
    measured = scaled(measure_log(scaled(log, 1.0 / scale)), scale)
    if measured is None:
        return log
    log = replace(log, measured=measured)
    if not log.odometry_stated:
        log = replace(log, odometry_sigma=measured.twist_sigma)
    if log.detections_stated or measured.along is None:
        return log
    cycles = []
    for cycle in log.cycles:
        covariances = measured.covariances(cycle.points_vehicle, inflated=False)
        cycles.append(cycle if covariances is None else replace(cycle, covariances=covariances))
    return replace(log, cycles=tuple(cycles))


def write_checked(log: Log, out: Path, source: Path) -> None:
    """Writes a log, or raises an InputError of its source where it would be refused when it is read."""
    try:
        write_log(log, out, check=True)
    except InputError as error:
        where = f"{error.file.name}, row {error.row}" if error.row else error.file.name
        likely = because(hints(log))
        why = f"{error.message}; {likely}" if likely else error.message
        raise InputError(source, f"its log would be refused ({where}): {why}") from None


def report(notes: Counter[str], log: Log, out: Path) -> None:
    """Prints the length of the log, and how often something was left out or assumed."""
    console = Console()
    for text, count in notes.items():
        if count:
            console.print(f"{count} {text}", highlight=False, soft_wrap=True, markup=False)
    measured = [] if log.measured is None else [measured_line(log.measured)]
    for line in (outline(log), *measured, f"{out}: {describe(log)}"):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def outline(log: Log) -> str:
    """Returns in a line what a look at the log should show first: rates, speeds, ranges and labels."""
    twists, seconds = log.odometry.twist, max(float(np.ptp(log.odometry.t)), np.finfo(float).tiny)
    ranges = np.concatenate([np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles])
    labels = np.bincount(np.concatenate([cycle.labels for cycle in log.cycles]), minlength=len(NAMES))
    told = ", ".join(f"{count} {name}" for name, count in zip(NAMES, labels.tolist(), strict=True) if count)
    return (
        f"odometry at {len(twists) / seconds:.3g} Hz, up to {np.hypot(*twists[:, :2].T).max():.3g} m/s and "
        f"{np.abs(twists[:, 2]).max():.3g} rad/s; detections at {len(log.cycles) / seconds:.3g} Hz, "
        f"{ranges.min():.3g} m to {ranges.max():.3g} m away: {told}"
    )
