"""The results of a scaling measurement: a table to print, and points, slopes and figures on disk."""

import math
import platform
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Any, Final

try:
    import resource
except ImportError:  # Windows does not say how much memory was used at most
    resource = None  # type: ignore[assignment]

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullFormatter, ScalarFormatter

from pathspace_graph.eval.experiment.tables import TextTable
from pathspace_graph.eval.figures import style
from pathspace_graph.eval.figures.style import MARKERS, PALETTE, WIDTH
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.files import atomic_folder, write_json

from .scaling import CONES, LAPS, READINGS, Scaling, Sweep

MARKER: Final = "scaling.json"
"""File by which a folder of results is known."""
COMPARED_AT: Final = 200.0
"""Number of cones at which estimators are compared, that of an ordinary track."""

_HEIGHT: Final = 3.1
"""Height of a figure (in)."""
_TITLES: Final[dict[Sweep, tuple[str, str]]] = {
    CONES: ("cones seen", "(a) map size"),
    READINGS: ("detections per update", "(b) detections"),
    LAPS: ("lap", "time per lap on a closed road"),
}
"""Axis title and title of each panel."""


# --- table and files -------------------------------------------------------------------------------------


def scaling_figures(scaling: Scaling) -> tuple[tuple[str, ...], dict[str, list[tuple[float, float]]]]:
    """Return the header, and the figures of each estimator with their standard errors, NaN where none."""
    settings, first = scaling.settings, scaling.estimators[0]
    header = (
        "estimator",
        f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})",
        "slope, readings",
        f"ms at {COMPARED_AT:g} cones",
        f"{first} / this",
        "most cones",
        "ms, lap 2",
        f"ms, lap {settings.laps}",
        "peak MB",
    )
    rows = {}
    for name in scaling.estimators:
        slopes = (scaling.slope(sweep, name) for sweep in (CONES, READINGS))
        at = scaling.seconds_at(COMPARED_AT, name)
        laps = scaling.of(LAPS, name).set_index("at")["seconds"]
        alone = [
            1e3 * at,
            scaling.seconds_at(COMPARED_AT, first) / at,
            scaling.of(CONES, name)["at"].max(),
            *(1e3 * laps.get(float(lap), math.nan) for lap in (2, settings.laps)),
            scaling.memory[name],
        ]
        both = [(float(slope["slope"]), float(slope["error"])) for slope in slopes]
        rows[name] = [*both, *((float(value), math.nan) for value in alone)]
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
    if not math.isfinite(value):
        return "-"
    return f"{value:.{digits}f}" + (f" +- {error:.{digits}f}" if math.isfinite(error) else "")


def stops(scaling: Scaling) -> list[str]:
    """Return a line for each estimator and sweep that did not reach the end."""
    stopped = (s for s in scaling.slopes.to_dict("records") if s["stopped"])
    slope = " (slope to {high:.0f})"
    return [
        f"{s['estimator']}, {s['sweep']}: stopped, {s['stopped']}"
        + (slope.format(**s) if s["points"] else "")
        for s in stopped
    ]


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
        scaling.points.to_csv(folder / "points.csv", index=False, lineterminator="\n")
        (folder / "table.md").write_text(scaling_table(scaling).markdown(), encoding="utf-8")
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
        ticks = (50, 100, 200, 500, 1000, 2000)
        _label_ticks(cones, tuple(tick for tick in ticks if tick <= scaling.settings.cones_max))
        _label_ticks(detections, scaling.settings.readings)
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


def _label_ticks(axes: Axes, ticks: tuple[int, ...]) -> None:
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
