"""Means and paired differences: by hand, held against scipy, their coverage, and what is left out."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pathspace_graph.eval.experiment.statistics import (
    by_track,
    estimate,
    holm,
    paired_p,
    wilcoxon_p,
)


def test_the_interval_is_student_s_by_hand() -> None:
    """d = 1, 2, 3: mean 2, s = 1, t(0.975, 2) = 4.3027, half = 4.3027 / sqrt(3)."""
    found = estimate(np.array([1.0, 2.0, 3.0]))
    assert (found.mean, found.count) == (pytest.approx(2.0), 3)
    assert found.half == pytest.approx(4.3027 / np.sqrt(3), abs=1e-3)


def test_the_interval_holds_the_mean_95_times_of_100() -> None:
    rng = np.random.default_rng(5)
    found = [estimate(rng.normal(1.0, 2.0, 6)) for _ in range(600)]
    assert np.mean([abs(d.mean - 1.0) <= d.half for d in found]) == pytest.approx(0.95, abs=0.03)


def test_few_values_have_no_interval_and_equal_ones_none_to_speak_of() -> None:
    one = estimate(np.array([-2.0]))
    assert (one.mean, one.count) == (-2.0, 1) and np.isnan(one.half)
    assert np.isnan(estimate(np.zeros(0)).mean)
    same = estimate(np.ones(2))
    assert (same.mean, same.half) == (1.0, 0.0)


def test_the_interval_of_few_and_p_are_those_of_scipy() -> None:
    values = np.random.default_rng(1).normal(0.3, 1.0, 7)
    made = estimate(values)
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert made.mean - made.half == pytest.approx(low)
    assert made.mean + made.half == pytest.approx(high)
    assert paired_p(values) == pytest.approx(stats.ttest_1samp(values, 0.0).pvalue)


@pytest.mark.parametrize(("values", "p"), [([], None), ([1.0], None), ([0.0, 0.0], 1.0), ([2.0, 2.0], 0.0)])
def test_p_where_there_is_no_spread(values: list[float], p: float | None) -> None:
    found = paired_p(np.array(values))
    assert np.isnan(found) if p is None else found == p


def test_holm_by_hand() -> None:
    """Sorted 0.01, 0.02, 0.03, 0.4 times 4, 3, 2, 1, never falling; what isn't known isn't counted."""
    corrected = holm(np.array([0.03, 0.01, np.nan, 0.4, 0.02]))
    np.testing.assert_allclose(corrected, [0.06, 0.04, np.nan, 0.4, 0.06])
    np.testing.assert_allclose(holm(np.array([0.9, 0.8])), [1.0, 1.0])


def test_drives_of_a_track_are_one_sample_and_of_a_single_track_each_is_one() -> None:
    index = pd.MultiIndex.from_product([["a", "b"], [0, 1]], names=["track", "seed"])
    values = pd.Series([1.0, 3.0, 5.0, 9.0], index)
    assert by_track(values).to_dict() == {"a": 2.0, "b": 7.0}
    assert len(by_track(values.loc[["a"]])) == 2


def test_wilcoxon_by_hand() -> None:
    """Five positive differences: one of 2^5 orders of signs on each side, p = 2 / 32."""
    assert wilcoxon_p(np.array([0.1, 0.2, 0.3, 0.4, 0.5])) == pytest.approx(2.0 / 32.0)
    assert np.isnan(wilcoxon_p(np.zeros(3)))
