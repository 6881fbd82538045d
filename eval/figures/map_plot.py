"""A picture of a map: boundaries with their 2-sigma band, control points, trajectory, truth if known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.files import atomic_file
from pathspace_graph.io.log import Log, Truth
from pathspace_graph.io.map import Map, MapBoundary, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, NAMES, RIGHT
from pathspace_graph.spline.bspline import BSpline

from .style import BLUE, DARK, GREEN, ORANGE

Array = NDArray[np.float64]

FORMATS = (".png", ".pdf", ".svg")
"""Suffixes that a plot can be saved under."""

BAND_SIGMAS = 2.0
"""Half width of the uncertainty band in standard deviations across the curve."""

_REPRODUCIBLE = {".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
"""Metadata that would differ from one run to the next is left out."""


@dataclass(frozen=True, slots=True)
class PlotStyle:
    """How a map is drawn; lengths in inches, line widths and markers in points."""

    width: float = 7.0
    """Width of the figure: two columns of a paper."""

    max_height: float = 7.5
    """Tallest figure; a track narrower than it is long is drawn smaller."""

    furniture: float = 0.85
    """Height that tick labels and the legend take."""

    margin: float = 3.0
    """Free space around what is drawn (m)."""

    dpi: float = 200.0
    """Resolution of a png."""

    font_size: float = 8.0
    """Of all text (pt)."""

    left_color: str = BLUE
    """Blue, as the cones; told from amber by every kind of colour vision, and by lightness in print."""

    right_color: str = ORANGE
    """Amber, for yellow cones on white paper."""

    truth_color: str = DARK
    """Of everything that is true rather than estimated."""

    trajectory_color: str = GREEN
    """Of the estimated trajectory."""

    band_alpha: float = 0.35
    """Opacity of the uncertainty band."""

    curve_width: float = 0.7
    """Of a boundary."""

    path_width: float = 0.6
    """Of trajectories."""

    marker_size: float = 2.6
    """Of cones and control points."""

    landmark_size: float = 1.4
    """Of landmarks, small enough for their ellipses to be seen."""

    samples_per_span: int = 24
    """Points drawn on each span of a spline."""

    def color(self, label: int) -> str:
        """The colour of a boundary."""
        return {LEFT: self.left_color, RIGHT: self.right_color}[label]


def plot_map(
    track: Map,
    *,
    log: Log | None = None,
    trajectory: Array | None = None,
    band_scale: float = 1.0,
    title: str | None = None,
    style: PlotStyle | None = None,
) -> Figure:
    """The map in metres, equal aspect, with the band S(u) +- 2 band_scale sigma(u) n(u) around each boundary.

    `log` adds the true cones and the true path where it has truth; trajectory (n, 3) or (n, 2), map frame.
    A `band_scale` other than 1 draws the band wider than it is, and the legend says so.
    """
    style = style or PlotStyle()
    if not band_scale > 0.0:
        raise SettingsError(f"band_scale: expected a positive number, found {band_scale}")
    with mpl.rc_context({"font.size": style.font_size, "axes.linewidth": 0.6}):
        figure = Figure(layout="constrained")
        axes = figure.add_subplot()
        # what is drawn first is named first in the legend; what lies on top is told by zorder
        for label, boundary in sorted(track.boundaries.items()):
            draw_boundary(axes, boundary, label, band_scale, style)
        if log is not None and log.truth is not None:
            draw_truth(axes, log.truth, style)
        if trajectory is not None and len(trajectory):
            draw_trajectory(axes, np.asarray(trajectory), style)
        draw_start(axes, style)
        _finish(figure, axes, title, style)
    return figure


def save_plot(figure: Figure, file: Path | str, *, style: PlotStyle | None = None) -> None:
    """Writes a .png, .pdf or .svg, whole or not at all; SettingsError for any other suffix."""
    file = Path(file)
    suffix = file.suffix.lower()
    check_plot_file(file)
    dpi = (style or PlotStyle()).dpi
    # text stays text in vector formats, and ids don't change from run to run
    options = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pathspace"}
    with atomic_file(file) as temporary, mpl.rc_context(options):
        figure.savefig(temporary, dpi=dpi, format=suffix[1:], metadata=_REPRODUCIBLE[suffix])


def check_plot_file(file: Path | str) -> None:
    """SettingsError where a plot can't be saved under that suffix; for a check before long work."""
    if Path(file).suffix.lower() not in FORMATS:
        raise SettingsError(f"{file}: expected a file name that ends in {', '.join(FORMATS)}")


