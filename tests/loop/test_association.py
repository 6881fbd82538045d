"""Association: which detections a curve accepts, by offsets that are put in by hand on exact drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import integrate_twists
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.labels import LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.motion import MeasuredMotion, integrate_odometry, predict
from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.settings.mapper import GateSettings

from ..scenes.drives import (
    CYCLE,
    DT,
    ODOMETRY_SIGMA,
    READING_SIGMA,
    ahead,
    corridor,
    detections,
    exact_log,
    map_log,
)

Array = NDArray[np.float64]

SPEED = 6.0
AHEAD = 4.0
"""The detections of a test lie this far ahead of the vehicle (m), where the curve is known."""
OWN_VARIANCE = READING_SIGMA**2 + 0.25**2 + 0.1**2
"""This is the variance (m^2) of a residual by the detection, the model, and the floor of the gate."""


def driven(seconds: float = 4.0, half_width: float = 2.0) -> FixedLagMapper:
    """Returns the mapper after a straight exact drive between two rows of cones."""
    return map_log(exact_log(ahead(SPEED, seconds), *corridor(60.0, half_width=half_width)))[0]


def next_cycle(
    mapper: FixedLagMapper, points_vehicle: Array, labels: list[int]
) -> tuple[Odometry, Detections]:
    """Returns the next cycle straight on, with detections (m, 2) that are put in by hand."""
    t = mapper.road.smoother.times[-1]
    odometry = Odometry(t + DT * np.arange(CYCLE), ahead(SPEED, CYCLE * DT))
    return odometry, detections(t + CYCLE * DT, points_vehicle, np.array(labels, np.intp))


def used_of(mapper: FixedLagMapper, points_vehicle: Array, labels: list[int]) -> list[int]:
    """Returns the boundary that each detection of the next cycle is used on, or -1 for none."""
    mapper.update(*next_cycle(mapper, points_vehicle, labels))
    table = mapper.road.smoother.map.detections
    newest = table.cycle == mapper.road.smoother.next_cycle - 1
    return np.where(table.used, table.boundary, -1)[newest].tolist()


def at(lateral: list[float]) -> Array:
    """Returns points (k, 2) of the vehicle frame, AHEAD of it and at these distances to its left (m)."""
    return np.column_stack([np.full(len(lateral), AHEAD), lateral])


# --- the gate --------------------------------------------------------------------------------------------


def variance_of_residual(mapper: FixedLagMapper) -> float:
    """Returns the variance (m^2) of a residual AHEAD on the left curve in the next cycle.

    On a straight along x the gradient is (0, 1, AHEAD) by the pose, and minus the basis by the control
    points' y. The next pose is the last one with one cycle of odometry.
    """
    step = integrate_twists(
        np.full(CYCLE, DT), ahead(SPEED, CYCLE * DT), mapper.front_end.noise.known.odometry
    )
    x = mapper.poses[-1, 0] + step.delta[0] + AHEAD
    keys = mapper.control_keys(LEFT)
    spline = mapper.boundaries[LEFT].spline(mapper.control_points(LEFT))
    g = np.zeros(3 + 2 * len(keys))
    g[:3] = [0.0, 1.0, AHEAD + step.delta[0]]
    g[4::2] = -spline.basis_matrix(spline.foot_points(np.array([[x, 2.0]])).u)[0]
    pose, by_step = mapper.pose_key(mapper.road.smoother.next_cycle - 1), np.array([0.0, 1.0, AHEAD])
    joint = g @ mapper.marginal_covariance([pose, *keys]) @ g + by_step @ step.covariance @ by_step
    return float(joint + OWN_VARIANCE)


def test_the_gate_is_three_sigmas_of_detection_pose_and_curve_together() -> None:
    """The odometry of the cycle is so poor that the detection's own uncertainty is half of the variance."""
    mapper = driven()
    noise = mapper.front_end.noise
    noise.known.odometry[:] = [0.25, 6.0, 0.035]
    mapper.front_end._motion.set_noise(noise.twist)
    variance = variance_of_residual(mapper)
    assert variance > 1.8 * OWN_VARIANCE
    shares = [-1.5, -1.03, -0.97, -0.3, 0.0, 0.5, 0.97, 1.03, 1.5]
    found = used_of(mapper, at([2.0 + 3.0 * share * np.sqrt(variance) for share in shares]), [LEFT] * 9)
    assert found == [LEFT if abs(share) < 1.0 else -1 for share in shares]


