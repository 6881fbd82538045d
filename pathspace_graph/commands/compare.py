"""`demo` and `compare`: estimators on a simulated track or on logs, or two maps, side by side."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from joblib import Parallel, delayed
from rich.table import Table
from rich.text import Text

from pathspace_graph.console import LINES, note, output, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import DEFAULT_ONLINE, make_online
from pathspace_graph.eval.experiment import compare as experiment
from pathspace_graph.eval.experiment.compare import compare, side_by_side
from pathspace_graph.eval.experiment.run import check_jobs, run_estimator, unfinished, workers
from pathspace_graph.eval.figures.drawing import plot_apart, plot_map, save_plot
from pathspace_graph.eval.metrics.alignment import maps_apart
from pathspace_graph.eval.metrics.measures import laps_of, not_mapped, summarize
from pathspace_graph.io.files import atomic_folder, check_target, write_json
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import write_result
from pathspace_graph.options.runs import Compare, Demo
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .estimate import map_online, outline, tell
from .outcome import Outcome
from .simulate import describe, generated_track

RIVAL: Final = "landmark-fixed-lag"  # estimator whose table stands beside the spline graph's in the demo
PICTURE: Final = "track.png"
APART_FILE: Final = "apart.json"  # by which the folder is recognized
STATISTICS: Final = ("mean", "rms", "p95", "max")


def compare_command(options: Compare) -> Outcome:
    if len(options.log) == 2:
        return compare_maps(*options.log, options.out, force=options.force)
    if len(options.log) != 1:
        raise SettingsError(f"LOG: expected one log, or two maps, found {len(options.log)} folders")
    own = options.own(options.estimators)
    plan = experiment.plan_of(options.log[0], options.estimators, options.settings, own)
    check_jobs(options.jobs)
    check_target(options.out, experiment.MARKER, force=options.force)
    for drive in dict.fromkeys(cell.drive for cell in plan.cells):
        tell(drive.load()[1], of=drive.source if len(plan.study.logs) > 1 else "")
    with unfinished(options.out) as folder:
        with progress("comparing", lines=LINES) as advance:
            comparison = compare(plan, folder, jobs=options.jobs, on_cell=advance)
        with progress("writing"):
            experiment.write_comparison(options.out, comparison, options.jobs, force=options.force)
    console = output(wide=True)
    printed = {name: table for name, table in experiment.tables(comparison).items() if name != "metrics"}
    for table in printed.values():
        console.print(table.title, highlight=False, markup=False)
        console.print(table.rich())
    note(*(f"{_name(run)}: not converged" for run in comparison.unsettled))
    wrong = [f"{_name(run)}: failed, {run['error']}" for run in comparison.failures]
    return Outcome([options.out], {name: table.records() for name, table in printed.items()}, wrong)


def _name(names: Mapping[str, str]) -> str:
    return f"{names['estimator']} on {names['log']}"


def compare_maps(first: Path, second: Path, out: Path, *, force: bool) -> Outcome:
    """Align the first map with the second, print and write their distances, and draw both."""
    check_target(out, APART_FILE, force=force)
    tracks = read_map(first), read_map(second)
    apart = maps_apart(*tracks)
    distances = {"motion": apart.motion, "distances": apart.statistics()}
    content = {"maps": [str(first), str(second)], **distances}
    with atomic_folder(out, APART_FILE, force=force) as folder:
        write_json(folder / APART_FILE, content)
        save_plot(plot_apart(*tracks, apart), folder / "apart.png")
    table = Table()
    table.add_column("boundary")
    for name in STATISTICS:
        table.add_column(Text(f"{name} [m]"), justify="right")  # a plain text would be markup
    for name, own in apart.statistics().items():
        table.add_row(name, *(f"{own[key]:.3f}" for key in STATISTICS))
    output().print(table)
    x, y, turn = apart.motion.tolist()
    where = f"({x:.3f}, {y:.3f}) m, turned by {np.rad2deg(turn):.3f}°"
    say(f"the frame of {first} is at {where} in that of {second}")
    return Outcome([out], content)


def demo_command(options: Demo) -> Outcome:
    check_target(options.out, PICTURE, force=True)
    with progress("driving"):
        log = simulate(generated_track(options.seed), SimulationSettings(laps=options.laps), options.seed)
    say(f"a generated track, {options.laps} times around: {describe(log)}")
    with workers(2):  # the rival in another process; with one job it would be run here, and first
        begun = Parallel(return_as="generator")([delayed(run_estimator)(RIVAL, options.settings, log)])
        result = map_online(log, make_online(DEFAULT_ONLINE, options.settings, log))
        with progress(RIVAL):
            (rival,) = begun  # to the end, or joblib warns of tasks that were cancelled
    with progress("writing"), atomic_folder(options.out, PICTURE, force=True) as folder:
        write_log(log, folder / "log")
        write_result(folder / "map", result, summarize(result, log))
        picture = plot_map(result.map, log=log, trajectory=result.trajectory, smoothed=result.smoothed)
        save_plot(picture, folder / PICTURE, 150.0)  # dots per inch, which suits a web page
    table = side_by_side({run.estimator: laps_of(run, log) for run in (result, rival)})
    if len(table.frame):
        output().print(table.rich())
    say(outline(result))
    say(*not_mapped(result.map, log), f"log, map and {PICTURE}:")
    return Outcome([options.out], {"laps": table.records()})
