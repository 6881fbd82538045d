"""Ghosts, on maps whose answer is known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.metrics.accuracy import ghosts
from pathspace_graph.io.map import Map
from pathspace_graph.labels import LEFT, RIGHT

from .straight_maps import landmarks, line, row, truth


def test_ghost_landmarks() -> None:
    """One is 2.5 m off the row, and one of the wrong colour."""
    true = truth(row(2.0), row(-2.0))
    track = Map(
        False,
        {
            LEFT: landmarks((0, 2.1), (5, 2), (5.4, 2.1), (10, 2), (2.5, 4.5), (5, -2)),
            RIGHT: landmarks((2.5, -2)),
        },
    )
    found = ghosts(track, true)
    assert found == {"ghost_landmarks": 2, "ghost_metres": 0.0}


def test_ghost_curve_is_the_length_with_no_boundary_near() -> None:
    """20 m of curve over 10 m of truth: what is more than 2 m past its end has no boundary near."""
    found = ghosts(Map(False, {LEFT: line(2.0, end=20.0)}), truth(row(2.0)))
    assert found["ghost_metres"] == pytest.approx(8.0, abs=0.1)
    assert found["ghost_landmarks"] == 0
    whole = ghosts(Map(False, {LEFT: line(2.0)}), truth(np.zeros((0, 2))))
    assert whole["ghost_metres"] == pytest.approx(10.0)
