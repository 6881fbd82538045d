"""Paired differences: the interval by hand, its coverage, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.eval.paired import difference


def test_the_interval_is_student_s_by_hand() -> None:
    """d = 1, 2, 3: mean 2, s = 1, t(0.975, 2) = 4.3027, half = 4.3027 / sqrt(3)."""
    found = difference([11.0, 7.0, 9.0], [10.0, 5.0, 6.0])
    assert (found.mean, found.pairs) == (pytest.approx(2.0), 3)
    assert found.low == pytest.approx(2.0 - 4.3027 / np.sqrt(3), abs=1e-3)
    assert found.high == pytest.approx(2.0 + 4.3027 / np.sqrt(3), abs=1e-3)
    assert not found.significant


def test_what_pairs_share_cancels() -> None:
    rng = np.random.default_rng(0)
    hard = 10.0 * rng.random(20)  # some logs are harder than others, for everyone
    found = difference(hard + 0.3 + 0.01 * rng.normal(size=20), hard)
    assert found.significant and found.low == pytest.approx(0.3, abs=0.02)


def test_the_interval_holds_the_mean_95_times_of_100() -> None:
    rng = np.random.default_rng(5)
    found = [difference(rng.normal(1.0, 2.0, 6), np.zeros(6)) for _ in range(600)]
    assert np.mean([d.low <= 1.0 <= d.high for d in found]) == pytest.approx(0.95, abs=0.03)


def test_pairs_that_lack_a_value_are_left_out_and_few_have_no_interval() -> None:
    found = difference([1.0, np.nan, 3.0, np.inf], [0.0, 1.0, 1.0, 1.0])
    assert (found.mean, found.pairs) == (1.5, 2)
    one = difference([1.0], [3.0])
    assert (one.mean, one.pairs) == (-2.0, 1) and np.isnan(one.low) and not one.significant
    assert np.isnan(difference([], []).mean)
    same = difference([2.0, 3.0], [1.0, 2.0])
    assert (same.low, same.mean, same.high) == (1.0, 1.0, 1.0)
