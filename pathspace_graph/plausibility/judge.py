"""Check of a log before it is mapped: hints about likely mistakes, also for a log that is refused."""

from collections import Counter
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph.errors import InputError, check_type
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.gate import read_usable_log
from pathspace_graph.front_end.kind import kind_of
from pathspace_graph.front_end.scan_matching import MIN_MATCHED
from pathspace_graph.io import log as logs
from pathspace_graph.io.covariances import covariances_of
from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, Log, Odometry
from pathspace_graph.io.parsing import read_table, shown
from pathspace_graph.labels import LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.lengths import Length, scaled
from pathspace_graph.scale import scale_of
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.settings.online import LimitSettings

from . import hypotheses
from .diagnosis import noise_hints
from .hint import Hint, because, hint_of
from .hypotheses import AS_WRITTEN, DEGREE, Hypothesis, Mounting, Pairs, Trial, Trials, far_better

LEAST_TWISTS: Final = 20  # least number of twists for hints
LEAST_CYCLES: Final = 100  # least number of cycles whose typical number of detections tells the sensor's
PAIR_OVERLAP: Final = 0.5  # least share of detections in view of both cycles of a compared pair
SHORTEST_STEP: Final = 2e-4  # shortest usual time between rows (s)
LONGEST_STEP: Final = 5.0  # longest usual time between rows (s)
WITHOUT_DETECTIONS: Final = 10.0  # longest drive before the first detection or after the last one (s)
DRIVING: Final = 0.1  # least share of the largest speed while driving
FARTHEST_RANGE: Final = 120.0  # largest typical range of cones (m)
DECISIVE_RANGE: Final = 20.0  # typical range that decides between two possible units (m)
NEAREST_RANGE: Final = 0.05  # least typical range of cones (m)
FASTEST: Final = 100.0  # speed that no vehicle exceeds in a tenth of its time (m/s)
FASTEST_TURN: Final = 8.0  # yaw rate that no vehicle exceeds in a tenth of its time (rad/s)
TURN_TOLD: Final = 5.0  # least yaw of the sensor for a hint (degrees)
TURN_SIGMA: Final = 1.0  # largest standard deviation of the yaw for a hint (degrees)
ARM_TOLD: Final = 1.0  # least lever arm of the sensor for a hint (m)
ARM_SIGMA: Final = 0.2  # largest relative standard deviation of the lever arm for a hint
CLAIMED_LESS: Final = 10.0  # ratio of actual to claimed scatter from which covariances are too small
CLAIMED_MORE: Final = 30.0  # ratio of claimed to actual scatter from which covariances are too large
LEAST_SCATTER: Final = 0.02  # lower bound of the actual scatter in that ratio (m)
BOTH_SIDES: Final = 0.15  # largest deviation from 0.5 of the share of a label that is on both sides
SAME_CONES: Final = 0.25  # largest motion over the range, and turn (rad), of cycles that see the same cones
SAME_CONES_SEEN: Final = 6  # least number of detections of such a pair of cycles
SAME_CONES_PAIRS: Final = 30  # least number of such pairs
UNEXPLAINED: Final = 0.15  # least explained share by the best motion on such pairs
LINE_RATIO: Final = 0.1  # largest ratio of the spreads of two coordinates of detections on a line
TIME_UNITS: Final = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}  # by size (s)
LENGTH_UNITS: Final = {1e-2: "centimetres", 1e-3: "millimetres"}  # by size (m)
FRAME_MEANINGS: Final = {  # words for frames of detections, by rotation (degrees) and whether mirrored
    (180.0, False): "the sensor's frame has x to the rear and y to the right",
    (-90.0, False): "the sensor's frame has x to the right and y ahead",
    (90.0, False): "the sensor's frame has x to the left and y to the rear",
    (90.0, True): "the columns x and y are swapped",
    (180.0, True): "the sensor's frame has x to the rear",
    (-90.0, True): "the sensor's frame has x to the right and y to the rear",
}
LARGEST_READING: Final = 1e20  # largest number in a log for hints
MIRRORED: Final = 0.0, True  # frame in which y points to the right and x ahead


def hints(log: Log) -> list[Hint]:
    """Return hints about likely mistakes in a log; none for weak evidence or numbers that are not finite."""
    check_type("log", log, Log)
    if len(log.odometry.t) < LEAST_TWISTS or not _has_numbers(log):
        return []
    scale = scale_of(log)
    return [scaled(hint, scale) for hint in _hints(scaled(log, 1.0 / scale))]


