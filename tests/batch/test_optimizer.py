"""Steps of the batch's optimizer."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.batch.optimizer import extrapolation_factor
from pathspace_graph.settings.mapper import MapperSettings

BATCH = MapperSettings().batch


@pytest.mark.parametrize("share", [0.4, 0.7, 0.9])
def test_steps_that_shrink_by_one_share_lead_home_at_once(share: float) -> None:
    """x_k = x + r^k d: the second step, lengthened, ends at x."""
    home, off = np.array([1.0, -2.0, 3.0]), np.array([0.5, 0.1, -0.3])
    points = [home + share**k * off for k in range(3)]
    before, step = points[1] - points[0], points[2] - points[1]
    np.testing.assert_allclose(points[1] + extrapolation_factor(step, before, BATCH) * step, home, atol=1e-12)


@pytest.mark.parametrize("step", [[0.0, 1.0], [-0.5, 0.0], [1.2, 0.0], [0.1, 0.0]])
def test_a_step_that_does_not_go_on_is_left_as_it_is(step: list[float]) -> None:
    assert extrapolation_factor(np.array(step), np.array([1.0, 0.0]), BATCH) == 1.0
    assert extrapolation_factor(np.array(step), np.zeros(2), BATCH) == 1.0
