"""A study's figures: paired differences from the baseline, and accuracy against size and against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pathspace_graph.eval.figures.style import (
    BLUE,
    DARK,
    GREY,
    MARKERS,
    PALETTE,
    WIDTH,
    figure_context,
    shared_legend,
)
from pathspace_graph.eval.metrics.measures import METRICS

from .statistics import Contrast, contrasts
from .study import Study

ACCURACY: Final = "rmse"
SIZE: Final = "size"
TIME: Final = "ms_mean"

_MAX_PANELS: Final = 3
"""The figure of differences shows at most this many metrics side by side."""
_ROW_HEIGHT: Final = 0.24
"""A combination takes this height in the figure of differences (in)."""
_LABELS_HEIGHT: Final = 1.1
"""Titles and tick labels take this height there (in)."""
_SCATTER_HEIGHT: Final = 3.6
"""Each noise takes this height in the figures of accuracy (in)."""
_MEAN_SIZE: Final = 4.5
"""The marker of a mean has this size (pt)."""
_PAIR_SIZE: Final = 3.5
"""The marker of a single pair has this size (pt)."""
_JITTER: Final = 0.22
"""Single pairs are scattered vertically by up to this share of a row, so that they can be told apart."""
_JITTER_SEED: Final = 0


def figures(study: Study, frame: pd.DataFrame) -> dict[str, Figure]:
    """Draws every figure that the study has runs for, by the name of its file."""
    with figure_context():
        drawn = {
            "differences": plot_differences(study, frame),
            "accuracy_size": plot_against(study, frame, SIZE),
            "accuracy_time": plot_against(study, frame, TIME),
        }
    return {name: figure for name, figure in drawn.items() if figure is not None}


# --- differences -----------------------------------------------------------------------------------------


def plot_differences(study: Study, frame: pd.DataFrame) -> Figure | None:
    """Draws every pair, their mean and its interval: a row for each combination, a panel for each metric.

    Only the first metrics of the study have a panel, and None is returned where no run differs.
    """
    panels = [contrasts(study, frame, metric) for metric in study.metrics if metric in frame]
    panels = [panel for panel in panels if _differs(panel)][:_MAX_PANELS]
    if not panels:
        return None
    rows = [i for i in range(len(panels[0])) if any(_is_known(panel[i]) for panel in panels)]
    figure = Figure(figsize=(WIDTH, _LABELS_HEIGHT + _ROW_HEIGHT * len(rows)), layout="constrained")
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(all_axes, panels, strict=True):
        _draw_differences(axes, [panel[i] for i in rows])
    all_axes[0].set_yticks(range(len(rows)), [_row_name(study, panels[0][i]) for i in rows])
    all_axes[0].set_ylim(len(rows) - 0.5, -0.5)
    caption = "difference from the baseline: each pair, mean and 95 % interval; blue where significant"
    figure.supxlabel(caption)
    return figure


def _is_known(contrast: Contrast) -> bool:
    """Returns whether a combination isn't the baseline itself and has pairs."""
    return contrast.difference is not None and contrast.difference.count > 0


def _differs(panel: Sequence[Contrast]) -> bool:
    """Returns whether any run differs from the baseline."""
    return any(d != 0.0 for contrast in panel for d in contrast.differences)


def _draw_differences(axes: Axes, rows: Sequence[Contrast]) -> None:
    metric = METRICS[rows[0].metric]
    rng = np.random.default_rng(_JITTER_SEED)
    axes.axvline(0.0, color=DARK, linewidth=0.6, zorder=1)
    for row, contrast in enumerate(rows):
        if contrast.difference is None or not contrast.difference.count:
            continue
        color = BLUE if contrast.significant else GREY
        pairs = metric.factor * np.array(contrast.differences)
        scattered = row + rng.uniform(-_JITTER, _JITTER, len(pairs))
        axes.plot(pairs, scattered, ".", color=color, alpha=0.5, markersize=_PAIR_SIZE, zorder=2)
        mean, half = metric.factor * contrast.difference.mean, metric.factor * contrast.difference.half
        look: dict[str, Any] = {"color": color, "markersize": _MEAN_SIZE, "elinewidth": 1.0}
        axes.errorbar(mean, row, xerr=_bar(half), fmt="o", zorder=3, **look)
    axes.set_title(metric.heading)
    axes.grid(axis="x")


def _bar(half: float) -> float | None:
    """Returns the half width of an error bar, or None where it isn't known."""
    return None if np.isnan(half) else half


def _row_name(study: Study, contrast: Contrast) -> str:
    several = [name for name in ("noise", "estimator", "variant") if len(_of(study, name)) > 1]
    return _brief(study, ", ".join(getattr(contrast, name) for name in several))


def _brief(study: Study, name: str) -> str:
    """Returns `sigma_spacing=1` for `gauge.sigma_spacing=1`, unless two groups have a setting of one name."""
    last = {field: field.rpartition(".")[2] for field in study.varied}
    if len(set(last.values())) == len(last):
        for field, short in last.items():
            name = name.replace(f"{field}=", f"{short}=")
    return name


def _of(study: Study, name: str) -> Sequence[str]:
    return {"noise": list(study.noise), "estimator": study.estimators, "variant": list(study.points)}[name]


# --- accuracy against ------------------------------------------------------------------------------------


def plot_against(study: Study, frame: pd.DataFrame, metric: str) -> Figure | None:
    """Draws the mean accuracy of each combination against the mean of another metric, with both intervals."""
    if metric not in frame or ACCURACY not in frame:
        return None
    across, up = contrasts(study, frame, metric), contrasts(study, frame, ACCURACY)
    figure = Figure(figsize=(WIDTH, _SCATTER_HEIGHT * len(study.noise)), layout="constrained")
    all_axes = figure.subplots(len(study.noise), 1, squeeze=False)[:, 0]
    for axes, noise in zip(all_axes, study.noise, strict=True):
        pairs = [(a, b) for a, b in zip(across, up, strict=True) if a.noise == noise and a.value.count]
        for index, (a, b) in enumerate(pairs):
            _draw_point(axes, a, b, index, _label(study, a))
        axes.set_xlabel(METRICS[metric].heading)
        axes.set_ylabel(METRICS[ACCURACY].heading)
        axes.set_title(noise if len(study.noise) > 1 else "")
        axes.grid()
    shared_legend(figure, loc="outside right upper")
    return figure


def _draw_point(axes: Axes, across: Contrast, up: Contrast, index: int, label: str) -> None:
    x, y = METRICS[across.metric], METRICS[up.metric]
    axes.errorbar(
        x.factor * across.value.mean,
        y.factor * up.value.mean,
        xerr=_bar(x.factor * across.value.half),
        yerr=_bar(y.factor * up.value.half),
        fmt=MARKERS[index % len(MARKERS)],
        color=DARK if across.difference is None else PALETTE[index % len(PALETTE)],
        markersize=_MEAN_SIZE,
        elinewidth=0.6,
        label=label,
    )


def _label(study: Study, contrast: Contrast) -> str:
    several = [name for name in ("estimator", "variant") if len(_of(study, name)) > 1]
    return _brief(study, ", ".join(getattr(contrast, name) for name in several) or contrast.name)
