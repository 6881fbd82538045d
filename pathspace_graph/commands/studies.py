"""`ablate`, `faults`, `scale`, `report`, `compare`, `demo`: estimators side by side, on one or many logs."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from joblib import Parallel, delayed

from pathspace_graph.console import LINES, note, output, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import DEFAULT_ONLINE, ONLINE, check_online, make_online
from pathspace_graph.eval import benchmark
from pathspace_graph.eval.benchmark import RIVAL
from pathspace_graph.eval.experiment import compare as experiment
from pathspace_graph.eval.experiment import run as runs
from pathspace_graph.eval.experiment.faults import at_strength, only, suite, write_suite
from pathspace_graph.eval.experiment.study import Study, find_study, log_folders, read_study_file
from pathspace_graph.eval.experiment.tables import TextTable, write_study
from pathspace_graph.eval.figures.drawing import plot_apart, plot_map, save_plot
from pathspace_graph.eval.metrics.alignment import maps_apart
from pathspace_graph.eval.metrics.measures import figures, laps_of, not_mapped, summarize
from pathspace_graph.eval.report import ReportPlan, write_report
from pathspace_graph.io.files import atomic_folder, check_target, write_json
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import write_result
from pathspace_graph.options.runs import Ablate, Compare, Demo, FaultSuite, Report, Scale, StudyCommand
from pathspace_graph.settings.mapper import ScalingSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from .estimate import map_online, outline
from .simulate import Outcome, describe, generated_track, tell


def execute(
    options: StudyCommand, study: Study, write: Callable[[Study, pd.DataFrame, Path], str]
) -> Outcome:
    """Run a study with the drives of the options, `write` it and print the text of it."""
    runs.check_jobs(options.jobs)
    if options.laps is not None and options.laps < 1:
        raise SettingsError(f"--laps: expected at least 1, found {options.laps}")
    tracks = tuple(int(track) if track.isdecimal() else Path(track) for track in options.tracks)
    logs = {name: (folder,) for path in options.logs for name, folder in log_folders(path).items()}
    if tracks or logs:
        study = replace(study, tracks=tracks, logs=logs)
    chosen: dict[str, Any] = {"seeds": options.seeds, "laps": options.laps}
    study = replace(study, **{name: value for name, value in chosen.items() if value})
    plan = runs.make_plan(study, keep=options.keep)
    if stale := runs.of_other_code(options.out, plan.cells):
        note(f"{stale} runs in {options.out} are of other code, and are not used")
    with progress("runs", lines=LINES) as advance:
        how: dict[str, Any] = {"cluster": options.cluster, "retry_failed": options.retry_failed}
        frame = runs.run_study(plan, options.out, jobs=options.jobs, on_cell=advance, **how)
    text = write(study, frame, options.out)
    say(text.rstrip("\n"), "")
    failures = frame[frame["failure"] != ""]["failure"].tolist()
    wrong = [f"{len(failures)} of {len(plan.cells)} cells failed, the first of {one}" for one in failures[:1]]
    return Outcome([options.out], {"cells": len(plan.cells), "failures": failures}, wrong)


def ablate_command(options: Ablate) -> Outcome:
    study = read_study_file(find_study(options.study))
    return execute(
        options, study if options.baseline is None else study.against(options.baseline), write_study
    )


def faults_command(options: FaultSuite) -> Outcome:
    chosen = replace(only(suite(), options.only), estimators=(options.estimator,))
    return execute(options, at_strength(chosen, 1.0) if options.quick else chosen, write_suite)


def scale_command(options: Scale) -> Outcome:
    names = tuple(dict.fromkeys(options.estimators or ONLINE))
    for name in names:
        check_online(name, "--estimators")
    if options.quick and options.scaling != ScalingSettings():
        raise SettingsError("--quick: expected no other --scaling options with it, found some")
    check_target(options.out, benchmark.MARKER, force=options.force)
    measured = benchmark.QUICK if options.quick else options.scaling
    with runs.unfinished(options.out) as folder:
        with progress("sweeps", lines=LINES) as advance:
            points = benchmark.measure_scaling(names, measured, options.settings, folder, on_cell=advance)
        benchmark.write_scaling(options.out, points, measured, options.settings, force=options.force)
    table = benchmark.scaling_table(points, measured)
    output(wide=True).print(table.rich())
    return Outcome([options.out], {"slopes": table.records()})


def report_command(options: Report) -> Outcome:
    runs.check_jobs(options.jobs)
    drives: dict[str, Any] = {"tracks": options.tracks, "real": options.real, "quick": options.quick}
    with progress("runs", lines=LINES) as advance:
        plan = ReportPlan(jobs=options.jobs, on_cell=advance, **drives)
        written = [*write_report(plan, options.out, options.only)]
    say(*(f"{file}\n{table.text()}\n" for file, table in written))
    return Outcome([file for file, _ in written], {file.stem: table.records() for file, table in written})


# --- `demo` and `compare`: estimators on a simulated track or on logs, or two maps, side by side --------

PICTURE: Final = "track.png"
APART_FILE: Final = "apart.json"  # by which the folder is recognized


def compare_command(options: Compare) -> Outcome:
    if len(options.log) == 2:
        return compare_maps(*options.log, options.out, force=options.force)
    if len(options.log) != 1:
        raise SettingsError(f"LOG: expected one log, or two maps, found {len(options.log)} folders")
    own = options.own(options.estimators)
    plan = experiment.plan_of(options.log[0], options.estimators, options.settings, own)
    runs.check_jobs(options.jobs)
    check_target(options.out, experiment.MARKER, force=options.force)
    for drive in dict.fromkeys(cell.drive for cell in plan.cells):
        tell(drive.load()[1], of=drive.source if len(plan.study.logs) > 1 else "")
    with runs.unfinished(options.out) as folder:
        with progress("comparing", lines=LINES) as advance:
            comparison = experiment.compare(plan, folder, jobs=options.jobs, on_cell=advance)
        with progress("writing"):
            experiment.write_comparison(options.out, comparison, options.jobs, force=options.force)
    console = output(wide=True)
    printed = {name: table for name, table in experiment.tables(comparison).items() if name != "metrics"}
    for table in printed.values():
        console.print(table.title, highlight=False, markup=False)
        console.print(table.rich())
    named = "{estimator} on {log}".format_map
    note(*(f"{named(run)}: not converged" for run in comparison.unsettled))
    wrong = [f"{named(run)}: failed, {run['error']}" for run in comparison.failures]
    return Outcome([options.out], {name: table.records() for name, table in printed.items()}, wrong)


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
    rows = [(name, *figures(own.values(), 3)) for name, own in apart.statistics().items()]
    output().print(TextTable.of(("boundary", "mean [m]", "rms [m]", "p95 [m]", "max [m]"), rows).rich())
    x, y, turn = apart.motion.tolist()
    where = f"({x:.3f}, {y:.3f}) m, turned by {np.rad2deg(turn):.3f}°"
    say(f"the frame of {first} is at {where} in that of {second}")
    return Outcome([out], content)


def demo_command(options: Demo) -> Outcome:
    check_target(options.out, PICTURE, force=True)
    with progress("driving"):
        log = simulate(generated_track(options.seed), SimulationSettings(laps=options.laps), options.seed)
    say(f"a generated track, {options.laps} times around: {describe(log)}")
    with runs.workers(2):  # the rival in another process; with one job it would be run here, and first
        begun = Parallel(return_as="generator")([delayed(runs.run_estimator)(RIVAL, options.settings, log)])
        result = map_online(log, make_online(DEFAULT_ONLINE, options.settings, log))
        with progress(RIVAL):
            (rival,) = begun  # to the end, or joblib warns of tasks that were cancelled
    with progress("writing"), atomic_folder(options.out, PICTURE, force=True) as folder:
        write_log(log, folder / "log")
        write_result(folder / "map", result, summarize(result, log))
        picture = plot_map(result.map, log=log, trajectory=result.trajectory, smoothed=result.smoothed)
        save_plot(picture, folder / PICTURE, 150.0)  # dots per inch, which suits a web page
    table = experiment.side_by_side({run.estimator: laps_of(run, log) for run in (result, rival)})
    if len(table.frame):
        output().print(table.rich())
    say(outline(result))
    say(*not_mapped(result.map, log), f"log, map and {PICTURE}:")
    return Outcome([options.out], {"laps": table.records()})