def uncertainty_band(boundary: SplineBoundary, u: Array, scale: float = 1.0) -> tuple[Array, Array]:
    """S(u) +- 2 scale sigma(u) n(u), m: left and right edge (k, 2) of the band at parameters u (k,)."""
    spline = boundary.spline
    half = BAND_SIGMAS * scale * spline.normal_sigma(u, boundary.covariance)
    tangent = spline.tangent_unit(u)
    offsets = half[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    centre = spline.evaluate(u)
    return centre + offsets, centre - offsets


def curve_parameters(spline: BSpline, samples_per_span: int) -> Array:
    """Parameters (k,) over the whole domain, dense enough on every span to draw it, both ends included."""
    edges = spline.breaks
    fractions = np.arange(samples_per_span) / samples_per_span
    inner = edges[:-1, None] + np.diff(edges)[:, None] * fractions
    return np.append(inner.ravel(), edges[-1])


# --- layers ----------------------------------------------------------------------------------------------


def draw_boundary(axes: Axes, boundary: MapBoundary, label: int, band_scale: float, style: PlotStyle) -> None:
    """A curve with its band and control points, or landmarks with their ellipses, in the map frame (m)."""
    if isinstance(boundary, PointBoundary):
        _draw_landmarks(axes, boundary, label, band_scale, style)
    else:
        _draw_spline(axes, boundary, label, band_scale, style)


def _draw_spline(
    axes: Axes, boundary: SplineBoundary, label: int, band_scale: float, style: PlotStyle
) -> None:
    color, name = style.color(label), NAMES[label]
    u = curve_parameters(boundary.spline, style.samples_per_span)
    left, right = uncertainty_band(boundary, u, band_scale)
    outline = _band_outline(left, right, closed=boundary.spline.periodic)
    band = PathPatch(outline, facecolor=color, alpha=style.band_alpha, linewidth=0.0, zorder=2)
    band.set_label(f"{name} {_band_name(band_scale)}")
    axes.add_patch(band)
    axes.plot(
        *boundary.spline.evaluate(u).T,
        color=color,
        linewidth=style.curve_width,
        zorder=4,
        label=f"{name} boundary",
    )
    axes.plot(
        *boundary.spline.distinct_control_points.T,
        linestyle="none",
        marker="s",
        markersize=style.marker_size,
        markerfacecolor="white",
        markeredgecolor=color,
        markeredgewidth=0.6,
        zorder=5,
        label=f"{name} control points",
    )


def _draw_landmarks(
    axes: Axes, boundary: PointBoundary, label: int, band_scale: float, style: PlotStyle
) -> None:
    color, name = style.color(label), NAMES[label]
    widths, heights, angles = _ellipses(boundary, BAND_SIGMAS * band_scale)
    ellipses = EllipseCollection(
        widths,
        heights,
        angles,
        units="xy",
        offsets=boundary.points,
        offset_transform=axes.transData,
        facecolor=color,
        alpha=style.band_alpha,
        linewidth=0.0,
        zorder=2,
    )
    axes.add_collection(ellipses)
    ellipse_key = PathPatch(Outline(np.zeros((0, 2))), facecolor=color, alpha=style.band_alpha, linewidth=0.0)
    ellipse_key.set_label(f"{name} {_band_name(band_scale, 'ellipses')}")
    axes.add_patch(ellipse_key)
    axes.plot(
        *boundary.points.T,
        linestyle="none",
        marker="o",
        markersize=style.landmark_size,
        color=color,
        zorder=4,
        label=f"{name} landmarks",
    )


def draw_trajectory(axes: Axes, trajectory: Array, style: PlotStyle) -> None:
    """Poses (n, 3) or positions (n, 2) as a line, map frame (m)."""
    axes.plot(
        trajectory[:, 0],
        trajectory[:, 1],
        color=style.trajectory_color,
        linewidth=style.path_width,
        zorder=3,
        label="trajectory",
    )


def draw_truth(axes: Axes, truth: Truth, style: PlotStyle) -> None:
    """The true path dashed and the true cones as crosses, as far as they are known, map frame (m)."""
    if len(truth.poses):
        axes.plot(
            *truth.poses[:, :2].T,
            color=style.truth_color,
            linewidth=0.6 * style.path_width,
            linestyle=(0, (5, 3)),
            zorder=3.5,
            label="true path",
        )
    if len(truth.cones):
        axes.plot(
            *truth.cones.T,
            linestyle="none",
            marker="x",
            markersize=style.marker_size,
            markeredgewidth=0.6,
            color=style.truth_color,
            zorder=6,
            label="true cones",
        )


def draw_start(axes: Axes, style: PlotStyle) -> None:
    """The origin of the map frame: where the vehicle stood first, heading along x."""
    axes.plot(
        0.0,
        0.0,
        linestyle="none",
        marker=">",
        markersize=2.0 * style.marker_size,
        color="black",
        zorder=7,
        label="start",
    )


def _finish(figure: Figure, axes: Axes, title: str | None, style: PlotStyle) -> None:
    axes.set_aspect("equal")
    axes.margins(0.0)
    axes.autoscale_view()
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    axes.set_xlim(x0 - style.margin, x1 + style.margin)
    axes.set_ylim(y0 - style.margin, y1 + style.margin)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.tick_params(width=0.6, length=2.5)
    if title:
        axes.set_title(title)
    _add_legend(figure, axes)
    ratio = (y1 - y0 + 2 * style.margin) / (x1 - x0 + 2 * style.margin)
    figure.set_size_inches(style.width, min(style.max_height, style.width * ratio + style.furniture))


def _add_legend(figure: Figure, axes: Axes) -> None:
    """Below the axes; a column is as long as a boundary has entries."""
    handles, labels = axes.get_legend_handles_labels()
    rows = max(1, *(sum(label.startswith(name) for label in labels) for name in NAMES))
    columns = -(-len(labels) // rows)
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        handlelength=1.8,
        columnspacing=1.4,
    )


# --- shapes ----------------------------------------------------------------------------------------------


def _band_name(scale: float, shape: str = "band") -> str:
    exaggerated = "" if scale == 1.0 else f" (drawn {scale:g}× as wide)"
    return f"{BAND_SIGMAS:g}σ {shape}{exaggerated}"


def _band_outline(left: Array, right: Array, closed: bool) -> Outline:
    """One polygon around an open band; a ring (one edge, and the other run backwards) where closed."""
    if not closed:
        return Outline(np.concatenate([left, right[::-1], left[:1]]), closed=True)
    return Outline.make_compound_path(Outline(left, closed=True), Outline(right[::-1], closed=True))


def _ellipses(boundary: PointBoundary, sigmas: float) -> tuple[Array, Array, Array]:
    """Full widths, full heights (m) and angles (degrees) of the points' own `sigmas`-ellipses."""
    blocks = boundary.covariance.reshape(boundary.size, 2, boundary.size, 2)
    own = blocks[np.arange(boundary.size), :, np.arange(boundary.size), :]
    variances, axes = np.linalg.eigh(own)
    widths, heights = 2.0 * sigmas * np.sqrt(np.maximum(variances, 0.0)).T
    return widths, heights, np.degrees(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))
