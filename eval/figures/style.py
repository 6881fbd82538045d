"""How all figures look: sizes, colours, legends, the marks they are drawn with, and their files."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BytesIO
from math import ceil
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from pathspace_graph.errors import SettingsError
from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.files import atomic_file, is_stream
from pathspace_graph.io.map import SplineBoundary
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
MARKERS: Final = "os^Dv*<>PXphd"

_RC: Final = {
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
}
SIGMAS: Final = 2.0  # standard deviations to the edge of a band or an ellipse
FORMATS: Final = (".png", ".pdf", ".svg")  # suffixes under which a figure can be saved
SUFFIXES: Final = (".png", ".pdf")  # formats of commands that write several figures: to look at, to print
DPI: Final = 200.0  # resolution of a png (dots per inch)
# what would differ from one run to the next is left out, and text stays text in vector formats
_METADATA: Final = {".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}
_FILE_RC: Final = {"pdf.fonttype": 42, "svg.fonttype": "none", "svg.hashsalt": "pathspace"}


@contextmanager
def figure_context() -> Iterator[None]:
    """Set the fonts and lines that all figures share."""
    with mpl.rc_context(_RC):
        yield


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


def draw_curve(
    axes: Axes,
    spline: BSpline,
    color: str,
    label: str | None = None,
    width: float = 0.7,
    stretch: tuple[float, float] = (-np.inf, np.inf),
    **line: Any,
) -> None:
    """Draw a spline over its whole domain, or over a stretch of it, from one parameter to another."""
    u = curve_parameters(spline)
    low, high = np.clip(stretch, u[0], u[-1])
    points = spline.evaluate(np.concatenate([[low], u[(u > low) & (u < high)], [high]]))
    axes.plot(*points.T, color=color, linewidth=width, label=label, **{"zorder": 3, **line})


def draw_points(
    axes: Axes, points: Array, marker: str, color: str, label: str | None = None, **options: Any
) -> None:
    """Draw a marker at each point (k, 2)."""
    options = {"markersize": MARKER_SIZE, "zorder": 6, **options}
    axes.plot(*points.T, linestyle="none", marker=marker, color=color, label=label, **options)


def draw_band(
    axes: Axes,
    boundary: SplineBoundary,
    color: str,
    label: str,
    scale: float = 1.0,
    **options: Any,
) -> None:
    """Fill the 2-sigma band around a curve, `scale` times as wide as it is."""
    left, right = uncertainty_band(boundary, curve_parameters(boundary.spline), scale)
    outline = Outline(np.concatenate([left, right[::-1], left[:1]]), closed=True)
    if boundary.spline.periodic:  # a ring, with edges in opposite directions
        edges = Outline(left, closed=True), Outline(right[::-1], closed=True)
        outline = Outline.make_compound_path(*edges)
    look: dict[str, Any] = {"alpha": 0.25, "linewidth": 0.0, "zorder": 2} | options
    axes.add_patch(PathPatch(outline, facecolor=color, label=label, **look))


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
    """Return the suffix of `file`, or .png for a stream; raise SettingsError where it is no picture's."""
    suffix = Path(file).suffix.lower()
    if suffix not in FORMATS and is_stream(Path(file)):
        return FORMATS[0]
    if suffix not in FORMATS:
        raise SettingsError(f"{file}: expected a file name that ends in {', '.join(FORMATS)}")
    return suffix


def save_plot(figure: Figure, file: Path | str, dpi: float = DPI) -> None:
    """Write a .png (also to a stream), .pdf or .svg; raise SettingsError for any other suffix."""
    suffix = check_plot_file(file)
    with atomic_file(Path(file)) as temporary, mpl.rc_context(_FILE_RC):
        figure.savefig(temporary, dpi=dpi, format=suffix[1:], metadata=_METADATA[suffix])


def save_figures(folder: Path, figures: Mapping[str, Figure]) -> None:
    """Write every figure under its name in `folder`, in the place of an earlier one."""
    for name, figure in figures.items():
        for suffix in SUFFIXES:
            save_plot(figure, folder / f"{name}{suffix}")
