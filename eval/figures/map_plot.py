"""Pictures of a map, with its 2-sigma band and the truth if known, and of a log before it is mapped."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.accuracy import mapped_points
from pathspace_graph.eval.metrics.alignment import MapsApart
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.health import DEGRADED, LOST
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary
from pathspace_graph.labels import BIG_ORANGE, LEFT, NAMES, POINTS, RIGHT, UNKNOWN

from . import style
from .style import BLUE, DARK, GREEN, GREY, ORANGE, PURPLE, RED, WIDTH, Picture

MARGIN: Final = 3.0  # free space around what is drawn (m)
BOUNDARY_COLORS: Final = {LEFT: BLUE, RIGHT: ORANGE}  # those of their cones; yellow is amber, seen on white
TRAJECTORY_COLOR: Final = GREEN
HEALTH_COLORS: Final = {DEGRADED: PURPLE, LOST: RED}
LABEL_COLORS: Final = {**BOUNDARY_COLORS, UNKNOWN: GREY, **dict.fromkeys(POINTS, RED)}
BAND_ALPHA: Final = 0.35
PATH_WIDTH: Final = 0.6  # width of the trajectory (pt); the true path is thinner
LANDMARK_SIZE: Final = 1.4  # size of landmarks (pt), small enough for their ellipses to be seen


def plot_map(
    track: Map,
    *,
    log: Log | None = None,
    trajectory: Array | None = None,
    smoothed: Array | None = None,
    health: Sequence[str] = (),
    differences: Sequence[tuple[float, float]] = (),
    band_scale: float = 1.0,
    title: str | None = None,
) -> Picture:
    """Draw the map in metres, with equal scales and the band S(u) +- 2 band_scale sigma(u) n(u).

    `log` adds the true cones and the true path where it has truth; trajectory (n, 3) or (n, 2), map frame.
    It is drawn in another colour where the `health` of its n cycles is not good. Beside a `smoothed` one
    (n, 3) it is drawn thin, as the poses that were estimated at their time.
    The `differences` are places that are not where a known map has them, each marked by a cross.
    The band is cut at 3 m, as at the open end of a road. The legend says so where a `band_scale` other than
    1 draws it wider than it is.
    """
    if not band_scale > 0.0:
        raise SettingsError(f"band_scale: expected a positive number, found {band_scale}")
    with style.figure_context():
        figure = Picture(layout="constrained")
        axes = figure.add_subplot(title=title or "")
        # the legend names what is drawn first before the rest; zorder decides what lies on top
        for label, boundary in sorted(track.boundaries.items()):
            draw_boundary(axes, boundary, label, band_scale)
        for label, cones in sorted(track.points.items()):
            size = (2.0 if label == BIG_ORANGE else 1.2) * LANDMARK_SIZE
            text = f"{NAMES[label].replace('_', ' ')} cones"
            style.draw_points(axes, cones.points, "^", RED, text, markersize=size, zorder=4.5)
        if len(differences):
            places = np.array(differences)
            style.draw_points(axes, places, "x", PURPLE, "not as the known map", markersize=5.0, zorder=4.6)
        if log is not None and log.truth is not None:
            draw_truth(axes, log.truth)
        if smoothed is not None and trajectory is not None and len(smoothed):
            label = "poses as estimated at their time"
            draw_trajectory(axes, np.asarray(trajectory), label=label, width=0.25)
            trajectory = smoothed
        if trajectory is not None and len(trajectory):
            draw_trajectory(axes, np.asarray(trajectory), health)
        finish(figure, [axes])
    return figure


def draw_boundary(axes: Axes, boundary: MapBoundary, label: int, band_scale: float = 1.0) -> None:
    """Draw a curve with its band and control points, or landmarks with their ellipses, in the map frame."""
    color, name = BOUNDARY_COLORS[label], NAMES[label]
    exaggerated = "" if band_scale == 1.0 else f" (drawn {band_scale:g}× as wide)"
    if isinstance(boundary, PointBoundary):
        ellipses = style.ellipse_outlines(boundary.points, boundary.covariance, band_scale)
        area: dict[str, Any] = {"facecolor": color, "alpha": BAND_ALPHA, "linewidth": 0.0, "zorder": 2}
        text = f"{name} {style.SIGMAS:g}σ ellipses{exaggerated}"
        axes.add_collection(PolyCollection(list(ellipses), label=text, **area))
        look_of = {"markersize": LANDMARK_SIZE, "zorder": 4}
        style.draw_points(axes, boundary.points, "o", color, f"{name} landmarks", **look_of)
        return
    spline, text = boundary.spline, f"{name} {style.SIGMAS:g}σ band{exaggerated}"
    if boundary.covariance.size:  # the outline of a map has none
        style.draw_band(axes, boundary, color, text, band_scale, alpha=BAND_ALPHA)
    until = boundary.confirmed_until
    style.draw_curve(axes, spline, color, f"{name} boundary", stretch=(-np.inf, until), zorder=4)
    if until < spline.domain[1]:
        dashed: dict[str, Any] = {"linestyle": (0, (4, 2)), "zorder": 4}
        style.draw_curve(axes, spline, color, f"{name} tentative", stretch=(until, np.inf), **dashed)
    squares: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.6, "zorder": 5}
    points, text = spline.distinct_control_points, f"{name} control points"
    style.draw_points(axes, points, "s", color, text, **squares)


def draw_trajectory(
    axes: Axes,
    trajectory: Array,
    health: Sequence[str] = (),
    label: str = "trajectory",
    width: float = PATH_WIDTH,
) -> None:
    """Draw poses (n, 3) or positions (n, 2) as a line, map frame (m), and what wasn't healthy in colour."""
    axes.plot(*trajectory[:, :2].T, label=label, color=TRAJECTORY_COLOR, linewidth=width, zorder=3)
    for condition, color in HEALTH_COLORS.items():
        chosen = np.array([word == condition for word in health], bool)
        if len(chosen) == len(trajectory) and chosen.any():
            unhealthy = np.where(chosen[:, None], trajectory[:, :2], np.nan).T
            axes.plot(*unhealthy, label=condition, color=color, linewidth=2.0 * width, zorder=3.2)


