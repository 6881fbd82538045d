"""Time of an update against the size of the map, its detections and the laps: points, power laws, figures.

All estimators run in one process, every cycle in turn, so that what slows the machine down slows all alike.
"""

import math
import platform
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any, Final, Literal

try:
    import resource
except ImportError:  # Windows does not say how much memory was used at most
    resource = None  # type: ignore[assignment]

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullFormatter, ScalarFormatter
from scipy.stats import linregress
from threadpoolctl import threadpool_limits

from pathspace_graph.estimators import make_online
from pathspace_graph.eval.experiment.frame import write_csv
from pathspace_graph.eval.experiment.tables import TextTable
from pathspace_graph.eval.figures import style
from pathspace_graph.eval.figures.style import MARKERS, PALETTE, WIDTH
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.files import atomic_folder, write_json, write_text
from pathspace_graph.io.log import Log
from pathspace_graph.run import split_odometry, timed_update, timed_wait
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings

from .roads import Drives, first_cycles

MARKER: Final = "scaling.json"  # file by which a folder of results is known
COMPARED_AT: Final = 200.0  # number of cones at which estimators are compared, that of an ordinary track
Sweep = Literal["cones", "readings", "laps"]  # cones seen, detections of an update, or lap
CONES: Final[Sweep] = "cones"
READINGS: Final[Sweep] = "readings"
LAPS: Final[Sweep] = "laps"
Logs = Sequence[tuple[Log, int, Array]]  # log, number of detections if varied, abscissae (NaN doesn't count)
_HEIGHT: Final = 3.1  # height of a figure (in)
_TITLES: Final[dict[Sweep, tuple[str, str]]] = {  # axis title and title of each panel
    CONES: ("cones seen", "(a) map size"),
    READINGS: ("detections per update", "(b) detections"),
    LAPS: ("lap", "time per lap on a closed road"),
}
JUDGED: Final = 10  # number of updates whose mean is compared with the budget


@dataclass(eq=False)
class Lane:
    """An estimator that is to map a log, and what was measured, until the log ended or it was stopped."""

    estimator: str
    log: Log
    at: Array = field(default_factory=lambda: np.zeros(0))  # (n,) abscissa of each cycle; NaN doesn't count
    readings: int = 0  # number of detections in each cycle of the log, where they are varied
    seconds: list[float] = field(default_factory=list)  # processor time of each update (s)
    sizes: list[int] = field(default_factory=list)  # size of the map after each update
    stopped: str = ""  # why it did not reach the log's end; empty where it did

    def updates(self, settings: MapperSettings, budget: float) -> Iterator[None]:
        """Do an update at each step, until the log ends or the lane is stopped."""
        estimator = make_online(self.estimator, settings, self.log)
        for odometry, detections in split_odometry(self.log):
            try:
                timed_wait(estimator)
                estimate, _, seconds = timed_update(estimator, odometry, detections)
            except Exception as error:  # the table reports any failure
                self.stopped = " ".join(f"{type(error).__name__}: {error}".split())
                return
            self.seconds.append(seconds)
            self.sizes.append(sum(estimate.sizes))
            if len(self.seconds) >= JUDGED and np.mean(self.seconds[-JUDGED:]) > budget:
                self.stopped = f"over {budget:g} s an update"
                return
            yield


def run_lanes(
    lanes: Sequence[Lane],
    settings: MapperSettings,
    budget: float,
    on_cycle: Callable[[], None] = lambda: None,
) -> None:
    """Give cycle k to every lane in turn; the lane that is first moves on by one with k.

    So none always follows the same other. A lane stops if its last updates took over `budget` s on average.
    """
    runners = [lane.updates(settings, budget) for lane in lanes]
    with threadpool_limits(limits=1):
        for number in range(max(len(lane.log.cycles) for lane in lanes)):
            first = number % len(runners)
            for runner in (*runners[first:], *runners[:first]):
                next(runner, None)
            on_cycle()


