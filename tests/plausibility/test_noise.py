"""Noise that a log states is held against what its readings show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pathspace_graph import hints
from pathspace_graph.front_end.sightings import TwistRecord
from pathspace_graph.io.log import Log, Odometry

from ..scenes.drives import short_drive


def with_covariances(log: Log, factor: float) -> Log:
    cycles = [replace(cycle, covariances=factor**2 * cycle.covariances) for cycle in log.cycles]
    return replace(log, cycles=tuple(cycles))


@pytest.mark.parametrize(
    ("factor", "size", "which"), [(0.4, "small", ("vx", "vy", "wz")), (4.0, "large", ("vx", "wz"))]
)
def test_stated_noise_of_odometry_is_contradicted(factor: float, size: str, which: tuple[str, ...]) -> None:
    """A lateral velocity that is stated four times too large may stand for the drift that is assumed."""
    log = short_drive()
    (found,) = hints(replace(log, odometry_sigma=factor * log.odometry_sigma))
    assert (found.cause, found.file) == ("noise", "log.toml")
    assert f"the stated noise is too {size}" in found.likely
    assert tuple(part.split()[0] for part in found.found.split(", ") if "scatters by" in part) == which
    assert found.advice.startswith("--noise measured")


@pytest.mark.parametrize(("factor", "size"), [(0.3, "small"), (4.0, "large")])
def test_stated_covariances_are_contradicted(factor: float, size: str) -> None:
    found = hints(with_covariances(short_drive(), factor))
    assert [(hint.cause, hint.likely) for hint in found] == [("noise", f"the covariances are too {size}")]


def test_noise_that_nobody_has_stated_is_not_contradicted() -> None:
    log = with_covariances(short_drive(), 4.0)
    unstated = replace(
        log, odometry_sigma=0.1 * log.odometry_sigma, odometry_stated=False, detections_stated=False
    )
    assert hints(unstated) == []


def test_rough_motion_does_not_count_as_noise() -> None:
    t = 0.1 * np.arange(300)
    twists = np.column_stack([5.0 + np.sin(2.0 * t), 0.0 * t, 0.3 * np.cos(3.0 * t)])
    log = replace(short_drive(), odometry=Odometry(t, twists), odometry_sigma=np.full(3, 1e-4))
    record = TwistRecord()
    record.add(log.odometry)
    orders = record.orders()
    assert orders is not None
    assert (orders[:, 0].max() > 2.0 * orders[:, 0].min()) and orders[:, 0].min() > 1.5e-4
    assert not any(hint.cause == "noise" and hint.file == "log.toml" for hint in hints(log))