def _has_numbers(log: Log) -> bool:
    arrays = ((cycle.points_vehicle, cycle.covariances) for cycle in log.cycles)
    parts = (*_stamps(log).values(), log.odometry.twist, *chain.from_iterable(arrays))
    return all((np.abs(part) <= LARGEST_READING).all() for part in parts)


def _hints(log: Log) -> list[Hint]:
    of_parts = whole_stamps(log)
    if of_parts:
        return of_parts
    log, found = stamps_in_seconds(log)
    of_clocks = one_clock(log)
    if of_clocks:
        return found + of_clocks
    of_ends = ends_apart(log) + few_detections(log)
    log, of_positions = positions_in_metres(log)
    found += of_positions
    pairs = hypotheses.pairs_of(log.cycles)
    if pairs is None:
        return of_ends + found + beyond_any_vehicle(log.odometry)
    trials = Trials(log, telling_pairs(log, pairs))
    others = _reading_hints(trials, found)
    if others and MapperSettings(kind=kind_of(log)).lines:
        others = _reading_hints(trials, found, stay=False)
    return of_ends + others


def _reading_hints(trials: Trials, found: list[Hint], *, stay: bool = True) -> list[Hint]:
    """Return hints `found` and hints by motion or, if there are none, hints about noise."""
    return found + _motion_hints(trials, stay=stay) or noise_hints(trials.log, stay=stay)


# --- units by typical values -----------------------------------------------------------------------------


def whole_stamps(log: Log) -> list[Hint]:
    """Return a hint for each file whose stamps have only whole seconds, or only fractions of a second."""
    found = []
    for file, t in _stamps(log).items():
        falls = np.flatnonzero(np.diff(t) < 0.0)
        if len(falls) >= 2 and np.ptp(t) <= max(1.0, 1.0 / min(TIME_UNITS)):
            found.append(
                hint_of("fraction of seconds", file=file, falls=len(falls), low=t.min(), high=t.max())
            )
        elif len(t) > 2 and (np.diff(t) == 0.0).mean() > 0.5 and (t == np.floor(t)).all():
            found.append(hint_of("whole seconds", file=file, rows=len(t) / len(np.unique(t))))
    return found


def stamps_in_seconds(log: Log) -> tuple[Log, list[Hint]]:
    """Return the log with stamps in seconds, and a hint for each file with another unit."""
    found, factors = [], {}
    for file, t in _stamps(log).items():
        step = _median(np.abs(np.diff(t)))
        fitting = [one for one in TIME_UNITS if SHORTEST_STEP <= step * one <= LONGEST_STEP]
        if step > LONGEST_STEP and fitting:
            unit = factors[file] = fitting[0]
            found.append(hint_of("unit of stamps", file=file, step=step, unit=TIME_UNITS[unit], factor=unit))
    if not factors:
        return log, []
    of_odometry, of_cycles = (factors.get(file, 1.0) for file in (ODOMETRY_FILE, DETECTIONS_FILE))
    odometry = replace(log.odometry, t=log.odometry.t * of_odometry)
    cycles = tuple(replace(cycle, t=cycle.t * of_cycles) for cycle in log.cycles)
    return replace(log, odometry=odometry, cycles=cycles), found


def one_clock(log: Log) -> list[Hint]:
    if not log.cycles:
        return []
    first, last = float(log.odometry.t[0]), float(log.odometry.t[-1])
    begin, end = log.cycles[0].t, log.cycles[-1].t
    apart = begin > last or end < first
    return [hint_of("two clocks", begin=begin, end=end, first=first, last=last)] if apart else []


def ends_apart(log: Log) -> list[Hint]:
    """Return a hint if the vehicle drives long before the first detection, or after the last one."""
    if not log.cycles:
        return []
    t, speed = log.odometry.t, np.hypot(log.odometry.twist[:, 0], log.odometry.twist[:, 1])
    driven = t[speed > DRIVING * speed.max()]
    begin, end = log.cycles[0].t, log.cycles[-1].t
    found = []
    if driven.size and begin - driven[0] > WITHOUT_DETECTIONS:
        found.append(hint_of("detections begin late", seconds=begin - t[0]))
    if driven.size and driven[-1] - end > WITHOUT_DETECTIONS:
        found.append(hint_of("detections end early", seconds=t[-1] - end))
    return found


