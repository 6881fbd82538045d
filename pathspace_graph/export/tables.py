"""A map as CSV: its centre line with widths, and its boundaries as points."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary
from pathspace_graph.labels import NAMES
from pathspace_graph.settings.output import SpeedSettings
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.planning import speed_profile

Array = NDArray[np.float64]

CENTRE_LINE_HEADER: Final = "# x_m,y_m,w_tr_right_m,w_tr_left_m"
"""This is the header of TUM's raceline format; its reader takes the line for a comment."""
PROFILE_HEADER: Final = "# s_m,x_m,y_m,psi_rad,kappa_radpm,vx_mps,ax_mps2"
"""These are the columns of TUM's trajectories."""
POINTS_HEADER: Final = "x,y,label"
"""This is the header of a table of points, as that of a log's true cones."""
_FEWEST_INTERVALS: Final = 4
"""A boundary is sampled at this number of intervals at least."""


def write_centre_line(file: Path, track: Map, step: float) -> None:
    """Writes the centre line in TUM's raceline format, in m, `step` (m) apart, to full precision.

    The first point of a closed line isn't repeated.
    """
    line = track.centre_line(step)
    rows = np.column_stack([line.points, line.width_right, line.width_left])
    _write(file, [CENTRE_LINE_HEADER, *(",".join(map(repr, row)) for row in rows.tolist())])


def write_profile(
    file: Path,
    track: Map,
    step: float,
    settings: SpeedSettings,
    start: float | None = None,
    stop: bool = False,
) -> None:
    """Writes the centre line with heading, curvature, speed and acceleration (m, rad, 1/m, m/s, m/s^2).

    The columns are those of TUM's trajectories. The heading is measured from the x axis of the map. An open
    line begins at the speed `start` (m/s), where it is given, and may end at a stop. SettingsError is raised
    where the vehicle cannot begin so fast.
    """
    line = track.centre_line(step)
    profile = speed_profile(line, settings, start, 0.0 if stop else None)
    if start is not None and profile.speed[0] < start:
        raise SettingsError(
            f"expected a start speed of at most {profile.speed[0]:.3g} m/s on this line, found {start:g}"
        )
    columns = (
        line.arc_length,
        line.points,
        line.heading,
        line.curvature,
        profile.speed,
        profile.acceleration,
    )
    rows = np.column_stack(columns)
    _write(file, [PROFILE_HEADER, *(",".join(map(repr, row)) for row in rows.tolist())])


def write_points(file: Path, track: Map, step: float) -> None:
    """Writes the boundaries as points in m, `step` (m) apart along each, and orange cones, to full precision.

    The landmarks of a boundary that is no curve are written as they are.
    """
    lines = [
        f"{x!r},{y!r},{NAMES[label]}"
        for label, boundary in sorted([*track.boundaries.items(), *track.points.items()])
        for x, y in boundary_points(boundary, step).tolist()
    ]
    _write(file, [POINTS_HEADER, *lines])


def boundary_points(boundary: MapBoundary, step: float) -> Array:
    """Returns points (n, 2) of a boundary about `step` (m) apart along it, or its landmarks.

    The points of an open curve begin and end at its ends; the first of a closed one isn't repeated.
    """
    if isinstance(boundary, PointBoundary):
        return boundary.points
    return sampled(boundary.spline, step)


def sampled(spline: BSpline, step: float) -> Array:
    """Returns points (n, 2) of a curve evenly spaced by arc length, about `step` (m) apart."""
    length = spline.length()
    count = max(round(length / step), _FEWEST_INTERVALS)
    at = np.linspace(0.0, length, count + 1)
    return spline.evaluate(spline.parameters_at(at[:-1] if spline.periodic else at))


def _write(file: Path, lines: list[str]) -> None:
    file.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
