"""The files of a comparison: tables, tidy results, figures, and the maps themselves."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure

from pathspace_graph.eval.figures.files import save_figures
from pathspace_graph.eval.metrics.summary import summarize, versions
from pathspace_graph.eval.metrics.text_table import TextTable
from pathspace_graph.io.files import atomic_folder, write_json
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.io.results import write_result
from pathspace_graph.settings.mapper import MapperSettings

from .blind_spot import find_blind_spot
from .comparison import Comparison, NamedLog, Outcome
from .differences import paired_frame, paired_table
from .plot import plot_blind_spot, plot_maps
from .table import final_table, paper_frame, paper_table

FORMAT: Final = "pathspace-comparison/1"
MARKER: Final = "comparison.json"
"""A comparison's folder is recognized by this file."""


def tables(comparison: Comparison) -> dict[str, TextTable]:
    """Returns the printed tables by the name of their files, differences only where runs can be paired."""
    printed = {"table": paper_table(comparison), "metrics": final_table(comparison)}
    if comparison.paired:
        printed["paired"] = paired_table(comparison, paired_frame(comparison))
    return printed


def write_comparison(out: Path, comparison: Comparison, settings: MapperSettings, jobs: int) -> None:
    """Writes all files of a comparison, or on failure none.

    `table.*` is the paper's Table 1. `metrics.*` has every metric; its CSV has a tidy row for each run and
    lap. `times.csv` has the stages of the cycles, `paired.*` the differences. Each log has `maps.*`,
    `blind_spot.*` and a map folder for each estimator, in a folder of its own where there are several logs.
    An earlier comparison in `out` is kept as a numbered backup.
    """
    with atomic_folder(out, MARKER) as folder:
        for name, table in tables(comparison).items():
            (folder / f"{name}.md").write_text(table.markdown(), encoding="utf-8")
            (folder / f"{name}.tex").write_text(table.latex(), encoding="utf-8")
        frames = {
            "table": paper_frame(comparison),
            "metrics": comparison.frame(),
            "times": comparison.times(),
        }
        if comparison.paired:
            frames["paired"] = paired_frame(comparison)
        for name, frame in frames.items():
            frame.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
        for named in comparison.logs:
            own = folder if len(comparison.logs) == 1 else folder / named.name
            own.mkdir(exist_ok=True)
            _write_log(own, named, comparison)
        write_json(folder / MARKER, _content(comparison, settings, jobs))


def _write_log(folder: Path, named: NamedLog, comparison: Comparison) -> None:
    """Writes the maps and figures of one log."""
    outcomes = comparison.of(named.name)
    for outcome in outcomes:
        if outcome.result is not None:
            write_result(
                folder / outcome.estimator, outcome.result, summarize(outcome.result, named.log, named.hints)
            )
    if any(outcome.result is not None for outcome in outcomes):
        save_figures(folder, {"maps": plot_maps(outcomes, named.log)})
    figure = blind_spot_figure(outcomes, named, comparison.reference)
    if figure is not None:
        save_figures(folder, {"blind_spot": figure})


def blind_spot_figure(outcomes: list[Outcome], named: NamedLog, reference: str) -> Figure | None:
    """Returns the reference beside the first landmark map that misses cones, or None.

    It is None without truth, or where no landmark map misses cones that the reference passes.
    """
    maps = {o.estimator: o.result.map for o in outcomes if o.result is not None}
    truth = named.log.truth
    points = [
        name
        for name, track in maps.items()
        if any(isinstance(boundary, PointBoundary) for boundary in track.boundaries.values())
    ]
    if truth is None or reference not in maps or reference in points:
        return None
    for name in points:
        spot = find_blind_spot(truth, maps[reference], maps[name])
        if spot is not None:
            return plot_blind_spot(spot, [(reference, maps[reference]), (name, maps[name])], truth)
    return None


def _content(comparison: Comparison, settings: MapperSettings, jobs: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "logs": [named.name for named in comparison.logs],
        "estimators": comparison.estimators,
        "reference": comparison.reference,
        "failures": [
            {"log": o.log, "estimator": o.estimator, "error": o.failure} for o in comparison.failures
        ],
        "jobs": jobs,
        "settings": asdict(settings),
        "versions": versions(),
    }
