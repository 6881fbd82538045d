"""Two maps of one track laid on each other, from wherever each drive has begun."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.alignment import aligned_distance, maps_apart, shape_rmse
from pathspace_graph.factors.se2 import inverse, move_points, wrap_angle
from pathspace_graph.io.log import Truth
from pathspace_graph.io.map import NO_COVARIANCE, Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.spline.knots import fit_spline

from ...scenes.drives import bean_track

Array = NDArray[np.float64]

AWAY = np.array([30.0, -12.0, 2.0])
"""This is a motion onto the other side of the track, by far more than closest points bridge."""


def rows() -> dict[int, Array]:
    """Returns the cones of both boundaries, with a dent that no other place of the track has."""
    track = bean_track()
    left, right = track.left.copy(), track.right.copy()
    left[3] *= 1.1
    right[3] *= 1.1
    return {LEFT: left, RIGHT: right}


def curves(cones: dict[int, Array]) -> Map:
    splines = {label: fit_spline(own, len(own), True) for label, own in cones.items()}
    return Map(True, {label: SplineBoundary(one, np.eye(2 * one.size)) for label, one in splines.items()})


def points(cones: dict[int, Array]) -> Map:
    return Map(True, {label: PointBoundary(own, NO_COVARIANCE) for label, own in cones.items()})


@pytest.mark.parametrize("kind", [curves, points])
def test_a_map_lies_on_itself_wherever_its_drive_began(kind: type) -> None:
    track = kind(rows())
    apart = maps_apart((points(rows()) if kind is points else track).moved(AWAY), track)
    assert apart.mean < 1e-3
    off = apart.motion - inverse(AWAY)
    assert np.hypot(*off[:2]) < 0.01
    assert abs(wrap_angle(off[2:])[0]) < 1e-3


def test_the_statistics_are_of_each_boundary_and_both_ways() -> None:
    """One boundary of the two is wider by 0.2 m; the other one keeps it from moving there."""
    cones = rows()
    track, far = curves(cones), curves({**cones, RIGHT: 1.02 * cones[RIGHT]})
    found, back = maps_apart(far, track).statistics(), maps_apart(track, far).statistics()
    assert found["left"]["max"] < 0.1 < found["right"]["rms"] < 0.4
    assert found["right"]["mean"] <= found["right"]["rms"] <= found["right"]["p95"] <= found["right"]["max"]
    assert found["left"]["mean"] < found["both"]["mean"] < found["right"]["mean"]
    assert back["both"]["rms"] == pytest.approx(found["both"]["rms"], rel=1e-3)


def test_the_error_of_the_shape_has_no_part_of_the_frame() -> None:
    cones = rows()
    labels = np.repeat([LEFT, RIGHT], [len(cones[LEFT]), len(cones[RIGHT])])
    at = np.concatenate([cones[LEFT], cones[RIGHT]])
    truth = Truth(np.zeros(0), np.zeros((0, 3)), move_points(np.array([0.8, -0.5, 0.02]), at), labels)
    assert shape_rmse(curves(cones), truth) < 1e-3
    wider = curves({LEFT: cones[LEFT], RIGHT: 1.05 * cones[RIGHT]})  # by 0.5 to 1.1 m, half of the cones
    assert 0.5 < shape_rmse(wider, truth) < 0.7


def test_maps_without_a_common_boundary_are_refused() -> None:
    track, cones = curves(rows()), rows()
    left, right = (Map(True, {label: track.boundaries[label]}) for label in cones)
    assert aligned_distance(left, right) == np.inf
    with pytest.raises(SettingsError, match="expected a boundary that both have, found none"):
        maps_apart(left, right)
