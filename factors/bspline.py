"""B-spline basis functions on plain arrays: Cox-de Boor values and derivatives.

A spline of degree p over n control points has n + p + 1 non-decreasing knots and the domain
[knots[p], knots[n]]. On the span knots[i] <= u < knots[i + 1] only the control points i - p .. i matter.
A periodic spline of m distinct control points is stored unwrapped: n = m + p control points, of which the
last p repeat the first, over one period of knots and p more on either side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


def domain(knots: Floats, degree: int) -> tuple[float, float]:
    """[knots[p], knots[n]]: where all p + 1 basis functions of a span exist."""
    return float(knots[degree]), float(knots[len(knots) - degree - 1])


def wrap(knots: Floats, degree: int, u: Floats) -> Floats:
    """u modulo the period, into the domain of a periodic spline (its right end by round-off only)."""
    low, high = domain(knots, degree)
    period = high - low
    wrapped = u - period * np.floor((u - low) / period)
    return np.minimum(np.maximum(wrapped, low), high)


def find_span(knots: Floats, degree: int, u: Floats) -> Ints:
    """i with knots[i] <= u < knots[i + 1]; the right end of the domain belongs to the last non-empty span.

    knots (n + p + 1,), u (m,), as if clipped to the domain -> (m,) in [p, n - 1].
    """
    end = len(knots) - degree - 1
    last = int(np.searchsorted(knots[degree:end], knots[end], side="left")) - 1
    inner = knots[degree + 1 : degree + 1 + max(last, 0)]
    return np.searchsorted(inner, u, side="right") + degree


def basis(knots: Floats, degree: int, u: Floats, derivatives: int = 0) -> tuple[Floats, Ints]:
    """N_i^p = (u - t_i) / (t_{i+p} - t_i) N_i^{p-1} + (t_{i+p+1} - u) / (t_{i+p+1} - t_{i+1}) N_{i+1}^{p-1}.

    knots (n + p + 1,) of a domain that is not empty, u (m,) clipped to it -> values
    (derivatives + 1, m, p + 1), spans (m,); column j belongs to the control point span - p + j. At a knot the
    derivative from the right is given, at the right end of the domain the one from the left. A span found is
    never empty, so no divisor is zero: functions of empty support (0/0 := 0) are not met. De Boor (1972).
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
    """Basis values of every degree q <= p, (q + 1, m) each, from the knots `window` (2 p, m) around u."""
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
    """q (N_i^{q-1} / (t_{i+q} - t_i) - N_{i+1}^{q-1} / (t_{i+q+1} - t_{i+1})): (q, m) -> (q + 1, m)."""
    ratio = q * level / (window[degree : degree + q] - window[degree - q : degree])
    raised = np.zeros((q + 1, ratio.shape[1]))
    raised[1:] = ratio
    raised[:-1] -= ratio
    return raised


def positive(width: Floats) -> Floats:
    """The width, or infinity where it is zero, so that 0 / 0 := 0."""
    return np.where(width > 0.0, width, np.inf)


def scatter(values: Floats, first: Ints, size: int, periodic: bool = False) -> Floats:
    """Dense rows (m, size) of the local values (m, p + 1) whose first column is the control point `first`.

    Where periodic, columns are folded modulo `size` (and summed where a short period folds them together).
    """
    matrix = np.zeros((len(values), size))
    columns = first[:, None] + np.arange(values.shape[1])
    if periodic:
        columns %= size
    np.add.at(matrix, (np.arange(len(values))[:, None], columns), values)
    return matrix


def basis_matrix(knots: Floats, degree: int, u: Floats, n: int, derivative: int = 0) -> Floats:
    """B with B[k, i] = d^r/du^r N_i^p(u_k): (m, n), so that S(u) = B c for n control points."""
    values, span = basis(knots, degree, u, derivative)
    return scatter(values[derivative], span - degree, n)


def periodic_basis_matrix(knots: Floats, degree: int, u: Floats, m: int, derivative: int = 0) -> Floats:
    """B onto the m distinct control points of a periodic spline, u taken modulo the period: (rows, m)."""
    values, span = basis(knots, degree, wrap(knots, degree, u), derivative)
    return scatter(values[derivative], span - degree, m, periodic=True)


def uniform_knots(count: int, degree: int, interval: float = 1.0, start: float = 0.0) -> Floats:
    """Unclamped equally spaced knots of `count` control points, the domain beginning at `start`."""
    return start + interval * np.arange(-degree, count + 1, dtype=np.float64)


def clamped_knots(breaks: Floats, degree: int) -> Floats:
    """The breaks (k + 1,) with both ends repeated p times more: knots of k + p control points."""
    return np.concatenate([np.full(degree, breaks[0]), breaks, np.full(degree, breaks[-1])])


def periodic_knots(breaks: Floats, degree: int) -> Floats:
    """One period of m + 1 > p breaks and p knots more on either side, for m + p unwrapped control points."""
    period = breaks[-1] - breaks[0]
    before = breaks[-1 - degree : -1] - period
    after = breaks[1 : degree + 1] + period
    return np.concatenate([before, breaks, after])


def end_change_matrix(knots: Floats, degree: int, new_knots: Floats) -> Floats:
    """M (n, n) with C_new = M C: the same curve on the same domain where only knots outside of it changed.

    c_j is the blossom of the polynomial of a span that it acts on, at the knots t_{j+1} .. t_{j+p}
    (Ramshaw 1989): so clamping, unclamping and the extension of Hu et al. (2002) are one formula. The first
    and the last span of the domain must not be empty; knots beyond index n + p - 1 are not read.
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
    """Weights (p + 1,) on the span's control points of its polynomial's blossom, by de Boor's recurrence."""
    weights = np.eye(degree + 1)
    for r, x in enumerate(arguments, start=1):
        lower = knots[span - degree + r : span + 1]
        upper = knots[span + 1 : span + degree - r + 2]
        share = ((x - lower) / (upper - lower))[:, None]
        weights = (1.0 - share) * weights[:-1] + share * weights[1:]
    return np.asarray(weights[0])