def peak_memory(lane: Lane, settings: MapperSettings) -> float:
    """Return the peak (MB) of Python and numpy, not GTSAM, as the lane ran, by (slow) tracemalloc."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        run_lanes([lane], settings, float("inf"))
        return (tracemalloc.get_traced_memory()[1] - before) / 1e6
    finally:
        tracemalloc.stop()


@dataclass(frozen=True, eq=False)
class Scaling:
    """All results of the measurement."""

    settings: ScalingSettings
    mapper: dict[str, Any]
    points: pd.DataFrame  # row for each mean of some updates, as `binned` returns them
    slopes: pd.DataFrame  # row for each sweep and estimator, as `fit_slope` returns it
    memory: dict[str, float]  # peak (MB) of Python and numpy, by each estimator's first lap

    def of(self, sweep: Sweep, estimator: str) -> pd.DataFrame:
        return self.points[(self.points["sweep"] == sweep) & (self.points["estimator"] == estimator)]

    def slope(self, sweep: Sweep, estimator: str) -> pd.Series:
        return self.slopes.set_index(["sweep", "estimator"]).loc[(sweep, estimator)]

    @property
    def estimators(self) -> tuple[str, ...]:
        return tuple(self.memory)

    def seconds_at(self, cones: float, estimator: str) -> float:
        """Return the mean update (s) at a number of cones, between the points; NaN beyond them."""
        points = self.of(CONES, estimator)
        if not len(points):
            return float("nan")
        at, seconds = np.log(points["at"]), np.log(points["seconds"])
        return float(np.exp(np.interp(np.log(cones), at, seconds, left=np.nan, right=np.nan)))


def binned(sweep: Sweep, lane: Lane, edges: Array) -> pd.DataFrame:
    """Return a point for each interval between two `edges` that holds cycles of a lane.

    It has the means of `at`, of `seconds` of an update and of the map's `size`, and the number of `cycles`.
    """
    at = lane.at[: len(lane.seconds)]
    frame = pd.DataFrame({"at": at, "seconds": lane.seconds, "size": lane.sizes})
    bins = np.searchsorted(edges, frame["at"], side="right") - 1
    inside = (bins >= 0) & (bins < len(edges) - 1)
    points = frame[inside].groupby(bins[inside])
    means = points.mean().assign(sweep=sweep, estimator=lane.estimator, cycles=points.size())
    return means[["sweep", "estimator", "at", "seconds", "cycles", "size"]].reset_index(drop=True)


def fit_slope(
    sweep: Sweep, estimator: str, points: pd.DataFrame, fit_from: float = 0.0, stopped: str = ""
) -> dict[str, Any]:
    """Return the power law `seconds ~ at^slope`, a line fitted to the logarithms from `fit_from` on.

    `error` is the standard error of the exponent; both are NaN with too few `points`, from `low` to `high`.
    """
    kept = points[points["at"] >= fit_from].astype({"at": float, "seconds": float})
    slope = error = float("nan")
    if len(kept) > 2:  # two would leave nothing to estimate the error from
        line = linregress(np.log(kept["at"]), np.log(kept["seconds"]))
        slope, error = float(line.slope), float(line.stderr)
    fitted = {"slope": slope, "error": error, "points": len(kept)}
    ends = {"low": float(kept["at"].min()), "high": float(kept["at"].max())}
    return {"sweep": sweep, "estimator": estimator, **fitted, **ends, "stopped": stopped}


def sweeps(drives: Drives, settings: ScalingSettings) -> dict[Sweep, tuple[Logs, Array, float]]:
    """Return the logs of each sweep, the edges of its points' intervals, and where its slope begins."""
    low, high = np.log(settings.cones_min), np.log(settings.cones_max + 1.0)
    cones = np.exp(np.linspace(low, high, settings.bins + 1))
    lap = 1.0 + np.searchsorted(drives.lap_ends, [seen.t for seen in drives.laps.cycles])
    dense = []
    for wanted, log in drives.readings.items():
        counts = np.array([len(seen.labels) for seen in log.cycles])
        counts[: settings.warm_up] = -1
        dense.append((log, wanted, np.where(counts == wanted, float(wanted), np.nan)))
    ends = np.arange(1.0, len(drives.lap_ends) + 2.0)
    return {
        CONES: ([(drives.cones, 0, drives.seen)], cones, settings.fit_from),
        READINGS: (dense, np.append(np.sort(settings.readings), np.inf), 0.0),
        LAPS: ([(drives.laps, 0, lap.astype(float))], ends, 2.0),
    }


