"""`export`: a map in the formats of planners and other tools."""

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.io import export as formats
from pathspace_graph.io.export import LocalPlane
from pathspace_graph.io.files import atomic_file, check_file_target
from pathspace_graph.io.log import LOG_FILE, TRUTH_POSES_FILE, read_log
from pathspace_graph.io.map import MAP_FILE, Map, SplineBoundary, read_map
from pathspace_graph.io.results import SMOOTHED_FILE, TRAJECTORY_FILE, read_trajectory, write_trajectory
from pathspace_graph.settings.output import SpeedSettings
from pathspace_graph.spline.ahead import LEAST_STEP, MOST_POINTS
from pathspace_graph.spline.crossing import crossed_boundaries, crossings_told

Format = Literal["centerline", "tum", "geojson", "points", "lanelet2", "profile"]
ALONG_THE_ROAD = ("centerline", "profile", "geojson", "lanelet2")  # formats that say where to drive
ON_EARTH = ("geojson", "lanelet2")  # formats that have latitude and longitude


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a map in a format that planners and other tools read."""

    map: Positional[Path]
    """Folder of the map. With `tum` it may also be a log, whose true path is written."""
    format: Annotated[Format, arg(name="as")]
    """Format of the file: the centre line with widths as TUM raceline CSV (`centerline`), the trajectory in
    the TUM format (`tum`), boundaries and centre line as GeoJSON (`geojson`), both boundaries as CSV with the
    columns x, y and label (`points`), both boundaries with lanelets as OSM XML (`lanelet2`), or the centre
    line with the speed that friction and curvature allow as CSV (`profile`)."""
    out: Path
    """File for the result, or standard output (`-`); an earlier file is kept as a numbered backup."""
    step: float = 1.0
    """Distance of the points along a curve (m)."""
    origin: tuple[float, float, float] | None = None
    """Latitude and longitude of the map's origin (degrees, WGS84), and heading of its x axis, which is the
    way that the vehicle faced at the start (degrees, clockwise from north). `geojson` and `lanelet2` need
    them."""
    speed: SpeedSettings = field(default_factory=SpeedSettings)
    """Vehicle of a `profile`."""
    start_speed: float | None = None
    """Speed at which the `profile` of an open track begins (m/s), by default what its curvature allows."""
    stop: bool = False
    """End the `profile` of an open track at a standstill."""

    def run(self) -> None:
        check_file_target(self.out)
        if not LEAST_STEP <= self.step < np.inf:
            expected = f"expected a number of at least {LEAST_STEP:g} m"
            raise SettingsError(f"--step: {expected}, found {self.step:g}")
        if self.format != "profile" and (self.stop or self.start_speed is not None):
            raise SettingsError(f"--start-speed, --stop: expected --as profile, found --as {self.format}")
        plane = self._plane()
        file = self.map / MAP_FILE
        if self.format == "tum" and not file.exists() and (self.map / LOG_FILE).exists():
            write_true_path(self.map, self.out)
            return
        track = read_map(self.map)
        check_length(track, self.step, file)
        if self.format in ALONG_THE_ROAD:
            check_crossings(track, self.map)
        with atomic_file(self.out) as temporary:
            try:
                self._write(temporary, track, plane)
            except SettingsError as error:
                raise InputError(file, str(error)) from None

    def _write(self, file: Path, track: Map, plane: LocalPlane | None) -> None:
        if self.format == "centerline":
            formats.write_centre_line(file, track, self.step)
        elif self.format == "profile":
            formats.write_profile(file, track, self.step, self.speed, self.start_speed, self.stop)
        elif self.format == "points":
            formats.write_points(file, track, self.step)
        elif self.format == "tum":
            read_trajectory(self.map / TRAJECTORY_FILE)  # or it is refused
            shutil.copyfile(self.map / TRAJECTORY_FILE, file)
        elif plane is not None:
            write = formats.write_geojson if self.format == "geojson" else formats.write_lanelet2
            write(file, track, self.step, plane)

    def _plane(self) -> LocalPlane | None:
        if self.origin is not None:
            return LocalPlane(*self.origin)
        if self.format in ON_EARTH:
            expected = "expected LATITUDE LONGITUDE HEADING in degrees, the heading clockwise from north"
            raise SettingsError(f"--origin: {expected}, found none, which --as {self.format} needs")
        return None


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
    crossed = crossings_told(crossed_boundaries(track.splines, read_trajectory(file)[1][:, :2]))
    if crossed:
        raise InputError(folder / MAP_FILE, f"expected the map of the drive in {file.name}: {crossed}")


def check_length(track: Map, step: float, file: Path) -> None:
    """Raise an InputError where a curve has too many points at this step (m)."""
    most = MOST_POINTS * step
    for boundary in track.boundaries.values():
        length = boundary.spline.length() if isinstance(boundary, SplineBoundary) else 0.0
        if length > most:
            expected = f"expected curves of at most {most:g} m at this step"
            raise InputError(file, f"{expected}, found {length:.6g} m")
