"""The open map: a bias of the yaw rate is found as far as the measurements tell, though it swings the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph.graph.variables import CALIBRATION_KEY
from pathspace_graph.io.log import Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.smoother import FAR_STRETCH
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import ahead, corridor, exact_log, map_log

BIAS = 2e-3


@pytest.mark.slow
def test_a_bias_is_estimated_as_bayes_says() -> None:
    """On exact measurements the estimate is the true bias, shrunk by the share of its prior that is left.

    The start of the map stays at the start, although the vehicle is tens of metres beside its true place.
    """
    log = exact_log(ahead(10.0, 60.0), *corridor(640.0))
    biased = log.odometry.twist + np.array([0.0, 0.0, -BIAS])
    mapper, _ = map_log(replace(log, odometry=Odometry(log.odometry.t, biased)))
    variance = mapper.road.smoother.covariance(np.array([CALIBRATION_KEY]))[1, 1]
    share = variance / MapperSettings().odometry.sigma_bias ** 2
    expected = -BIAS * (1.0 - share)
    assert share < 0.9
    assert mapper.vehicle_state().calibration[1] == pytest.approx(expected, rel=0.2)
    first = mapper.control_points(0)[1]
    np.testing.assert_allclose(first[1], 2.0, atol=0.3)


def test_control_points_that_a_detection_holds_stay_active() -> None:
    """A detection in use may lie behind all that the window's poses see, where the map has moved since.

    Its control points were deactivated and activated again with all after them, in each cycle of the window.
    """
    mapper, _ = map_log(exact_log(ahead(10.0, 12.0), *corridor(150.0)))
    smoother = mapper.road.smoother
    state, detections = smoother.map.state, smoother.map.detections
    row = detections.used_on(LEFT)[:1]
    behind = float(state.pose_u[LEFT].min()) - 40.0
    assert state.boundaries[LEFT].tables.span_of(behind) < state.active(LEFT)[0]
    detections.refine(row, np.array([behind]))
    smoother.deactivate_distant()
    assert state.boundaries[LEFT].tables.span_of(behind - 2.0) == state.active(LEFT)[0]


def test_a_stretch_waits_for_a_cycle_without_growth_and_longer_for_a_batch() -> None:
    mapper, _ = map_log(exact_log(ahead(10.0, 12.0), *corridor(150.0)))
    road, asked = mapper.road, list[float]()
    road.smoother.deactivate_distant = asked.append  # type: ignore[method-assign,assignment]
    for grown in (frozenset[int](), frozenset({LEFT})):
        road.growth.expand = lambda *_, grown=grown: (grown, "")  # type: ignore[method-assign]
        for solving in (False, True):
            road.expand(solving=solving)
    assert asked == [FAR_STRETCH, 4.0 * FAR_STRETCH, 2.0 * FAR_STRETCH, 4.0 * FAR_STRETCH]


def test_a_stretch_of_its_length_becomes_inactive(monkeypatch: pytest.MonkeyPatch) -> None:
    mapper, _ = map_log(exact_log(ahead(10.0, 12.0), *corridor(150.0)))
    smoother = mapper.road.smoother
    state, spacing = smoother.map.state, smoother.map.settings.spline.spacing
    first = {label: state.active(label)[0] for label in state.boundaries}
    for behind, stretch, leaves in ((11.0, 12.0, False), (18.0, 24.0, False), (18.0, 12.0, True)):
        kept = {label: state.active(label)[round(behind / spacing) :] for label in first}
        monkeypatch.setattr(smoother, "_needed", lambda label, room=0.0, kept=kept: kept[label])
        smoother.deactivate_distant(stretch)
        assert all(state.active(label)[0] > first[label] for label in first) == leaves
