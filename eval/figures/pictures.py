"""The pictures that records have in a notebook: of a map, and of a log before anything is mapped."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.io.log import Log
from pathspace_graph.labels import NAMES, POINTS, UNKNOWN

from . import map_plot, style
from .map_plot import BOUNDARY_COLORS, TRAJECTORY_COLOR, WHOLE_TRACK, plot_map
from .style import GREY, RED

__all__ = ["plot_log", "plot_map"]

LABEL_COLORS = {**BOUNDARY_COLORS, UNKNOWN: GREY, **dict.fromkeys(POINTS, RED)}


def plot_log(log: Log, *, title: str | None = None) -> style.Picture:
    """Draw where the odometry alone leads, the detections seen from there, and the truth if it is known.

    Dead reckoning drifts: laps lie beside each other, and the detections of a cone apart.
    """
    odometry, stamps = log.odometry, np.array([cycle.t for cycle in log.cycles])
    poses = integrate_poses(np.diff(odometry.t), odometry.twist[:-1])
    poses = np.concatenate([np.zeros((1, 3)), poses])
    with style.figure_context():
        figure = style.Picture(layout="constrained")
        axes = figure.add_subplot()
        # a cycle lies between two odometry stamps: its pose is interpolated, which a picture can bear
        at = np.column_stack([np.interp(stamps, odometry.t, column) for column in poses.T])
        _draw_detections(axes, log, at)
        line: dict[str, Any] = {"color": TRAJECTORY_COLOR, "linewidth": WHOLE_TRACK.path_width, "zorder": 3}
        axes.plot(*poses[:, :2].T, label="odometry alone", **line)
        if log.truth is not None:
            map_plot.draw_truth(axes, log.truth, WHOLE_TRACK)
        map_plot.draw_start(axes, WHOLE_TRACK)
        map_plot.finish(figure, axes, title)
    return figure


def _draw_detections(axes: Axes, log: Log, poses: Array) -> None:
    """Draw the detections of all cycles, seen from the poses (n, 3) of the cycles."""
    counts = [len(cycle.labels) for cycle in log.cycles]
    seen = np.concatenate([np.zeros((0, 2)), *(cycle.points_vehicle for cycle in log.cycles)])
    points = to_map(seen, np.repeat(poses, counts, axis=0))
    labels: IntArray = np.concatenate([np.zeros(0, int), *(cycle.labels for cycle in log.cycles)])
    for label, color in LABEL_COLORS.items():
        if (labels == label).any():
            text = f"{NAMES[label].replace('_', ' ')} detections"
            style.draw_points(
                axes, points[labels == label], ".", color, text, markersize=1.2, zorder=2, alpha=0.4
            )
