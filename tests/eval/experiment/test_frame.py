"""The rows of a study: each run beside the batch on the same log and with the same settings."""

from __future__ import annotations

from typing import Any

import pytest

from pathspace_graph.eval.experiment.frame import RUN, add_batch


def row(estimator: str, seed: int = 0, variant: str = "default", **values: float) -> dict[str, Any]:
    names = {"track": "oval", "seed": seed, "noise": "nominal", "estimator": estimator, "variant": variant}
    return names | values


def test_every_lap_is_compared_with_the_batch_of_its_own_log_and_settings() -> None:
    rows = [
        row("fixed-lag", turn=0.003, rmse=0.4),
        row("fixed-lag", turn=0.002, rmse=0.3),
        row("spline", turn=0.001, rmse=0.2),
        row("fixed-lag", seed=1, turn=0.003, rmse=0.4),
        row("fixed-lag", variant="other", turn=0.003, rmse=0.4),
        row("spline", variant="other", turn=0.004, rmse=0.4),
    ]
    add_batch(rows, (*RUN, "noise", "variant"))
    found = [(row.get("turn_from_batch"), row.get("rmse_by_batch")) for row in rows]
    assert found[:2] == [
        (pytest.approx(0.002), pytest.approx(2.0)),
        (pytest.approx(0.001), pytest.approx(1.5)),
    ]
    assert found[2] == found[3] == found[5] == (None, None)  # the batch itself, and a run without one
    assert found[4] == (pytest.approx(-0.001), pytest.approx(1.0))


def test_a_batch_that_failed_compares_with_nothing() -> None:
    rows = [row("fixed-lag", turn=0.003, rmse=0.4), row("spline")]
    add_batch(rows, (*RUN, "noise", "variant"))
    assert "turn_from_batch" not in rows[0]
