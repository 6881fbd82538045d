"""`online` and `batch`: map a log cycle by cycle, without reading ahead, or optimize it at once."""

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.table import Table
from rich.text import Text

from pathspace_graph import estimators
from pathspace_graph.batch.joint import solve_together
from pathspace_graph.batch.known_map import map_of_cones
from pathspace_graph.batch.mapper import BatchMapper, BatchResult
from pathspace_graph.console import note, output, progress, say
from pathspace_graph.errors import InputError, SettingsError, solving
from pathspace_graph.estimators import DEFAULT_BATCH, DEFAULT_ONLINE
from pathspace_graph.eval.metrics import measures
from pathspace_graph.eval.metrics.alignment import MapDifference, differences
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import inverse
from pathspace_graph.graph.exchange import GRAPH_FILE, write_graph
from pathspace_graph.health import DEGRADED, LOST, counts
from pathspace_graph.io.files import atomic_file, check_target
from pathspace_graph.io.log import Log
from pathspace_graph.io.map import MAP_FILE, Map, as_ribbon, read_map
from pathspace_graph.io.results import BatchRun, RunResult, write_result
from pathspace_graph.labels import NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.options.runs import Batch, MapKind, Online, Plot
from pathspace_graph.plausibility.diagnosis import crossings_of, diagnose, noise_lines
from pathspace_graph.plausibility.judge import Hint, objections, read_plausible_log
from pathspace_graph.run import Observer, OnlineEstimator, run_online, with_own
from pathspace_graph.settings.checked import override
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.track import EVENTS
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.spline.boundary import crossings_told

from .simulate import Outcome, tell

Run = TypeVar("Run", bound=RunResult)


def read_known_map(path: Path, sigma: float, settings: MapperSettings) -> tuple[Map, Array | None]:
    """Read the map of a folder, of a track file, or of an event of the rules.

    Cones of a track file or of an event are known with a standard deviation `sigma` (m). The second result is
    the pose (3,) at the begin of an open track, None of a closed one.
    """
    if path.is_dir() or path.name == MAP_FILE:
        track = read_map(path)
        return track, None if track.closed else np.zeros(3)
    if not path.exists() and str(path) in EVENTS:
        drawn = EVENTS[str(path)]()
    elif path.exists():
        drawn = read_track(path)
    else:
        events = " or ".join(EVENTS)
        raise InputError(path, f"expected a map's folder, a track file, {events}, found none")
    track = map_of_cones(*drawn.rows, drawn.closed, sigma, settings)
    return track, None if drawn.closed else drawn.start


def online_command(options: Online) -> Outcome:
    estimators.check_online(options.estimator)
    check_target(options.out, MAP_FILE, force=options.force)
    if options.on is not None and options.estimator != DEFAULT_ONLINE:
        raise SettingsError(f"--on: expected --estimator {DEFAULT_ONLINE}, found {options.estimator}")
    for name, is_given in (("start", options.start is not None), ("keep-map", options.keep_map)):
        if is_given and options.on is None:
            raise SettingsError(f"--{name}: expected --on MAP as well, found none")
    parameters = own_parameters(options)
    known = None if options.on is None else read_known_map(options.on, options.map_sigma, options.settings)
    drawing = viewing = None
    if options.plot is not None:  # importing matplotlib is slow
        drawing = import_module("pathspace_graph.commands.pictures")
        drawing.check_plot_file(options.plot)
    if options.view or options.save_view is not None:
        viewing = import_module("pathspace_graph.eval.view.recording")
        viewing.check_recording(options.save_view, options.view)
    log, hints = read_plausible_log(options.log, options.settings.limits, options.scale)
    tell(hints)
    estimator: OnlineEstimator
    if known is None:
        estimator = estimators.make_online(options.estimator, options.settings, log, parameters)
    else:
        settings, start = estimators.settings_of(options.settings, log), known[1]
        start = start if options.start is None else np.array(options.start)
        start = None if start is None else start / np.array([log.scale, log.scale, 1.0])
        track = scaled(known[0], 1.0 / log.scale)
        estimator = FixedLagMapper.on(track, settings, log.noise, start=start, keep=options.keep_map)
        log = replace(log, truth=None)  # it is in another frame
    with (
        nullcontext()
        if viewing is None
        else viewing.recording(
            options.save_view, window=options.view, truth=log.at_scale_one().truth
        ) as recorder
    ):
        observers = [] if recorder is None else [recorder]
        mapped = map_online(log, estimator, options.estimator, observers)
        result = of_kind(with_own(mapped, parameters), options.map, options.settings)
        summarized, changes = measures.summarize(result, log, hints), list[MapDifference]()
        found_at = estimator.placed_at if isinstance(estimator, FixedLagMapper) else None
        if known is not None and found_at is not None:
            before = scaled(known[0], 1.0 / result.scale)
            found = differences(before, result.at_scale_one().map)
            changes = [scaled(one, result.scale) for one in found]
        if known is not None:
            summarized["known_map"] = {"map": str(options.on), "found_at": found_at}
            summarized["differences"] = [asdict(one) for one in changes]
        write_result(options.out, result, summarized, force=options.force)
    if drawing is not None and options.plot is not None:
        drawing.plot_command(Plot(map=options.out, out=options.plot, log=None if known else options.log))
    report(result, log)
    say(*(one.line for one in changes))
    crossed = crossings_told(crossings_of(result))
    wrong = objections(hints) + ([f"not a map of the drive: {crossed}"] if crossed else [])
    if known is not None and found_at is None:
        wrong.append(f"the vehicle was not found on {options.on}: this is the map of its own road")
    files = (options.out, options.plot, options.save_view)
    return Outcome([file for file in files if file is not None], summarized, wrong)


