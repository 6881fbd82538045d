"""Ribbons between circles and straights, their edges, and the derivatives of these."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.map import SplineBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT
from pathspace_graph.spline.bspline import BSpline
from pathspace_graph.spline.centre_line import CentreCurve, find_line

from ..scenes.jacobians import assert_jacobians
from ..scenes.maps import open_map, ring_map

Array = NDArray[np.float64]


def line_of(kind: str, spacing: float = 3.0) -> CentreCurve:
    track = ring_map() if kind == "ring" else open_map()
    splines = []
    for label in BOUNDARIES:
        boundary = track.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        splines.append(boundary.spline)
    return find_line(splines[0], splines[1], spacing)


def test_the_ribbon_between_two_circles() -> None:
    """Circles of 18 m and 22 m: the line has 20 m and the track 2 m to either side."""
    ribbon = line_of("ring").ribbon
    assert ribbon.periodic
    assert ribbon.size == round(2 * np.pi * 20.0 / 3.0)
    u = np.linspace(0.0, ribbon.tables.high, 200)
    np.testing.assert_allclose(np.hypot(*ribbon.centre.evaluate(u).T), 20.0, atol=2e-3)
    np.testing.assert_allclose(ribbon.half_width(u), 2.0, atol=1e-3)
    for label, radius in ((LEFT, 18.0), (RIGHT, 22.0)):
        spline, _ = ribbon.edge(label)
        at = np.linspace(*spline.domain, 333)
        np.testing.assert_allclose(np.hypot(*spline.evaluate(at).T), radius, atol=5e-3)


def test_the_ribbon_between_two_straights() -> None:
    line = line_of("open")
    ribbon, splines = line.ribbon, line.sides
    assert not ribbon.periodic
    spline, _ = ribbon.edge(LEFT)
    np.testing.assert_allclose(spline.evaluate(np.linspace(*spline.domain, 50))[:, 1], 2.0, atol=1e-6)
    ends = [splines[0].evaluate(np.array([u]))[0, 0] for u in splines[0].domain]
    np.testing.assert_allclose([spline.evaluate(np.array([u]))[0, 0] for u in spline.domain], ends, atol=1e-3)


@pytest.mark.parametrize("kind", ["ring", "open"])
@pytest.mark.parametrize("label", BOUNDARIES)
def test_edges_change_with_the_control_points_as_the_derivatives_say(kind: str, label: int) -> None:
    ribbon = line_of(kind, 8.0).ribbon
    rng = np.random.default_rng(2)
    distinct = ribbon.distinct_control_points + rng.normal(0.0, 0.2, ribbon.distinct_control_points.shape)

    def control_points(values: Array) -> tuple[Array, Array]:
        spline, by_control = ribbon.with_points(values.reshape(-1, 3)).edge(label)
        return spline.distinct_control_points.ravel(), by_control

    assert_jacobians(control_points, [distinct.ravel()])


@pytest.mark.parametrize("kind", ["ring", "open"])
def test_parameters_lead_from_a_boundary_to_the_place_beside_it(kind: str) -> None:
    """The point of the line is half the width away, also across the seam and a lap later."""
    line = line_of(kind)
    ribbon = line.ribbon
    for side, spline in enumerate(line.sides):
        low, high = spline.domain
        u = np.linspace(low, high, 40)[1:-1]
        laps = [u, u + (high - low), u - (high - low)] if ribbon.periodic else [u]
        for shifted in laps:
            at = line.ribbon_parameters(side, shifted)
            away = np.linalg.norm(ribbon.centre.evaluate(at) - spline.evaluate(u), axis=1)
            np.testing.assert_allclose(away, 2.0, atol=5e-3)


def test_boundaries_that_are_not_side_by_side_have_no_ribbon() -> None:
    line = BSpline.open_uniform(np.column_stack([np.arange(9.0), np.zeros(9)]))
    with pytest.raises(SettingsError, match="to the left of the right one"):
        find_line(line, line, 3.0)
