"""The mounting of the sensor by least squares: exact on exact detections, with honest sigmas."""

from __future__ import annotations

import numpy as np

from pathspace_graph.plausibility.hypotheses import AS_WRITTEN, Trials, lever, mounting_of, pairs_of
from pathspace_graph.sim.mistakes import in_frame

from ..scenes.batch import course_log
from ..scenes.drives import short_drive


def test_a_lever_arm_moves_as_a_point_of_the_vehicle() -> None:
    motion, arm = np.array([[2.0, 1.0, 0.5]]), np.array([3.0, -1.0])
    c, s = np.cos(0.5), np.sin(0.5)
    moved = np.array([[c, -s], [s, c]]) @ arm + motion[0, :2]
    np.testing.assert_allclose((motion + lever(motion, arm))[0, :2], moved - arm, atol=1e-12)


def test_exact_detections_give_the_exact_mounting() -> None:
    log = in_frame(course_log(1.0), turn=0.1, ahead=1.5, left=-0.4)
    pairs = pairs_of(log.cycles)
    assert pairs is not None
    found = mounting_of(Trials(log, pairs), AS_WRITTEN)
    assert found is not None
    np.testing.assert_allclose(found.values, [0.1, 1.5, -0.4], atol=0.02)


def test_the_sigmas_hold_the_error_of_a_noisy_drive() -> None:
    log = in_frame(short_drive(), ahead=1.0)
    pairs = pairs_of(log.cycles)
    assert pairs is not None
    found = mounting_of(Trials(log, pairs), AS_WRITTEN)
    assert found is not None
    assert (np.abs(found.values - [0.0, 1.0, 0.0]) < 5.0 * found.sigmas).all()
    assert (found.sigmas < [0.02, 0.3, 0.3]).all()
