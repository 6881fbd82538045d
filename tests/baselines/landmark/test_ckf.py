"""The paper's baseline filter: association, landmarks, and whole drives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pathspace_graph.baselines.filters import LandmarkCkf
from pathspace_graph.estimators import make_online
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.io.map import PointBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.drives import ahead, corridor, exact_log


def straight() -> Log:
    cones, labels = corridor(60.0)
    return exact_log(ahead(6.0, 8.0), cones, labels)


def test_a_straight_drive_maps_each_detected_cone_once() -> None:
    log = straight()
    result = run_online(log, make_online("landmark-ckf", MapperSettings(), log), name="landmark-ckf")
    assert log.truth is not None
    for label in (LEFT, RIGHT):
        boundary = result.map.boundaries[label]
        assert isinstance(boundary, PointBoundary)
        cones = log.truth.cones[log.truth.cone_labels == label]
        offset = boundary.points[:, None] - cones[None]
        distance = np.hypot(offset[..., 0], offset[..., 1])
        assert distance.min(axis=1).max() < 0.05
        assert len(np.unique(distance.argmin(axis=1))) == boundary.size >= 12
        assert np.linalg.eigvalsh(boundary.covariance)[0] > 0.0


def test_detections_update_only_landmarks_of_their_label() -> None:
    """Detections whose label changes create landmarks with the new label, and do not move the old ones."""
    log = straight()
    swapped = tuple(
        Detections(c.t, c.points_vehicle, c.covariances, 1 - c.labels) if k >= len(log.cycles) // 2 else c
        for k, c in enumerate(log.cycles)
    )
    mapper = LandmarkCkf(odometry_sigma=log.odometry_sigma)
    result = run_online(replace(log, cycles=swapped), mapper, name="landmark-ckf")
    sides = {label: np.sign(result.map.boundaries[label].points[:, 1]) for label in (LEFT, RIGHT)}  # type: ignore[union-attr]
    assert set(sides[LEFT]) == set(sides[RIGHT]) == {-1.0, 1.0}


def test_one_false_detection_creates_no_landmark_unless_the_settings_say_so() -> None:
    log = straight()

    def with_ghost(c: Detections) -> Detections:
        points = np.concatenate([c.points_vehicle, [[5.0, 20.0]]])
        covariances = np.concatenate([c.covariances, 0.01 * np.eye(2)[None]])
        return Detections(c.t, points, covariances, np.append(c.labels, LEFT))

    def size(tentative: int) -> int:
        settings = MapperSettings(ckf=replace(MapperSettings().ckf, sightings=tentative))
        mapper = LandmarkCkf(settings, log.odometry_sigma)
        for k, (odometry, cycle) in enumerate(split_odometry(log)):
            mapper.update(odometry, with_ghost(cycle) if k == 30 else cycle)
        return int((np.abs(mapper.belief.points[:, 1]) > 10.0).sum())

    assert size(3) == 0
    assert size(1) == 1
