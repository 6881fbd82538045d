"""When the search for a return is due: some metres or cycles after the last attempt."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.loop import open as open_road
from pathspace_graph.loop.open import RETURN_CYCLES, ReturnFinder
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

STEP = MapperSettings().closing.check_interval


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that gets what is tried."""
    ways: list[str] = []
    monkeypatch.setattr(
        open_road,
        "return_to_beginning",
        lambda *found: ways.append("cones" if found[-1] is None else "curves"),
    )
    return ways


def searched(finder: ReturnFinder, cycle: int, length: float) -> None:
    """Search on a road with a curve whose first 30 m count."""
    line = BSpline.open_uniform(np.column_stack([np.arange(9.0), np.zeros(9)]))
    smoother = SimpleNamespace(
        variables=SimpleNamespace(sensor=None),
        newest_covariance=lambda: None,
        transform_to_origin=lambda: None,
        refresh=lambda: None,
        map=SimpleNamespace(state=SimpleNamespace(splines={0: line})),
    )
    path = SimpleNamespace(length=length, near_beginning=lambda *_: True)
    record = SimpleNamespace(seen_in=lambda *_: None, with_newest_path=lambda *_: None)
    boundaries = {0: SimpleNamespace(confirmed_end=50.0)}
    road = {
        "path": path,
        "next_cycle": cycle,
        "poses": [None],
        "boundaries": boundaries,
        "smoother": smoother,
    }
    finder.find(SimpleNamespace(**road, settings=None), record, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "way"), [(None, "cones"), ("cones", "cones"), ("line", "curves")])
def test_cones_are_recognized_and_of_lines_the_curves(kind: Any, way: str, tried: list[str]) -> None:
    searched(ReturnFinder(MapperSettings(kind=kind)), 0, 100.0)
    assert tried == [way]


def test_an_attempt_waits_for_some_metres_and_for_some_cycles_at_rest(tried: list[str]) -> None:
    finder = ReturnFinder(MapperSettings())
    for cycle in range(RETURN_CYCLES):
        searched(finder, cycle, 100.0)
    assert len(tried) == 1
    searched(finder, RETURN_CYCLES, 100.0)
    assert len(tried) == 2
    searched(finder, RETURN_CYCLES + 1, 100.0 + 0.99 * STEP)
    assert len(tried) == 2
    searched(finder, RETURN_CYCLES + 1, 100.0 + STEP)
    assert len(tried) == 3


def test_nothing_is_tried_in_a_rest(tried: list[str]) -> None:
    finder = ReturnFinder(MapperSettings())
    finder.rest(SimpleNamespace(path=SimpleNamespace(length=100.0)), 20.0)  # type: ignore[arg-type]
    searched(finder, 1, 119.0)
    assert tried == []
    searched(finder, 2, 120.0)
    assert len(tried) == 1
