"""`simulate`, `convert` and `export`: logs of drives and of records, and maps for other tools."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pathspace_graph.console import note, progress, say
from pathspace_graph.convert.bag import read_bag
from pathspace_graph.convert.recording import rate, to_log, windowed
from pathspace_graph.convert.settings import LabelRule
from pathspace_graph.convert.text_files import read_csv, read_json_lines
from pathspace_graph.errors import InputError, PathspaceError, SettingsError
from pathspace_graph.front_end.front_end import seen_cycles
from pathspace_graph.front_end.gate import check_usable
from pathspace_graph.front_end.noise import measure_noise
from pathspace_graph.graph.exchange import GRAPH_FILE, read_graph, write_g2o
from pathspace_graph.io import export as formats
from pathspace_graph.io.files import atomic_file, check_file_target, check_target
from pathspace_graph.io.log import LOG_FILE, ODOMETRY_FILE, TRUTH_POSES_FILE, Log, Odometry
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE, write_trajectory
from pathspace_graph.io.tables import read_table, read_trajectory
from pathspace_graph.labels import NAMES
from pathspace_graph.lengths import scaled
from pathspace_graph.options.data import Convert, Simulate
from pathspace_graph.options.runs import Export
from pathspace_graph.plausibility.diagnosis import crossings_on, measured_line
from pathspace_graph.plausibility.judge import because, hints
from pathspace_graph.settings.mapper import LimitSettings, MapperSettings
from pathspace_graph.sim.simulate import simulate
from pathspace_graph.sim.track import EVENTS, Track
from pathspace_graph.sim.track_files import read_track
from pathspace_graph.sim.track_generator import TrackGeneratorSettings, generate_track
from pathspace_graph.spline.boundary import crossings_told
from pathspace_graph.spline.planning import LEAST_STEP, MOST_POINTS

from .estimate import Outcome, tell

OF_KIND: Final = {  # kinds of records that take an option; any other option is for all of them
    **dict.fromkeys(("odometry", "detections"), ("bag", "csv")),
    **dict.fromkeys(("imu", "wheelbase", "definition", "received", "namespaces", "label_field"), ("bag",)),
    **dict.fromkeys(("columns", "units"), ("csv",)),
}


def convert_command(options: Convert) -> Outcome:
    for name, kinds in OF_KIND.items():
        given: Any = options if hasattr(options, name) else options.topics
        if options.kind not in kinds and getattr(given, name) != getattr(type(given), name):
            expected = f"expected --from {' or '.join(kinds)}"
            raise SettingsError(f"--{name.replace('_', '-')}: {expected}, found {options.kind}")
    records = _records(options)
    if not records:
        _convert(options, options.source, options.out)
        return Outcome([options.out])
    written, refused = list[Path](), list[str]()
    for record in records:
        say(f"{record}:")
        try:
            _convert(options, record, options.out / record.stem)
            written.append(options.out / record.stem)
        except PathspaceError as error:
            refused.append(str(error))
    if refused:
        some = f"{len(refused)} of {len(records)} records were refused"
        raise PathspaceError(f"{some}: {'; '.join(refused)}")
    return Outcome(written)


def _records(options: Convert) -> list[Path]:
    """Records in a folder of several; none where the source is a record itself."""
    folder = options.source
    if not folder.is_dir() or (folder / "metadata.yaml").exists():
        return []
    if options.kind == "csv":
        file = options.topics.odometry or ODOMETRY_FILE
        return [] if (folder / file).exists() else sorted(one.parent for one in folder.glob(f"*/{file}"))
    suffixes = {"bag": (".bag", ".mcap", ".db3"), "jsonl": (".jsonl", ".json")}[options.kind]
    known = [one for one in folder.iterdir() if one.suffix in suffixes]
    bags = [one.parent for one in folder.glob("*/metadata.yaml")] if options.kind == "bag" else []
    return sorted({*known, *bags})


def _convert(options: Convert, source: Path, out: Path) -> None:
    """Convert a record and report it; InputError of the source where an estimator could not use its log."""
    check_target(out, LOG_FILE, force=options.force)
    rule = LabelRule(options.labels, options.label_field)
    with progress("converting"):
        if options.kind == "csv":
            read = read_csv(source, options.topics, rule, options.columns, options.units)
        elif options.kind == "jsonl":
            read = read_json_lines(source, options.topics, rule)
        else:
            read = read_bag(source, options.topics, rule, mounted=options.frames.mounting is not None)
        record = windowed(read, options.window, source)
        recorded = to_log(record, options.frames, options.noise, source, options.window.spacing)
        log = with_measured_noise(replace(recorded, scale=options.scale), record.parts)
        try:
            check_usable(log, out, LimitSettings())
            write_log(log, out, check=True, force=options.force)
        except InputError as error:  # an estimator could not use it
            where = f"{error.file.name}, row {error.row}" if error.row else error.file.name
            likely = because(hints(log))
            why = f"{error.message}; {likely}" if likely else error.message
            part = "--start and --end take a part of the record"
            raise InputError(source, f"its log would be refused ({where}): {why}; {part}") from None
    # what was dropped or assumed and how often, labels, rates, speeds, ranges and the length
    twists, seconds = log.odometry.twist, float(np.ptp(log.odometry.t))
    ranges = np.concatenate([np.hypot(*cycle.points_vehicle.T) for cycle in log.cycles])
    labels = np.bincount(np.concatenate([cycle.labels for cycle in log.cycles]), minlength=len(NAMES))
    counted = [f"{count} {name}" for name, count in zip(NAMES, labels.tolist(), strict=True) if count]
    measured = [] if log.measured is None else [measured_line(scaled(log.measured, 1.0 / log.scale))]
    say(
        *(f"{count} {text}" for text, count in record.notes.items() if count),
        *([rule.summary()] if rule.met else []),
        f"odometry at {rate(len(twists), seconds)}, up to {np.hypot(*twists[:, :2].T).max():.3g} m/s and "
        f"{np.abs(twists[:, 2]).max():.3g} rad/s; detections at {rate(len(log.cycles), seconds)}, "
        f"{ranges.min():.3g} m to {ranges.max():.3g} m away: {', '.join(counted)}",
        *measured,
        describe(log),
    )
    tell(hints(log))


def with_measured_noise(log: Log, parts: int = 1) -> Log:
    """Measure the noise of a log where it is not stated.

    Of interpolated twists, `parts` of a sample, the white noise is that of the samples: each part has it
    `sqrt(parts)` times, so that the parts of a sample move the vehicle as uncertainly as the sample held.
    """
    if log.odometry_stated:
        log = replace(log, odometry_sigma=log.odometry_sigma * np.sqrt(parts))
    if log.odometry_stated and log.detections_stated:
        return log
    settings = MapperSettings(kind=log.sensor.kind)
    at_one = log.at_scale_one()
    samples = Odometry(at_one.odometry.t[::parts], at_one.odometry.twist[::parts])
    measured = measure_noise(seen_cycles(at_one, settings), samples, of_lines=settings.kind == "line")
    if measured is None:
        return log
    white = measured.odometry * np.sqrt(parts)
    measured = scaled(replace(measured, odometry=white, interval=measured.interval / parts), log.scale)
    log = replace(log, measured=measured)
    if not log.odometry_stated:
        sigma = np.maximum(measured.odometry, 1e-6)  # a vy that is always 0 has none, and a header wants some
        log = replace(log, odometry_sigma=sigma, odometry_drift=measured.drift)
    if log.detections_stated:
        return log
    known = ((cycle, measured.covariances(cycle.points_vehicle, inflated=False)) for cycle in log.cycles)
    return replace(
        log, cycles=tuple(cycle if K is None else replace(cycle, covariances=K) for cycle, K in known)
    )


# --- `simulate`: the log of a drive on a track from a file, or on a generated one -----------------------


def simulate_command(options: Simulate) -> Outcome:
    check_target(options.out, LOG_FILE, force=options.force)
    if [options.track, options.generate, options.event].count(None) != 2:
        raise SettingsError("simulate: expected one of --track FILE, --generate SEED or --event NAME")
    with progress("driving"):
        if options.track is not None:
            track = read_track(options.track)
        elif options.generate is not None:
            track = generated_track(options.generate, options.generator)
        else:
            track = EVENTS[str(options.event)]()
        log = simulate(track, options.settings, options.seed)
        write_log(log, options.out, force=options.force)
    say(describe(log))
    return Outcome([options.out])


def generated_track(seed: int, settings: TrackGeneratorSettings | None = None) -> Track:
    """Generated track of a seed."""
    if seed < 0:
        raise SettingsError(f"seed of a generated track: expected at least 0, found {seed}")
    return generate_track(np.random.default_rng(seed), settings)


def describe(log: Log) -> str:
    """Length of the log in words."""
    detections = sum(len(cycle.labels) for cycle in log.cycles)
    seconds = log.odometry.t[-1] - log.odometry.t[0]
    return f"{seconds:.1f} s, {len(log.cycles)} perception cycles, {detections} detections"


# --- `export`: a map in the formats of planners and other tools -----------------------------------------

GRAPHS: Final = ("graph", "g2o", "dot")  # formats of a factor graph


def export_command(options: Export) -> Outcome:
    check_file_target(options.out)
    if not LEAST_STEP <= options.step < np.inf:
        expected = f"expected a number of at least {LEAST_STEP:g} m"
        raise SettingsError(f"--step: {expected}, found {options.step:g}")
    if options.format != "profile" and (options.stop or options.start_speed is not None):
        raise SettingsError(f"--start-speed, --stop: expected --as profile, found --as {options.format}")
    if options.format in ("geojson", "lanelet2") and options.origin is None:
        expected = "expected LATITUDE LONGITUDE HEADING in degrees, the heading clockwise from north"
        raise SettingsError(f"--origin: {expected}, found none, which --as {options.format} needs")
    plane = None if options.origin is None else formats.LocalPlane(*options.origin)
    if options.format in GRAPHS:
        return export_graph(options.map / GRAPH_FILE, options.format, options.out)
    file = options.map / MAP_FILE
    if options.format == "tum" and not file.exists() and (options.map / LOG_FILE).exists():
        truth = read_log(options.map).truth
        if truth is None or len(truth.poses) == 0:
            raise InputError(options.map, f"expected a log with {TRUTH_POSES_FILE}, or a map, found neither")
        with atomic_file(options.out) as temporary:
            write_trajectory(temporary, truth.pose_t, truth.poses)
        return Outcome([options.out])
    track = read_map(options.map)
    most = MOST_POINTS * options.step
    for curve in track.splines.values():
        if (length := curve.length()) > most:
            expected = f"expected curves of at most {most:g} m at this step"
            raise InputError(file, f"{expected}, found {length:.6g} m")
    if options.format not in ("points", "tum"):  # the others say where to drive
        files = (options.map / name for name in (SMOOTHED_FILE, TRAJECTORY_FILE))
        for driven in [file for file in files if file.exists()][:1]:
            path, cycles = read_trajectory(driven)[1], options.map / CYCLES_FILE
            health = [*read_table(cycles).columns.get("health", ())] if cycles.exists() else []
            if crossed := crossings_told(crossings_on(track, path, health)):
                raise InputError(file, f"expected the map of the drive in {driven.name}: {crossed}")
    with atomic_file(options.out) as temporary:
        try:
            _write(options, temporary, track, plane)
        except SettingsError as error:
            raise InputError(file, str(error)) from None
    return Outcome([options.out])


def _write(options: Export, file: Path, track: Map, plane: formats.LocalPlane | None) -> None:
    if options.format == "centerline":
        formats.write_centre_line(file, track, options.step)
    elif options.format == "profile":
        begin, stop = options.start_speed, options.stop
        formats.write_profile(file, track, options.step, options.speed, begin, stop)
    elif options.format == "points":
        formats.write_points(file, track, options.step)
    elif options.format == "tum":
        read_trajectory(options.map / TRAJECTORY_FILE)  # or it is refused
        shutil.copyfile(options.map / TRAJECTORY_FILE, file)
    elif plane is not None:
        write = formats.write_geojson if options.format == "geojson" else formats.write_lanelet2
        write(file, track, options.step, plane)


def export_graph(file: Path, form: str, out: Path) -> Outcome:
    """Write the factor graph of a batch for GTSAM, Graphviz or g2o; InputError where there is none."""
    if not file.exists():
        raise InputError(file, "expected a factor graph, which batch --graph writes, found none")
    try:
        graph, values = read_graph(file, "pose_graph" if form == "g2o" else "graph")
        whole = read_graph(file)[0].size() if form == "g2o" else 0
    except (KeyError, RuntimeError, ValueError) as error:
        raise InputError(file, f"expected a factor graph of batch --graph, found {error!r}") from error
    with atomic_file(out) as temporary:
        if form == "graph":
            shutil.copyfile(file, temporary)
        elif form == "dot":
            temporary.write_text(graph.dot(values), encoding="utf-8")
        else:
            write_g2o(temporary, graph, values)
    if form == "g2o":
        left_out = whole - graph.size()
        note(f"g2o holds poses and what relates two of them: {left_out} other factors are left out")
    return Outcome([out])
