"""How the isolated figures look: one font, one set of colours, letters for panels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from pathspace_graph.labels import BOUNDARIES, NAMES

BLUE: Final = "#0067A9"
ORANGE: Final = "#D98200"
GREEN: Final = "#009E73"
RED: Final = "#CC0000"
PURPLE: Final = "#7B3294"
DARK: Final = "#4D4D4D"
GREY: Final = "#8C8C8C"
LIGHT: Final = "#B0B0B0"

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FigureStyle:
    """Lengths in inches, lines and markers in points."""

    width: float = 7.0
    """Of a figure: two columns of a paper."""
    font_size: float = 8.0
    """Of all text."""
    curve_color: str = BLUE
    """Of the state's curve."""
    fitted_color: str = PURPLE
    """Of what is fitted or updated: the paper's purple."""
    other_color: str = ORANGE
    """Of what it is held against."""
    detection_color: str = GREEN
    """Of readings."""
    sigma_color: str = RED
    """Of sigma points and of what is marked."""
    faint_color: str = LIGHT
    """Of samples."""
    truth_color: str = DARK
    """Of what is true."""
    curve_width: float = 1.3
    """Of a curve."""
    thin_width: float = 0.5
    """Of one sample among many."""
    marker_size: float = 4.0
    """Of control points and readings."""
    alpha: float = 0.25
    """Of filled areas."""


@contextmanager
def figure_context(style: FigureStyle) -> Iterator[None]:
    """Fonts and lines of all figures."""
    size = style.font_size
    with mpl.rc_context(
        {
            "font.size": size,
            "axes.titlesize": size,
            "legend.fontsize": size - 0.5,
            "axes.linewidth": 0.6,
            "axes.titlelocation": "left",
            "xtick.major.width": 0.6,
            "ytick.major.width": 0.6,
            "xtick.major.size": 2.5,
            "ytick.major.size": 2.5,
            "legend.frameon": False,
        }
    ):
        yield


def draw_ellipses(axes: Axes, centres: Array, covariances: Array, color: str, style: FigureStyle) -> None:
    """The 2-sigma ellipses of points (k, 2) with covariances (k, 2, 2)."""
    variances, vectors = np.linalg.eigh(covariances)
    widths, heights = 4.0 * np.sqrt(np.maximum(variances, 0.0)).T
    angles = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    axes.add_collection(
        EllipseCollection(
            widths,
            heights,
            angles,
            units="xy",
            offsets=centres,
            offset_transform=axes.transData,
            facecolor=color,
            edgecolor=color,
            alpha=style.alpha,
            linewidth=0.5,
            zorder=1,
        )
    )


def draw_control_points(axes: Axes, points: Array, color: str, style: FigureStyle, label: str = "") -> None:
    """Squares, and their polygon as a thin line."""
    axes.plot(*points.T, color=color, linewidth=style.thin_width, linestyle=(0, (4, 3)), zorder=2)
    axes.plot(
        *points.T,
        linestyle="none",
        marker="s",
        markersize=style.marker_size,
        markerfacecolor="white",
        markeredgecolor=color,
        markeredgewidth=0.8,
        zorder=4,
        label=label or None,
    )


def draw_detections(axes: Axes, points: Array, color: str, style: FigureStyle, label: str) -> None:
    """Filled circles."""
    axes.plot(
        *points.T,
        linestyle="none",
        marker="o",
        markersize=style.marker_size,
        color=color,
        zorder=6,
        label=label,
    )


def point_blocks(covariance: Array) -> Array:
    """(m, 2, 2) marginals of the joint covariance (2m, 2m) over x0, y0, x1, y1 ..."""
    m = len(covariance) // 2
    index = np.arange(m)
    return np.asarray(covariance.reshape(m, 2, m, 2)[index, :, index, :])


def frame(axes: Axes, low: tuple[float, float], high: tuple[float, float]) -> None:
    """Metres, as wide as high."""
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x [m]")


_ROUNDS = 2
"""The layout moves a little when the height changes."""


_SIDES = tuple(NAMES[label] for label in BOUNDARIES)


def legend_below(figure: Figure, columns: int) -> None:
    """Below all panels, each entry once."""
    entries = _entries(figure.axes)
    figure.legend(
        entries.values(), entries.keys(), loc="outside lower center", ncols=columns, handlelength=1.8
    )


def grouped_legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """The same with a column for the left boundary, one for the right, then the rest."""
    entries = _entries(panels)
    sides = [[label for label in entries if label.startswith(side)] for side in _SIDES]
    rest = [label for label in entries if not label.startswith(_SIDES)]
    rows = max(1, *(len(side) for side in sides))
    columns = [*(side for side in sides if side), *(rest[i : i + rows] for i in range(0, len(rest), rows))]
    blank = Line2D([], [], linestyle="none")
    padded = [label for column in columns for label in column + [""] * (rows - len(column))]
    figure.legend(
        [entries.get(label, blank) for label in padded],
        padded,
        loc="outside lower center",
        ncols=max(len(columns), 1),
        frameon=False,
        handlelength=1.8,
        columnspacing=1.4,
    )


def fit_height(figure: Figure, margin: float = 0.05) -> None:
    """As high as what is drawn and a margin (inches), where the width decides how large panels are."""
    for _ in range(_ROUNDS):
        figure.draw_without_rendering()
        width, _ = figure.get_size_inches()
        needed = figure.get_tightbbox().height + 2.0 * margin
        figure.set_size_inches(width, needed)


def _entries(panels: Iterable[Axes]) -> dict[str, Any]:
    """The first artist of each label."""
    entries: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return entries
