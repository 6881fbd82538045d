"""`ablate`, `faults`, `scale` and `report`: studies over many logs, in parallel and resumable."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from pathspace_graph.console import LINES, note, output, progress, say
from pathspace_graph.errors import SettingsError
from pathspace_graph.estimators import ONLINE, check_online
from pathspace_graph.eval import benchmark
from pathspace_graph.eval.experiment.faults import at_strength, only, suite, write_suite
from pathspace_graph.eval.experiment.run import check_jobs, make_plan, of_other_code, run_study, unfinished
from pathspace_graph.eval.experiment.study import Study, find_study, log_folders, read_study_file
from pathspace_graph.eval.experiment.tables import write_study
from pathspace_graph.eval.report import ReportPlan, write_report
from pathspace_graph.io.files import check_target
from pathspace_graph.options.runs import Ablate, FaultSuite, Report, Scale, StudyCommand
from pathspace_graph.settings.evaluation import ScalingSettings

from .outcome import Outcome


def execute(
    options: StudyCommand, study: Study, write: Callable[[Study, pd.DataFrame, Path], str]
) -> Outcome:
    """Run a study with the drives of the options, `write` it and print the text of it."""
    check_jobs(options.jobs)
    if options.laps is not None and options.laps < 1:
        raise SettingsError(f"--laps: expected at least 1, found {options.laps}")
    tracks = tuple(int(track) if track.isdecimal() else Path(track) for track in options.tracks)
    logs = {name: (folder,) for path in options.logs for name, folder in log_folders(path).items()}
    if tracks or logs:
        study = replace(study, tracks=tracks, logs=logs)
    chosen: dict[str, Any] = {"seeds": options.seeds, "laps": options.laps}
    study = replace(study, **{name: value for name, value in chosen.items() if value})
    plan = make_plan(study, keep=options.keep)
    if stale := of_other_code(options.out, plan.cells):
        note(f"{stale} runs in {options.out} are of other code, and are not used")
    with progress("runs", lines=LINES) as advance:
        how: dict[str, Any] = {"cluster": options.cluster, "retry_failed": options.retry_failed}
        frame = run_study(plan, options.out, jobs=options.jobs, on_cell=advance, **how)
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
    with unfinished(options.out) as folder:
        with progress("sweeps", lines=LINES) as advance:
            points = benchmark.measure_scaling(names, measured, options.settings, folder, on_cell=advance)
        benchmark.write_scaling(options.out, points, measured, options.settings, force=options.force)
    table = benchmark.scaling_table(points, measured)
    output(wide=True).print(table.rich())
    return Outcome([options.out], {"slopes": table.records()})


def report_command(options: Report) -> Outcome:
    check_jobs(options.jobs)
    drives: dict[str, Any] = {"tracks": options.tracks, "real": options.real, "quick": options.quick}
    with progress("runs", lines=LINES) as advance:
        plan = ReportPlan(jobs=options.jobs, on_cell=advance, **drives)
        written = [*write_report(plan, options.out, options.only)]
    say(*(f"{file}\n{table.text()}\n" for file, table in written))
    return Outcome([file for file, _ in written], {file.stem: table.records() for file, table in written})
