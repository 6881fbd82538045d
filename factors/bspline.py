"""B-spline basis functions on plain arrays: their values and derivatives by the Cox-de Boor recurrence.

A spline of degree p over n control points has n + p + 1 non-decreasing knots and the domain
[knots[p], knots[n]]. On the span knots[i] <= u < knots[i + 1] only the control points i - p to i matter.
A periodic spline of m distinct control points is stored unwrapped: n = m + p control points, of which the
last p repeat the first, over one period of knots and p more on either side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def domain(knots: Floats, degree: int) -> tuple[float, float]:
    """Returns the limits knots[p] and knots[n] of the domain, where all p + 1 basis functions exist."""
    return float(knots[degree]), float(knots[len(knots) - degree - 1])


def wrap(knots: Floats, degree: int, u: Floats) -> Floats:
    """Returns u modulo the period, inside the domain of a periodic spline.

    The right end of the domain is reached by round-off only.
    """
    low, high = domain(knots, degree)
    period = high - low
    wrapped = u - period * np.floor((u - low) / period)
    return np.minimum(np.maximum(wrapped, low), high)


def find_span(knots: Floats, degree: int, u: Floats) -> Ints:
    """Returns the span i (m,), in [p, n - 1], of each u (m,), so that knots[i] <= u < knots[i + 1].

    Values of u outside the domain are treated as if they were clipped to it. The right end of the domain
    belongs to the last non-empty span. knots has shape (n + p + 1,).
    """
    end = len(knots) - degree - 1
    last = int(np.searchsorted(knots[degree:end], knots[end], side="left")) - 1
    inner = knots[degree + 1 : degree + 1 + max(last, 0)]
    return np.searchsorted(inner, u, side="right") + degree


def basis(knots: Floats, degree: int, u: Floats, derivatives: int = 0) -> tuple[Floats, Ints]:
    """Returns basis values and derivatives (derivatives + 1, m, p + 1) at u (m,), and the spans (m,) of u.

        N_i^p = (u - t_i) / (t_{i+p} - t_i) N_i^{p-1} + (t_{i+p+1} - u) / (t_{i+p+1} - t_{i+1}) N_{i+1}^{p-1}

    knots (n + p + 1,) must have a non-empty domain, and u is clipped to it. Column j belongs to the control
    point span - p + j. A derivative at a knot is the one from the right, and at the right end of the domain
    the one from the left. The span of a parameter is never empty, so no divisor is zero. See de Boor (1972).
    """
    low, high = domain(knots, degree)
    u = np.minimum(np.maximum(u, low), high)
    span = find_span(knots, degree, u)
    window = knots[span + np.arange(1 - degree, degree + 1)[:, None]]
    orders = min(derivatives, degree)
    levels = _levels(window, degree, u)
    values = np.zeros((derivatives + 1, degree + 1, len(u)))
    values[0] = levels[degree]
    for order in range(1, orders + 1):
        level = levels[degree - order]
        for q in range(degree - order + 1, degree + 1):
            level = _differentiate(window, degree, q, level)
        values[order] = level
    return values.transpose(0, 2, 1), span


def _levels(window: Floats, degree: int, u: Floats) -> list[Floats]:
    """Returns the basis values (q + 1, m) of each degree q <= p, from the knots (2 p, m) around each u."""
    levels = [np.ones((1, len(u)))]
    for q in range(1, degree + 1):
        lower, upper = window[degree - q : degree], window[degree : degree + q]
        ratio = levels[-1] / (upper - lower)
        level = np.empty((q + 1, len(u)))
        np.multiply(upper - u, ratio, out=level[:-1])
        level[-1] = 0.0
        level[1:] += (u - lower) * ratio
        levels.append(level)
    return levels


def _differentiate(window: Floats, degree: int, q: int, level: Floats) -> Floats:
    """Returns q (N_i^{q-1} / (t_{i+q} - t_i) - N_{i+1}^{q-1} / (t_{i+q+1} - t_{i+1})) (q + 1, m).

    level (q, m) holds the functions, or derivatives, of degree q - 1.
    """
    ratio = q * level / (window[degree : degree + q] - window[degree - q : degree])
    raised = np.zeros((q + 1, ratio.shape[1]))
    raised[1:] = ratio
    raised[:-1] -= ratio
    return raised


def divisors(width: Floats) -> Floats:
    """Returns each width, or infinity where it is zero, so that 0 / 0 is taken as 0."""
    return np.where(width > 0.0, width, np.inf)


def scatter(values: Floats, first: Ints, size: int, periodic: bool = False) -> Floats:
    """Returns dense rows (m, size) of local values (m, p + 1), whose first columns belong to `first` (m,).

    Columns of a periodic spline are taken modulo `size`, and values that fall on the same column are added.
    """
    matrix = np.zeros((len(values), size))
    columns = first[:, None] + np.arange(values.shape[1])
    if periodic:
        columns %= size
    np.add.at(matrix, (np.arange(len(values))[:, None], columns), values)
    return matrix


def basis_matrix(knots: Floats, degree: int, u: Floats, n: int, derivative: int = 0) -> Floats:
    """Returns B (m, n) with B[k, i] = d^r/du^r N_i^p(u_k), so that d^r S/du^r = B c for n control points."""
    values, span = basis(knots, degree, u, derivative)
    return scatter(values[derivative], span - degree, n)


def periodic_basis_matrix(knots: Floats, degree: int, u: Floats, m: int, derivative: int = 0) -> Floats:
    """Returns B (k, m) as `basis_matrix`, for the m distinct control points of a periodic spline.

    Parameters u (k,) are taken modulo the period.
    """
    values, span = basis(knots, degree, wrap(knots, degree, u), derivative)
    return scatter(values[derivative], span - degree, m, periodic=True)


def uniform_knots(count: int, degree: int, interval: float = 1.0, start: float = 0.0) -> Floats:
    """Returns unclamped, equally spaced knots of `count` control points; the domain begins at `start`."""
    return start + interval * np.arange(-degree, count + 1, dtype=np.float64)


def clamped_knots(breaks: Floats, degree: int) -> Floats:
    """Returns the breaks (k + 1,) with both ends repeated p times more, as knots of k + p control points."""
    return np.concatenate([np.full(degree, breaks[0]), breaks, np.full(degree, breaks[-1])])


def periodic_knots(breaks: Floats, degree: int) -> Floats:
    """Returns one period of m + 1 > p breaks with p more knots on either side.

    They are the knots of m + p unwrapped control points.
    """
    period = breaks[-1] - breaks[0]
    before = breaks[-1 - degree : -1] - period
    after = breaks[1 : degree + 1] + period
    return np.concatenate([before, breaks, after])


def end_change_matrix(knots: Floats, degree: int, new_knots: Floats) -> Floats:
    """Returns M (n, n) with C_new = M C, which keeps the curve where only knots outside the domain change.

    The control point c_j is the blossom, at the knots t_{j+1} to t_{j+p}, of the polynomial of any span that
    it acts on (Ramshaw 1989). So clamping, unclamping and the extension of Hu et al. (2002) are one formula.
    The first and the last span of the domain must not be empty. Knots beyond index n + p - 1 are not read.
    """
    count = len(knots) - degree - 1
    matrix = np.eye(count)
    for j in range(count):
        arguments = new_knots[j + 1 : j + degree + 1]
        if not np.array_equal(arguments, knots[j + 1 : j + degree + 1]):
            span = degree if j < degree else count - 1
            matrix[j] = 0.0
            matrix[j, span - degree : span + 1] = _blossom(knots, degree, span, arguments)
    return matrix


def _blossom(knots: Floats, degree: int, span: int, arguments: Floats) -> Floats:
    """Returns the weights (p + 1,) of a span's control points in the blossom of its polynomial.

    They follow from de Boor's recurrence, with another argument at each level.
    """
    weights = np.eye(degree + 1)
    for r, x in enumerate(arguments, start=1):
        lower = knots[span - degree + r : span + 1]
        upper = knots[span + 1 : span + degree - r + 2]
        share = ((x - lower) / (upper - lower))[:, None]
        weights = (1.0 - share) * weights[:-1] + share * weights[1:]
    return np.asarray(weights[0])