def few_detections(log: Log) -> list[Hint]:
    """Return a hint if the typical cycle has too few detections for scan matching to check the odometry."""
    typical = _median(np.array([len(cycle.labels) for cycle in log.cycles]))
    if len(log.cycles) < LEAST_CYCLES or typical >= MIN_MATCHED:
        return []
    return [hint_of("few detections", count=typical, least=MIN_MATCHED)]


def positions_in_metres(log: Log) -> tuple[Log, list[Hint]]:
    typical = _median(np.concatenate([np.zeros(0), *(np.hypot(*c.points_vehicle.T) for c in log.cycles)]))
    if typical > FARTHEST_RANGE:
        unit = next((unit for unit in LENGTH_UNITS if typical * unit <= DECISIVE_RANGE), min(LENGTH_UNITS))
        what = f"are in {LENGTH_UNITS[unit]}, not in metres"
    elif 0.0 < typical < NEAREST_RANGE:
        unit, what = 1e3, "were divided by 1000 although they were in metres"
    else:
        return log, []
    cycles = [replace(cycle, points_vehicle=cycle.points_vehicle * unit) for cycle in log.cycles]
    hint = hint_of("unit of positions", typical=Length(typical), what=what, factor=unit)
    return replace(log, cycles=tuple(cycles)), [hint]


def beyond_any_vehicle(odometry: Odometry) -> list[Hint]:
    speed = float(np.quantile(np.hypot(odometry.twist[:, 0], odometry.twist[:, 1]), 0.9))
    rate = float(np.quantile(np.abs(odometry.twist[:, 2]), 0.9))
    found = [hint_of("too fast", speed=Length(speed))] if speed > FASTEST else []
    return [*found, hint_of("turns too fast", rate=rate)] if rate > FASTEST_TURN else found


def _stamps(log: Log) -> dict[str, Array]:
    return {ODOMETRY_FILE: log.odometry.t, DETECTIONS_FILE: np.array([cycle.t for cycle in log.cycles])}


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


# --- motion of the detections ----------------------------------------------------------------------------


def telling_pairs(log: Log, pairs: Pairs) -> Pairs:
    """Return the pairs of cycles that see the same cones by odometry, or adjacent pairs for a bad odometry.

    Pairs of different cones would fit a vehicle at rest best, since one stretch looks like the next.
    """
    if beyond_any_vehicle(log.odometry):
        return pairs.chosen(pairs.gap <= hypotheses.PAIR_GAPS[1])
    motion = hypotheses.motions(log.odometry.t, AS_WRITTEN.poses(log.odometry), pairs.begin, pairs.end)
    return pairs.chosen(pairs.overlap(motion) >= PAIR_OVERLAP)


def _motion_hints(trials: Trials, *, stay: bool) -> list[Hint]:
    """Return hints by the motion of detections; only some of them if these do not `stay`, as on a line."""
    if len(trials.pairs) == 0:
        return beyond_any_vehicle(trials.log.odometry)
    best, found = _interpretation(trials)
    if best.hypothesis.content == "nothing" and not stay:
        return []  # walls look alike from everywhere along them
    if best.hypothesis.content == "nothing" or (found and camera(trials.pairs)):
        return found
    late, of_clocks = _latency(trials, best)
    if not stay:
        return found + of_clocks
    if best.share < hypotheses.LEAST_EXPLAINED and late is best:
        return found + (_unexplained_hints(trials, best) if not found else [])
    mounting = hypotheses.mounting_of(trials, late.hypothesis)
    found += of_clocks
    if mounting is not None:
        found = _rotation_hints(found, late, mounting)
        found += _offset_hints(mounting) + _covariance_hints(mounting)
    return found + _label_hints(trials, best)


def _interpretation(trials: Trials) -> tuple[Trial, list[Hint]]:
    best = trials.best()
    figures = far_better(best, trials.as_written)
    if figures is None:
        return trials.as_written, beyond_any_vehicle(trials.log.odometry)
    in_line = camera(trials.pairs)
    if in_line:
        return trials.as_written, in_line
    return best, _frame_hints(best, trials, figures) + _odometry_hints(best.hypothesis, figures)


