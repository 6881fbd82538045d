"""`export`: a map in the formats of planners and other tools."""

import shutil
from pathlib import Path

import numpy as np

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.health import LOST
from pathspace_graph.io import export as formats
from pathspace_graph.io.export import LocalPlane
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import LOG_FILE, TRUTH_POSES_FILE
from pathspace_graph.io.log_files import read_log
from pathspace_graph.io.map import MAP_FILE, Map, read_map
from pathspace_graph.io.results import CYCLES_FILE, SMOOTHED_FILE, TRAJECTORY_FILE, write_trajectory
from pathspace_graph.io.tables import read_table, read_trajectory
from pathspace_graph.options.runs import Export
from pathspace_graph.spline.ahead import LEAST_STEP, MOST_POINTS
from pathspace_graph.spline.boundary import crossed_boundaries, crossings_told

from .outcome import Outcome


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
    plane = None if options.origin is None else LocalPlane(*options.origin)
    file = options.map / MAP_FILE
    if options.format == "tum" and not file.exists() and (options.map / LOG_FILE).exists():
        write_true_path(options.map, options.out)
        return Outcome([options.out])
    track = read_map(options.map)
    most = MOST_POINTS * options.step
    for curve in track.splines.values():
        if (length := curve.length()) > most:
            expected = f"expected curves of at most {most:g} m at this step"
            raise InputError(file, f"{expected}, found {length:.6g} m")
    if options.format not in ("points", "tum"):  # the others say where to drive
        check_crossings(track, options.map)
    with atomic_file(options.out) as temporary:
        try:
            _write(options, temporary, track, plane)
        except SettingsError as error:
            raise InputError(file, str(error)) from None
    return Outcome([options.out])


def _write(options: Export, file: Path, track: Map, plane: LocalPlane | None) -> None:
    if options.format == "centerline":
        formats.write_centre_line(file, track, options.step)
    elif options.format == "profile":
        formats.write_profile(file, track, options.step, options.speed, options.start_speed, options.stop)
    elif options.format == "points":
        formats.write_points(file, track, options.step)
    elif options.format == "tum":
        read_trajectory(options.map / TRAJECTORY_FILE)  # or it is refused
        shutil.copyfile(options.map / TRAJECTORY_FILE, file)
    elif plane is not None:
        write = formats.write_geojson if options.format == "geojson" else formats.write_lanelet2
        write(file, track, options.step, plane)


def write_true_path(folder: Path, out: Path) -> None:
    """Write the true poses of a log in the TUM format; InputError where they are not known."""
    truth = read_log(folder).truth
    if truth is None or len(truth.poses) == 0:
        raise InputError(folder, f"expected a log with {TRUTH_POSES_FILE}, or a map, found neither")
    with atomic_file(out) as temporary:
        write_trajectory(temporary, truth.pose_t, truth.poses)


def check_crossings(track: Map, folder: Path) -> None:
    """Raise an InputError where the vehicle drove across a boundary, if its trajectory is in the folder."""
    files = (folder / name for name in (SMOOTHED_FILE, TRAJECTORY_FILE))
    file = next((file for file in files if file.exists()), None)
    if file is None:
        return
    path, cycles = read_trajectory(file)[1][:, :2], folder / CYCLES_FILE
    health = read_table(cycles, {}).columns.get("health", ()) if cycles.exists() else ()
    lost = np.array([condition == LOST for condition in health], bool)
    known = ~lost if len(lost) == len(path) else None
    crossed = crossings_told(crossed_boundaries(track.splines, path, known))
    if crossed:
        raise InputError(folder / MAP_FILE, f"expected the map of the drive in {file.name}: {crossed}")
