"""Pictures: how all figures look, the marks they are drawn with, their files; maps with the truth; logs."""

from collections.abc import Mapping, Sequence
from functools import partial
from io import BytesIO
from math import ceil
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from pathspace_graph import labels as kinds
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.alignment import MapsApart
from pathspace_graph.factors.arrays import Array
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.health import DEGRADED, LOST
from pathspace_graph.io.files import atomic_file, check_file_target, is_stream
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import BOUNDARIES, NAMES
from pathspace_graph.spline.bspline import BSpline

WIDTH: Final = 7.0  # width of a figure (in): two columns of a paper
MARKER_SIZE: Final = 2.6  # size of a control point or a detection (pt)

BLUE: Final = "#0067A9"
ORANGE: Final = "#D98200"
GREEN: Final = "#009E73"
RED: Final = "#CC0000"
PURPLE: Final = "#7B3294"
DARK: Final = "#4D4D4D"
GREY: Final = "#8C8C8C"
LIGHT: Final = "#B0B0B0"
# every kind of colour vision tells blue from orange, and so does a print without colours
PALETTE: Final = (BLUE, ORANGE, RED, PURPLE, GREEN, DARK)

figure_context: Final = partial(
    mpl.rc_context,
    {
        **dict.fromkeys(("font.size", "figure.labelsize", "axes.titlesize"), 8.0),
        "axes.titlelocation": "left",
        "axes.linewidth": 0.6,
        "grid.linewidth": 0.3,
        "grid.alpha": 0.5,
        **{f"{axis}tick.major.width": 0.6 for axis in "xy"},
        **{f"{axis}tick.major.size": 2.5 for axis in "xy"},
        "legend.fontsize": 7.5,
        "legend.frameon": False,
        "legend.handlelength": 1.8,
        "legend.columnspacing": 1.4,
    },
)
"""Context in which figures have the fonts and lines that they share."""
SIGMAS: Final = 2.0  # standard deviations to the edge of a band or an ellipse
FORMATS: Final = (".png", ".pdf", ".svg")  # suffixes under which a figure can be saved
SUFFIXES: Final = (".png", ".pdf")  # formats of commands that write several figures: to look at, to print
DPI: Final = 200.0  # resolution of a png (dots per inch)


class Picture(Figure):
    """Figure that a notebook shows, whether or not it has a backend of matplotlib."""

    def _repr_png_(self) -> bytes:
        buffer = BytesIO()
        self.savefig(buffer, format="png", dpi=DPI)
        return buffer.getvalue()


