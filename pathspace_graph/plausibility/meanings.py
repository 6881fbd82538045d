"""The words for a hypothesis that explains a log better than what is written in it."""

from __future__ import annotations

from typing import Final

import numpy as np

from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE

from .hint import Hint
from .hypotheses import Frame, Trial, Trials, Verdict
from .motions import DEGREE, Meaning

SPEEDS: Final = {
    1.0 / 3.6: "the speeds are in km/h, not in m/s",
    0.44704: "the speeds are in miles per hour, not in m/s",
    0.514444: "the speeds are in knots, not in m/s",
    1e-2: "the speeds are in cm/s, not in m/s",
    1e-3: "the speeds are in mm/s, not in m/s",
    3.6: "the speeds were divided by 3.6 although they were in m/s",
    1e3: "the speeds were divided by 1000 although they were in m/s",
}
"""A unit of the speeds (m/s) means this."""
RATES: Final = {
    DEGREE: "the yaw rate is in degrees per second, not in rad/s",
    1.0 / DEGREE: "the yaw rate was turned from degrees to radians although it was in rad/s",
}
"""A unit of the yaw rate (rad/s) means this."""
FRAMES: Final = {
    Frame(180.0): "the sensor's frame has x to the rear and y to the right",
    Frame(-90.0): "the sensor's frame has x to the right and y ahead",
    Frame(90.0): "the sensor's frame has x to the left and y to the rear",
    Frame(90.0, True): "the columns x and y are swapped",
    Frame(180.0, True): "the sensor's frame has x to the rear",
    Frame(-90.0, True): "the sensor's frame has x to the right and y to the rear",
}
"""A frame in quarter turns means this; the one with y to the right has its own hint."""
MIRRORED: Final = Frame(0.0, True)
"""Here y points to the right and x ahead."""


def frame_hints(best: Trial, trials: Trials, told: Verdict) -> list[Hint]:
    """Returns a hint about the frame of the detections, where it is not the vehicle's."""
    frame = best.hypothesis.frame
    if frame == Frame():
        return []
    if frame == MIRRORED:
        return [_mirrored(best, trials, told)]
    of_odometry = _of_odometry(frame, trials)
    if of_odometry is not None:
        likely, advice = of_odometry
        return [Hint("odometry", ODOMETRY_FILE, "columns vx, vy", told.text, likely, advice)]
    side = "with y to the right, and " if frame.mirrored else ""
    likely = FRAMES.get(frame, f"the sensor's frame is {side}turned by {_angle(frame.turn)}")
    return [Hint("sensor frame", DETECTIONS_FILE, "columns x, y", told.text, likely, _advice(frame))]


def _mirrored(best: Trial, trials: Trials, told: Verdict) -> Hint:
    """Returns the hint where detections turn the other way than the odometry; colours tell which is wrong."""
    if best.sided >= trials.as_written.sided:
        likely = "y points to the right in the detections, not to the left"
        return Hint("y to the right", DETECTIONS_FILE, "column y", told.text, likely, "negate column y")
    likely = "the yaw rate is positive to the right, as where z points down, or y points to the right"
    advice = "negate column wz, or column y of the detections"
    return Hint("yaw rate", ODOMETRY_FILE, "column wz", told.text, likely, advice)


def _of_odometry(frame: Frame, trials: Trials) -> tuple[str, str] | None:
    """Returns cause and advice where it is the odometry that goes backward or to a side, or else None."""
    vx, vy = np.median(trials.log.odometry.twist[:, :2], axis=0)
    sees_ahead = np.nanmedian(trials.pairs.before[..., 0]) > 0.0
    if abs(vy) > abs(vx) and abs(frame.turn) == 90.0:
        return "vx and vy are swapped, or in a frame whose x axis points to a side", "give vx ahead, vy left"
    if vx < 0.0 and sees_ahead and frame == Frame(180.0):
        return "the speed ahead is negative", "negate columns vx and vy"
    return None


def _advice(frame: Frame) -> str:
    """Returns how to turn detections into the vehicle's frame."""
    matrix = frame.matrix
    if np.allclose(matrix, np.round(matrix), atol=1e-9):
        signs = {1: "", -1: "-"}
        terms = [
            f"{signs[int(row[k])]}{'xy'[k]}"
            for row in np.round(matrix)
            for k in np.flatnonzero(np.round(row))
        ]
        return f"put {terms[0]} into column x and {terms[1]} into column y"
    mirror = "negate column y, then " if frame.mirrored else ""
    return f"{mirror}turn the detections by {_angle(frame.turn)}"


def _angle(turn: float) -> str:
    return f"{abs(turn):.0f} degrees to the {'left' if turn > 0.0 else 'right'}"


def odometry_hints(best: Trial, told: Verdict) -> list[Hint]:
    """Returns hints about what the odometry means, where it is not a twist of the vehicle in SI units."""
    meaning = best.hypothesis.meaning
    if meaning == Meaning(speed=1e-3, rate=1e-3):
        likely = "the stamps are in milliseconds, not in seconds"
        return [Hint("stamps", ODOMETRY_FILE, "column t", told.text, likely, "multiply column t by 0.001")]
    if meaning.content == "nothing":
        likely = "the detections are in the frame of the map, or the vehicle stood while its wheels turned"
        advice = "give the detections in the vehicle's frame"
        return [Hint("map frame", DETECTIONS_FILE, "columns x, y", told.text, likely, advice)]
    found = _content(meaning, told)
    if meaning.speed != 1.0:
        likely, advice = SPEEDS[meaning.speed], f"multiply vx and vy by {meaning.speed:.5g}"
        found.append(Hint("speeds", ODOMETRY_FILE, "columns vx, vy", told.text, likely, advice))
    if meaning.rate != 1.0:
        likely, advice = RATES[meaning.rate], f"multiply it by {meaning.rate:.5g}"
        found.append(Hint("yaw rate", ODOMETRY_FILE, "column wz", told.text, likely, advice))
    return found


def _content(meaning: Meaning, told: Verdict) -> list[Hint]:
    """Returns a hint where the columns of the odometry hold something else than a twist of the vehicle."""
    if meaning.content == "pose":
        likely, advice = "the odometry is a pose (x, y, heading), not a twist", "give the body twist"
        return [Hint("odometry", ODOMETRY_FILE, "columns vx, vy, wz", told.text, likely, advice)]
    if meaning.content == "twist in the map frame":
        likely = "vx and vy are along the axes of a fixed frame, not of the vehicle"
        advice = "turn them by the heading into the vehicle's frame"
        return [Hint("odometry", ODOMETRY_FILE, "columns vx, vy", told.text, likely, advice)]
    return []