def _frame_hints(best: Trial, trials: Trials, figures: dict[str, float]) -> list[Hint]:
    """Return a hint about the frame of the detections, or about the axes of the odometry."""
    frame = best.hypothesis
    vx, vy = np.median(trials.log.odometry.twist[:, :2], axis=0)
    sees_ahead = np.nanmedian(trials.pairs.before[..., 0]) > 0.0
    if frame.stands == AS_WRITTEN.stands:
        return []
    if frame.stands == MIRRORED:
        of_detections = best.sided >= trials.as_written.sided
        mistake = "y to the right" if of_detections else "yaw rate to the right"
    elif abs(vy) > abs(vx) and abs(frame.turn) == 90.0:
        mistake = "vx and vy swapped"
    elif vx < 0.0 and sees_ahead and frame.stands == (180.0, False):
        mistake = "backward"
    else:
        mistake = "frame"
    side = "with y to the right, and " if frame.mirrored else ""
    what = FRAME_MEANINGS.get(frame.stands, f"the sensor's frame is {side}turned by {_angle(frame.turn)}")
    return [hint_of(mistake, what=what, how=_remedy(frame), **figures)]


def _remedy(frame: Hypothesis) -> str:
    rows = np.round(frame.frame)
    if np.allclose(frame.frame, rows, atol=1e-9):
        x, y = (f"{'-' if row.sum() < 0.0 else ''}{'xy'[np.abs(row).argmax()]}" for row in rows)
        return f"put {x} into column x and {y} into column y"
    mirror = "negate column y, then " if frame.mirrored else ""
    return f"{mirror}turn the detections by {_angle(frame.turn)}"


def _angle(turn: float, decimals: int = 0) -> str:
    return f"{abs(turn):.{decimals}f} degrees to the {'left' if turn > 0.0 else 'right'}"


def _odometry_hints(meaning: Hypothesis, figures: dict[str, float]) -> list[Hint]:
    """Return hints about an odometry that is not a body twist in SI units."""
    if (meaning.speed, meaning.rate) == (1e-3, 1e-3):
        return [hint_of("milliseconds", **figures)]
    found = [] if meaning.content == "twist" else [hint_of(meaning.content, **figures)]
    if meaning.speed != 1.0:
        what = hypotheses.SPEED_UNITS[meaning.speed]
        found.append(hint_of("unit of speeds", what=what, factor=meaning.speed, **figures))
    if meaning.rate != 1.0:
        what = hypotheses.RATE_UNITS[meaning.rate]
        found.append(hint_of("unit of yaw rate", what=what, factor=meaning.rate, **figures))
    return found


def _latency(trials: Trials, best: Trial) -> tuple[Trial, list[Hint]]:
    late = hypotheses.best_lateness(trials, best)
    figures, seconds = far_better(late, best), late.hypothesis.late
    if figures is None:
        return best, []
    return late, [hint_of("late", seconds=abs(seconds), way="late" if seconds > 0.0 else "early", **figures)]


def _rotation_hints(found: list[Hint], best: Trial, mounting: Mounting) -> list[Hint]:
    yaw, sigma = mounting.values[0] / DEGREE, mounting.sigmas[0] / DEGREE
    frame = best.hypothesis
    if frame.turn % 90.0 == 0.0 and (abs(yaw) < TURN_TOLD or sigma > TURN_SIGMA):
        return found
    side = ", with y to the right" if frame.mirrored else ""
    turned = hint_of("turned", angle=_angle(frame.turn + yaw, 1), side=side)
    figures = [one.found for one in found if one.cause == "sensor frame"]
    others = [one for one in found if one.cause not in ("sensor frame", "y to the right")]
    return [*others, replace(turned, found=figures[0]) if figures else turned]


def _offset_hints(mounting: Mounting) -> list[Hint]:
    length, sigma = np.hypot(*mounting.values[1:]), mounting.sigmas[1:].max()
    if length < ARM_TOLD or sigma > ARM_SIGMA * length:
        return []
    ahead, left = mounting.values[1:].tolist()
    words = {"ahead_or_behind": "ahead" if ahead > 0.0 else "behind"}
    words["left_or_right"] = "left" if left > 0.0 else "right"
    lengths = {"ahead": ahead, "left": left, "along": abs(ahead), "aside": abs(left)}
    return [hint_of("place", **words, **{name: Length(value) for name, value in lengths.items()})]


def _covariance_hints(mounting: Mounting) -> list[Hint]:
    scatter, claimed = mounting.scatter, mounting.claimed
    too_large = claimed > CLAIMED_MORE * max(scatter, LEAST_SCATTER)
    if not too_large and claimed * CLAIMED_LESS >= scatter:
        return []
    unit = "mm^2 or cm^2, not in m^2" if too_large else "another unit"
    return [hint_of("covariances", scatter=Length(scatter), claimed=Length(claimed), unit=unit)]


