"""Check of a log before it is mapped: hints about likely mistakes, also for a log that is refused."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from math import hypot
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy  # imports its modules lazily
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import InputError, check_type
from pathspace_graph.factors.arrays import Array
from pathspace_graph.front_end.gate import check_usable
from pathspace_graph.front_end.scan_matching import MIN_MATCHED
from pathspace_graph.io import log as logs
from pathspace_graph.io.covariances import covariances_of
from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, Log, Odometry
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.parsing import shown
from pathspace_graph.io.tables import read_table
from pathspace_graph.labels import LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.settings.online import LimitSettings

from .diagnosis import noise_hints
from .hint import Hint, because, hint_of
from .kind import is_line
from .regression import Better, Complex, Fit, Regression, far_better, motions_of

LARGEST_READING: Final = 1e20  # largest number in a log for hints
LEAST_TWISTS: Final = 20  # least number of twists for hints


def hints(log: Log) -> list[Hint]:
    """Return hints about likely mistakes in a log; those by motion are the strongest first.

    There are none for weak evidence, nor for numbers that are not finite.
    """
    check_type("log", log, Log)
    arrays = ((cycle.points_vehicle, cycle.covariances) for cycle in log.cycles)
    parts = (*_stamps(log).values(), log.odometry.twist, *chain.from_iterable(arrays))
    if len(log.odometry.t) < LEAST_TWISTS or any(not (np.abs(one) <= LARGEST_READING).all() for one in parts):
        return []
    if of_parts := parts_of_stamps(log):
        return of_parts
    log, found = stamps_in_seconds(log)
    t, stamps = log.odometry.t, [cycle.t for cycle in log.cycles] or [float(log.odometry.t[0])]
    if stamps[0] > t[-1] or stamps[-1] < t[0]:
        return [*found, hint_of("two clocks", begin=stamps[0], end=stamps[-1], first=t[0], last=t[-1])]
    log = with_usual_noise(log.at_scale_one())
    of_cycles = gaps_and_reach(log)
    log, of_positions = positions_in_metres(log)
    log, of_rows = possible_rows(log)
    stay = log.sensor.kind != "line" and not is_line(log)
    with threadpool_limits(limits=1):
        found += of_positions + of_rows + (camera(log) or motion_hints(log))
        found = found or side_hints(log) or of_kind(log)
        if stay:
            found = found or one_label(log)
    return of_cycles + (found or noise_hints(log, stay=stay))


# --- stamps, units and rows by typical values ------------------------------------------------------------

TIME_UNITS: Final = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}  # by size (s)
LENGTH_UNITS: Final = {1e-2: "centimetres", 1e-3: "millimetres"}  # by size (m)
USUAL_STEPS: Final = 2e-4, 5.0  # shortest and longest usual time between rows (s)
WITHOUT_DETECTIONS: Final = 10.0  # longest drive before the first detection or after the last one (s)
DRIVING: Final = 0.1  # least share of the largest speed while driving
MOST_NOISE: Final = (
    (0.2, 0.1),
    (0.2, 0.05),
)  # largest noise along the ray and across it, at 0 m and per m
LEAST_CYCLES: Final = 100  # least number of cycles whose typical number of detections tells the sensor's
USUAL_RANGES: Final = 0.05, 20.0, 120.0  # typical ranges of cones: least, of the likelier unit, most (m)
FASTEST: Final = 100.0, 8.0  # speed (m/s) and yaw rate (rad/s) that no vehicle exceeds in a tenth of its time
LARGEST_STEPS: Final = 10.0, 10.0, 5.0  # from the rows around to a row that can be (m/s, m/s, rad/s)
USUAL: Final = 0.9  # and at most this quantile of the column
MOST_STEPS: Final = 0.02  # largest share of rows that cannot be
LINE_RATIO: Final = 0.1  # largest ratio of the spreads of two coordinates of detections on a line
BOTH_SIDES: Final = 0.15  # largest deviation from 0.5 of the share of a label that is on both sides


def parts_of_stamps(log: Log) -> list[Hint]:
    """Return a hint for each file whose stamps have only whole seconds, or only fractions of a second."""
    found = []
    for file, t in _stamps(log).items():
        falls, seconds, fraction = int((np.diff(t) < 0.0).sum()), "whole seconds", "fraction of each second"
        if falls >= 2 and np.ptp(t) <= max(1.0, 1.0 / min(TIME_UNITS)):
            how = f"fall {falls} times and stay between {t.min():.4g} and {t.max():.4g}"
            found.append(hint_of("part of stamps", file=file, how=how, part=fraction, rest=seconds))
        elif len(t) > 2 and (np.diff(t) == 0.0).mean() > 0.5 and (t == np.floor(t)).all():
            how = f"are whole numbers, {len(t) / len(np.unique(t)):.0f} rows to each"
            found.append(hint_of("part of stamps", file=file, how=how, part=seconds, rest=fraction))
    return found


def stamps_in_seconds(log: Log) -> tuple[Log, list[Hint]]:
    """Return the log with stamps in seconds, and a hint for each file with another unit."""
    found, sizes = [], dict.fromkeys(_stamps(log), 1.0)
    for file, t in _stamps(log).items():
        step, (shortest, longest) = _median(np.abs(np.diff(t))), USUAL_STEPS
        fitting = [size for size in TIME_UNITS if shortest <= step * size <= longest]
        if step > longest and fitting:
            size = sizes[file] = fitting[0]
            found.append(hint_of("unit of stamps", file=file, step=step, unit=TIME_UNITS[size], size=size))
    if not found:
        return log, []
    odometry = replace(log.odometry, t=log.odometry.t * sizes[ODOMETRY_FILE])
    cycles = tuple(replace(cycle, t=cycle.t * sizes[DETECTIONS_FILE]) for cycle in log.cycles)
    return replace(log, odometry=odometry, cycles=cycles), found


def with_usual_noise(log: Log) -> Log:
    """Return the log with at most a usual noise of detections: measured by wrong odometry, it is larger."""
    noise = log.measured
    if log.detections_stated or noise is None or noise.along is None or noise.across is None:
        return log
    along, across = (
        replace(one, sigma=np.minimum(one.sigma, most))
        for one, most in zip((noise.along, noise.across), MOST_NOISE, strict=True)
    )
    usual = replace(noise, along=along, across=across)
    known = ((cycle, usual.covariances(cycle.points_vehicle, inflated=False)) for cycle in log.cycles)
    return replace(log, cycles=tuple(replace(cycle, covariances=C) for cycle, C in known if C is not None))


def gaps_and_reach(log: Log) -> list[Hint]:
    """Return hints if the vehicle drives without detections at an end, or if most cycles have hardly any."""
    if not log.cycles:
        return []
    t, speed, begin, end = log.odometry.t, _speeds(log), log.cycles[0].t, log.cycles[-1].t
    driven = t[speed > DRIVING * speed.max()]
    early = driven.size and begin - driven[0] > WITHOUT_DETECTIONS
    late = driven.size and driven[-1] - end > WITHOUT_DETECTIONS
    found = [hint_of("detections begin late", seconds=begin - t[0])] if early else []
    found += [hint_of("detections end early", seconds=t[-1] - end)] if late else []
    typical = _median(np.array([len(cycle.labels) for cycle in log.cycles]))
    few = len(log.cycles) >= LEAST_CYCLES and typical < MIN_MATCHED
    return found + ([hint_of("few detections", count=typical, least=MIN_MATCHED)] if few else [])


def positions_in_metres(log: Log) -> tuple[Log, list[Hint]]:
    typical, (least, likely, most) = _median(np.abs(_points(log))), USUAL_RANGES
    if typical > most:
        size = next((size for size in LENGTH_UNITS if typical * size <= likely), min(LENGTH_UNITS))
        what = f"are in {LENGTH_UNITS[size]}, not in metres"
    elif 0.0 < typical < least:
        size, what = 1e3, "were divided by 1000 although they were in metres"
    else:
        return log, []
    cycles = tuple(replace(cycle, points_vehicle=cycle.points_vehicle * size) for cycle in log.cycles)
    hint = hint_of("unit of positions", typical=typical, what=what, size=size)
    return replace(log, cycles=cycles), [hint]


def possible_rows(log: Log) -> tuple[Log, list[Hint]]:
    """Return the log without steps of the odometry that cannot be, and a hint about these rows."""
    twist = log.odometry.twist
    smooth = scipy.ndimage.median_filter(twist, size=(5, 1), mode="nearest")
    step = np.abs(twist - smooth)
    wrong = step > np.maximum(LARGEST_STEPS, np.quantile(np.abs(twist), USUAL, axis=0))
    if not 0 < wrong.any(axis=1).sum() < MOST_STEPS * len(twist):
        return log, []
    row, count = int((step * wrong).max(axis=1).argmax()), int(wrong.any(axis=1).sum())
    figures = {"count": count, "total": len(twist), "step": step[row].max(), "row": row + 2}
    hint = hint_of("yaw wraps" if wrong[:, 2].any() else "positions jump", **figures)
    return replace(log, odometry=replace(log.odometry, twist=np.where(wrong, smooth, twist))), [hint]


def beyond_any_vehicle(log: Log) -> list[Hint]:
    speed, rate = (np.quantile(one, 0.9) for one in (_speeds(log), np.abs(log.odometry.twist[:, 2])))
    found = [hint_of("too fast", speed=speed)] if speed > FASTEST[0] else []
    return found + ([hint_of("turns too fast", rate=rate)] if rate > FASTEST[1] else [])


def camera(log: Log) -> list[Hint]:
    """Return a hint if the detections lie on a line, as with the axes of a camera."""
    points = _points(log)
    spread = np.array([points.real.std(), points.imag.std()]) if len(points) else np.ones(2)
    least, most = spread.min(), spread.max()
    in_line = least < LINE_RATIO * most
    return [hint_of("camera", thin="xy"[int(spread.argmin())], least=least, most=most)] if in_line else []


def one_label(log: Log) -> list[Hint]:
    share, labels = sided(log), set(np.unique(_labels(log)).tolist())
    if labels not in ({LEFT}, {RIGHT}) or abs(share - 0.5) > BOTH_SIDES:
        return []
    return [hint_of("one label", label=NAMES[labels.pop()], share=100.0 * share)]


def sided(log: Log, turn: complex = 1.0, *, mirrored: bool = False) -> float:
    """Return the share of near labels on their side, once a mirrored frame is turned; 0.5 without labels."""
    points, labels = _points(log), _labels(log)
    near = np.isin(labels, (LEFT, RIGHT)) & (np.abs(points) < _median(np.abs(points)))
    left = ((points.conj() if mirrored else points)[near] * turn).imag > 0.0
    return float((left == (labels[near] == LEFT)).mean()) if near.any() else 0.5


def _stamps(log: Log) -> dict[str, Array]:
    return {ODOMETRY_FILE: log.odometry.t, DETECTIONS_FILE: np.array([cycle.t for cycle in log.cycles])}


def _points(log: Log) -> Complex:
    return np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in log.cycles)]) @ [1.0, 1j]


def _labels(log: Log) -> Array:
    return np.concatenate([np.zeros(0, int), *(cycle.labels for cycle in log.cycles)])


def _speeds(log: Log) -> Array:
    return np.asarray(np.hypot(*log.odometry.twist[:, :2].T))


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


# --- the regression in words -----------------------------------------------------------------------------

SPEED_UNITS: Final = {1.0 / 3.6: "km/h", 0.44704: "mph", 0.514444: "knots", 1e-2: "cm/s", 1e-3: "mm/s"}
RATE_UNITS: Final = {float(np.pi / 180.0): "degrees per second"}
SAME_FACTOR: Final = 1.2  # largest ratio of a factor and a unit
FACTOR_TOLD: Final = 1.6  # least factor, or its inverse, that is told if it is no unit
TINY: Final = 1e-9  # least size of a factor
LATE_TOLD: Final = 0.2  # least lag that is told (s): less is left to the calibration
TURN_TOLD: Final = 8.5  # least yaw of the sensor that is told (degrees)
TURN_SIGMA: Final = 1.0  # largest standard deviation of the yaw (degrees)
LEVER_TOLD: Final = 1.0  # least lever arm of the sensor that is told (m)
LEVER_SIGMA: Final = 0.2  # largest relative standard deviation of the lever arm
FLAT: Final = 0.2  # largest size of a missing rate, by what the cones show
AT_REST: Final = 0.03  # largest difference of explained shares between no motion and the best fit
LEAST_MOTIONS: Final = 20  # least number of motions for a regression
LEAST_PAIRS: Final = 30  # least number of pairs of cycles that can show no motion,
UNEXPLAINED: Final = 30.0, 0.2  # with at most this share of them that do (%), explained to this degree
WELL_EXPLAINED: Final = 0.5  # least explained share for a small turn and a place, and for another drive
FAR_LESS: Final = 0.4  # largest share that a fit explains of another drive, by what the cones show
SIDES_TOLD: Final = 0.015  # least difference between the lags of both sides that is told (s),
SIDES_CLEAR: Final = 4.0  # and in standard deviations
SIDES: Final = 2000, 100  # approximate number of cycles of a side in use, and least number of motions,
SIDES_EXPLAINED: Final = 0.4  # of which at least this share is explained: of points of lines it is 0.3
FRAMES: Final = {  # frames of detections, and columns for x and y, by rotation (degrees) and whether mirrored
    (180, False): ("the sensor's frame has x to the rear and y to the right", "-x", "-y"),
    (-90, False): ("the sensor's frame has x to the right and y ahead", "y", "-x"),
    (90, False): ("the sensor's frame has x to the left and y to the rear", "-y", "x"),
    (90, True): ("the columns x and y are swapped", "y", "x"),
    (180, True): ("the sensor's frame has x to the rear", "-x", "y"),
    (-90, True): ("the sensor's frame has x to the right and y to the rear", "-y", "-x"),
}


def of_kind(log: Log) -> list[Hint]:
    """Return a hint if detections are of the other kind than the log says, which is cones by default."""
    stated = log.sensor.kind or "cones"
    found = {True: "line", False: "cones", None: stated}[is_line(log)]
    return [hint_of(f"kind {found}", stated=stated)] if found != stated else []


OF_LINES: Final = {"yaw rate", "clocks", "y to the right"}  # causes that points of lines tell
Told = dict[Hint, float]  # hints, and how much more of the motions each explains


def motion_hints(log: Log) -> list[Hint]:
    """Return hints by the regression, the strongest first."""
    motions, told = motions_of(log), Told()
    share = 100.0 * len(motions.rate) / max(motions.tried, 1)
    few = motions.tried >= LEAST_PAIRS and share < UNEXPLAINED[0]
    unexplained = [hint_of("unexplained", share=share, tried=motions.tried)] if few else []
    if len(motions.rate) < LEAST_MOTIONS:
        return beyond_any_vehicle(log) or unexplained
    regression = Regression(log.odometry, motions)
    fit, why = regression.best()
    explained, rest = regression.explained(fit), regression.shares(0.0 * motions.velocity, 0.0 * motions.rate)
    may_rest = rest.both.mean() > explained.both.mean() - AT_REST
    stated = log.sensor.kind == "line"
    lines, of_log = (
        stated or bool(is_line(one)) for one in (replace(log, odometry=regression.odometry(fit)), log)
    )
    at_rest = far_better(rest.both, regression.explained(Fit()).both)
    if at_rest and may_rest and not (lines or of_log):
        return [hint_of("map frame", evidence=at_rest.words)]
    if unexplained and not lines and explained.both.mean() < UNEXPLAINED[1]:
        return unexplained
    tell(told, why.get("content"), "pose" if fit.content == "pose" else "fixed frame")
    when, before, after, jumping, constant = regression.jump(fit)
    jump = far_better(jumping, np.maximum(explained.both, rest.both))
    if jump and far_better(jumping, constant):
        tell(told, jump, "clock jumps", seconds=after - before, when=when)
    else:
        late = why.get("lag") if abs(fit.lag) > LATE_TOLD else None
        tell(told, late, "late" if fit.lag > 0.0 else "early", seconds=abs(fit.lag))
        tell_missing(told, regression, fit)
    if not may_rest and all(hint.cause != "speeds" for hint in told):
        tell_factors(told, regression, fit)
        tell_frame(told, regression, fit, log)
    told = {hint: gain for hint, gain in told.items() if not lines or hint.cause in OF_LINES}
    return sorted(told, key=lambda hint: -told[hint]) or beyond_any_vehicle(log)


def tell(told: Told, better: Better | None, mistake: str, **figures: Any) -> None:
    if better is not None:
        told[hint_of(mistake, evidence=better.words, **figures)] = better.gain


def tell_missing(told: Told, regression: Regression, fit: Fit) -> None:
    """Tell a speed or a yaw rate that the cones show and the odometry has not."""
    explained, (shown_v, shown_w) = regression.explained(fit), regression.around()
    seen, (v, w) = regression.shares(shown_v, shown_w), regression.predicted(fit)
    stated_v, stated_w = regression.stated(fit.content, fit.lag)
    turn, way = far_better(seen.turn, explained.turn), far_better(seen.way, explained.way)
    rates = {"stated": float(stated_w.std()), "seen": float(shown_w.std())}
    speeds = {"stated": np.abs(stated_v).mean(), "seen": np.abs(shown_v).mean()}
    backward = regression.shares(np.where((v.conj() * shown_v).real < 0.0, -v, v), w)
    if turn and rates["stated"] < FLAT * rates["seen"]:
        tell(told, turn, "no yaw rate", **rates)
    elif way and speeds["stated"] < FLAT * speeds["seen"]:
        tell(told, way, "no speed", **speeds)
    elif no_sign := far_better(backward.way, explained.way):
        tell(told, no_sign, "no sign")
    elif seen.both.mean() > max(WELL_EXPLAINED, explained.both.mean() / FAR_LESS):
        tell(told, way or turn, "other drive", which="way" if way else "turns")


def tell_factors(told: Told, regression: Regression, fit: Fit) -> None:
    """Tell factors of speed and yaw rate that are those of other units."""
    explained, speed, rate = regression.explained(fit), abs(fit.gain), abs(fit.rate)
    of_speed = regression.explained(replace(fit, gain=fit.gain / max(speed, TINY)))
    of_rate = regression.explained(replace(fit, rate=float(np.sign(fit.rate))))
    speeds, rates = far_better(explained.way, of_speed.way), far_better(explained.turn, of_rate.turn)
    thousandth = {1e-3: "milliseconds"}
    if speeds and rates and unit_of(speed, thousandth) == unit_of(rate, thousandth):
        tell(told, speeds, "milliseconds")
        return
    for better, mistake, (unit, size) in (
        (speeds, "unit of speeds", unit_of(speed, SPEED_UNITS)),
        (rates, "unit of yaw rate", unit_of(rate, RATE_UNITS)),
    ):
        tell(told, better if unit else None, mistake, unit=unit, size=size)


def unit_of(size: float, units: Mapping[float, str]) -> tuple[str, float]:
    """Return name and size of the unit near a size, or of an unknown unit; without a name near 1."""
    near = min(units, key=lambda one: abs(np.log(one / max(size, TINY))))
    if 1.0 / SAME_FACTOR < size / near < SAME_FACTOR:
        return units[near], near
    return "" if 1.0 / FACTOR_TOLD < size < FACTOR_TOLD else f"units of {size:.3g}", size


def tell_frame(told: Told, regression: Regression, fit: Fit, log: Log) -> None:
    """Tell whether detections, or else the odometry, have other axes than the vehicle, or another origin."""
    explained, opposite = regression.explained(fit), regression.explained(replace(fit, rate=abs(fit.rate)))
    mirror, size = far_better(explained.turn, opposite.turn), max(abs(fit.gain), TINY)
    turn = float(np.angle(fit.gain, deg=True)) * (1.0 if mirror else -1.0)
    better = far_better(explained.way, regression.explained(replace(fit, gain=complex(size))).way)
    clear, sure = explained.both.mean() > WELL_EXPLAINED, Better(0.0, "")
    small = sure if clear and np.rad2deg(fit.sigmas[0] / size) < TURN_SIGMA else None
    quarter = (90 * round(turn / 90.0) + 179) % 360 - 179
    is_quarter = abs((turn - quarter + 180.0) % 360.0 - 180.0) < TURN_TOLD
    vx, vy = np.median(log.odometry.twist[:, :2], axis=0)
    of_axes = None
    if is_quarter and abs(quarter) == 90 and abs(vy) > abs(vx):
        tell(told, better, "swapped")
    elif is_quarter and quarter == 180 and not mirror and vx < 0.0 and np.median(_points(log).real) > 0.0:
        tell(told, better, "backward")
    elif is_quarter and quarter:
        of_axes, (what, x, y) = better, FRAMES[quarter, bool(mirror)]
        tell(told, better, "frame", what=what, x=x, y=y)
    elif abs(turn) > TURN_TOLD:
        angle = f"{abs(turn):.1f} degrees to the {'left' if turn > 0.0 else 'right'}"
        side, of_axes = ", with y to the right" if mirror else "", better or small
        tell(told, of_axes, "turned", angle=angle, side=side, yaw=np.deg2rad(turn))
    if mirror and not of_axes:
        back = np.exp(1j * np.deg2rad(turn))
        of_detections = sided(log, back, mirrored=True) >= sided(log, np.conj(back))
        tell(told, mirror, "y to the right" if of_detections else "yaw rate to the right")
    if clear and abs(fit.lever) > max(LEVER_TOLD, fit.sigmas[1] / LEVER_SIGMA):
        place = fit.lever * np.conj(fit.gain) / size
        ahead, left = place.real, -place.imag if mirror else place.imag
        tell(told, sure, "place", ahead=ahead, left=left, along=f"{ahead:+.2f}", aside=f"{left:+.2f}")


def side_hints(log: Log) -> list[Hint]:
    """Return a hint if the motions that cones on the left and on the right show disagree in time.

    The sides are those of the vehicle, as of two cameras; in a bend a left cone may be on the right.
    """
    lags, (most, least) = [], SIDES
    for side in (1.0, -1.0):
        cycles = tuple(cycle.where(side * cycle.points_vehicle[:, 1] > 0.0) for cycle in log.cycles)
        motions = motions_of(replace(log, cycles=cycles), most, MIN_MATCHED, fastest=0.0)
        if len(motions.rate) < least:
            return []
        regression = Regression(log.odometry, motions)
        fit = regression.fit("twist", 0.0)
        lag, sigma = regression.lag(fit)
        if regression.explained(replace(fit, lag=lag)).both.mean() < SIDES_EXPLAINED:
            return []
        lags.append((lag, sigma))
    apart, sigma = lags[0][0] - lags[1][0], hypot(lags[0][1], lags[1][1])
    if abs(apart) < max(SIDES_TOLD, SIDES_CLEAR * sigma):
        return []
    late, early = ("left", "right") if apart > 0.0 else ("right", "left")
    return [hint_of("sides", late=late, early=early, ms=1e3 * abs(apart))]


# --- logs that are refused, and words of labels ----------------------------------------------------------

NO_LABEL_WORDS: Final = frozenset({"unknown", "", "none", "nan", "null"})  # words for no label
# causes of a refusal, by the size of numbers; labels and frames are never the cause
REFUSABLE: Final = {"stamps", "clocks", "positions", "speeds", "yaw rate", "odometry", "covariances"}
SHOWN_WORDS: Final = 3  # largest number of foreign labels in a hint


def read_usable_log(folder: Path, limits: LimitSettings, scale: float | None = None) -> Log:
    """Read a log and check all its cycles; an unusable one raises an InputError with file, row and stamp.

    A `scale` of the scene replaces that of the log.
    """
    log = read_log(folder)
    log = log if scale is None else replace(log, scale=scale)
    check_usable(log, folder, limits)
    return log


def read_plausible_log(
    folder: Path, limits: LimitSettings, scale: float | None = None
) -> tuple[Log, list[Hint]]:
    """Read and check a log; an InputError names file, row, what was expected, and the likely cause.

    A `scale` of the scene replaces that of the log.
    """
    try:
        log = read_usable_log(folder, limits, scale)
    except InputError as error:
        of_data = error.file.name in (ODOMETRY_FILE, DETECTIONS_FILE)
        found = [hint for hint in refused_hints(folder) if hint.cause in REFUSABLE] if of_data else []
        if not found:
            raise
        raise InputError(error.file, f"{error.message}; {because(found)}", error.row) from error
    return log, hints(log) + _foreign_label_hints(folder, log)


def refused_hints(folder: Path) -> list[Hint]:
    """Return the hints about a refused log; none if it cannot be parsed."""
    try:
        files = ODOMETRY_FILE, DETECTIONS_FILE
        rows, table = (read_table(folder / file, logs.COLUMNS[file]) for file in files)
        twists = rows.numbers("t", LARGEST_READING), rows.stack(("vx", "vy", "wz"), LARGEST_READING)
        stamps, points = table.numbers("t", LARGEST_READING), table.stack(("x", "y"), LARGEST_READING)
        covariances = covariances_of(*table.stack(("xx", "xy", "yy"), LARGEST_READING).T)
    except InputError:
        return []
    cycles = logs.cycles_of(stamps, points, covariances, logs.labels_of(table))
    return hints(Log(Odometry(*twists), cycles, np.ones(3), odometry_stated=False))


def _foreign_label_hints(folder: Path, log: Log) -> list[Hint]:
    if not log.cycles or any((cycle.labels != UNKNOWN).any() for cycle in log.cycles):
        return []
    met = Counter(read_table(folder / DETECTIONS_FILE, ("label",)).columns["label"])
    foreign = [word for word, _ in met.most_common() if word.strip().lower() not in NO_LABEL_WORDS]
    words = ", ".join(map(shown, foreign[:SHOWN_WORDS]))
    return [hint_of("foreign labels", words=words)] if foreign else []
