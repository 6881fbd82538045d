"""Time of an update against the size of the map, its detections and the laps: table and figure."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from pathspace_graph.eval.experiment.frame import write_csv
from pathspace_graph.eval.experiment.provenance import code_of
from pathspace_graph.eval.experiment.rows import rows_of
from pathspace_graph.eval.experiment.runner import OnCell
from pathspace_graph.eval.experiment.statistics import Estimate
from pathspace_graph.eval.experiment.tables import Quantity, Table
from pathspace_graph.eval.figures import style
from pathspace_graph.eval.figures.style import MARKERS, PALETTE, WIDTH
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings

from .lanes import CONES, DENSE_LINE, LAPS, POINT, READINGS, SLOPE, Sweep, memory_rows, sweep_rows
from .roads import LINE_POINTS, Drives, first_cycles

MARKER: Final = "scaling.json"  # file by which a folder of results is known
COMPARED_AT: Final = 200.0  # number of cones at which estimators are compared, that of an ordinary track
_HEIGHT: Final = 3.1  # height of a figure (in)
_TITLES: Final[dict[Sweep, tuple[str, str]]] = {  # axis title and title of each panel
    CONES: ("cones seen", "(a) map size"),
    READINGS: ("detections per update", "(b) detections"),
}


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

    def seconds_on_line(self, estimator: str) -> float:
        """Return the mean update (s) on dense lines; NaN where the estimator was stopped."""
        stopped = self.slope(DENSE_LINE, estimator)["stopped"]
        return float("nan") if stopped else float(self.of(DENSE_LINE, estimator)["seconds"].iloc[0])


def measure_scaling(
    estimators: Sequence[str],
    drives: Drives,
    settings: ScalingSettings,
    mapper: MapperSettings | None = None,
    folder: Path | None = None,
    on_cycle: OnCell = lambda *_: None,
) -> Scaling:
    """Measure all sweeps, and the memory, each kept in a folder at once, or read from there.

    `on_cycle` gets the numbers of cycles that are done, and of all that remained.
    """
    mapper, code = mapper or MapperSettings(), {name: code_of(name) for name in estimators}
    shared, found = {"estimators": tuple(estimators), "settings": settings, "mapper": mapper}, []
    done, total = 0, drives.cycles

    def count() -> None:
        nonlocal done
        done += 1
        on_cycle(done, total)

    others = {"drives": drives, "on_cycle": count}
    for sweep, logs in drives.by_sweep.items():
        before = done
        found.append(rows_of(sweep_rows, [{"sweep": sweep, **shared}], folder, others=others, depends=code))
        total -= max(len(log.cycles) for log in logs) if done == before else 0  # it was kept
    end = int(np.searchsorted([seen.t for seen in drives.laps.cycles], drives.lap_ends[0]))
    others, parts = (
        {"first_lap": first_cycles(drives.laps, end)},
        [{"estimator": name, "mapper": mapper} for name in estimators],
    )
    memory = rows_of(memory_rows, parts, folder, others=others, depends=[code, settings])
    rows = pd.concat(found, ignore_index=True)
    points, slopes = rows[rows["cycles"].notna()], rows[rows["cycles"].isna()]
    peaks = dict(zip(estimators, memory["megabytes"].tolist(), strict=True))
    return Scaling(settings, asdict(mapper), points[POINT].reset_index(drop=True), slopes[SLOPE], peaks)


# --- table and files -------------------------------------------------------------------------------------


def scaling_table(scaling: Scaling) -> Table:
    """Return a row for each estimator: slopes with standard errors, times, the ratio to the first, memory."""
    settings, first = scaling.settings, scaling.estimators[0]
    header = (
        *("estimator", f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})", "slope, readings"),
        *(f"ms at {COMPARED_AT:g} cones", f"{first} / this", "most cones"),
        *("ms, lap 2", f"ms, lap {settings.laps}", f"ms, {LINE_POINTS} points of lines", "peak MB"),
    )
    rows = []
    for name in scaling.estimators:
        slopes = (scaling.slope(sweep, name) for sweep in (CONES, READINGS))
        both = (Quantity.estimated(Estimate(slope["slope"], slope["error"], 1), 2) for slope in slopes)
        at, laps = scaling.seconds_at(COMPARED_AT, name), scaling.of(LAPS, name).set_index("at")["seconds"]
        alone = [1e3 * at, scaling.seconds_at(COMPARED_AT, first) / at, scaling.of(CONES, name)["at"].max()]
        alone += [1e3 * laps.get(float(lap), math.nan) for lap in (2, settings.laps)]
        alone += [1e3 * scaling.seconds_on_line(name), scaling.memory[name]]
        rows.append((name, *both, *Quantity.row(alone, 1, 2, 0, 1, 1, 1, 1)))
    return Table(header, tuple(rows), "Time per update: slopes of the logarithms, ± standard error")


def stops(scaling: Scaling) -> list[str]:
    """Return a line for each estimator and sweep that did not reach the end."""
    lines = []
    for row in (row for row in scaling.slopes.to_dict("records") if row["stopped"]):
        reached = f" (slope to {row['high']:.0f})" if row["points"] else ""
        lines.append(f"{row['estimator']}, {row['sweep']}: stopped, {row['stopped']}{reached}")
    return lines


def write_scaling(out: Path, scaling: Scaling, *, force: bool = False) -> None:
    """Write `points.csv`, `scaling.json` (with slopes and settings), `table.md` and the figure."""
    at = {name: scaling.seconds_at(COMPARED_AT, name) for name in scaling.estimators}
    content = {
        "format": "pathspace-scaling/1",
        "slopes": scaling.slopes.to_dict("records"),
        "compared_at_cones": COMPARED_AT,
        "seconds_compared": at,
        "peak_megabytes_tracemalloc_first_lap": scaling.memory,
        "settings": asdict(scaling.settings),
        "estimator_settings": scaling.mapper,
        "versions": versions(),
    }
    with atomic_folder(out, MARKER, force=force) as folder:
        write_csv(folder / "points.csv", scaling.points)
        scaling_table(scaling).write(folder, "table", "md")
        write_json(folder / MARKER, content)
        style.save_figures(folder, {"scaling": plot_scaling(scaling)})


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
        cones.set_ylabel("mean update [ms]")
        ticks = [n for n in (50, 100, 200, 500, 1000, 2000) if n <= scaling.settings.cones_max]
        for axes, labelled in ((cones, ticks), (detections, scaling.settings.readings)):
            axes.xaxis.set_major_locator(FixedLocator(labelled))
            axes.xaxis.set_major_formatter(ScalarFormatter())
            axes.xaxis.set_minor_formatter(NullFormatter())
        style.shared_legend(figure, columns=min(len(scaling.estimators), 4))
    return figure


def _draw_sweep(axes: Axes, scaling: Scaling, sweep: Sweep) -> dict[str, str]:
    drawn: dict[str, str] = {}
    for name, color, marker in zip(scaling.estimators, cycle(PALETTE), cycle(MARKERS), strict=False):
        points = scaling.of(sweep, name)
        if len(points):
            look: dict[str, Any] = {"linewidth": 0.7, "marker": marker, "markersize": 3.6}
            milliseconds = 1e3 * points["seconds"]
            axes.plot(points["at"], milliseconds, linestyle="none", color=color, label=name, **look)
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
