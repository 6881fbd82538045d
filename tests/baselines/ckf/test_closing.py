"""Closing of the paper's filter on two circles whose end has drifted away from their beginning."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.baselines.ckf import CurveState
from pathspace_graph.baselines.filters import (
    SIGMA_ALONG,
    SIGMA_TIE,
    associate_early_segment,
    simplify,
    update_by_correspondences,
)
from pathspace_graph.factors.se2 import move_points
from pathspace_graph.io.log import Detections

from .scenes import RADII, around, bend, circles, detections_of

Array = NDArray[np.float64]

SHIFT = np.array([0.5, 0.3])
PHI = 0.5
"""The vehicle has this angle (rad) on its second lap."""
MIDDLE = 24.0
"""Distance (m) within which the loop may close."""
COVARIANCE = np.diag([0.3, 0.3, 0.003]) ** 2


def true_pose(phi: float) -> Array:
    """Returns the pose (3,) between the circles at an angle."""
    return np.append(around(np.array([phi]), MIDDLE)[0], phi + 0.5 * np.pi)


def drifted() -> CurveState:
    """Returns both circles and the vehicle on its second lap, all of it displaced by the shift."""
    return circles(true_pose(PHI) + np.append(SHIFT, 0.0), SHIFT, COVARIANCE)


def last_cycles(shift: Array) -> list[tuple[Array, Detections]]:
    """Returns the last poses, displaced by a shift (2,), and what was detected from the true ones."""
    cycles = []
    for k in range(12):
        phi = PHI - 0.01 * (11 - k)
        pose, ahead = true_pose(phi), phi + np.array([0.05, 0.2, 0.35, 0.5])
        points = np.concatenate([around(ahead, radius) for radius in RADII.values()])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        points_vehicle = (points - pose[:2]) @ np.array([[c, -s], [s, c]])
        labels = np.repeat(list(RADII), len(ahead))
        cycles.append((pose + np.append(shift, 0.0), detections_of(points_vehicle, labels, 0.1 * k)))
    return cycles


def beginning() -> Array:
    """Returns the poses (k, 3) of the first stretch of the drive."""
    return np.array([true_pose(phi) for phi in np.linspace(0.0, 2.0, 30)])


def test_the_motion_takes_the_drift_of_the_lap_back() -> None:
    motion = associate_early_segment(drifted(), last_cycles(SHIFT), beginning())
    assert motion is not None
    moved = move_points(motion, around(np.array([PHI]), MIDDLE) + SHIFT)
    np.testing.assert_allclose(moved, around(np.array([PHI]), MIDDLE), atol=0.15)


def test_detections_off_the_beginning_are_not_associated() -> None:
    """The same detections from far outside the circles do not lie on the beginning."""
    assert associate_early_segment(drifted(), last_cycles(np.array([9.0, 9.0])), beginning()) is None


def test_the_correspondences_lay_the_end_on_the_beginning() -> None:
    state = drifted()
    spread = np.trace(state.belief.covariance)
    assert update_by_correspondences(state, np.append(-SHIFT, 0.0))
    phi = 2.0 * np.pi + np.linspace(0.1, 1.0, 20)
    for label, radius in RADII.items():
        end = np.full(20, state.curves[label].domain[1])
        on_end = state.foot_points(label, around(phi, radius), end - 1.3 * radius, end).position
        on_beginning = state.foot_points(label, on_end, 0.0 * end, 0.0 * end + 1.3 * radius)
        assert np.abs(on_beginning.distance).max() < 0.1
    assert np.trace(state.belief.covariance) < spread
    assert np.linalg.eigvalsh(state.belief.covariance)[0] > -1e-9


def test_along_a_curve_all_correspondences_are_one_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are one result of the registration: together they tell as much of the place as one alone."""
    state, noises = drifted(), list[Array]()
    monkeypatch.setattr(state.belief, "update", lambda *given: noises.append(np.diag(given[-1])))
    assert update_by_correspondences(state, np.append(-SHIFT, 0.0))
    (variances,) = noises
    along = variances[variances > 1.01 * SIGMA_TIE**2]
    assert len(along) == len(variances) / 2
    assert np.sum(1.0 / along) == pytest.approx(len(state.curves) / SIGMA_ALONG**2)


def test_closing_waits_until_the_end_has_reached_its_beginning() -> None:
    state = bend()
    before = state.belief.mean.copy()
    assert not update_by_correspondences(state, np.array([0.0, 50.0, 0.0]))
    np.testing.assert_array_equal(state.belief.mean, before)


@pytest.mark.parametrize("cones", [30, 50])
def test_simplified_circles_are_closed_and_have_a_share_of_the_cones(cones: int) -> None:
    state = circles(true_pose(PHI), np.zeros(2), COVARIANCE)
    phi = np.linspace(0.0, 2.0 * np.pi, cones, endpoint=False)
    simplify(state, {label: dict(enumerate(around(phi, radius))) for label, radius in RADII.items()})
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    for label, radius in RADII.items():
        curve, covariance = state.spline(label), state.covariance(label)
        assert curve.periodic
        assert curve.size == pytest.approx(state.settings.spline.size_share * cones, rel=0.2)
        assert np.abs(curve.foot_points(around(angle, radius)).distance).max() < 0.1
        assert covariance.shape == (2 * curve.size, 2 * curve.size)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        beside = curve.evaluate(np.array([state.pose_u[label] % curve.domain[1]]))[0]
        np.testing.assert_allclose(beside, around(np.array([2.0 * np.pi + 0.6]), radius)[0], atol=0.5)
    assert len(state.belief.points) == sum(curve.size for curve in state.curves.values())
