"""The results of a scaling measurement: a table to print, and points, slopes and figures on disk."""

from __future__ import annotations

import math
import platform
import resource
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from pathspace_graph.eval.figures.files import save_figures
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.files import atomic_folder, write_json

from .plot import plot_laps, plot_scaling
from .points import CONES, LAPS, READINGS, Scaling, Slope

FORMAT: Final = "pathspace-scaling/1"
MARKER: Final = "scaling.json"
"""A folder of results is known by this file."""
COMPARED_AT: Final = 200.0
"""Estimators are compared at this number of cones, that of an ordinary track."""


def scaling_table(scaling: Scaling) -> TextTable:
    """Returns a row for each estimator: slopes, times, the ratio to the first, laps and memory."""
    settings = scaling.settings
    header = (
        "estimator",
        f"slope, cones ({settings.fit_from:g} to {settings.cones_max:g})",
        "slope, readings",
        f"ms at {COMPARED_AT:g} cones",
        f"{scaling.estimators[0]} / this",
        "most cones",
        f"ms, lap 2 and {settings.laps}",
        "peak MB",
    )
    rows = tuple(_row(scaling, name) for name in scaling.estimators)
    return TextTable("Time per update: slopes of the logarithms, +- standard error", header, rows)


def _row(scaling: Scaling, name: str) -> tuple[str, ...]:
    here = scaling.seconds_at(COMPARED_AT, name)
    first = scaling.seconds_at(COMPARED_AT, scaling.estimators[0])
    cones, laps = scaling.of(CONES, name), {round(p.at): p.seconds for p in scaling.of(LAPS, name)}
    ends = (laps.get(lap, math.nan) for lap in (2, scaling.settings.laps))
    return (
        name,
        _slope(scaling.slope(CONES, name)),
        _slope(scaling.slope(READINGS, name)),
        _number(1e3 * here, ".1f"),
        _number(first / here, ".2f"),
        f"{cones[-1].at:.0f}" if cones else "none",
        ", ".join(_number(1e3 * seconds, ".1f") for seconds in ends),
        f"{scaling.memory[name]:.1f}",
    )


def _slope(slope: Slope) -> str:
    if not math.isfinite(slope.slope):
        return f"too few points ({slope.points})"
    return f"{slope.slope:.2f} +- {slope.error:.2f}"


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def stops(scaling: Scaling) -> list[str]:
    """Returns a line for each estimator and sweep that did not reach the end."""
    return [
        f"{s.estimator}, {s.sweep}: stopped, {s.stopped}" + (f" (slope to {s.high:.0f})" if s.points else "")
        for s in scaling.slopes
        if s.stopped
    ]


def write_scaling(out: Path, scaling: Scaling) -> None:
    """Writes `points.csv`, `scaling.json` (with slopes and settings), `table.md` and two figures."""
    with atomic_folder(out, MARKER) as folder:
        scaling.frame().to_csv(folder / "points.csv", index=False, lineterminator="\n")
        (folder / "table.md").write_text(scaling_table(scaling).markdown(), encoding="utf-8")
        write_json(folder / MARKER, _content(scaling))
        save_figures(folder, {"scaling": plot_scaling(scaling), "laps": plot_laps(scaling)})


def _content(scaling: Scaling) -> dict[str, Any]:
    at = {name: scaling.seconds_at(COMPARED_AT, name) for name in scaling.estimators}
    return {
        "format": FORMAT,
        "slopes": [asdict(slope) for slope in scaling.slopes],
        "compared_at_cones": COMPARED_AT,
        "seconds_compared": at,
        "ratio_of_first": {name: at[scaling.estimators[0]] / seconds for name, seconds in at.items()},
        "peak_megabytes_tracemalloc_first_lap": scaling.memory,
        "peak_megabytes_of_the_process": _process_megabytes(),
        "settings": asdict(scaling.settings),
        "estimator_settings": scaling.mapper,
        "versions": versions(),
    }


def _process_megabytes() -> float:
    """Returns the most memory (MB) that the process had, with all estimators loaded at once."""
    unit = 1e-6 if platform.system() == "Darwin" else 1.024e-3
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