def test_what_is_rough_off_is_never_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gate by sigmas alone would accept both."""
    mapper = driven()
    monkeypatch.setattr(GateSettings, "rough", 1.0)
    mapper.road.smoother.map.settings = replace(mapper.settings, gate=GateSettings(chi=100.0))
    assert used_of(mapper, at([2.9, 3.1]), [LEFT, LEFT]) == [LEFT, -1]


def test_a_detection_of_the_other_colour_is_rejected() -> None:
    assert used_of(driven(), at([2.0, -2.0, 2.0, -2.0]), [LEFT, LEFT, RIGHT, RIGHT]) == [LEFT, -1, -1, RIGHT]


def test_nothing_is_used_beyond_the_end_of_a_curve_or_out_of_view() -> None:
    """The curves end 7 m ahead at most, and 4 m behind the vehicle they are out of view."""
    mapper = driven()
    along = np.array([20.0, 3.0, -3.5, -5.0, -12.0])
    found = used_of(mapper, np.column_stack([along, np.full(5, 2.0)]), [LEFT] * 5)
    assert found == [-1, LEFT, LEFT, -1, -1]


# --- unknown colour --------------------------------------------------------------------------------------


def test_a_detection_of_unknown_colour_goes_to_the_one_curve_that_accepts_it() -> None:
    """Its gate is narrower, and of its own uncertainty alone: 1.5 sqrt(0.1^2 + 0.25^2 + 0.1^2) = 0.43 m."""
    lateral = [2.0, -2.0, 2.41, -2.41, 2.45, 0.0]
    found = used_of(driven(), at(lateral), [UNKNOWN] * 6)
    assert found == [LEFT, RIGHT, LEFT, RIGHT, -1, -1]


def test_a_detection_of_unknown_colour_between_two_curves_is_ambiguous() -> None:
    """The rows are 0.6 m apart: the point between them is in both gates, one on the outer side in one."""
    found = used_of(driven(half_width=0.3), at([0.0, 0.5, -0.5]), [UNKNOWN] * 3)
    assert found == [-1, LEFT, RIGHT]


# --- the window ------------------------------------------------------------------------------------------


def test_older_detections_are_tested_again_only_where_a_curve_has_grown() -> None:
    mapper = driven()
    smoother, table = mapper.road.smoother, mapper.road.smoother.map.detections
    released = np.concatenate([table.used_on(label)[-5:] for label in (LEFT, RIGHT)])
    labels = table.boundary[released].copy()
    table.release(released)
    odometry, cycle = next_cycle(mapper, at([]), [])
    motion = MeasuredMotion(integrate_odometry(odometry, cycle.t, ODOMETRY_SIGMA), odometry.twist)
    predict(smoother, mapper.road.path, motion, cycle.t)
    smoother.associate(frozenset())
    assert not table.used[released].any()
    for label in (LEFT, RIGHT):  # the newest pose's parameter was appended; it is found anew
        smoother.map.state.pose_u[label] = smoother.map.state.pose_u[label][:-1]
    smoother.associate(frozenset({LEFT}))
    np.testing.assert_array_equal(table.used[released], labels == LEFT)
    assert table.changed[released].all()


# --- the place of the vehicle ------------------------------------------------------------------------------


def test_the_pose_is_found_beside_the_curve_in_every_cycle() -> None:
    """The parameter of a straight curve is the way along it, up to where the first cone was."""
    mapper = driven()
    before = {label: u.copy() for label, u in mapper.road.smoother.map.state.pose_u.items()}
    used_of(mapper, at([]), [])
    for label, u in mapper.road.smoother.map.state.pose_u.items():
        assert len(u) == len(mapper.poses)
        assert u[-1] - before[label][-1] == pytest.approx(SPEED * CYCLE * DT, abs=0.02)


@pytest.fixture
def hairpin() -> FixedLagMapper:
    """The mapper after 36 m straight on, half a turn of radius 2.5 m, and 20 m of the way back.

    The inner rows of both legs are 1.4 m apart.
    """
    straight, radius, half = 36.0, 2.5, 1.8
    steps = round(np.pi * radius / SPEED / DT)
    turn = np.tile([SPEED, 0.0, np.pi / steps / DT], (steps, 1))
    x, angle = np.arange(0.0, straight + 0.1, 4.0), np.linspace(-np.pi / 2, np.pi / 2, 7)[1:-1]
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rows = [
        np.concatenate(
            [
                np.column_stack([x, np.full(len(x), side)]),
                np.array([straight, radius]) + (radius - side) * circle,
                np.column_stack([x[::-1], np.full(len(x), 2.0 * radius - side)]),
            ]
        )
        for side in (half, -half)
    ]
    labels = np.repeat([LEFT, RIGHT], [len(row) for row in rows]).astype(np.intp)
    twists = np.concatenate([ahead(SPEED, straight / SPEED), turn, ahead(SPEED, 20.0 / SPEED)])
    return map_log(exact_log(twists, np.concatenate(rows), labels))[0]


def test_the_other_leg_of_a_hairpin_accepts_nothing(hairpin: FixedLagMapper) -> None:
    """A left detection on the leg of the way there lies on the curve, but on no part in view."""
    x, y, theta = hairpin.poses[-1]
    assert abs(theta - np.pi) < 0.05
    boundary, points = hairpin.boundaries[LEFT], hairpin.control_points(LEFT)
    rows_map = np.array([[x - 1.0, 3.2], [x - 1.0, 1.8]])
    whole = boundary.find(points, rows_map, np.zeros(2), np.full(2, boundary.confirmed_end))
    assert np.abs(whole.distance).max() < 0.1
    assert used_of(hairpin, np.array([[1.0, y - 3.2], [1.0, y - 1.8]]), [LEFT, LEFT]) == [LEFT, -1]


def test_a_vehicle_that_has_lost_its_place_is_relocated(hairpin: FixedLagMapper) -> None:
    """Its parameters are put on the other leg, where both curves lead against its heading."""
    pose_u = hairpin.road.smoother.map.state.pose_u
    before = {label: pose_u[label][-1] for label in (LEFT, RIGHT)}
    for u in pose_u.values():
        np.subtract(u, 30.0, out=u)
    used_of(hairpin, at([]), [])
    for label, u in before.items():
        assert hairpin.road.smoother.map.state.pose_u[label][-1] == pytest.approx(
            u + SPEED * CYCLE * DT, abs=0.1
        )
