"""`plot` and `view`: a map as a picture, and a result as one page for any browser."""

from importlib import import_module
from typing import Any, Final

import numpy as np

from pathspace_graph.errors import InputError
from pathspace_graph.eval.figures.drawing import check_plot_file, plot_map, save_plot
from pathspace_graph.eval.metrics.alignment import maps_apart
from pathspace_graph.frames import read_cycles
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.options.runs import Plot, View

from .simulate import Outcome

SUMMARY_FILE: Final = "summary.json"


def plot_command(options: Plot) -> Outcome:
    check_plot_file(options.out)
    track = read_map(options.map)
    log = None if options.log is None else read_log(options.log)
    files = (options.map / name for name in (TRAJECTORY_FILE, SMOOTHED_FILE))
    trajectory, smoothed = (read_trajectory(file)[1] if file.exists() else None for file in files)
    cycles = read_cycles(options.map) if (options.map / CYCLES_FILE).exists() else {}
    look: dict[str, Any] = {"band_scale": options.band_scale, "title": options.title}
    look |= {"trajectory": trajectory, "smoothed": smoothed, "health": [*cycles.get("health", [])]}
    file = options.map / SUMMARY_FILE
    differences = read_json(file, "a summary").get("differences", []) if file.exists() else []
    look["differences"] = [(one["x"], one["y"]) for one in differences]  # from the map that was known
    save_plot(plot_map(track, log=log, **look), options.out)
    return Outcome([options.out])


# --- `view`: a result as one page for any browser -------------------------------------------------------


def view_command(options: View) -> Outcome:
    check_file_target(options.html)
    folder, track = options.result, read_map(options.result)
    cycles, summary = read_cycles(folder), read_json(folder / SUMMARY_FILE, "a summary")
    stamps, passed = read_trajectory(folder / TRAJECTORY_FILE)
    poses = passed
    if len(cycles) == 0:  # a batch of landmarks keeps none
        nothing = {"health": "", "reason": "", "readings": 0, "offered": 0, "lap": 0}
        cycles = cycles.reindex(range(len(stamps))).assign(t=stamps, **nothing)
    if (folder / SMOOTHED_FILE).exists():
        poses = read_trajectory(folder / SMOOTHED_FILE)[1]
    if len(cycles) < 2 or not len(cycles) == len(passed) == len(poses):
        found = f"{len(cycles)} and {len(passed)} poses"
        expected = "expected at least two cycles and a pose for each"
        raise InputError(folder / CYCLES_FILE, f"{expected}, found {found}")
    cycles = cycles.assign(**dict(zip(("x", "y", "theta"), poses.T, strict=True)))
    other = None
    if options.other is not None:
        known = read_map(options.other)
        other = (options.other.resolve().name, known, maps_apart(known, track))
    same = passed if not np.array_equal(passed, poses) else None
    page = import_module("pathspace_graph.eval.view.page").page  # a picture does without bokeh
    text = page(folder.resolve().name, track, cycles, summary, passed=same, other=other)
    with atomic_file(options.html) as file:
        file.write_text(text, encoding="utf-8")
    return Outcome([options.html])