def own_parameters(options: Online | Batch) -> Any:
    """Estimator's own parameters with those of the file; InputError where something is wrong."""
    try:
        parameters, rest = estimators.with_parameters(options.estimator, options.own([options.estimator]))
        override(options.settings, rest, "")
    except SettingsError as error:
        raise InputError(options.file or "--settings", str(error)) from error
    estimators.check_estimator(options.estimator, options.settings, parameters)
    return parameters


def batch_command(options: Batch) -> Outcome:
    estimators.check_batch(options.estimator)
    maker = estimators.maker_of(options.estimator)
    is_ours = isinstance(maker, type) and issubclass(maker, BatchMapper)
    is_ours |= options.estimator == DEFAULT_BATCH
    if options.start == "odometry" and not is_ours:
        raise SettingsError(f"--start: expected online for {options.estimator}, found {options.start}")
    check_target(options.out, MAP_FILE, force=options.force)
    parameters = own_parameters(options)
    if options.graph and (not is_ours or len(options.log) > 1):
        raise SettingsError(f"--graph: expected one log and the estimator {DEFAULT_BATCH}")
    if len(options.log) > 1:
        return batch_of_several(options)
    log, hints = read_plausible_log(options.log[0], options.settings.limits, options.scale)
    tell(hints)
    with progress("optimizing") as advance:
        estimator = estimators.make_batch(options.estimator, options.settings, log, parameters)
        more = (options.start, advance) if isinstance(estimator, BatchMapper) else ()
        solved = with_own(estimator.solve(log, *more), parameters)
        result: BatchRun = of_kind(solved, options.map, options.settings)
    summarized = summarize_batch(result, log, hints)
    write_result(options.out, result, summarized, force=options.force)
    if options.graph and isinstance(solved, BatchResult):
        with atomic_file(options.out / GRAPH_FILE) as temporary:
            write_graph(temporary, solved.graph(), solved.values(), solved.pose_graph())
    report(result, log)
    return Outcome([options.out], summarized, objections(hints) + untrusted(result))


def batch_of_several(options: Batch) -> Outcome:
    """Map several drives of one track at once."""
    if options.estimator != DEFAULT_BATCH:
        expected = f"--estimator: expected {DEFAULT_BATCH} for several logs"
        raise SettingsError(f"{expected}, found {options.estimator}")
    logs, hints = dict[str, Log](), dict[str, list[Hint]]()
    for name, folder in unique_names(options.log).items():
        logs[name], hints[name] = read_plausible_log(folder, options.settings.limits, options.scale)
        tell(hints[name], of=name)
    make: Any = partial(estimators.make_batch, DEFAULT_BATCH)
    with progress("optimizing") as advance:
        joint = solve_together(logs, make, options.settings, options.start, advance)
    name, result = next(iter(joint.drives.items()))
    result = of_kind(result, options.map, options.settings)
    drives = dict[str, Any]()
    shown = ("lap_count", "noise", "calibration", "final", "ate", "inside_two_sigma")
    for own, drive in joint.drives.items():  # with truth in the frame of each drive
        known = measures.summarize(drive.moved(inverse(joint.frames[own])), logs[own])
        drives[own] = {"frame": joint.frames[own], **{key: known[key] for key in shown if key in known}}
    summarized = summarize_batch(result, logs[name], hints[name])
    summarized |= {"drives": drives, "left_out": joint.left_out}
    write_result(options.out, result, summarized, joint.drives, force=options.force)
    report(result, logs[name])
    for name, drive in joint.drives.items():
        x, y, heading = joint.frames[name].tolist()
        laps = f"{drive.laps} lap{'' if drive.laps == 1 else 's'}"
        say(f"{name}: {laps}, begins at ({x:.2f}, {y:.2f}) m, turned by {np.rad2deg(heading):.2f}°")
    left_out = [f"{name} is left out: {why}" for name, why in joint.left_out.items()]
    wrong = [f"{of}: {line}" for of in logs for line in objections(hints[of])]
    return Outcome([options.out], summarized, [*left_out, *wrong, *untrusted(result)])


def untrusted(result: BatchRun) -> list[str]:
    """What is wrong with the result of a batch."""
    known, wrong = result if isinstance(result, BatchResult) else None, list[str]()
    if not result.converged:
        reason = known.convergence.reason if known else "associations still change"
        wrong.append(f"not converged: {reason}")
    objections = [known.objection if known else "", crossings_told(crossings_of(result))]
    return wrong + [f"not a map of the drive: {objection}" for objection in objections if objection]


