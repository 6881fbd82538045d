"""The memory that a map takes."""

from __future__ import annotations

from typing import Final

from pathspace_graph.map import Map, SplineBoundary

NUMBER: Final = 8
"""Bytes of a double."""


def map_bytes(track: Map) -> int:
    """8 (2 m + knots) of a spline: distinct control points, one period of its knots; 8 (2 m) of landmarks."""
    numbers = 0
    for boundary in track.boundaries.values():
        numbers += 2 * boundary.size
        if isinstance(boundary, SplineBoundary):
            spline = boundary.spline
            numbers += len(spline.breaks) if spline.periodic else len(spline.knots)
    return NUMBER * numbers


def covariance_bytes(track: Map) -> int:
    """8 n (n + 1) / 2 of each boundary's joint covariance, n = 2 m, whose halves are the same."""
    sizes = [2 * boundary.size for boundary in track.boundaries.values()]
    return NUMBER * sum(n * (n + 1) // 2 for n in sizes)
