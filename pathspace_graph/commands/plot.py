"""`plot`: a picture of a map."""

from pathlib import Path
from typing import Any, Final

from pathspace_graph.eval.figures.drawing import check_plot_file, plot_map, save_plot
from pathspace_graph.frames import read_cycles
from pathspace_graph.io.files import check_file_target
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.parsing import read_json
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.options.runs import Plot

from .outcome import Outcome

SUMMARY_FILE: Final = "summary.json"


def plot_command(options: Plot) -> Outcome:
    check_picture(options.out)
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


def check_picture(file: Path) -> None:
    """Raise an error where no picture could be written, before anything is mapped."""
    check_plot_file(file)
    check_file_target(file)
