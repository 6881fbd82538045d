"""Hints about likely mistakes in a log, and the table of their texts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

from pathspace_graph.io.log import DETECTIONS_FILE, LOG_FILE, ODOMETRY_FILE
from pathspace_graph.lengths import Text


@dataclass(frozen=True)
class Hint:
    """A likely mistake in a log; lengths in its texts are in metres of the scene."""

    LENGTHS: ClassVar = dict.fromkeys(("cause", "file", "columns", "found", "likely", "advice"), 0)

    cause: str
    """Kind of the mistake."""
    file: str
    columns: str
    """Columns of the file."""
    found: str
    """Finding, with its figure."""
    likely: str
    """Likely cause."""
    advice: str
    """Correction."""

    @property
    def line(self) -> str:
        return f"{self.file}, {self.columns}: {self.found}; likely cause: {self.likely}; {self.advice}"


def because(hints: Sequence[Hint]) -> str:
    """Return the likely causes of a refusal in words; empty without hints."""
    causes = [f"{hint.likely} ({hint.file}, {hint.columns}: {hint.found})" for hint in hints]
    return f"likely cause: {'; '.join(causes)}" if causes else ""


_T, _XY, _V, _WZ, _K = "column t", "columns x, y", "columns vx, vy", "column wz", "columns xx, xy, yy"
_LABEL = "column label"
_EXPECTED = (
    "the odometry predicts {as_written:.0f} % of the detections, and {share:.0f} % with the likely cause"
)
_MOVES_TURNED = "static cones move as if the sensor were turned by {angle}"
_BY_READINGS = "--noise measured uses the measured one"
_CUT = "check that the recording has all detections; convert with"
_CLASSES = "the classes of the detector were not turned into left and right"

# kind, file, columns, finding, likely cause and advice of each mistake, with places for its figures
TABLE: Final[dict[str, tuple[str, str, str, str, str, str]]] = {
    "unit of stamps": ("stamps", "{file}", _T, "successive rows are typically {step:.4g} s apart",
        "the stamps are in {unit}, not in seconds", "multiply column t by {factor:g}"),
    "fraction of seconds": ("stamps", "{file}", _T,
        "the stamps fall {falls} times and stay between {low:.4g} and {high:.4g}",
        "this is only the fraction of each second", "add the seconds to it"),
    "whole seconds": ("stamps", "{file}", _T, "the stamps are whole numbers, {rows:.0f} rows to each",
        "these are only the whole seconds", "add the fraction of each second"),
    "milliseconds": ("stamps", ODOMETRY_FILE, _T, _EXPECTED, "the stamps are in milliseconds, not in seconds",
        "multiply column t by 0.001"),
    "two clocks": ("clocks", DETECTIONS_FILE, _T,
        "the stamps go from {begin:.12g} to {end:.12g} s, those of " + ODOMETRY_FILE
        + " from {first:.12g} to {last:.12g} s",
        "the two files were stamped by different clocks, such as the sensor's and the receiver's",
        "stamp both by one clock"),
    "late": ("clocks", DETECTIONS_FILE, _T, _EXPECTED,
        "the detections are stamped about {seconds:g} s too {way}",
        "stamp odometry and detections when they are measured, by one clock"),
    "detections end early": ("gaps", DETECTIONS_FILE, _T,
        "the last detection is {seconds:.3g} s before the last odometry",
        "the detector or its recording stopped before the drive ended", _CUT + " --end leaves the rest out"),
    "detections begin late": ("gaps", DETECTIONS_FILE, _T,
        "the first detection is {seconds:.3g} s after the first odometry",
        "the detector or its recording started after the drive began", _CUT + " --start leaves the rest out"),
    "few detections": ("reach", DETECTIONS_FILE, _XY, "the typical cycle has {count:.2g} detections",
        "the sensor's range is short for the width of the track, or its detector misses most cones",
        "expect drift: fewer than {least} cannot check the odometry"),
    "unit of positions": ("positions", DETECTIONS_FILE, _XY, "detections are typically {typical:.4g} m away",
        "the positions {what}", "multiply x and y by {factor:g}"),
    "too fast": ("speeds", ODOMETRY_FILE, _V, "the speed is more than {speed:.4g} m/s in a tenth of the rows",
        "the speeds are not in m/s, but in mm/s or cm/s", "give them in m/s"),
    "turns too fast": ("yaw rate", ODOMETRY_FILE, _WZ,
        "the yaw rate is more than {rate:.4g} rad/s in a tenth of the rows",
        "the yaw rate is in degrees per second, not in rad/s", "multiply it by pi/180"),
    "unit of speeds": ("speeds", ODOMETRY_FILE, _V, _EXPECTED, "the speeds {what}",
        "multiply vx and vy by {factor:.5g}"),
    "unit of yaw rate": ("yaw rate", ODOMETRY_FILE, _WZ, _EXPECTED, "the yaw rate {what}",
        "multiply it by {factor:.5g}"),
    "pose": ("odometry", ODOMETRY_FILE, "columns vx, vy, wz", _EXPECTED,
        "the odometry is a pose (x, y, heading), not a twist", "give the body twist"),
    "twist in the map frame": ("odometry", ODOMETRY_FILE, _V, _EXPECTED,
        "vx and vy are along the axes of a fixed frame, not of the vehicle",
        "rotate them by the heading into the vehicle's frame"),
    "nothing": ("map frame", DETECTIONS_FILE, _XY, _EXPECTED,
        "the detections are in the frame of the map, or the vehicle stood while its wheels turned",
        "give the detections in the vehicle's frame"),
    "vx and vy swapped": ("odometry", ODOMETRY_FILE, _V, _EXPECTED,
        "vx and vy are swapped, or in a frame whose x axis points to a side", "give vx ahead, vy left"),
    "backward": ("odometry", ODOMETRY_FILE, _V, _EXPECTED, "the speed ahead is negative",
        "negate columns vx and vy"),
    "y to the right": ("y to the right", DETECTIONS_FILE, "column y", _EXPECTED,
        "y points to the right in the detections, not to the left", "negate column y"),
    "yaw rate to the right": ("yaw rate", ODOMETRY_FILE, _WZ, _EXPECTED,
        "the yaw rate is positive to the right, as with z down, or y points to the right",
        "negate column wz, or column y of the detections"),
    "frame": ("sensor frame", DETECTIONS_FILE, _XY, _EXPECTED, "{what}", "{how}"),
    "camera": ("sensor frame", DETECTIONS_FILE, _XY,
        "column {thin} varies by only {least:.2g} m, the other one by {most:.2g} m",
        "the detections are in the frame of a camera, with z ahead, x to the right and y down",
        "put z into column x and -x into column y"),
    "turned": ("sensor frame", DETECTIONS_FILE, _XY, _MOVES_TURNED,
        "the sensor is turned by {angle} in the vehicle{side}",
        "state the sensor's mounting, or rotate the detections by it into the vehicle's frame"),
    "place": ("mounting", DETECTIONS_FILE, _XY,
        "static cones move as if the sensor were {along:.2f} m {ahead_or_behind} and {aside:.2f} m to the "
        "{left_or_right} of the odometry's reference point",
        "the detections are in the sensor's frame, whose origin is not the vehicle's",
        "add {ahead:.2f} to x and {left:.2f} to y, or state the sensor's mounting"),
    "covariances": ("covariances", DETECTIONS_FILE, _K,
        "detections of one cone are typically {scatter:.2g} m apart, or {claimed:.2g} m by their covariances",
        "the covariances are in {unit}, or no covariances at all", "give each detection's covariance in m^2"),
    "one label": ("labels", DETECTIONS_FILE, _LABEL,
        "all labels are {label}, and {share:.0f} % of the cones are on that side", _CLASSES,
        "write left, right or unknown for each detection"),
    "foreign labels": ("labels", DETECTIONS_FILE, _LABEL, "the labels are {words}", _CLASSES,
        "write left, right or unknown (or blue, yellow) for each detection"),
    "unexplained": ("unexplained", DETECTIONS_FILE, _XY,
        "no motion predicts more than {share:.0f} % of the detections",
        "bearings in degrees were taken for radians, or the two files are of different drives",
        "compare a few cycles with the sensor's raw data"),
    "noise of odometry": ("noise", LOG_FILE, "[odometry] sigma", "{figures}",
        "the stated noise is too {size}", _BY_READINGS),
    "noise of detections": ("noise", DETECTIONS_FILE, _K,
        "detections scatter by {scatter:.2g} m {way} the ray at {at:.2g} m, and {stated:.2g} m is stated",
        "the covariances are too {size}", _BY_READINGS),
}  # fmt: skip


def hint_of(mistake: str, **figures: Any) -> Hint:
    """Return a hint of `TABLE` with its figures; one in m or m/s is a `Length`."""
    return Hint(*(Text(text, **figures) for text in TABLE[mistake]))
