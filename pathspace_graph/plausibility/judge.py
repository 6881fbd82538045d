"""`hints`: a log is judged before it is mapped, and its likely mistakes are told."""

from __future__ import annotations

import numpy as np

from pathspace_graph.io.log import DETECTIONS_FILE, Log
from pathspace_graph.labels import LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.lengths import scaled
from pathspace_graph.scale.scene import scale_of
from pathspace_graph.settings.plausibility import PlausibilitySettings

from .hint import Hint
from .hypotheses import Trial, Trials, verdict
from .meanings import frame_hints, odometry_hints
from .motions import Meaning, motions
from .mounting import Mounting, best_lateness, mounting_of
from .noise import noise_hints
from .pairs import Pairs, pairs_of
from .units import beyond_any_vehicle, one_clock, positions_in_metres, stamps_in_seconds, whole_stamps

COLUMNS = "columns x, y"
"""The detections are in these columns."""


def hints(log: Log, settings: PlausibilitySettings | None = None) -> list[Hint]:
    """Returns the likely mistakes in a log, each with its figure; there are none in a good one.

    Only the readings are looked at, never the truth. Where a log is short, or stands still, or goes straight
    on, the evidence is weak, and nothing is said.
    """
    settings = settings or PlausibilitySettings()
    if len(log.odometry.t) < settings.least_twists:
        return []
    scale = scale_of(log)
    return [scaled(hint, scale) for hint in _hints(scaled(log, 1.0 / scale), settings)]


def _hints(log: Log, settings: PlausibilitySettings) -> list[Hint]:
    """Returns the hints about a log at scale 1."""
    of_parts = whole_stamps(log)
    if of_parts:
        return of_parts
    log, found = stamps_in_seconds(log, settings)
    of_clocks = one_clock(log)
    if of_clocks:
        return found + of_clocks
    log, of_positions = positions_in_metres(log, settings)
    found += of_positions
    pairs = pairs_of(log.cycles, settings)
    if pairs is None:
        return found + beyond_any_vehicle(log.odometry, settings)
    found += _by_motion(Trials(log, telling_pairs(log, pairs, settings), settings), settings)
    return found or noise_hints(log, settings)


def telling_pairs(log: Log, pairs: Pairs, settings: PlausibilitySettings) -> Pairs:
    """Returns the pairs of cycles that see the same cones if the odometry is right.

    One stretch of a track looks like the next. So cycles without cones in common agree best with a vehicle
    that does not move. Where the odometry is impossible anyway, the pairs are those that follow each other.
    """
    if beyond_any_vehicle(log.odometry, settings):
        return pairs.chosen(pairs.gap <= settings.gaps[1])
    motion = motions(log.odometry.t, Meaning().poses(log.odometry), pairs.begin, pairs.end)
    return pairs.chosen(pairs.overlap(motion) >= settings.overlap)


def _by_motion(trials: Trials, settings: PlausibilitySettings) -> list[Hint]:
    """Returns what the motion of the detections tells."""
    if len(trials.pairs) == 0:
        return beyond_any_vehicle(trials.log.odometry, settings)
    best, found = _meant(trials, settings)
    if best.hypothesis.meaning.content == "nothing" or (found and is_a_line(trials.pairs, settings)):
        return found
    late, of_clocks = _late(trials, best, settings)
    if best.share < settings.least_share and late is best:
        return found + (_unexplained(trials, best, settings) if not found else [])
    mounting = mounting_of(trials, late.hypothesis, settings)
    found += of_clocks
    if mounting is not None:
        found = _turned(found, late, mounting, settings)
        found += _placed(mounting, settings) + _certain(mounting, settings)
    return found + _labelled(trials, best, settings)


def _meant(trials: Trials, settings: PlausibilitySettings) -> tuple[Trial, list[Hint]]:
    """Returns the hypothesis that explains the log, and what it says of frame and odometry."""
    best = trials.best()
    told = verdict(best, trials.as_written, settings)
    if best is trials.as_written or not told.is_clear(settings):
        return trials.as_written, beyond_any_vehicle(trials.log.odometry, settings)
    if is_a_line(trials.pairs, settings):
        return trials.as_written, [_optical(trials.pairs)]
    return best, frame_hints(best, trials, told) + odometry_hints(best, told)


def _late(trials: Trials, best: Trial, settings: PlausibilitySettings) -> tuple[Trial, list[Hint]]:
    """Returns the trial with the lateness of the detections, and a hint where there is a large one."""
    late = best_lateness(trials, best, settings)
    told = verdict(late, best, settings)
    if not told.is_clear(settings):
        return best, []
    seconds = late.hypothesis.late
    likely = f"the detections are stamped about {abs(seconds):g} s too {'late' if seconds > 0.0 else 'early'}"
    advice = "stamp odometry and detections when they are measured, by one clock"
    return late, [Hint("clocks", DETECTIONS_FILE, "column t", told.text, likely, advice)]


# --- the mounting ----------------------------------------------------------------------------------------