def measure_scaling(
    estimators: Sequence[str],
    drives: Drives,
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    on_cycle: Callable[[], None] = lambda: None,
) -> Scaling:
    """Measure all three sweeps, and the memory; `on_cycle` is called after each cycle of a sweep."""
    mapper = mapper or MapperSettings()
    points, slopes = [], []
    for sweep, (logs, edges, fit_from) in sweeps(drives, settings).items():
        lanes = [Lane(name, log, at, k) for name in estimators for log, k, at in logs]
        run_lanes(lanes, mapper, settings.budget, on_cycle)
        for name in estimators:
            own = [lane for lane in lanes if lane.estimator == name]
            points.append(_joined([binned(sweep, lane, edges) for lane in own]))
            stops = [(lane.readings, lane.stopped) for lane in own if lane.stopped]
            stopped = "; ".join(f"{k} readings: {why}" if k else why for k, why in stops)
            slopes.append(fit_slope(sweep, name, points[-1], fit_from, stopped))
    end = int(np.searchsorted([seen.t for seen in drives.laps.cycles], drives.lap_ends[0]))
    first_lap = first_cycles(drives.laps, end)
    memory = {name: peak_memory(Lane(name, first_lap), mapper) for name in estimators}
    return Scaling(settings, asdict(mapper), _joined(points), pd.DataFrame(slopes), memory)


def _joined(points: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat([of for of in points if len(of)] or points[:1], ignore_index=True)


# --- table and files -------------------------------------------------------------------------------------


def scaling_figures(scaling: Scaling) -> tuple[tuple[str, ...], dict[str, list[tuple[float, float]]]]:
    """Return the header, and the figures of each estimator with their standard errors, NaN where none."""
    settings, first = scaling.settings, scaling.estimators[0]
    header = (
        *("estimator", f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})", "slope, readings"),
        *(f"ms at {COMPARED_AT:g} cones", f"{first} / this", "most cones"),
        *("ms, lap 2", f"ms, lap {settings.laps}", "peak MB"),
    )
    rows = {}
    for name in scaling.estimators:
        slopes = (scaling.slope(sweep, name) for sweep in (CONES, READINGS))
        both = [(float(slope["slope"]), float(slope["error"])) for slope in slopes]
        at, laps = scaling.seconds_at(COMPARED_AT, name), scaling.of(LAPS, name).set_index("at")["seconds"]
        alone = [1e3 * at, scaling.seconds_at(COMPARED_AT, first) / at, scaling.of(CONES, name)["at"].max()]
        alone += [1e3 * laps.get(float(lap), math.nan) for lap in (2, settings.laps)]
        rows[name] = [*both, *((float(value), math.nan) for value in (*alone, scaling.memory[name]))]
    return header, rows


def scaling_table(scaling: Scaling) -> TextTable:
    """Return a row for each estimator: slopes, times, the ratio to the first, laps and memory."""
    header, found = scaling_figures(scaling)
    header, rows = (*header[:6], f"ms, lap 2 and {scaling.settings.laps}", header[8]), []
    for name, row in found.items():
        digits = (2, 2, 1, 2, 0, 1, 1, 1)
        *cells, second, last, peak = (_number(*of, places) for of, places in zip(row, digits, strict=True))
        rows.append((name, *cells, f"{second}, {last}", peak))
    return TextTable("Time per update: slopes of the logarithms, +- standard error", header, tuple(rows))


def _number(value: float, error: float, digits: int) -> str:
    by = f" +- {error:.{digits}f}" if math.isfinite(error) else ""
    return f"{value:.{digits}f}{by}" if math.isfinite(value) else "-"


def stops(scaling: Scaling) -> list[str]:
    """Return a line for each estimator and sweep that did not reach the end."""
    lines = []
    for row in (row for row in scaling.slopes.to_dict("records") if row["stopped"]):
        reached = f" (slope to {row['high']:.0f})" if row["points"] else ""
        lines.append(f"{row['estimator']}, {row['sweep']}: stopped, {row['stopped']}{reached}")
    return lines