def draw_truth(axes: Axes, truth: Truth) -> None:
    """Draw the true path dashed and the true cones as crosses, as far as they are known, map frame (m)."""
    if len(truth.poses):
        line: dict[str, Any] = {"linewidth": 0.6 * PATH_WIDTH, "linestyle": (0, (5, 3)), "zorder": 3.5}
        axes.plot(*truth.poses[:, :2].T, color=DARK, label="true path", **line)
    if len(truth.cones):
        cross = {"markeredgewidth": 0.6}
        style.draw_points(axes, truth.cones, "x", DARK, "true cones", **cross)


def finish(figure: Figure, panels: Sequence[Axes], columns: int = 1) -> None:
    """Mark the start, add frame, axis titles and legend, and give a figure the shape of its maps."""
    for axes in panels:  # the origin of the map frame, where the vehicle stood first, heading along x
        size = 2.0 * style.MARKER_SIZE
        style.draw_points(axes, np.zeros((1, 2)), ">", "black", "start", markersize=size, zorder=7)
        axes.margins(0.0)
        axes.autoscale_view()
    drawn = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in panels])
    low, high = drawn[:, :, 0].min(axis=0) - MARGIN, drawn[:, :, 1].max(axis=0) + MARGIN
    for axes in panels:
        axes.set(
            aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]"
        )
        axes.label_outer()
    style.shared_legend(figure)
    (width, height), rows = high - low, -(-len(panels) // columns)
    figure.set_size_inches(WIDTH, min(7.5, rows * WIDTH / columns * height / width + 0.85))


def plot_maps(maps: Mapping[str, tuple[Map, Array]], truth: Truth | None) -> Picture:
    """Draw maps and driven paths (n, 3) side by side over the truth, each below its title."""
    columns = 1 if len(maps) == 1 else 2 if len(maps) <= 4 else 3
    with style.figure_context():
        figure = Picture(layout="compressed")
        grid = figure.subplots(-(-len(maps) // columns), columns, sharex=True, sharey=True, squeeze=False)
        for axes, (title, (track, path)) in zip(grid.flat, maps.items(), strict=False):
            for label, boundary in sorted(track.boundaries.items()):
                draw_boundary(axes, boundary, label)
            if truth is not None:
                draw_truth(axes, truth)
            draw_trajectory(axes, path)
            axes.set_title(title)
        for axes in grid.flat[len(maps) :]:
            axes.remove()
        finish(figure, [*grid.flat][: len(maps)], columns)
    return figure


def plot_apart(first: Map, second: Map, apart: MapsApart, *, title: str | None = None) -> Picture:
    """Draw two maps, the first laid on the second, and how far they are apart there, in colours."""
    with style.figure_context():
        figure = Picture(layout="constrained")
        axes = figure.add_subplot(title=title or "")
        for track, color, name in ((first.moved(apart.motion), BLUE, "first"), (second, DARK, "second")):
            for boundary in track.boundaries.values():
                points = mapped_points(boundary)
                if isinstance(boundary, PointBoundary):
                    style.draw_points(axes, points, "o", color, name, markersize=1.4, zorder=3)
                else:
                    style.draw_curve(axes, boundary.spline, color, name, zorder=3)
        points = np.concatenate([*apart.points.values()])
        distances = np.concatenate([*apart.distances.values()])
        order = np.argsort(distances)
        x, y = points[order].T
        dots: dict[str, Any] = {"s": 9.0, "cmap": "YlOrRd", "vmin": 0.0, "linewidths": 0.0, "zorder": 2}
        drawn = axes.scatter(x, y, c=distances[order], **dots)
        figure.colorbar(drawn, ax=axes, label="distance from the other map [m]", shrink=0.8)
        finish(figure, [axes])
    return figure


def plot_log(log: Log, *, title: str | None = None) -> Picture:
    """Draw where the odometry alone leads, the detections seen from there, and the truth if it is known.

    Dead reckoning drifts: laps lie beside each other, and the detections of a cone apart.
    """
    odometry, stamps = log.odometry, np.array([cycle.t for cycle in log.cycles])
    poses = odometry.poses()
    with style.figure_context():
        figure = Picture(layout="constrained")
        axes = figure.add_subplot(title=title or "")
        # a cycle lies between two odometry stamps: its pose is interpolated, which a picture can bear
        at = np.column_stack([np.interp(stamps, odometry.t, column) for column in poses.T])
        seen = np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in log.cycles)])
        labels = np.concatenate([np.zeros(0, int), *(cycle.labels for cycle in log.cycles)])
        points = to_map(seen, np.repeat(at, [len(cycle.labels) for cycle in log.cycles], axis=0))
        dots = {"markersize": 1.2, "zorder": 2, "alpha": 0.4}
        for label in (label for label in LABEL_COLORS if (labels == label).any()):
            text, own = f"{NAMES[label].replace('_', ' ')} detections", points[labels == label]
            style.draw_points(axes, own, ".", LABEL_COLORS[label], text, **dots)
        line: dict[str, Any] = {"color": TRAJECTORY_COLOR, "linewidth": PATH_WIDTH, "zorder": 3}
        axes.plot(*poses[:, :2].T, label="odometry alone", **line)
        if log.truth is not None:
            draw_truth(axes, log.truth)
        finish(figure, [axes])
    return figure
