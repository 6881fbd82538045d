"""The files of studies, of the suite of faults and of comparisons: tables, tidy results, figures and maps."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pandas as pd
from matplotlib.figure import Figure

from pathspace_graph.eval.figures.style import save_figures
from pathspace_graph.eval.metrics.summary import summarize, versions
from pathspace_graph.io.files import atomic_folder, replacing, write_json, write_text
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.io.results import write_result
from pathspace_graph.settings.mapper import MapperSettings

from .cells import NamedLog
from .compare import Comparison, paired_frame, paper_frame
from .compare import tables as comparison_tables
from .faults import beside_clean, fault_table, outcomes
from .frame import times_of, without_times
from .plots import find_blind_spot, plot_blind_spot, plot_differences, plot_faults, plot_maps
from .study import Study
from .tables import as_latex, as_markdown, as_text, caption, summary_tables, track_tables

MARKER: Final = "comparison.json"
"""File by which a comparison's folder is recognized."""


def write_csv(file: Path, frame: pd.DataFrame) -> None:
    """Write a frame without its index, whole or not at all."""
    with replacing(file) as temporary:
        frame.to_csv(temporary, index=False, lineterminator="\n")


# --- studies ---------------------------------------------------------------------------------------------


def write_study(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write the tables and the figures of a study, and return the text of its summary."""
    summary, differences = write_tables(study, frame, out), plot_differences(study, frame)
    if differences is not None:
        save_figures(out / "figures", {"differences": differences})
    return summary


def write_tables(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write `results.csv`, `times.csv` and the summary in three forms, and return its text."""
    write_results(frame, out)
    tables, note = [*track_tables(study, frame), *summary_tables(study, frame)], caption(study, frame)
    for suffix, form in (("txt", as_text), ("md", as_markdown), ("tex", as_latex)):
        write_text(out / f"summary.{suffix}", form(tables, note))
    return as_text(tables, note)


def write_results(frame: pd.DataFrame, out: Path) -> None:
    write_csv(out / "results.csv", without_times(frame))
    write_csv(out / "times.csv", times_of(frame))


def write_suite(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write the results of every run, and the table, the values and the figure; return the table's text.

    `faults.csv` has calibration and notices as JSON texts.
    """
    faults = outcomes(study, frame)
    table = fault_table(study, faults)
    text = f"{table.title}\n\n{table.text()}\n"
    write_results(frame, out)
    for suffix, content in (("txt", text), ("md", table.markdown()), ("tex", table.latex())):
        write_text(out / f"faults.{suffix}", content)
    about = {"estimator": study.estimators, "seeds": study.seeds, "laps": study.laps}
    write_json(out / "faults.json", {"format": "pathspace-faults/1", **about, "faults": faults}, indent=1)
    flat = pd.DataFrame(faults)
    for key in ("calibration", "said"):
        flat[key] = [json.dumps(value, ensure_ascii=False) for value in flat[key]]
    write_csv(out / "faults.csv", flat)
    save_figures(out, {"faults": plot_faults(study, beside_clean(frame))})
    return text


# --- comparisons -----------------------------------------------------------------------------------------


def write_comparison(out: Path, comparison: Comparison, settings: MapperSettings, jobs: int) -> None:
    """Write all files of a comparison (docs/formats.md), or on failure none.

    Where there are several logs, each has a folder of its own. An earlier comparison in `out` is kept as a
    numbered backup.
    """
    frames = {"table": paper_frame(comparison), "metrics": comparison.frame, "times": comparison.times()}
    if comparison.paired:
        frames["paired"] = paired_frame(comparison)
    with atomic_folder(out, MARKER) as folder:
        for name, table in comparison_tables(comparison).items():
            (folder / f"{name}.md").write_text(table.markdown(), encoding="utf-8")
            (folder / f"{name}.tex").write_text(table.latex(), encoding="utf-8")
        for name, frame in frames.items():
            frame.to_csv(folder / f"{name}.csv", index=False, lineterminator="\n")
        for named in comparison.logs:
            _write_log(folder if len(comparison.logs) == 1 else folder / named.name, named, comparison)
        about = {
            "format": "pathspace-comparison/1",
            "logs": [named.name for named in comparison.logs],
            "estimators": comparison.estimators,
            "reference": comparison.reference,
            "failures": [{**o.names, "error": o.failure} for o in comparison.failures],
            "jobs": jobs,
            "settings": asdict(settings),
            "versions": versions(),
        }
        write_json(folder / MARKER, about)


def _write_log(folder: Path, named: NamedLog, comparison: Comparison) -> None:
    folder.mkdir(exist_ok=True)
    found = comparison.of(named.name)
    maps = {str(o.names["estimator"]): o.result.map for o in found if o.result is not None}
    for outcome in found:
        if outcome.result is not None:
            summary = summarize(outcome.result, named.log, named.hints)
            write_result(folder / outcome.names["estimator"], outcome.result, summary)
    if maps:
        save_figures(folder, {"maps": plot_maps(found, named.log)})
    if named.log.truth is not None and comparison.reference in maps:
        figure = blind_spot_figure(maps, comparison.reference, named.log.truth)
        save_figures(folder, {} if figure is None else {"blind_spot": figure})


def blind_spot_figure(maps: Mapping[str, Map], reference: str, truth: Truth) -> Figure | None:
    """Return the reference beside the first landmark map that misses cones that it passes, or None."""
    points = [
        name
        for name, track in maps.items()
        if any(isinstance(boundary, PointBoundary) for boundary in track.boundaries.values())
    ]
    for name in points if reference not in points else ():
        spot = find_blind_spot(truth, maps[reference], maps[name])
        if spot is not None:
            return plot_blind_spot(spot, [(reference, maps[reference]), (name, maps[name])], truth)
    return None
