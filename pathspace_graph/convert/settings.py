"""What a record does not state: noise, the mounting of the sensor, and the direction of y."""

import re
from collections import Counter
from collections.abc import Sequence
from colorsys import rgb_to_hsv
from contextlib import suppress
from dataclasses import dataclass
from math import inf, pi
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.log import SIGMA_DETECTIONS
from pathspace_graph.labels import BIG_ORANGE, LEFT, NAMES, ORANGE, RIGHT, UNKNOWN
from pathspace_graph.settings.checked import AtLeast0, Checked, Positive, Signed, Unlimited

Side = Literal["left", "right"]  # side of the x axis to which the y axis points
# fields of a message that may hold the label of a detection, the first one that is there
LABEL_FIELDS: Final = ("label", "class", "class_id", "color", "colour", "type", "results", "hypothesis")
NO_LABEL: Final = "none"  # name of a label field that means no labels
LEAST_SPACING: Final = 1e-3  # of points along a line (m)


@dataclass(frozen=True)
class Topics:
    """Which messages of a bag, or files, are read, and how."""

    odometry: str | None = None
    """Topic of the odometry in a bag: any message with a twist, with a speed (then --imu or --wheelbase gives
    the yaw rate), or with a pose. For CSV a file in the folder, by default odometry.csv."""
    detections: str | None = None
    """Topic of the detections in a bag: a point cloud with a field for the label, an array of markers (blue
    is left, yellow is right), any message with lists of cones or polylines, or a LaserScan. For CSV a file in
    the folder, by default detections.csv."""
    imu: str | None = None
    """Topic of the yaw rate, sensor_msgs/Imu, whose z axis points up."""
    wheelbase: float | None = None
    """Wheelbase (m), by which speed and steering angle give the yaw rate."""
    definition: tuple[str, ...] = ()
    """Files of messages that the bag does not define itself, as PACKAGE/msg/NAME=FILE or as a path that ends
    in PACKAGE/msg/NAME.msg."""
    namespaces: tuple[str, ...] = ()
    """Namespaces of the markers that are detections, by default all of them."""
    from_poses: bool = False
    """Make the twists from the poses of the odometry, for a publisher that leaves its twist zero."""
    held: bool = False
    """Each twist is the mean until the next one. Without it twists are samples, and those slower than 8 Hz
    are interpolated."""
    received: bool = False
    """Use the times of receipt as stamps, even where messages have their own."""


@dataclass(frozen=True)
class NoiseSettings(Checked, group=""):
    """Noise of a record that does not state it."""

    sigma_odometry: tuple[Positive, Positive, Positive] | None = None
    """Each sample of [vx, vy, wz] has these standard deviations (m/s, m/s, rad/s), white from sample to
    sample. Without them they are 0.25, 0.12 and 0.035, or what a data set states of itself. The covariance in
    a message is not used: mostly it is that of a filter's state, which is not white."""
    sigma_drift: tuple[AtLeast0, AtLeast0, AtLeast0] | None = None
    """Drift of the odometry beside that white noise (m, m and rad by root of s): a random walk of the
    integrated pose. Where it is not stated, 0.05, 0.05 and 0.0017 are assumed."""
    sigma_range: float | None = None
    """Standard deviation of the range at range 0 (m) of a detection without a covariance. Where none of these
    three is stated, they are measured, and without enough cones 0.05, 0.012 and 0.0157."""
    sigma_range_growth: AtLeast0 | None = None
    """Growth of the standard deviation of the range with the range (m/m)."""
    sigma_bearing: float | None = None
    """Standard deviation of the bearing (rad) of a detection without a covariance."""
    replace_covariances: bool = False
    """All detections have the covariance by these standard deviations, also where the record has another."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma_drift is not None and self.sigma_odometry is None:
            raise SettingsError("sigma_drift: expected sigma_odometry beside it, found none")

    @property
    def of_detections(self) -> tuple[float | None, ...]:
        """What is stated of detections, in the order of `sigmas`."""
        return self.sigma_range, self.sigma_range_growth, self.sigma_bearing

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Sigmas of the range at range 0 (m), of its growth (m/m), and of the bearing (rad)."""
        pairs = zip(self.of_detections, SIGMA_DETECTIONS, strict=True)
        return tuple(default if own is None else own for own, default in pairs)


