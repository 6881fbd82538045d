"""The layout of several curves in numpy: their spans on one axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pathspace_graph.factors.arrays import Array, IntArray
from pathspace_graph.factors.bspline import SpanPolynomials

_PERIODS_LAID_OUT: Final = (-1.0, 0.0, 1.0)  # shifts at which a periodic curve lies on the axis of `Spans`
_GAP_OF_CURVES: Final = 1.0  # least distance of curves on the axis of `Spans`, in units of the parameter


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of several curves of one degree on one axis v: rows on any of them are evaluated in one call.

    Parameter u of curve k lies at `v = u + shift[k]`. A periodic curve is laid out for three periods, so that
    a stretch across the seam need not be wrapped.
    """

    degree: int
    periodic: bool  # all curves are closed, or none is
    low: Array
    high: Array  # limits (k,) of the curves' domains on the axis
    shift: Array  # (k,) from a curve's own parameter to the axis; zero for the first curve
    interval: Array  # (k,) mean knot intervals
    first: int  # where the control points of the first curve begin in the common array
    columns: IntArray  # (n, p + 1) control points that matter on each span
    starts: Array  # (l,) left ends of the spans, in order: l is n, or 3 n for periodic curves
    inverse_widths: Array  # (l,) one over the width of each span
    number: IntArray  # (l,) number of each span, in [0, n)
    by_span: Array  # (n, 3 (p + 1), p + 1) polynomials of the basis and of two derivatives
    values: Array  # (p + 1, n, p + 1) polynomials of the basis, power after power


def lay_out(
    curves: Sequence[SpanPolynomials], offsets: Sequence[int], sizes: Sequence[int] | None = None
) -> Spans:
    """Return the spans of curves, all periodic or none, laid out on one axis.

    The control points of each curve begin at its entry of `offsets` in a common array, which holds unwrapped
    ones, or as many distinct ones of each periodic curve as `sizes` tells.
    """
    periodic, counts = curves[0].periodic, [curve.occupied for curve in curves]
    periods = np.array(_PERIODS_LAID_OUT) if periodic else np.zeros(1)
    shift = np.array(_shifts(curves, periods))
    columns = [_windows(curve)[:n] for curve, n in zip(curves, counts, strict=True)]
    if periodic and sizes is not None:
        columns = [window % size for window, size in zip(columns, sizes, strict=True)]
    starts = [
        (curve.starts[:n] + curve.length * periods[:, None]).ravel() + moved
        for curve, n, moved in zip(curves, counts, shift, strict=True)
    ]
    first = np.cumsum([0, *counts[:-1]])
    number = [np.tile(k + np.arange(n), len(periods)) for k, n in zip(first, counts, strict=True)]
    inverse_widths = np.concatenate([c.inverse_widths[:n] for c, n in zip(curves, counts, strict=True)])
    laid = np.concatenate(number)
    return Spans(
        degree=curves[0].degree,
        periodic=periodic,
        low=np.array([curve.low for curve in curves]) + shift,
        high=np.array([curve.high for curve in curves]) + shift,
        shift=shift,
        interval=np.array([curve.length / len(curve.starts) for curve in curves]),
        first=offsets[0],
        columns=np.concatenate([k + window for k, window in zip(offsets, columns, strict=True)]),
        starts=np.concatenate(starts),
        inverse_widths=inverse_widths[laid],
        number=laid,
        by_span=np.concatenate([_polynomials(c)[:n] for c, n in zip(curves, counts, strict=True)]),
        values=np.concatenate([c.coefficients[:, :n] for c, n in zip(curves, counts, strict=True)], axis=1),
    )


def _shifts(curves: Sequence[SpanPolynomials], periods: Array) -> list[float]:
    """Return the shift of each curve at which no two overlap: whole numbers, which add little round-off."""
    shifts, end = [0.0], curves[0].high + curves[0].length * periods[-1]
    for curve in curves[1:]:
        shifts.append(float(np.ceil(end - (curve.low + curve.length * periods[0]) + _GAP_OF_CURVES)))
        end = curve.high + curve.length * periods[-1] + shifts[-1]
    return shifts


def _windows(curve: SpanPolynomials) -> IntArray:
    """Return the indices (n - p, p + 1) of the control points that matter on each span."""
    return np.arange(len(curve.starts))[:, None] + np.arange(curve.degree + 1)


def _polynomials(curve: SpanPolynomials) -> Array:
    """Return the polynomials of the basis and of two derivatives by span: (n - p, 3 (p + 1), p + 1)."""
    stack = curve._stack(2)
    return stack.transpose(1, 0, 2).reshape(len(curve.starts), -1, curve.degree + 1)
