"""`export`: a map in the formats of planners and other tools."""

import shutil
from pathlib import Path
from typing import Final

import numpy as np

from pathspace_graph.console import note
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.graph.exchange import GRAPH_FILE, read_graph, write_g2o
from pathspace_graph.io import export as formats
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import LOG_FILE, TRUTH_POSES_FILE
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE, write_trajectory
from pathspace_graph.io.tables import read_table, read_trajectory
from pathspace_graph.options.runs import Export
from pathspace_graph.plausibility.diagnosis import crossings_on
from pathspace_graph.spline.boundary import crossings_told
from pathspace_graph.spline.planning import LEAST_STEP, MOST_POINTS

from .simulate import Outcome

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