def unique_names(folders: Sequence[Path]) -> dict[str, Path]:
    """Folders by their names; a repeated name gets a number."""
    named = dict[str, Path]()
    for folder in folders:
        name = folder.resolve().name
        same = (f"{name}-{number}" for number in count(2))
        named[name if name not in named else next(one for one in same if one not in named)] = folder
    return named


def of_kind(result: Run, kind: MapKind, settings: MapperSettings) -> Run:
    """Convert the maps of a result to this kind; where no line fits, note it and keep the boundaries."""
    if kind == "boundaries":
        return result

    failed = list[SettingsError]()

    def line(track: Map) -> Map:
        try:
            found = as_ribbon(scaled(track, 1.0 / result.scale), settings.spline.sigma_shape)
        except SettingsError as error:
            failed.append(error)
            return track
        return scaled(found, result.scale)

    last = line(result.map)
    if failed:
        note(f"--map {kind}: {failed[0]}, and the map is of boundaries")
        return result
    laps = tuple((lap, line(track)) for lap, track in result.lap_maps)
    return replace(result, map=last, lap_maps=laps, snapshots=tuple(map(line, result.snapshots)))


def summarize_batch(result: BatchRun, log: Log, hints: Sequence[Hint] = ()) -> dict[str, Any]:
    """Summary of a run, and how its optimization began and ended."""
    start = "odometry" if isinstance(result, BatchResult) and result.online is None else "online"
    found = measures.summarize(result, log, hints) | {"start": start, "converged": result.converged}
    if not isinstance(result, BatchResult):
        return found
    found |= {"convergence": asdict(result.convergence), "objection": result.objection}
    return found | {"stages": result.seconds}


def map_online(
    log: Log,
    estimator: OnlineEstimator,
    name: str = DEFAULT_ONLINE,
    observers: Sequence[Observer] = (),
) -> RunResult:
    """Map a log with progress; the map at the end of each true lap is kept where there is truth."""
    times = measures.lap_times(log)
    with progress("mapping", len(log.cycles)) as advance, solving("an update"):
        watching = [lambda _: advance(), *observers]
        return run_online(log, estimator, name=name, snapshot_times=times, observers=watching, outlines=True)


def report(result: RunResult, log: Log) -> None:
    """Print the run, the paper's table where there is truth, and on standard error what was not mapped."""
    if laps := measures.laps_of(result, log):
        table = Table()
        for name in ("lap", "rmse [m]", "missed [%]", "size"):
            table.add_column(Text(name), justify="right")  # a plain text would be markup, [m] a style
        for row in laps:
            table.add_row(str(row.lap), f"{row.rmse:.3f}", f"{100 * row.missed:.1f}", str(row.size))
        output().print(table)
    begin = float(log.odometry.t[0])  # a bag's stamps count from 1970
    say(outline(result, begin))
    if result.scale != 1.0:
        say(f"lengths of hints, notices, calibration and noise are in units of {result.scale:g} m")
    if result.settings.get("kind") == "line":
        say("detections are points of lines, not of things that stay")
    say(*(f"at {record.t - begin:.1f} s: {record.notice}" for record in result.cycles if record.notice))
    if result.batches is not None and result.batches.late:
        late = f"{result.batches.late} cycle{'' if result.batches.late == 1 else 's'}"
        say(f"in a vehicle the batch of the lap would have been {late} late")
    at_one = result.at_scale_one()
    say(*noise_lines(at_one.noise))
    say(*([] if at_one.vehicle is None else diagnose(at_one.vehicle, result.settings)))
    if missing := measures.not_mapped(result.map, log):
        note("; ".join(missing))


def outline(result: RunResult, begin: float = 0.0) -> str:
    """Summary of the run in one line, with times since `begin` (s)."""
    laps = f"{result.laps} lap{'' if result.laps == 1 else 's'}"
    loop = "loop closed" if result.map.closed else "loop not closed"
    sizes = [f"{NAMES[label]} {boundary.size}" for label, boundary in sorted(result.map.boundaries.items())]
    points = f"control points: {' + '.join(sizes) or 'none'}"
    orange = sorted(result.map.points.items())
    cones = [f"{own.size} {NAMES[label].replace('_', ' ')} cones" for label, own in orange]
    size = [] if result.scale == 1.0 else [f"{result.scale:g} times the size of a Formula Student track"]
    number = counts([measures.health_of(record) for record in result.cycles])
    reasons = Counter(record.reason for record in result.cycles if record.health == DEGRADED)
    mostly = f" (mostly: {reasons.most_common(1)[0][0]})" if reasons else ""
    health = [
        f"{condition} in {100.0 * (number[condition] / max(len(result.cycles), 1)):.1f} % of the cycles{why}"
        for condition, why in ((DEGRADED, mostly), (LOST, ""))
        if number[condition]
    ]
    last = measures.stretches_of(result)[-1:]
    if last and last[0].health == LOST and last[0].end == result.cycles[-1].t:
        health.append(f"still lost since {last[0].begin - begin:.1f} s ({last[0].reason})")
    return ", ".join([laps, loop, points, *cones, *size, *health])