def write_scaling(out: Path, scaling: Scaling) -> None:
    """Write `points.csv`, `scaling.json` (with slopes and settings), `table.md` and two figures."""
    at = {name: scaling.seconds_at(COMPARED_AT, name) for name in scaling.estimators}
    content = {
        "format": "pathspace-scaling/1",
        "slopes": scaling.slopes.to_dict("records"),
        "compared_at_cones": COMPARED_AT,
        "seconds_compared": at,
        "ratio_of_first": {name: at[scaling.estimators[0]] / seconds for name, seconds in at.items()},
        "peak_megabytes_tracemalloc_first_lap": scaling.memory,
        "peak_megabytes_of_the_process": _process_megabytes(),
        "settings": asdict(scaling.settings),
        "estimator_settings": scaling.mapper,
        "versions": versions(),
    }
    with atomic_folder(out, MARKER) as folder:
        write_csv(folder / "points.csv", scaling.points)
        write_text(folder / "table.md", scaling_table(scaling).markdown())
        write_json(folder / MARKER, content)
        style.save_figures(folder, {"scaling": plot_scaling(scaling), "laps": plot_laps(scaling)})


def _process_megabytes() -> float | None:
    """Return the most memory (MB) that the process had, with all estimators loaded; None if unknown."""
    if resource is None:
        return None
    unit = 1e-6 if platform.system() == "Darwin" else 1.024e-3
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def plot_scaling(scaling: Scaling) -> Figure:
    """Draw two sweeps on logarithmic axes, with fitted lines, and a cross where an estimator was stopped."""
    with style.figure_context():
        figure = Figure(figsize=(WIDTH, _HEIGHT), layout="constrained")
        cones, detections = figure.subplots(1, 2, sharey=True)
        for axes, sweep in ((cones, CONES), (detections, READINGS)):
            for name, color in _draw_sweep(axes, scaling, sweep).items():
                _draw_power_law(axes, scaling, sweep, name, color)
                if sweep == CONES and scaling.slope(sweep, name)["stopped"]:
                    last = scaling.of(sweep, name).iloc[-1]
                    axes.plot(last["at"], 1e3 * last["seconds"], "x", color=color, markersize=10.8)
            axes.set_xscale("log")
        cones.set_ylabel("mean update (ms)")
        ticks = [n for n in (50, 100, 200, 500, 1000, 2000) if n <= scaling.settings.cones_max]
        for axes, labelled in ((cones, ticks), (detections, scaling.settings.readings)):
            axes.xaxis.set_major_locator(FixedLocator(labelled))
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
        style.shared_legend(figure, columns=min(len(scaling.estimators), 4))
    return figure


def plot_laps(scaling: Scaling) -> Figure:
    """Draw the time per update of each lap, from the first on."""
    with style.figure_context():
        figure = Figure(figsize=(WIDTH / 2, _HEIGHT), layout="constrained")
        axes = figure.subplots()
        _draw_sweep(axes, scaling, LAPS, linestyle="-")
        axes.set_ylabel("mean update (ms)")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        style.shared_legend(figure, columns=2)
    return figure


def _draw_sweep(axes: Axes, scaling: Scaling, sweep: Sweep, linestyle: str = "none") -> dict[str, str]:
    drawn: dict[str, str] = {}
    for name, color, marker in zip(scaling.estimators, cycle(PALETTE), cycle(MARKERS), strict=False):
        points = scaling.of(sweep, name)
        if len(points):
            look: dict[str, Any] = {"linewidth": 0.7, "marker": marker, "markersize": 3.6}
            milliseconds = 1e3 * points["seconds"]
            axes.plot(points["at"], milliseconds, linestyle=linestyle, color=color, label=name, **look)
            drawn[name] = color
    abscissa, title = _TITLES[sweep]
    axes.set(yscale="log", xlabel=abscissa, title=title)
    style.label_logarithms(axes)
    axes.grid(which="both")
    return drawn


def _draw_power_law(axes: Axes, scaling: Scaling, sweep: Sweep, name: str, color: str) -> None:
    slope = scaling.slope(sweep, name)
    if not np.isfinite(slope["slope"]):
        return
    ends = slope[["low", "high"]].to_numpy(float)
    points = scaling.of(sweep, name)[["at", "seconds"]]
    at, seconds = np.exp(np.log(points[points["at"].between(*ends)]).mean())
    milliseconds = 1e3 * seconds * (ends / at) ** slope["slope"]
    axes.plot(ends, milliseconds, color=color, linewidth=0.9, alpha=0.8)
