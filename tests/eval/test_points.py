"""Means of cycles, power laws and their errors, by hand."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.eval.benchmark import CONES, LAPS, Lane, Part, Scaling, binned, fit_slope
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.settings.evaluation import ScalingSettings

NO_LOG = Log(Odometry(np.zeros(1), np.zeros((1, 3))), (), np.ones(3))


def points(*found: tuple[float, float], sweep: str = CONES) -> pd.DataFrame:
    """Points at abscissas, with their times (s)."""
    frame = pd.DataFrame(found, columns=["at", "seconds"])
    return frame.assign(sweep=sweep, estimator="any", cycles=1, size=1.0)


def test_slope_of_a_power_law_is_its_exponent() -> None:
    slope = fit_slope(points(*((at, 1e-6 * at**2.5) for at in (10.0, 100.0, 300.0, 1000.0, 2000.0))), 100.0)
    assert slope["slope"] == pytest.approx(2.5)
    assert slope["error"] == pytest.approx(0.0, abs=1e-6)
    assert (slope["points"], slope["low"], slope["high"]) == (4, 100.0, 2000.0)


def test_standard_error_of_a_slope_by_hand() -> None:
    """Abscissas -1, 0, 1 and ordinates 0, 3, 0 in logarithms: slope 0, squares 6, error sqrt(6 / 2)."""
    three = points(*((float(np.exp(x)), float(np.exp(y))) for x, y in ((-1, 0), (0, 3), (1, 0))))
    slope = fit_slope(three)
    assert slope["slope"] == pytest.approx(0.0, abs=1e-12)
    assert slope["error"] == pytest.approx(np.sqrt(3.0))


def test_two_points_have_no_slope_and_none_have_no_range() -> None:
    assert np.isnan(fit_slope(points((1.0, 1.0), (2.0, 2.0)))["slope"])
    nothing = fit_slope(points())
    assert nothing["points"] == 0
    assert np.isnan(nothing["low"]) and np.isnan(nothing["high"])


def test_bins_are_means_of_their_cycles() -> None:
    at = np.array([1.0, 10.0, 12.0, 40.0, 90.0])  # the last cycle wasn't reached
    lane = Lane("any", Part(NO_LOG, at), [1.0, 2.0, 3.0, 5.0], [2, 2, 4, 6])
    found = binned(lane, np.array([5.0, 20.0, 30.0, 80.0, 100.0]))
    means = found[["at", "seconds", "cycles", "size"]].values.tolist()
    assert means == [[11.0, 2.5, 2, 3.0], [40.0, 5.0, 1, 6.0]]


def test_times_between_two_points_follow_the_power_law_through_them() -> None:
    """From 100 to 400 cones the time grows from 1 to 4 ms, so at 200 cones it is 2 ms."""
    found = pd.concat([points((100.0, 0.001), (400.0, 0.004)), points((200.0, 9.0), sweep=LAPS)])
    scaling = Scaling(ScalingSettings(), {}, found, pd.DataFrame())
    assert scaling.seconds_at(200.0, "any") == pytest.approx(0.002)
    assert np.isnan(scaling.seconds_at(50.0, "any"))
    assert np.isnan(scaling.seconds_at(500.0, "any"))
    assert np.isnan(scaling.seconds_at(200.0, "other"))