def _turned(found: list[Hint], best: Trial, mounting: Mounting, settings: PlausibilitySettings) -> list[Hint]:
    """Returns the hints with one about a sensor that is turned by an angle that is no quarter turn."""
    yaw, sigma = mounting.yaw
    frame = best.hypothesis.frame
    if frame.turn % 90.0 == 0.0 and (abs(yaw) < settings.turned or sigma > settings.turned_sigma):
        return found
    turn = frame.turn + yaw
    angle = f"{abs(turn):.1f} degrees to the {'left' if turn > 0.0 else 'right'}"
    side = ", with y to the right" if frame.mirrored else ""
    figure = next((hint.found for hint in found if hint.cause == "sensor frame"), "")
    figure = figure or f"static cones move as they would for a sensor that is turned by {angle}"
    likely = f"the sensor is turned by {angle} in the vehicle{side}"
    advice = "state the sensor's mounting, or turn the detections by that into the vehicle's frame"
    others = [hint for hint in found if hint.cause not in ("sensor frame", "y to the right")]
    return [*others, Hint("sensor frame", DETECTIONS_FILE, COLUMNS, figure, likely, advice)]


def _placed(mounting: Mounting, settings: PlausibilitySettings) -> list[Hint]:
    """Returns a hint where the sensor sits metres away from the point that the odometry describes."""
    length, sigma = mounting.arm
    if length < settings.arm or sigma > settings.arm_sigma * length:
        return []
    ahead, left = mounting.values[1:].tolist()
    place = f"{abs(ahead):.1f} m {'ahead' if ahead > 0.0 else 'behind'} and {abs(left):.1f} m to the "
    place += "left" if left > 0.0 else "right"
    found = f"static cones move as they would for a sensor {place} of the point that the odometry describes"
    likely = "the detections are in the sensor's frame, whose origin is not the vehicle's"
    advice = f"add {ahead:.2f} to x and {left:.2f} to y, or state the sensor's mounting"
    return [Hint("mounting", DETECTIONS_FILE, COLUMNS, found, likely, advice)]


# --- covariances and labels ------------------------------------------------------------------------------


def _certain(mounting: Mounting, settings: PlausibilitySettings) -> list[Hint]:
    """Returns a hint where the covariances are far from how detections of one cone scatter."""
    scatter, claimed = mounting.scatter, mounting.claimed
    if claimed * settings.claimed_less < scatter:
        likely = "the covariances are in another unit, or no covariances at all"
    elif claimed > settings.claimed_more * max(scatter, settings.least_scatter):
        likely = "the covariances are in mm^2 or cm^2, not in m^2, or no covariances at all"
    else:
        return []
    found = (
        f"detections of one cone are {scatter:.2g} m apart as a rule, by their covariances {claimed:.2g} m"
    )
    advice = "give each detection's covariance in m^2"
    return [Hint("covariances", DETECTIONS_FILE, "columns xx, xy, yy", found, likely, advice)]


def _labelled(trials: Trials, best: Trial, settings: PlausibilitySettings) -> list[Hint]:
    """Returns a hint where one label stands for cones on both sides of the vehicle."""
    labels = np.concatenate([cycle.labels for cycle in trials.log.cycles])
    present = [label for label in (LEFT, RIGHT) if (labels == label).any()]
    if len(present) != 1 or (labels == UNKNOWN).any() or abs(best.sided - 0.5) > settings.both_sides:
        return []
    found = f"all labels are {NAMES[present[0]]}, and {best.sided:.0%} of the cones are on that side"
    likely = "the classes of the detector were not turned into left and right"
    advice = "write left, right or unknown for each detection"
    return [Hint("labels", DETECTIONS_FILE, "column label", found.replace("%", " %"), likely, advice)]


# --- what no motion explains -----------------------------------------------------------------------------


def _unexplained(trials: Trials, best: Trial, settings: PlausibilitySettings) -> list[Hint]:
    """Returns a hint where detections of cycles close to each other agree with no motion at all."""
    pairs = trials.pairs
    motion = trials.motion(best.hypothesis)
    ranges = np.nanmedian(np.hypot(pairs.before[..., 0], pairs.before[..., 1]))
    near = np.hypot(motion[:, 0], motion[:, 1]) < settings.near * ranges
    near &= np.abs(motion[:, 2]) < settings.near
    near &= pairs.count >= settings.many
    share = float(best.explained[near].mean()) if near.sum() >= settings.least_near else 1.0
    if share > settings.unexplained:
        return []
    if is_a_line(pairs, settings):
        return [_optical(pairs)]
    found = f"only {share:.0%} of the detections lie where any motion expects them".replace("%", " %")
    likely = "bearings in degrees were taken for radians, or the two files are not of one drive"
    advice = "compare a few cycles with what the sensor saw"
    return [Hint("unexplained", DETECTIONS_FILE, COLUMNS, found, likely, advice)]


def is_a_line(pairs: Pairs, settings: PlausibilitySettings) -> bool:
    """Returns whether one coordinate of all detections hardly varies beside the other."""
    spread = np.nanstd(pairs.before.reshape(-1, 2), axis=0)
    return bool(spread.min() < settings.line * spread.max())


def _optical(pairs: Pairs) -> Hint:
    spread = np.nanstd(pairs.before.reshape(-1, 2), axis=0)
    thin = "xy"[int(spread.argmin())]
    found = f"column {thin} varies by {spread.min():.2g} m only, the other one by {spread.max():.2g} m"
    likely = "the detections are in the frame of a camera, with z ahead, x to the right and y down"
    return Hint(
        "sensor frame", DETECTIONS_FILE, COLUMNS, found, likely, "put z into column x and -x into column y"
    )
