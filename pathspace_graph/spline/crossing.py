"""Whether the two boundaries of a map cross, which those of a track never do."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline


def sampled(spline: BSpline, step: float) -> Array:
    """Return points (n, 2) of a spline, from its beginning to its end, about this step (m) apart."""
    low, high = spline.domain
    return spline.evaluate(np.linspace(low, high, max(int((high - low) / step), 1) + 1))


def boundaries_cross(splines: Mapping[int, BSpline], step: float) -> bool:
    """Return whether the left and the right boundary cross, sampled at this step (m)."""
    return polylines_cross(sampled(splines[LEFT], step), sampled(splines[RIGHT], step))


def polylines_cross(a: Array, b: Array) -> bool:
    """Return whether a segment of the polyline a (n, 2) crosses one of the polyline b (m, 2)."""
    middle_a, middle_b = 0.5 * (a[1:] + a[:-1]), 0.5 * (b[1:] + b[:-1])
    reach = 0.5 * (np.hypot(*np.diff(a, axis=0).T).max() + np.hypot(*np.diff(b, axis=0).T).max())
    near = KDTree(middle_a).query_ball_tree(KDTree(middle_b), reach)
    i = np.repeat(np.arange(len(near)), [len(own) for own in near])
    j = np.array([k for own in near for k in own], np.intp)
    (p, q), (r, s) = (a[i], a[i + 1]), (b[j], b[j + 1])
    apart = _side(p, q, r) * _side(p, q, s) < 0.0
    return bool((apart & (_side(r, s, p) * _side(r, s, q) < 0.0)).any())


def _side(p: Array, q: Array, point: Array) -> Array:
    """Return on which side of the lines from p to q (k, 2) the points (k, 2) lie: positive on the left."""
    along, to = q - p, point - p
    return np.asarray(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0])