@dataclass(frozen=True)
class Frames(Checked, group=""):
    """Frames in which odometry and detections were recorded."""

    mounting: tuple[Signed, Signed, Signed] | None = None
    """Pose X Y YAW (m, m, rad) of the sensor in the vehicle frame: x forward, y left, yaw counterclockwise.
    Without it that of a bag's /tf_static is used, where there is one."""
    y: Side = "left"
    """Side to which the y axis of the record points. With `right`, angles are positive clockwise, so that y,
    vy, wz and bearings change their sign."""
    y_odometry: Side | None = None
    """Side to which the y axis of the odometry points, where it is another one than `y`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mounting and abs(self.mounting[2]) > 2.0 * pi:
            raise SettingsError(f"mounting: expected a yaw of at most 2 pi rad, found {self.mounting[2]:g}")

    @property
    def sides(self) -> NDArray[np.float64]:
        """Signs (2,) of a sensor's point [x, y] that make y point to the left."""
        return np.array([1.0, 1.0 if self.y == "left" else -1.0])

    @property
    def flip(self) -> NDArray[np.float64]:
        """Signs (3,) of a twist [vx, vy, wz] that make its y axis point to the left."""
        return np.array([1.0, 1.0, 1.0] if (self.y_odometry or self.y) == "left" else [1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Window(Checked, group=""):
    """Part of a record to convert, and correction of its stamps."""

    range_max: float | None = None
    """Largest distance of a detection from the sensor (m); farther ones are dropped."""
    time_offset: Signed = 0.0
    """Time (s) added to the stamps of the detections: negative where they are too late."""
    start: AtLeast0 = 0.0
    """Time after the first odometry at which the log begins (s)."""
    end: Unlimited = inf
    """Time after the first odometry at which the log ends (s)."""
    spacing: float | None = None
    """Distance of points along a line, a kerb or a wall (m), to which dense ones are thinned and polylines
    interpolated. It means that all detections are of lines. Without it those of a LaserScan and of polylines
    are, at 0.15 of their median range."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start >= self.end:
            raise SettingsError(f"start: expected less than end, found {self.start:g} and {self.end:g}")
        if self.spacing is not None and self.spacing < LEAST_SPACING:
            raise SettingsError(f"spacing: expected at least {LEAST_SPACING:g} m, found {self.spacing:g}")


class LabelRule:
    """Labels of numbers, words and colours, and a count of the values that were met.

    Pairs as `left=0` give labels to values; other words are read by their parts, as in `blue_cone` or `b`.
    The value of a message is in its `field`, or in the first of LABEL_FIELDS that it has.
    """

    def __init__(self, pairs: Sequence[str] = (), field: str | None = None) -> None:
        self.fields = (field,) if field else LABEL_FIELDS
        self._labels: dict[str, int] = {}
        self.met: Counter[tuple[str, int]] = Counter()  # values, by their text and the label they got
        for pair in pairs or ("left=0", "right=1"):
            name, equals, value = pair.partition("=")
            if not equals or name not in NAMES or not value:
                raise SettingsError(f"--labels: expected LABEL=VALUE with a LABEL of {NAMES}, found '{pair}'")
            self._labels[value] = NAMES.index(name)

    def of(self, value: Any, times: int = 1) -> int:
        """Label a value that was met so often: a number, a text, or a colour with `r`, `g` and `b`."""
        value = getattr(value, "data", value)
        if hasattr(value, "r") and hasattr(value, "g") and hasattr(value, "b"):
            r, g, b = (float(channel) for channel in (value.r, value.g, value.b))
            text, label = f"colour ({r:.3g}, {g:.3g}, {b:.3g})", label_of_colour(r, g, b)
        else:
            text = str(value).strip()
            with suppress(ValueError):  # a whole number is `1`, also where it is written as `1.0`
                text = str(int(float(text))) if float(text).is_integer() else text
            label = self._labels[text] if text in self._labels else label_of_words(text)
        self.met[text, label] += times
        return label

    def of_all(self, values: NDArray[Any]) -> NDArray[np.int_]:
        texts, place, counts = np.unique(values, return_inverse=True, return_counts=True)
        return np.array([*map(self.of, texts.tolist(), counts.tolist())], dtype=int)[place]

    def summary(self) -> str:
        """One line with the labels of the most frequent values; empty where there are none."""
        most = self.met.most_common(12)
        values = [f"{text or 'empty'} is {NAMES[label]} ({count})" for (text, label), count in most]
        return f"labels: {', '.join(values)}{', ...' * (len(self.met) > len(most))}" if values else ""


def label_of_words(text: str) -> int:
    """Label of a text by its words, as blue and cone in `Blue-cone`; UNKNOWN where none or several tell."""
    words = {*re.findall(r"[a-z]+", text.lower())}
    if words & {"orange", "o"}:
        return BIG_ORANGE if words & {"big", "large"} else ORANGE
    of_side = {LEFT: {"blue", "left", "b"}, RIGHT: {"yellow", "right", "y"}}
    sides = [label for label, names in of_side.items() if words & names]
    return sides[0] if len(sides) == 1 else UNKNOWN


def label_of_colour(red: float, green: float, blue: float) -> int:
    """Label of a blue, yellow or orange colour, UNKNOWN of any other; the scale is free."""
    most, least = max(red, green, blue), min(red, green, blue)
    if not 0.0 < most < inf or not most - least > 0.3 * most:  # it is grey
        return UNKNOWN
    hue = 360.0 * rgb_to_hsv(red, green, blue)[0]  # degrees
    hues = {LEFT: (190.0, 265.0), ORANGE: (14.0, 44.0), RIGHT: (44.0, 75.0)}
    labels = [label for label, (low, high) in hues.items() if low <= hue <= high]
    return labels[-1] if labels else UNKNOWN  # yellow begins where orange ends
