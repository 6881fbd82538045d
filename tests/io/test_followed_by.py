"""Odometry that is handed over in parts."""

from __future__ import annotations

import numpy as np

from pathspace_graph.io.log import Odometry


def test_a_stamp_that_both_parts_have_is_kept_once_with_the_earlier_twist() -> None:
    stamps = np.array([0.0, 0.1, 0.2])
    first, second = Odometry(stamps, np.ones((3, 3))), Odometry(stamps + 0.2, np.full((3, 3), 2.0))
    both = first.followed_by(second)
    np.testing.assert_allclose(both.t, [0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(both.twist[:, 0], [1.0, 1.0, 1.0, 2.0, 2.0])