def shared_legend(figure: Figure) -> None:
    """Add one legend for all panels below them, of three rows: the left boundary, the right one, the rest."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    sides = [NAMES[label] for label in BOUNDARIES]
    names = sorted(entries, key=lambda label: [not label.startswith(side) for side in sides])
    handles, columns = [entries[name] for name in names], max(ceil(len(names) / 3), 1)
    figure.legend(handles, names, loc="outside lower center", ncols=columns)


# --- marks -----------------------------------------------------------------------------------------------


def curve_parameters(spline: BSpline, samples_per_span: int = 24) -> Array:
    """Return parameters (k,) at equal steps on each span, both ends of the domain included."""
    breaks = spline.breaks
    fractions = np.arange(samples_per_span) / samples_per_span
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * fractions
    return np.append(inner.ravel(), breaks[-1])


def uncertainty_band(boundary: SplineBoundary, u: Array, scale: float = 1.0) -> tuple[Array, Array]:
    """Return the left and right edge (k, 2), S(u) +- scale min(2 sigma(u), 3 m) n(u).

    A curve with a wider band is not known.
    """
    spline = boundary.spline
    half = scale * np.minimum(SIGMAS * spline.normal_sigma(u, boundary.covariance), 3.0)
    offsets = half[:, None] * spline.normal_unit(u)
    centre = spline.evaluate(u)
    return centre + offsets, centre - offsets


def curve_parts(boundary: SplineBoundary, samples_per_span: int = 24) -> tuple[Array, Array]:
    """Return points (k, 2) on the confirmed curve, and on its tentative end (j, 2), which may be none."""
    u, until = curve_parameters(boundary.spline, samples_per_span), boundary.confirmed_until
    shared = [until] if until < u[-1] else []
    parts = np.append(u[u <= until], shared), np.append(shared, u[u > until])
    confirmed, tentative = map(boundary.spline.evaluate, parts)
    return confirmed, tentative


def draw_points(
    axes: Axes, points: Array, marker: str, color: str, label: str | None = None, **options: Any
) -> None:
    """Draw a marker at each point (k, 2)."""
    options = {"markersize": MARKER_SIZE, "zorder": 6, **options}
    axes.plot(*points.T, linestyle="none", marker=marker, color=color, label=label, **options)


def ellipse_outlines(points: Array, joint: Array, scale: float = 1.0) -> Array:
    """Return the 2-sigma ellipse of each point (m, 2), `scale` times as large, as a closed line (m, 33, 2).

    The joint covariance (2m, 2m) is over x0, y0, x1, y1 and so on.
    """
    m = np.arange(len(points))
    blocks = joint.reshape(len(points), 2, len(points), 2)[m, :, m, :]  # covariance of each point (m, 2, 2)
    variances, vectors = np.linalg.eigh(blocks)
    angles = np.linspace(0.0, 2.0 * np.pi, 33)
    circle = SIGMAS * scale * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    axes = vectors * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
    return np.asarray(points[:, None] + np.einsum("cj,mij->mci", circle, axes))


# --- files -----------------------------------------------------------------------------------------------


def check_plot_file(file: Path | str) -> str:
    """Return the suffix of `file`, or .png for a stream; raise an error where no picture can be written."""
    check_file_target(file)
    suffix = Path(file).suffix.lower()
    if suffix not in FORMATS and is_stream(Path(file)):
        return FORMATS[0]
    if suffix not in FORMATS:
        raise SettingsError(f"{file}: expected a file name that ends in {', '.join(FORMATS)}")
    return suffix


def save_plot(figure: Figure, file: Path | str, dpi: float = DPI) -> None:
    """Write a .png (also to a stream), .pdf or .svg; raise SettingsError for any other suffix."""
    suffix = check_plot_file(file)
    # what would differ from one run to the next is left out, and text stays text in vector formats
    metadata = {{".png": "Software", ".pdf": "CreationDate", ".svg": "Date"}[suffix]: None}
    same = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pathspace"}
    with atomic_file(Path(file)) as temporary, mpl.rc_context(same):
        figure.savefig(temporary, dpi=dpi, format=suffix[1:], metadata=metadata)


def save_figures(folder: Path, figures: Mapping[str, Figure]) -> None:
    """Write every figure under its name in `folder`, in the place of an earlier one."""
    for name, figure in figures.items():
        for suffix in SUFFIXES:
            save_plot(figure, folder / f"{name}{suffix}")


# --- maps and logs --------------------------------------------------------------------------------------

# those of their cones; yellow is amber, seen on white
BOUNDARY_COLORS: Final = {kinds.LEFT: BLUE, kinds.RIGHT: ORANGE}
HEALTH_COLORS: Final = {DEGRADED: PURPLE, LOST: RED}
LABEL_COLORS: Final = {**BOUNDARY_COLORS, kinds.UNKNOWN: GREY, **dict.fromkeys(kinds.POINTS, RED)}
CURVE_WIDTH: Final = 0.7  # width of a curve (pt)
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
    with figure_context():
        figure = Picture(layout="constrained")
        axes = figure.add_subplot(title=title or "")
        # the legend names what is drawn first before the rest; zorder decides what lies on top
        for label, boundary in sorted(track.boundaries.items()):
            draw_boundary(axes, boundary, label, band_scale)
        for label, cones in sorted(track.points.items()):
            size = (2.0 if label == kinds.BIG_ORANGE else 1.2) * LANDMARK_SIZE
            text = f"{NAMES[label].replace('_', ' ')} cones"
            draw_points(axes, cones.points, "^", RED, text, markersize=size, zorder=4.5)
        if len(differences):
            places = np.array(differences)
            draw_points(axes, places, "x", PURPLE, "not as the known map", markersize=5.0, zorder=4.6)
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
    area: dict[str, Any] = {"facecolor": color, "alpha": 0.35, "linewidth": 0.0, "zorder": 2}
    if isinstance(boundary, PointBoundary):
        ellipses = ellipse_outlines(boundary.points, boundary.covariance, band_scale)
        text = f"{name} {SIGMAS:g}σ ellipses{exaggerated}"
        axes.add_collection(PolyCollection(list(ellipses), label=text, **area))
        look_of = {"markersize": LANDMARK_SIZE, "zorder": 4}
        draw_points(axes, boundary.points, "o", color, f"{name} landmarks", **look_of)
        return
    spline, text = boundary.spline, f"{name} {SIGMAS:g}σ band{exaggerated}"
    if boundary.covariance.size:  # the outline of a map has none
        left, right = uncertainty_band(boundary, curve_parameters(spline), band_scale)
        outline = Outline(np.concatenate([left, right[::-1], left[:1]]), closed=True)
        if spline.periodic:  # a ring, with edges in opposite directions
            edges = Outline(left, closed=True), Outline(right[::-1], closed=True)
            outline = Outline.make_compound_path(*edges)
        axes.add_patch(PathPatch(outline, label=text, **area))
    confirmed, tentative = curve_parts(boundary)
    line: dict[str, Any] = {"color": color, "linewidth": CURVE_WIDTH, "zorder": 4}
    axes.plot(*confirmed.T, label=f"{name} boundary", **line)
    if len(tentative):
        axes.plot(*tentative.T, label=f"{name} tentative", linestyle=(0, (4, 2)), **line)
    squares: dict[str, Any] = {"markerfacecolor": "white", "markeredgewidth": 0.6, "zorder": 5}
    points, text = spline.distinct_control_points, f"{name} control points"
    draw_points(axes, points, "s", color, text, **squares)


def draw_trajectory(
    axes: Axes,
    trajectory: Array,
    health: Sequence[str] = (),
    label: str = "trajectory",
    width: float = PATH_WIDTH,
) -> None:
    """Draw poses (n, 3) or positions (n, 2) as a line, map frame (m), and what wasn't healthy in colour."""
    axes.plot(*trajectory[:, :2].T, label=label, color=GREEN, linewidth=width, zorder=3)
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
        draw_points(axes, truth.cones, "x", DARK, "true cones", **cross)


