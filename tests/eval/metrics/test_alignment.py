"""Two maps of one track: laid on each other, and where they differ."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.alignment import (
    aligned_distance,
    differences,
    end_by_registration,
    maps_apart,
    shape_rmse,
    standing,
)
from pathspace_graph.factors.noise import MeasuredNoise
from pathspace_graph.factors.se2 import inverse, move_points, to_vehicle, wrap_angle
from pathspace_graph.front_end.front_end import measure_log, seen_cycles
from pathspace_graph.io.log import Detections, Log, Truth
from pathspace_graph.io.map import NO_COVARIANCE, Map, PointBoundary, SplineBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.sim.faults import Faults, OdometryFaults
from pathspace_graph.sim.sensor import SensorSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track
from pathspace_graph.sim.vehicle import VehicleSettings
from pathspace_graph.spline.bspline import fit_spline

from ...scenes.drives import bean_track, detections
from ...scenes.maps import boundary, circle, ring_map

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
    splines = {label: fit_spline(own, len(own), True)[0] for label, own in cones.items()}
    return Map(True, {label: SplineBoundary(one, np.eye(2 * one.size)) for label, one in splines.items()})


def points(cones: dict[int, Array]) -> Map:
    return Map(True, {label: PointBoundary(own, NO_COVARIANCE) for label, own in cones.items()})


@pytest.mark.parametrize("kind", [curves, points])
def test_a_map_lies_on_itself_wherever_its_drive_began(kind: type) -> None:
    track = kind(rows())
    apart = maps_apart((points(rows()) if kind is points else track).moved(AWAY), track)
    assert apart.statistics()["both"]["mean"] < 1e-3
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
    half = 0.15 * np.sqrt(2.0 * np.log(2.0 / 0.5)) * 17.0
    assert one.length == pytest.approx(2.0 * half, abs=1.5)
    off, place = f"{one.distance:.2f} m from the known map", f"at x = {one.x:.1f} m, y = {one.y:.1f} m"
    assert one.line == f"the left boundary is up to {off} on {one.length:.0f} m, {place}"


# --- registration of the end of a drive ------------------------------------------------------------------


@cache
def standing_drive() -> tuple[Log, MeasuredNoise, Array]:
    """A lap, its noise and true last pose. Odometry misses 0.4 m of the start and goes on after the stop."""
    odometry = OdometryFaults(dead_band=1.5, false_travel=1.0, false_travel_time=3.0)
    vehicle = VehicleSettings(rest=3.0, stand=5.0, overrun=8.0)
    settings = SimulationSettings(
        laps=1, vehicle=vehicle, sensor=SensorSettings(range_max=25.0), faults=Faults(odometry=odometry)
    )
    log = simulate(generate_track(np.random.default_rng(21)), settings, seed=4)
    noise = measure_log(log)
    assert log.truth is not None and noise is not None
    return log, noise, log.truth.poses[-1]


def test_a_start_and_a_stop_that_the_odometry_misses_are_in_the_reference() -> None:
    log, noise, true = standing_drive()
    cycles = seen_cycles(log)
    assert 20 < len(standing(cycles)) <= 55 and 20 < len(standing(cycles[::-1])) <= 35
    assert np.hypot(*(cycles[-1].pose[:2] - true[:2])) > 1.0
    found = end_by_registration(cycles, noise)
    assert found is not None
    np.testing.assert_allclose(found[:2], true[:2], atol=0.15)
    assert found[2] == pytest.approx(true[2], abs=0.02)
    moving = [one for one in cycles if one.detections.t > 4.0]
    assert end_by_registration(moving, noise) is None
    assert end_by_registration(cycles[:-60], noise) is None


def test_what_is_seen_in_one_cycle_is_no_cone_of_the_reference() -> None:
    """The nearest four cones are too few, though there is clutter at the same places at both ends."""
    log, noise, true = standing_drive()
    cycles = [
        cycle.where(np.argsort(np.argsort(np.hypot(*cycle.points_vehicle.T))) < 4) for cycle in log.cycles
    ]
    for k, place in enumerate(np.random.default_rng(0).uniform([4.0, -9.0], [22.0, 9.0], (30, 1, 2))):
        for row, point in ((k, place), (-1 - k, to_vehicle(place, true[None]))):
            clutter = detections(cycles[row].t, point, np.array([LEFT]))
            _, *parts = zip(vars(cycles[row]).values(), vars(clutter).values(), strict=True)
            cycles[row] = Detections(clutter.t, *map(np.concatenate, parts))
    seen = seen_cycles(replace(log, cycles=tuple(cycles)))
    assert standing(seen) and standing(seen[::-1]) and end_by_registration(seen, noise) is None


def test_without_common_cones_there_is_no_reference() -> None:
    settings = SimulationSettings(laps=1, vehicle=VehicleSettings(rest=3.0, stand=5.0, overrun=-60.0))
    log = simulate(generate_track(np.random.default_rng(21)), settings, seed=4)
    noise = measure_log(log)
    assert noise is not None
    assert end_by_registration(seen_cycles(log), noise) is None
