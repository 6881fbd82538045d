"""The centre line of a mapped drive against that of curves through the true cones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial import KDTree

from pathspace_graph.sim.track import to_map_frame
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.planning import centre_line

from ..scenes.drives import bean_track, lap_log, map_log, noisy

Array = NDArray[np.float64]


def through(cones: Array) -> BSpline:
    """The closed cubic spline through a row of cones, by the length of its chords."""
    ring = np.concatenate([cones, cones[:1]])
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1)))
    spline = make_interp_spline(lengths, ring, 3, bc_type="periodic")
    return BSpline(spline.t, spline.c, 3, periodic=True)


def test_it_is_near_the_true_one_and_within_its_sigmas() -> None:
    track = bean_track()
    mapper, _ = map_log(noisy(lap_log(track, overrun=50.0), 0))
    line = mapper.map().centre_line()
    rows = to_map_frame(track).left, to_map_frame(track).right
    true = centre_line(*map(through, rows), None, 0.05)
    assert line.closed
    nearest = KDTree(true.points).query(line.points)[1]
    normal = np.column_stack([-np.sin(true.heading), np.cos(true.heading)])[nearest]
    across = ((line.points - true.points[nearest]) * normal).sum(axis=1)
    assert np.sqrt(np.mean(across**2)) < 0.25
    assert np.mean(np.abs(across) < 2.5 * line.points_sigma) > 0.8
    narrow = line.width_left - true.width_left[nearest]
    assert np.sqrt(np.mean(narrow**2)) < 0.15
    assert np.mean(np.abs(narrow) < 2.5 * line.width_left_sigma) > 0.8
    assert abs(line.length - true.length) < 3.0 * line.length_sigma