def finish(figure: Figure, panels: Sequence[Axes], columns: int = 1) -> None:
    """Mark the start, add frame, axis titles and legend, and give a figure the shape of its maps."""
    for axes in panels:  # the origin of the map frame, where the vehicle stood first, heading along x
        size = 2.0 * MARKER_SIZE
        draw_points(axes, np.zeros((1, 2)), ">", "black", "start", markersize=size, zorder=7)
        axes.margins(0.0)
        axes.autoscale_view()
    drawn = np.array([[axes.get_xlim(), axes.get_ylim()] for axes in panels])
    low, high = drawn[:, :, 0].min(axis=0) - 3.0, drawn[:, :, 1].max(axis=0) + 3.0  # m of free space
    for axes in panels:
        axes.set(
            aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]"
        )
        axes.label_outer()
    shared_legend(figure)
    (width, height), rows = high - low, -(-len(panels) // columns)
    figure.set_size_inches(WIDTH, min(7.5, rows * WIDTH / columns * height / width + 0.85))


def plot_maps(maps: Mapping[str, tuple[Map, Array]], truth: Truth | None) -> Picture:
    """Draw maps and driven paths (n, 3) side by side over the truth, each below its title."""
    columns = 1 if len(maps) == 1 else 2 if len(maps) <= 4 else 3
    with figure_context():
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
    with figure_context():
        figure = Picture(layout="constrained")
        axes = figure.add_subplot(title=title or "")
        for track, color, name in ((first.moved(apart.motion), BLUE, "first"), (second, DARK, "second")):
            for boundary in track.boundaries.values():
                if isinstance(boundary, PointBoundary):
                    draw_points(axes, boundary.points, "o", color, name, markersize=1.4, zorder=3)
                else:
                    curve = boundary.spline.evaluate(curve_parameters(boundary.spline))
                    axes.plot(*curve.T, color=color, linewidth=CURVE_WIDTH, label=name, zorder=3)
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
    with figure_context():
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
            draw_points(axes, own, ".", LABEL_COLORS[label], text, **dots)
        line: dict[str, Any] = {"color": GREEN, "linewidth": PATH_WIDTH, "zorder": 3}
        axes.plot(*poses[:, :2].T, label="odometry alone", **line)
        if log.truth is not None:
            draw_truth(axes, log.truth)
        finish(figure, [axes])
    return figure
