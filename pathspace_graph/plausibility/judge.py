"""Check of a log before it is mapped: hints about likely mistakes, also for a log that is refused.

The texts of the hints are a table, `hints.csv`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from itertools import chain
from math import hypot
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy  # imports its modules lazily
from scipy.spatial import KDTree
from threadpoolctl import threadpool_limits

from pathspace_graph.errors import InputError, check_type
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.noise import ASSUMED_DRIFT, ray_sigmas
from pathspace_graph.factors.se2 import move_points, relative
from pathspace_graph.front_end.front_end import measure_log
from pathspace_graph.front_end.gate import TWIST, check_usable
from pathspace_graph.front_end.measurement import (
    FOLLOW_RANGE,
    GATE_MOST,
    LEAST_NOISE,
    dead_reckoned,
    twist_noise,
)
from pathspace_graph.front_end.motion import MATCHING
from pathspace_graph.io import log as logs
from pathspace_graph.io.log import DETECTIONS_FILE, ODOMETRY_FILE, Detections, Log, Odometry, covariances_of
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.parsing import shown
from pathspace_graph.io.tables import read_table
from pathspace_graph.labels import BOUNDARIES, LEFT, NAMES, RIGHT, UNKNOWN
from pathspace_graph.settings.mapper import LimitSettings

from .regression import Better, Complex, Fit, Regression, far_better, motions_of


@dataclass(frozen=True)
class Hint:
    """A likely mistake in a log; lengths in its texts are in metres of the log."""

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


TEXTS: Final = read_table(Path(__file__).with_name("hints.csv")).columns
"""Fields of the hint of each mistake, with places for its figures."""


def hint_of(mistake: str, **figures: Any) -> Hint:
    row = TEXTS["mistake"].tolist().index(mistake)
    return Hint(**{entry.name: TEXTS[entry.name][row].format(**figures) for entry in fields(Hint)})


def because(hints: Sequence[Hint]) -> str:
    """Likely causes of a refusal in words; empty without hints."""
    causes = [f"{hint.likely} ({hint.file}, {hint.columns}: {hint.found})" for hint in hints]
    return f"likely cause: {'; '.join(causes)}" if causes else ""


def objections(hints: Sequence[Hint]) -> list[str]:
    """Why the map of a log with these hints is wrong; empty if it can be right in spite of all of them."""
    survivable = ("gaps", "reach", "mounting", "covariances", "labels", "noise", "sides")
    likely = [hint.likely for hint in hints if hint.cause not in survivable]
    return [f"not a map of the drive: {'; '.join(likely)}"] if likely else []


# --- the check -----------------------------------------------------------------------------------------

LARGEST_READING: Final = 1e20  # largest number in a log for hints


def hints(log: Log) -> list[Hint]:
    """Hints about likely mistakes in a log; those by motion are the strongest first.

    There are none for weak evidence, nor for numbers that are not finite.
    """
    check_type("log", log, Log)
    arrays = ((cycle.points_vehicle, cycle.covariances) for cycle in log.cycles)
    parts = (*_stamps(log).values(), log.odometry.twist, *chain.from_iterable(arrays))
    if len(log.odometry.t) < 20 or any(not (np.abs(one) <= LARGEST_READING).all() for one in parts):
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
        found = found or side_hints(log)
        stated = log.sensor.kind or "cones"
        seen = {True: "line", False: "cones", None: stated}[None if found else is_line(log)]
        if seen != stated:
            found = [hint_of(f"kind {seen}", stated=stated)]
        labels, share = {*np.unique(_labels(log)).tolist()}, sided(log)
        if not found and stay and labels in ({LEFT}, {RIGHT}) and abs(share - 0.5) <= 0.15:
            found = [hint_of("one label", label=NAMES[labels.pop()], share=100.0 * share)]
    if not found:
        found += _odometry_hints(log) if log.odometry_stated else []
        found += _detection_hints(log) if log.detections_stated and stay else []
    return of_cycles + found


# --- stamps, units and rows by typical values ------------------------------------------------------------

TIME_UNITS: Final = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}  # by size (s)
LENGTH_UNITS: Final = {1e-2: "centimetres", 1e-3: "millimetres"}  # by size (m)


def parts_of_stamps(log: Log) -> list[Hint]:
    """Hint for each file whose stamps have only whole seconds, or only fractions of a second."""
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
    """Log with stamps in seconds, and a hint for each file with another unit."""
    found, sizes = [], dict.fromkeys(_stamps(log), 1.0)
    for file, t in _stamps(log).items():
        step = _median(np.abs(np.diff(t)))
        fitting = [size for size in TIME_UNITS if 2e-4 <= step * size <= 5.0]
        if step > 5.0 and fitting:  # rows are usually 0.2 ms to 5 s apart
            size = sizes[file] = fitting[0]
            found.append(hint_of("unit of stamps", file=file, step=step, unit=TIME_UNITS[size], size=size))
    if not found:
        return log, []
    odometry = replace(log.odometry, t=log.odometry.t * sizes[ODOMETRY_FILE])
    cycles = tuple(replace(cycle, t=cycle.t * sizes[DETECTIONS_FILE]) for cycle in log.cycles)
    return replace(log, odometry=odometry, cycles=cycles), found


def with_usual_noise(log: Log) -> Log:
    """The log with at most a usual noise of detections: measured by wrong odometry, it is larger."""
    noise = log.measured
    if log.detections_stated or noise is None or noise.along is None or noise.across is None:
        return log
    along, across = (
        replace(one, sigma=np.minimum(one.sigma, most))
        for one, most in ((noise.along, (0.2, 0.1)), (noise.across, (0.2, 0.05)))  # at 0 m and per m
    )
    usual = replace(noise, along=along, across=across)
    return log.with_covariances(partial(usual.covariances, inflated=False))


def gaps_and_reach(log: Log) -> list[Hint]:
    """Hints if the vehicle drives without detections at an end, or if most cycles have hardly any."""
    if not log.cycles:
        return []
    t, speed = log.odometry.t, np.hypot(*log.odometry.twist[:, :2].T)
    begin, end = log.cycles[0].t, log.cycles[-1].t
    driven = t[speed > 0.1 * speed.max()]  # else it stands
    early = driven.size and begin - driven[0] > 10.0
    late = driven.size and driven[-1] - end > 10.0
    found = [hint_of("detections begin late", seconds=begin - t[0])] if early else []
    found += [hint_of("detections end early", seconds=t[-1] - end)] if late else []
    typical = _median(np.array([len(cycle.labels) for cycle in log.cycles]))
    few = len(log.cycles) >= 100 and typical < MATCHING.min_matched
    return found + ([hint_of("few detections", count=typical, least=MATCHING.min_matched)] if few else [])


def positions_in_metres(log: Log) -> tuple[Log, list[Hint]]:
    typical = _median(np.abs(_points(log)))
    if typical > 120.0:  # cones are seen at 20 m or less
        size = next((size for size in LENGTH_UNITS if typical * size <= 20.0), min(LENGTH_UNITS))
        what = f"are in {LENGTH_UNITS[size]}, not in metres"
    elif 0.0 < typical < 0.05:
        size, what = 1e3, "were divided by 1000 although they were in metres"
    else:
        return log, []
    cycles = tuple(replace(cycle, points_vehicle=cycle.points_vehicle * size) for cycle in log.cycles)
    hint = hint_of("unit of positions", typical=typical, what=what, size=size)
    return replace(log, cycles=cycles), [hint]


def possible_rows(log: Log) -> tuple[Log, list[Hint]]:
    """Log without steps of the odometry that cannot be, and a hint about these rows."""
    twist = log.odometry.twist
    smooth = scipy.ndimage.median_filter(twist, size=(5, 1), mode="nearest")
    step = np.abs(twist - smooth)
    # a row steps by at most 10 m/s or 5 rad/s, or by the speeds of the drive itself
    wrong = step > np.maximum((10.0, 10.0, 5.0), np.quantile(np.abs(twist), 0.9, axis=0))
    if not 0 < wrong.any(axis=1).sum() < 0.02 * len(twist):  # more rows are how this odometry is
        return log, []
    row, count = int((step * wrong).max(axis=1).argmax()), int(wrong.any(axis=1).sum())
    figures = {"count": count, "total": len(twist), "step": step[row].max(), "row": row + 2}
    hint = hint_of("yaw wraps" if wrong[:, 2].any() else "positions jump", **figures)
    return replace(log, odometry=replace(log.odometry, twist=np.where(wrong, smooth, twist))), [hint]


def beyond_any_vehicle(log: Log) -> list[Hint]:
    vx, vy, wz = log.odometry.twist.T
    speed, rate = (np.quantile(one, 0.9) for one in (np.hypot(vx, vy), np.abs(wz)))
    # m/s and rad/s that no vehicle exceeds in a tenth of its time
    found = [hint_of("too fast", speed=speed)] if speed > 100.0 else []
    return found + ([hint_of("turns too fast", rate=rate)] if rate > 8.0 else [])


def camera(log: Log) -> list[Hint]:
    """Hint if the detections lie on a line, as with the axes of a camera."""
    points = _points(log)
    spread = np.array([points.real.std(), points.imag.std()]) if len(points) else np.ones(2)
    least, most = spread.min(), spread.max()
    in_line = least < 0.1 * most  # all detections on a line
    return [hint_of("camera", thin="xy"[int(spread.argmin())], least=least, most=most)] if in_line else []


def sided(log: Log, turn: complex = 1.0, *, mirrored: bool = False) -> float:
    """Share of near labels on their side, once a mirrored frame is turned; 0.5 without labels."""
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


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0


# --- the regression in words -----------------------------------------------------------------------------

SPEED_UNITS: Final = {1.0 / 3.6: "km/h", 0.44704: "mph", 0.514444: "knots", 1e-2: "cm/s", 1e-3: "mm/s"}
TINY: Final = 1e-9  # least size of a factor
TURN_TOLD: Final = 8.5  # least yaw of the sensor that is told (degrees)
WELL_EXPLAINED: Final = 0.5  # least explained share for a small turn and a place, and for another drive
FRAMES: Final = {  # frames of detections, and columns for x and y, by rotation (degrees) and whether mirrored
    (180, False): ("the sensor's frame has x to the rear and y to the right", "-x", "-y"),
    (-90, False): ("the sensor's frame has x to the right and y ahead", "y", "-x"),
    (90, False): ("the sensor's frame has x to the left and y to the rear", "-y", "x"),
    (90, True): ("the columns x and y are swapped", "y", "x"),
    (180, True): ("the sensor's frame has x to the rear", "-x", "y"),
    (-90, True): ("the sensor's frame has x to the right and y to the rear", "-y", "-x"),
}


Told = dict[Hint, float]  # hints, and how much more of the motions each explains


def motion_hints(log: Log) -> list[Hint]:
    """Hints by the regression, the strongest first."""
    motions, told = motions_of(log), Told()
    share = 100.0 * len(motions.rate) / max(motions.tried, 1)
    few = motions.tried >= 30 and share < 30.0  # %
    unexplained = [hint_of("unexplained", share=share, tried=motions.tried)] if few else []
    if len(motions.rate) < 20:
        return beyond_any_vehicle(log) or unexplained
    regression = Regression(log.odometry, motions)
    fit, why = regression.best()
    explained, rest = regression.explained(fit), regression.shares(0.0 * motions.velocity, 0.0 * motions.rate)
    # no motion at all explains as much as the best fit
    may_rest = rest.both.mean() > explained.both.mean() - 0.03
    stated = log.sensor.kind == "line"
    lines, of_log = (
        stated or bool(is_line(one)) for one in (replace(log, odometry=regression.odometry(fit)), log)
    )
    at_rest = far_better(rest.both, regression.explained(Fit()).both)
    if at_rest and may_rest and not (lines or of_log):
        return [hint_of("map frame", evidence=at_rest.words)]
    if unexplained and not lines and explained.both.mean() < 0.2:
        return unexplained
    add_hint(told, why.get("content"), "pose" if fit.content == "pose" else "fixed frame")
    when, before, after, jumping, constant = regression.jump(fit)
    jump = far_better(jumping, np.maximum(explained.both, rest.both))
    if jump and far_better(jumping, constant):
        add_hint(told, jump, "clock jumps", seconds=after - before, when=when)
    else:
        late = why.get("lag") if abs(fit.lag) > 0.2 else None  # less (s) is left to the calibration
        add_hint(told, late, "late" if fit.lag > 0.0 else "early", seconds=abs(fit.lag))
        tell_missing(told, regression, fit)
    if not may_rest and all(hint.cause != "speeds" for hint in told):
        tell_factors(told, regression, fit)
        tell_frame(told, regression, fit, log)
    if lines:  # whose points tell these causes only
        told = {hint: told[hint] for hint in told if hint.cause in ("yaw rate", "clocks", "y to the right")}
    return sorted(told, key=lambda hint: -told[hint]) or beyond_any_vehicle(log)


def add_hint(told: Told, better: Better | None, mistake: str, **figures: Any) -> None:
    if better is not None:
        told[hint_of(mistake, evidence=better.words, **figures)] = better.gain


def tell_missing(told: Told, regression: Regression, fit: Fit) -> None:
    """Tell a speed or a yaw rate that the cones show and the odometry has not."""
    explained, motions = regression.explained(fit), regression.motions
    # medians of successive motions, which explain what the cones show
    columns = np.column_stack([motions.velocity.real, motions.velocity.imag, motions.rate])
    vx, vy, shown_w = scipy.ndimage.median_filter(columns, size=(9, 1), mode="nearest").T
    shown_v = vx + 1j * vy
    seen, (v, w) = regression.shares(shown_v, shown_w), regression.predicted(fit)
    stated_v, stated_w = regression.stated(fit.content, fit.lag)
    turn, way = far_better(seen.turn, explained.turn), far_better(seen.way, explained.way)
    rates = {"stated": float(stated_w.std()), "seen": float(shown_w.std())}
    speeds = {"stated": np.abs(stated_v).mean(), "seen": np.abs(shown_v).mean()}
    backward = regression.shares(np.where((v.conj() * shown_v).real < 0.0, -v, v), w)
    if turn and rates["stated"] < 0.2 * rates["seen"]:
        add_hint(told, turn, "no yaw rate", **rates)
    elif way and speeds["stated"] < 0.2 * speeds["seen"]:
        add_hint(told, way, "no speed", **speeds)
    elif no_sign := far_better(backward.way, explained.way):
        add_hint(told, no_sign, "no sign")
    elif seen.both.mean() > max(WELL_EXPLAINED, explained.both.mean() / 0.4):
        add_hint(told, way or turn, "other drive", which="way" if way else "turns")


def tell_factors(told: Told, regression: Regression, fit: Fit) -> None:
    """Tell factors of speed and yaw rate that are those of other units."""
    explained, speed, rate = regression.explained(fit), abs(fit.gain), abs(fit.rate)
    of_speed = regression.explained(replace(fit, gain=fit.gain / max(speed, TINY)))
    of_rate = regression.explained(replace(fit, rate=float(np.sign(fit.rate))))
    speeds, rates = far_better(explained.way, of_speed.way), far_better(explained.turn, of_rate.turn)
    thousandth = {1e-3: "milliseconds"}
    if speeds and rates and unit_of(speed, thousandth) == unit_of(rate, thousandth):
        add_hint(told, speeds, "milliseconds")
        return
    for better, mistake, (unit, size) in (
        (speeds, "unit of speeds", unit_of(speed, SPEED_UNITS)),
        (rates, "unit of yaw rate", unit_of(rate, {float(np.pi / 180.0): "degrees per second"})),
    ):
        add_hint(told, better if unit else None, mistake, unit=unit, size=size)


def unit_of(size: float, units: Mapping[float, str]) -> tuple[str, float]:
    """Name and size of the unit near a size, or of an unknown unit; without a name near 1."""
    near = min(units, key=lambda one: abs(np.log(one / max(size, TINY))))
    if 1.0 / 1.2 < size / near < 1.2:
        return units[near], near
    return "" if 1.0 / 1.6 < size < 1.6 else f"units of {size:.3g}", size


def tell_frame(told: Told, regression: Regression, fit: Fit, log: Log) -> None:
    """Tell whether detections, or else the odometry, have other axes than the vehicle, or another origin."""
    explained, opposite = regression.explained(fit), regression.explained(replace(fit, rate=abs(fit.rate)))
    mirror, size = far_better(explained.turn, opposite.turn), max(abs(fit.gain), TINY)
    turn = float(np.angle(fit.gain, deg=True)) * (1.0 if mirror else -1.0)
    better = far_better(explained.way, regression.explained(replace(fit, gain=complex(size))).way)
    clear, sure = explained.both.mean() > WELL_EXPLAINED, Better(0.0, "")
    # a small turn is told where it is known to a degree
    small = sure if clear and np.rad2deg(fit.sigmas[0] / size) < 1.0 else None
    quarter = (90 * round(turn / 90.0) + 179) % 360 - 179
    is_quarter = abs((turn - quarter + 180.0) % 360.0 - 180.0) < TURN_TOLD
    vx, vy = np.median(log.odometry.twist[:, :2], axis=0)
    of_axes = None
    if is_quarter and abs(quarter) == 90 and abs(vy) > abs(vx):
        add_hint(told, better, "swapped")
    elif is_quarter and quarter == 180 and not mirror and vx < 0.0 and np.median(_points(log).real) > 0.0:
        add_hint(told, better, "backward")
    elif is_quarter and quarter:
        of_axes, (what, x, y) = better, FRAMES[quarter, bool(mirror)]
        add_hint(told, better, "frame", what=what, x=x, y=y)
    elif abs(turn) > TURN_TOLD:
        angle = f"{abs(turn):.1f} degrees to the {'left' if turn > 0.0 else 'right'}"
        side, of_axes = ", with y to the right" if mirror else "", better or small
        add_hint(told, of_axes, "turned", angle=angle, side=side, yaw=np.deg2rad(turn))
    if mirror and not of_axes:
        back = np.exp(1j * np.deg2rad(turn))
        of_detections = sided(log, back, mirrored=True) >= sided(log, np.conj(back))
        add_hint(told, mirror, "y to the right" if of_detections else "yaw rate to the right")
    # a lever of a metre, known to a fifth
    if clear and abs(fit.lever) > max(1.0, fit.sigmas[1] / 0.2):
        place = fit.lever * np.conj(fit.gain) / size
        ahead, left = place.real, -place.imag if mirror else place.imag
        add_hint(told, sure, "place", ahead=ahead, left=left, along=f"{ahead:+.2f}", aside=f"{left:+.2f}")


def side_hints(log: Log) -> list[Hint]:
    """Hint if the motions that cones on the left and on the right show disagree in time.

    The sides are those of the vehicle, as of two cameras; in a bend a left cone may be on the right.
    """
    lags = []
    for side in (1.0, -1.0):
        cycles = tuple(cycle.where(side * cycle.points_vehicle[:, 1] > 0.0) for cycle in log.cycles)
        motions = motions_of(replace(log, cycles=cycles), 2000, MATCHING.min_matched, fastest=0.0)
        if len(motions.rate) < 100:
            return []
        regression = Regression(log.odometry, motions)
        fit = regression.fit("twist", 0.0)
        lag, sigma = regression.lag(fit)
        if regression.explained(replace(fit, lag=lag)).both.mean() < 0.4:  # of points of lines it is 0.3
            return []
        lags.append((lag, sigma))
    apart, sigma = lags[0][0] - lags[1][0], hypot(lags[0][1], lags[1][1])
    if abs(apart) < max(0.015, 4.0 * sigma):
        return []
    late, early = ("left", "right") if apart > 0.0 else ("right", "left")
    return [hint_of("sides", late=late, early=early, ms=1e3 * abs(apart))]


# --- noise that is stated ------------------------------------------------------------------------------


def _odometry_hints(log: Log) -> list[Hint]:
    """Compare white noise: orders of differences that disagree contain motion as well."""
    found = twist_noise(log.odometry)
    if found is None:
        return []
    (orders, interval), stated, hints = found, log.odometry_sigma, []
    least = orders.min(axis=0)
    agree = orders.max(axis=0) < 1.2 * least
    most = np.hypot(least, np.array(ASSUMED_DRIFT) / np.sqrt(interval))
    for which, values, size in (
        (agree & (least > 1.5 * stated), least, "small"),
        (1.5 * most < stated, most, "large, unless it stands for errors that change slowly"),
    ):
        figures = [
            f"{name} scatters by {value:.2g} {TWIST[name]}, and {said:.2g} is stated"
            for name, value, said, chosen in zip(TWIST, values, stated, which, strict=True)
            if chosen
        ]
        if figures:
            hints.append(hint_of("noise of odometry", figures=", ".join(figures), size=size))
    return hints


def _detection_hints(log: Log) -> list[Hint]:
    """Compare standard deviations along the ray or across it, whichever is farther off.

    The size of a cone is the least noise; tracking with a gate limits the largest measurable noise.
    """
    cycles, found = log.cycles[:300], dict[float, Hint]()
    measured = measure_log(replace(log, cycles=cycles))
    if measured is None or measured.along is None or measured.across is None:
        return []
    points = np.concatenate([cycle.points_vehicle for cycle in cycles])
    stated = ray_sigmas(points, np.concatenate([cycle.covariances for cycle in cycles]))
    near = (ranges := np.hypot(*points.T)) < FOLLOW_RANGE
    ranges, stated, at = ranges[near], stated[near], float(np.median(ranges[near]))
    floors = np.full(len(ranges), LEAST_NOISE[0]), LEAST_NOISE[1] * ranges
    rays = ("along", measured.along), ("across", measured.across)
    for (way, ray), claimed, floor in zip(rays, stated.T, floors, strict=True):
        sigmas, scatter = ray.sigmas(ranges), float(ray.sigmas(np.array([at]))[0])
        small = (sigmas > 2.0 * np.maximum(claimed, floor)).mean()
        large = ((2.0 * sigmas < claimed) & (3.0 * sigmas < GATE_MOST)).mean()
        if max(small, large) > 0.75:
            ratio = float(np.median(claimed / sigmas))
            is_unit = not 0.1 < ratio < 10.0
            how = f"too {'small' if small > large else 'large'}"
            how += ", as in another unit, or there are none at all" if is_unit else ""
            figures = {"scatter": scatter, "at": at, "stated": scatter * ratio, "way": way, "how": how}
            cause = "covariances" if is_unit else "noise"
            found[max(small, large)] = hint_of("noise of detections", cause=cause, **figures)
    return [found[max(found)]] if found else []


# --- cones, or points of lines -------------------------------------------------------------------------


@lru_cache(maxsize=2)
def is_line(log: Log) -> bool | None:
    """Whether the detections of the first seconds of a log are points of lines; None if that is not clear.

    The two nearest detections of each side are laid on those of an earlier cycle by odometry. Cones find
    themselves there, within their noise. Points of a line find a neighbour: at distances that are spread
    evenly over half the gap between points, whatever the gap.
    """
    cycles = [cycle for cycle in log.cycles if cycle.t <= log.cycles[0].t + 120.0]
    poses = dead_reckoned(log.odometry, np.array([cycle.t for cycle in cycles]))
    away, across = list[float](), list[float]()  # from partners, over half the gap; from their line (sigmas)
    for side, label in enumerate(BOUNDARIES):
        seen = list[tuple[float, Array, Array, Array]]()
        for cycle, pose in zip(cycles, poses, strict=True):
            own = cycle.labels  # or the vehicle's side, where no detection has a label
            if (own == UNKNOWN).all():
                own = np.where(cycle.points_vehicle[:, 1] > 0.0, LEFT, RIGHT)
            points, sigmas = _nearest_of_side(cycle.where(own == label))
            if len(points) > 1:
                seen.append((cycle.t, pose, points, sigmas))
        if not seen:
            continue
        gaps = (np.asarray(KDTree(points).query(points[:2], k=2)[0]) for _, _, points, _ in seen)
        gap = float(np.median([np.median(apart[:, 1]) for apart in gaps]))
        for k, (t, pose, points, sigmas) in enumerate(seen):
            begin = int(np.searchsorted([one[0] for one in seen[:k]], t - 1.5))
            for _, earlier, partners, _ in reversed(seen[begin:k]):  # over 1.5 s odometry hardly drifts
                way = relative(earlier, pose)
                if np.hypot(way[0], way[1]) < 0.25 * gap:  # at rest a line is seen at the same places
                    continue
                placed = move_points(way, points[:2])
                found = np.hypot(*placed.T) < np.hypot(*partners[-1])
                apart = KDTree(partners).query(placed[found])[0]
                away += np.minimum(apart / (0.5 * gap), 1.5).tolist()
                sigma = np.maximum(2.0**0.5 * sigmas[:2][found], 1e-3)
                off, step = placed[found, None] - partners[:-1], np.diff(partners, axis=0)
                along = np.clip((off * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
                aside = np.hypot(*(off - along[..., None] * step).transpose(2, 0, 1)).min(axis=1)
                across += (aside / sigma).tolist()
                break
            # comparisons that are enough: 0.1 to 0.27 was met for cones, 0.46 to 1.2 for lines
            if len(away) >= (side + 1) * 300 // 2:
                break
    # the median of 80 points of a line has a sigma of 0.08; what is off the line by 2.2 sigmas is garbled
    if len(away) < 80 or (
        np.median(away) >= 0.32 and not (np.median(away) > 0.4 and np.median(across) < 2.2)
    ):
        return None
    return bool(np.median(away) > 0.4)


def _nearest_of_side(detections: Detections) -> tuple[Array, Array]:
    """Nearest points (k, 2), one per cone, and the standard deviation (k,) of a coordinate (m)."""
    points, covariances = detections.points_vehicle, detections.covariances
    variances, chosen = 0.5 * np.trace(covariances, axis1=1, axis2=2), list[int]()
    for k in np.argsort(np.hypot(*points.T)).tolist():
        apart = ((points[chosen] - points[k]) ** 2).sum(axis=1)
        if (apart > 3.0**2 * (variances[chosen] + variances[k])).all():
            chosen.append(k)
        if len(chosen) == 10:
            break
    return points[chosen], np.sqrt(variances[chosen])


# --- logs that are refused, and words of labels ----------------------------------------------------------


def read_plausible_log(
    folder: Path, limits: LimitSettings, scale: float | None = None
) -> tuple[Log, list[Hint]]:
    """Read and check a log; an InputError names file, row, what was expected, and the likely cause.

    A `scale` of the scene replaces that of the log.
    """
    try:
        log = read_log(folder)
        log = log if scale is None else replace(log, scale=scale)
        check_usable(log, folder, limits)
    except InputError as error:
        if error.file.name not in (ODOMETRY_FILE, DETECTIONS_FILE):
            raise
        by_size = ("stamps", "clocks", "positions", "speeds", "yaw rate", "odometry", "covariances")
        found = [hint for hint in refused_hints(folder) if hint.cause in by_size]
        if not found:
            raise
        raise InputError(error.file, f"{error.message}; {because(found)}", error.row) from error
    found = hints(log)
    if log.cycles and (_labels(log) == UNKNOWN).all():
        met = Counter(read_table(folder / DETECTIONS_FILE, ("label",)).columns["label"]).most_common()
        foreign = [
            word for word, _ in met if word.strip().lower() not in ("unknown", "", "none", "nan", "null")
        ]
        words = ", ".join(map(shown, foreign[:3]))
        found += [hint_of("foreign labels", words=words)] if foreign else []
    return log, found


def refused_hints(folder: Path) -> list[Hint]:
    """Hints about a refused log; none if it cannot be parsed."""
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
