"""What a record does not say of itself: noise, where the sensor is mounted, and which way y points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, pi
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError, check_numbers
from pathspace_graph.labels import LEFT, NAMES, ORANGE, RIGHT, UNKNOWN, label_from_name

Side = Literal["left", "right"]
"""The y axis points to this side of the x axis."""
DEFAULT_LABELS: Final = ("left=0", "right=1")
"""Numbers mean these labels where nothing else is said."""
SIGMA_ODOMETRY: Final = (0.25, 0.12, 0.035)
"""A twist has these standard deviations (m/s, m/s, rad/s) where nothing is known of them."""
GROWTH: Final = "sigma_range_growth"
DETECTION_SIGMAS: Final = ("sigma_range", GROWTH, "sigma_bearing")
SIGMA_DETECTIONS: Final = (0.05, 0.012, pi / 200.0)
"""Noise of detections (m, m/m, rad) where nothing is known of it."""


@dataclass(frozen=True)
class NoiseSettings:
    """Describes the noise of a record that does not state it."""

    sigma_odometry: tuple[float, float, float] | None = None
    """Each sample of [vx, vy, wz] has these standard deviations (m/s, m/s, rad/s), white from sample to
    sample. Without them they are 0.25, 0.12 and 0.035, or what a data set states of itself. The covariance in
    a message is not used, since it mostly is that of a filter's state, which is not white."""
    sigma_range: float | None = None
    """Standard deviation of the range at range 0 (m) of a detection without a covariance. Where none of these
    three is stated, they are measured, and without enough cones 0.05, 0.012 and 0.0157."""
    sigma_range_growth: float | None = None
    """Growth of the standard deviation of the range with the range (m/m)."""
    sigma_bearing: float | None = None
    """Standard deviation of the bearing (rad) of a detection without a covariance."""
    replace_covariances: bool = False
    """All detections have the covariance by these standard deviations, also where the record has another."""

    def __post_init__(self) -> None:
        sigmas = self.sigma_odometry
        if sigmas is not None and (len(sigmas) != 3 or not all(0 < sigma < inf for sigma in sigmas)):
            raise SettingsError(f"--sigma-odometry: expected three positive numbers, found {sigmas}")
        given = [name for name, own in zip(DETECTION_SIGMAS, self._own, strict=True) if own is not None]
        check_numbers(self, "convert", [name for name in given if name != GROWTH], "a positive number")
        check_numbers(self, "convert", [name for name in given if name == GROWTH], "a number of at least 0")

    @property
    def _own(self) -> tuple[float | None, ...]:
        return self.sigma_range, self.sigma_range_growth, self.sigma_bearing

    @property
    def sigmas(self) -> tuple[float, ...]:
        """Returns sigmas of the range at range 0 (m), of its growth (m/m), and of the bearing (rad)."""
        return tuple(
            default if own is None else own for own, default in zip(self._own, SIGMA_DETECTIONS, strict=True)
        )

    @property
    def states_detections(self) -> bool:
        """Returns whether the noise of the detections is stated here."""
        return any(own is not None for own in self._own)


@dataclass(frozen=True)
class Frames:
    """Describes the frames in which odometry and detections were recorded."""

    mounting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The sensor has this pose [x, y, yaw] (m, m, rad) in the vehicle frame, where x points forward and y to
    the left."""
    y_odometry: Side = "left"
    """The y axis of the odometry points to this side. Where it is the right one, angles are positive
    clockwise."""
    y_detections: Side = "left"
    """The y axis of the detections points to this side, before they are moved to the vehicle frame."""

    def __post_init__(self) -> None:
        if not all(map(isfinite, self.mounting)) or abs(self.mounting[2]) > 2.0 * pi:
            expected = "--mounting: expected X Y YAW in m, m and rad, with a yaw of at most 2 pi"
            raise SettingsError(f"{expected}, found {' '.join(f'{value:g}' for value in self.mounting)}")

    @property
    def flip(self) -> NDArray[np.float64]:
        """Returns by what a twist [vx, vy, wz] (3,) is multiplied, so that its y axis points to the left."""
        return np.array([1.0, 1.0, 1.0] if self.y_odometry == "left" else [1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Window:
    """Says which detections of a record count, and when they were measured."""

    range_max: float | None = None
    """Detections farther from the sensor than this (m) are left out."""
    time_offset: float = 0.0
    """This time (s) is added to the stamps of the detections."""

    def __post_init__(self) -> None:
        if self.range_max is not None and not 0.0 < self.range_max < inf:
            raise SettingsError(f"--range-max: expected a positive number, found {self.range_max:g}")
        if not isfinite(self.time_offset):
            raise SettingsError(f"--time-offset: expected a number, found {self.time_offset:g}")


class LabelRule:
    """Tells the label of a number, a word or a colour.

    `left=0 right=1 right=7` gives labels to values. Any other word is read as the log's own format reads it.
    """

    def __init__(self, pairs: Sequence[str] = ()) -> None:
        self._labels: dict[str, int] = {}
        for pair in pairs or DEFAULT_LABELS:
            name, equals, value = pair.partition("=")
            if not equals or name not in NAMES or not value:
                raise SettingsError(f"--labels: expected LABEL=VALUE with a LABEL of {NAMES}, found '{pair}'")
            self._labels[value] = NAMES.index(name)

    def of(self, value: object) -> int:
        """Returns the label of a value: a number, a text, or a colour with `r`, `g` and `b`."""
        if hasattr(value, "r") and hasattr(value, "g") and hasattr(value, "b"):
            return label_of_colour(float(value.r), float(value.g), float(value.b))
        text = str(value).strip()
        if text in self._labels:
            return self._labels[text]
        number = _whole(text)
        return self._labels[number] if number in self._labels else label_from_name(text)


def _whole(text: str) -> str:
    """Returns the text of a whole number as `1`, also where it is written as `1.0`; else the text."""
    try:
        number = float(text)
    except ValueError:
        return text
    return str(int(number)) if isfinite(number) and number == int(number) else text


BLUE_HUES: Final = (190.0, 265.0)
"""A colour with a hue (degrees) between these is blue."""
YELLOW_HUES: Final = (44.0, 75.0)
"""A colour with a hue (degrees) between these is yellow; that of green is above."""
ORANGE_HUES: Final = (14.0, 44.0)
"""A colour with a hue (degrees) between these is orange; that of red is below."""
MIN_SATURATION: Final = 0.3
"""A colour of less saturation is grey."""


def label_of_colour(red: float, green: float, blue: float) -> int:
    """Return the label of a blue, yellow or orange colour, UNKNOWN of any other; the scale is free."""
    most, least = max(red, green, blue), min(red, green, blue)
    if not 0.0 < most < inf or not most - least > MIN_SATURATION * most:
        return UNKNOWN
    chroma = most - least
    if most == red:
        hue = 60.0 * (green - blue) / chroma
    elif most == green:
        hue = 60.0 * (blue - red) / chroma + 120.0
    else:
        hue = 60.0 * (red - green) / chroma + 240.0
    if BLUE_HUES[0] <= hue <= BLUE_HUES[1]:
        return LEFT
    if ORANGE_HUES[0] <= hue < ORANGE_HUES[1]:
        return ORANGE
    return RIGHT if YELLOW_HUES[0] <= hue <= YELLOW_HUES[1] else UNKNOWN
