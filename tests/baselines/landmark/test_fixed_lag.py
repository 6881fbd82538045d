"""The landmark graph online: exact laps, and drives with one fault in each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pathspace_graph.baselines.landmark_graph import LandmarkFixedLag
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.metrics.accuracy import lap_metrics
from pathspace_graph.eval.metrics.trajectory import position_rms, trajectory_errors
from pathspace_graph.front_end.sides import SideJudge
from pathspace_graph.io.log import Detections, Log
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings, SidesSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.drives import ahead, bean_track, corridor, exact_log, lap_log

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def lap() -> Log:
    return lap_log(bean_track(), overrun=25.0)


def run(log: Log, settings: MapperSettings | None = None) -> LandmarkFixedLag:
    estimator = LandmarkFixedLag(settings, log.odometry_sigma)
    run_online(log, estimator)
    return estimator


def with_cycles(log: Log, cycles: list[Detections]) -> Log:
    return replace(log, cycles=tuple(cycles))


def points(track: Map, label: int) -> Array:
    boundary = track.boundaries[label]
    assert isinstance(boundary, PointBoundary)
    return boundary.points


def farthest(track: Map, log: Log) -> float:
    """Returns the largest distance (m) from a landmark to a true cone of its label, and back."""
    assert log.truth is not None
    worst = 0.0
    for label in BOUNDARIES:
        cones = log.truth.cones[log.truth.cone_labels == label]
        mapped = points(track, label)
        worst = max(worst, KDTree(cones).query(mapped)[0].max(), KDTree(mapped).query(cones)[0].max())
    return worst


def test_an_exact_lap_closes_with_one_landmark_for_each_cone(lap: Log) -> None:
    estimator = run(lap)
    track = estimator.map()
    assert lap.truth is not None
    assert track.closed and estimator.closed
    assert track.size == len(lap.truth.cones)
    assert farthest(track, lap) < 0.02
    for boundary in track.boundaries.values():
        assert np.linalg.eigvalsh(boundary.covariance)[0] > 0.0


def test_a_lap_that_is_too_long_for_a_batch_stays_open(lap: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(lap).closed
    monkeypatch.setattr("pathspace_graph.loop.drive.MOST_CYCLES", 20)
    assert not run(lap).closed


def test_a_noisy_drive_is_mapped_completely() -> None:
    log = simulate(bean_track(), SimulationSettings(laps=2), seed=1)
    result = run_online(log, make_online("landmark-fixed-lag", MapperSettings(), log))
    assert log.truth is not None
    assert result.map.closed and result.laps == 2
    metrics = lap_metrics(result.map, log.truth, 2)
    assert metrics.missed == 0.0
    assert position_rms(trajectory_errors(result.trajectory_t, result.trajectory, log.truth)) < 0.3
    assert result.cycles[-1].stages.keys() == {
        "predict", "associate", "create", "update", "close", "marginalize"
    }  # fmt: skip
    assert farthest(result.map, log) < 3.0


def test_two_detections_create_no_landmark_and_three_do() -> None:
    cones, labels = corridor(60.0)
    log = exact_log(ahead(5.0, 4.0), cones, labels)
    thing = np.array([[5.0, 6.0]])  # it stands still, off the track
    k = 10

    def seen(times: int) -> int:
        cycles = list(log.cycles)
        for i in range(k, k + times):
            c = cycles[i]
            local = thing - np.array([[0.5 * (i - k), 0.0]])
            cycles[i] = Detections(
                c.t,
                np.concatenate([c.points_vehicle, local]),
                np.concatenate([c.covariances, 0.01 * np.eye(2)[None]]),
                np.append(c.labels, LEFT),
            )
        return run(with_cycles(log, cycles)).map().size

    without = seen(0)
    assert seen(2) == without
    assert seen(3) == without + 1


def test_detections_with_unknown_labels_are_used_and_create_nothing() -> None:
    """This is so where sides are not told from the way driven."""
    cones, labels = corridor(60.0)
    log = exact_log(ahead(5.0, 4.0), cones, labels)
    blank = [replace(c, labels=np.full(len(c.labels), UNKNOWN)) for c in log.cycles]
    settings = MapperSettings(sides=SidesSettings(colourless=1.0))
    assert run(with_cycles(log, blank), settings).map().size == 0
    late = [c if i < 20 else blank[i] for i, c in enumerate(log.cycles)]
    estimator = LandmarkFixedLag(settings, log.odometry_sigma)
    used = [estimator.update(o, c).readings for o, c in split_odometry(with_cycles(log, late))]
    assert min(used[20:30]) > 0


def test_a_cone_first_detected_with_the_wrong_label_gets_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    cones, labels = corridor(40.0)
    cones = cones + np.array([8.0, 0.0])  # so that no cone leaves the view before it is outvoted
    log = exact_log(ahead(5.0, 5.0), cones, labels)
    cycles = list(log.cycles)
    swapped = np.array([RIGHT, LEFT, UNKNOWN])
    for i in range(6):
        cycles[i] = replace(cycles[i], labels=swapped[cycles[i].labels])
    monkeypatch.setattr(SideJudge, "_judge_colours", lambda *_: None)  # colours are not swapped
    track = run(with_cycles(log, cycles)).map()
    for label in BOUNDARIES:
        assert (np.sign(points(track, label)[:, 1]) == (1 if label == LEFT else -1)).all()
    assert track.size == run(log).map().size
