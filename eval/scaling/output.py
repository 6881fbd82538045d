"""What a measurement of scaling leaves: a table to print, points, slopes and figures on disk."""

from __future__ import annotations

import json
import math
import platform
import resource
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from pathspace_graph.eval.figures.map_plot import save_plot
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.files import atomic_folder

from .plot import plot_laps, plot_scaling
from .points import CONES, LAPS, READINGS, Slope
from .scaling import Scaling

FORMAT: Final = "pathspace-scaling/1"
MARKER: Final = "scaling.json"
"""The file that the folder of a measurement is known by."""
SUFFIXES: Final = (".png", ".pdf")
"""Each figure is written as."""
COMPARED_AT: Final = 200.0
"""Cones at which estimators are held against each other, an ordinary track's."""


def scaling_table(scaling: Scaling) -> TextTable:
    """A row per estimator: its slopes, times, ratio to the first, what the laps cost, memory."""
    road = scaling.settings
    header = (
        "estimator",
        f"slope, cones ({road.fit_from:g} to {road.cones_max:g})",
        "slope, readings",
        f"ms at {COMPARED_AT:g} cones",
        f"{scaling.estimators[0]} / this",
        "most cones",
        f"ms, lap 2 and {road.laps}",
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
    """A line for each estimator and sweep that did not come to the end."""
    return [
        f"{s.estimator}, {s.sweep}: stopped, {s.stopped}" + (f" (slope to {s.high:.0f})" if s.points else "")
        for s in scaling.slopes
        if s.stopped
    ]


def write_scaling(out: Path, scaling: Scaling) -> None:
    """`points.csv`, `scaling.json` (slopes, settings, versions), `table.md`, two figures; all or nothing."""
    with atomic_folder(out, MARKER) as folder:
        scaling.frame().to_csv(folder / "points.csv", index=False, lineterminator="\n")
        (folder / "table.md").write_text(scaling_table(scaling).markdown(), encoding="utf-8")
        content = json.dumps(_content(scaling), indent=2, allow_nan=False)
        (folder / MARKER).write_text(content + "\n", encoding="utf-8")
        for name, figure in {"scaling": plot_scaling(scaling), "laps": plot_laps(scaling)}.items():
            for suffix in SUFFIXES:
                save_plot(figure, folder / f"{name}{suffix}")


def _content(scaling: Scaling) -> dict[str, Any]:
    at = {name: scaling.seconds_at(COMPARED_AT, name) for name in scaling.estimators}
    content = {
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
    finite: dict[str, Any] = _finite(content)
    return finite


def _process_megabytes() -> float:
    """The most that the process, with everything loaded and all estimators at once, ever had in memory."""
    unit = 1e-6 if platform.system() == "Darwin" else 1.024e-3
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _finite(value: Any) -> Any:
    """The same with null for what JSON has no number for."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
