"""The search for a return: its three ways take turns, so that no cycle pays for two of them."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest

from pathspace_graph.loop import returns
from pathspace_graph.loop.returns import RECOGNITION_INTERVAL, RETURN_CYCLES, ReturnFinder
from pathspace_graph.settings.mapper import MapperSettings

SETTINGS = MapperSettings().closing


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that gets each way that is tried, on a road that is always near its beginning."""
    ways: list[str] = []
    monkeypatch.setattr(returns, "near_start", lambda *_: True)
    monkeypatch.setattr(ReturnFinder, "_by_curves", lambda *_: ways.append("curves"))
    monkeypatch.setattr(ReturnFinder, "_by_cones", lambda *_: ways.append("cones"))
    monkeypatch.setattr(returns, "recognize", lambda _: ways.append("shape"))
    return ways


def road(cycle: int, length: float) -> Any:
    path = SimpleNamespace(length=length)
    return SimpleNamespace(path=path, next_cycle=cycle, poses=[None], boundaries={0: None}, smoother=None)


def searched(finder: ReturnFinder, cycle: int, length: float) -> None:
    finder.find(road(cycle, length), None, None)  # type: ignore[arg-type]


def test_a_cycle_tries_one_way_at_most_and_each_way_has_its_turn(tried: list[str]) -> None:
    """Where curves and cones are due in each cycle they alternate, and shape comes between."""
    finder, counts = ReturnFinder(SETTINGS), []
    for cycle in range(60):
        searched(finder, cycle, 100.0 + 2.0 * cycle)
        counts.append(len(tried))
    assert counts == list(range(1, 61))
    by_way = Counter(tried)
    assert by_way["shape"] == pytest.approx(120.0 / RECOGNITION_INTERVAL, abs=2)
    assert abs(by_way["curves"] - by_way["cones"]) <= 2


def test_a_way_waits_for_its_interval_and_cones_for_some_cycles_at_rest(tried: list[str]) -> None:
    finder = ReturnFinder(SETTINGS)
    for cycle in range(3):
        searched(finder, cycle, 100.0)
    assert sorted(tried) == ["cones", "curves", "shape"]
    at_cones = tried.index("cones")
    for cycle in range(3, at_cones + RETURN_CYCLES):
        searched(finder, cycle, 100.0)
    assert len(tried) == 3
    searched(finder, at_cones + RETURN_CYCLES, 100.0)
    assert tried[3:] == ["cones"]
    searched(finder, at_cones + RETURN_CYCLES + 1, 100.0 + SETTINGS.check_interval)
    assert tried[4:] == ["curves"]


def test_nothing_is_tried_in_a_rest(tried: list[str]) -> None:
    finder = ReturnFinder(SETTINGS)
    finder.rest(road(0, 100.0), 20.0)
    searched(finder, 1, 119.0)
    assert tried == []
    searched(finder, 2, 120.0)
    assert len(tried) == 1