def _label_hints(trials: Trials, best: Trial) -> list[Hint]:
    labels = np.concatenate([cycle.labels for cycle in trials.log.cycles])
    present = [label for label in (LEFT, RIGHT) if (labels == label).any()]
    if len(present) != 1 or (labels == UNKNOWN).any() or abs(best.sided - 0.5) > BOTH_SIDES:
        return []
    return [hint_of("one label", label=NAMES[present[0]], share=100.0 * best.sided)]


def _unexplained_hints(trials: Trials, best: Trial) -> list[Hint]:
    pairs = trials.pairs
    motion, size = trials.motion(best.hypothesis), np.hypot(pairs.before[..., 0], pairs.before[..., 1])
    near = np.hypot(motion[:, 0], motion[:, 1]) < SAME_CONES * np.nanmedian(size)
    near &= (np.abs(motion[:, 2]) < SAME_CONES) & (pairs.count >= SAME_CONES_SEEN)
    share = float(best.explained[near].mean()) if near.sum() >= SAME_CONES_PAIRS else 1.0
    return [] if share > UNEXPLAINED else camera(pairs) or [hint_of("unexplained", share=100.0 * share)]


def camera(pairs: Pairs) -> list[Hint]:
    """Return a hint if the detections lie on a line, as with the axes of a camera."""
    spread = np.nanstd(pairs.before.reshape(-1, 2), axis=0)
    least, most = spread.min(), spread.max()
    in_line = least < LINE_RATIO * most
    thin, lengths = "xy"[int(spread.argmin())], {"least": Length(least), "most": Length(most)}
    return [hint_of("camera", thin=thin, **lengths)] if in_line else []


NO_LABEL_WORDS: Final = frozenset({"unknown", "", "none", "nan", "null"})  # words for no label
# causes of a refusal, by the size of numbers; labels and frames are never the cause
REFUSABLE: Final = frozenset(
    {"stamps", "clocks", "positions", "speeds", "yaw rate", "odometry", "covariances"}
)
SHOWN_WORDS: Final = 3  # largest number of foreign labels in a hint


def read_plausible_log(folder: Path, limits: LimitSettings) -> tuple[Log, list[Hint]]:
    """Read and check a log; an InputError names file, row, what was expected, and the likely cause."""
    try:
        log = read_usable_log(folder, limits)
    except InputError as error:
        of_data = error.file.name in (ODOMETRY_FILE, DETECTIONS_FILE)
        causes = (
            because([hint for hint in refused_hints(folder) if hint.cause in REFUSABLE]) if of_data else ""
        )
        if not causes:
            raise
        raise InputError(error.file, f"{error.message}; {causes}", error.row) from error
    return log, hints(log) + _foreign_label_hints(folder, log)


def refused_hints(folder: Path) -> list[Hint]:
    """Return the hints about a refused log; none if it cannot be parsed."""
    try:
        files = ODOMETRY_FILE, DETECTIONS_FILE
        odometry, table = (read_table(folder / file, logs.COLUMNS[file]) for file in files)
        twists = Odometry(
            odometry.numbers("t", LARGEST_READING), odometry.stack(("vx", "vy", "wz"), LARGEST_READING)
        )
        stamps, points = table.numbers("t", LARGEST_READING), table.stack(("x", "y"), LARGEST_READING)
        covariances = covariances_of(*table.stack(("xx", "xy", "yy"), LARGEST_READING).T)
    except InputError:
        return []
    cycles = logs.cycles_of(stamps, points, covariances, logs.labels_of(table))
    return hints(Log(twists, cycles, np.ones(3), odometry_stated=False, detections_stated=False))


def _foreign_label_hints(folder: Path, log: Log) -> list[Hint]:
    if not log.cycles or any((cycle.labels != UNKNOWN).any() for cycle in log.cycles):
        return []
    met = Counter(read_table(folder / DETECTIONS_FILE, ("label",)).columns["label"])
    foreign = [word for word, _ in met.most_common() if word.strip().lower() not in NO_LABEL_WORDS]
    words = ", ".join(map(shown, foreign[:SHOWN_WORDS]))
    return [hint_of("foreign labels", words=words)] if foreign else []
