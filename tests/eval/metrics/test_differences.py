"""Where a map differs from the known one: the stretch, its place, and how far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.eval.metrics.alignment import DIFFERENT, differences
from pathspace_graph.labels import LEFT

from ...scenes.maps import boundary, circle, ring_map


def test_a_map_does_not_differ_from_itself() -> None:
    assert differences(ring_map(), ring_map()) == []


def test_a_bulge_is_told_with_its_place_length_and_distance() -> None:
    """The left circle of 18 m has a bulge of 2 m inwards at (-18, 0)."""
    known, round_one = ring_map(), circle(18.0, 60)
    points = round_one.distinct_control_points.copy()
    angle = np.arctan2(points[:, 1], -points[:, 0])  # from the negative x axis
    points *= (1.0 - 2.0 / 18.0 * np.exp(-0.5 * (angle / 0.15) ** 2))[:, None]
    bulged = type(round_one).periodic_from(round_one.breaks, points)
    found = replace(known, boundaries={**known.boundaries, LEFT: boundary(bulged)})
    (one,) = differences(known, found)
    assert one.boundary == "left"
    assert one.x == pytest.approx(-16.0, abs=0.2)
    assert one.y == pytest.approx(0.0, abs=0.3)
    assert one.distance == pytest.approx(1.86, abs=0.02)  # a control point of 2 m
    half = 0.15 * np.sqrt(2.0 * np.log(2.0 / DIFFERENT)) * 17.0
    assert one.length == pytest.approx(2.0 * half, abs=1.5)
    off, place = f"{one.distance:.2f} m from the known map", f"at x = {one.x:.1f} m, y = {one.y:.1f} m"
    assert one.line == f"the left boundary is up to {off} on {one.length:.0f} m, {place}"
