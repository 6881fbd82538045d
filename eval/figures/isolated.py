"""The paper's isolated tests as figures, each with a caption that says what it shows."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from pathspace_graph.io.files import atomic_folder

from .curves import plot_simplification, plot_uncertainty, simplification, uncertainty
from .style import save_figures
from .updates import expansion, fit, plot_expansion, plot_fit

MARKER: Final = "captions.md"
"""File by which a folder of these figures is known."""
_SEED: Final = 0
"""Seed of the splines that are drawn at random."""


@dataclass(frozen=True)
class IsolatedFigure:
    """Figure with a name and a caption."""

    name: str
    """Name of the figure's files."""
    make: Callable[[], tuple[Figure, str]]
    """Function that computes and draws the figure, and returns its caption with its numbers."""


def _uncertainty() -> tuple[Figure, str]:
    data = uncertainty(np.random.default_rng(_SEED))
    off = np.abs(data.marginals / data.joint - 1.0)
    return plot_uncertainty(data), (
        "Uncertainty along a spline. (a) Control points with their uncertainty make a continuous "
        "distribution of splines, wide where nothing was seen. (b) Its standard deviation across the curve "
        "by the joint covariance is that of splines drawn at random; the sum of squared basis functions, "
        f"which leaves the cross terms out, is off by up to {100 * off.max():.0f} %."
    )


def _expansion() -> tuple[Figure, str]:
    data = expansion()
    return plot_expansion(data), (
        "Expansion in its three steps. (a) Detections whose closest point is the end of the curve, beyond a "
        "threshold from the last two control points, mark an expansion. (b) The curve is extended to the "
        "last of their proximity chain, and is exactly as it was up to its old end; the others are "
        "detections of it now. (c) One update uses all of those."
    )


def _fit() -> tuple[Figure, str]:
    return plot_fit(fit()), (
        "The fit of S_z. (a) The closest points on the state's curve to the detections. (b) Sigma points of "
        "the detections, and the curve fitted to each by ridge regression. (c) Mean and covariance of their "
        "control points make one measurement of the curve. (d) The basis functions at the closest points: a "
        "control point whose function is zero there (grey) stays where it was."
    )


def _simplification() -> tuple[Figure, str]:
    data = simplification()
    weighted, uniform = (100.0 * simplified.rms for simplified in (data.weighted, data.uniform))
    return plot_simplification(data), (
        f"Simplification of a closed curve of {data.old.size} control points (a) to "
        f"{data.weighted.curve.size} (b, the curve before dashed). (c) The distance between the two: "
        f"{weighted:.1f} cm rms with curvature-weighted knots, {uniform:.1f} cm with uniform ones. "
        "(d) Curvature, and the knots."
    )


FIGURES: Final = (
    IsolatedFigure("uncertainty", _uncertainty),
    IsolatedFigure("expansion", _expansion),
    IsolatedFigure("fit", _fit),
    IsolatedFigure("simplification", _simplification),
)
"""All figures, in the paper's order."""


def write_figures(out: Path, on_figure: Callable[[], None] = lambda: None) -> None:
    """Write every figure and the captions, or nothing; `on_figure` is called after each figure."""
    captions = []
    with atomic_folder(out, MARKER) as folder:
        for isolated in FIGURES:
            figure, caption = isolated.make()
            save_figures(folder, {isolated.name: figure})
            captions.append(f"![{isolated.name}]({isolated.name}.png)\n\n{caption}\n")
            on_figure()
        (folder / MARKER).write_text("\n".join(captions), encoding="utf-8")
