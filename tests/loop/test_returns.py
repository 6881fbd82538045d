"""The search for a return: its three ways take turns, so that no cycle pays for two of them."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.loop import returns
from pathspace_graph.loop.returns import CERTAIN_PATH, RECOGNITION_INTERVAL, RETURN_CYCLES, ReturnFinder
from pathspace_graph.mapping.registration import Motion
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


@pytest.mark.parametrize(("length", "interval"), [(300.0, 10.0), (1000.0, 10.0), (5000.0, 50.0)])
def test_on_a_long_path_the_shape_is_asked_more_rarely(
    length: float, interval: float, tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each attempt costs in proportion to the map."""
    monkeypatch.setattr(returns, "near_start", lambda *_: False)
    finder = ReturnFinder(SETTINGS)
    for cycle, at in enumerate((length, length + 0.9 * interval, length + 1.02 * interval)):
        searched(finder, cycle, at)
        assert len(tried) == (1 if at < length + interval else 2)


@pytest.mark.parametrize("lost", [False, True])
def test_a_pose_that_was_certain_is_not_asked_again_for_some_metres(
    lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Unless the beginning is near: its covariance takes the inverse of the whole map."""
    asked, is_near = list[float](), [False]
    monkeypatch.setattr(returns, "is_within_reach", lambda *_: is_near[0])
    monkeypatch.setattr(returns, "is_lost", lambda *_: lost)
    monkeypatch.setattr(returns, "register", lambda *_: None)
    finder, one = ReturnFinder(SETTINGS), road(0, 0.0)
    one.path.beginning = None
    one.smoother = SimpleNamespace(
        map=None,
        times=[],
        transform_to_origin=lambda: None,
        newest_covariance=lambda: asked.append(one.path.length),
    )
    for length in (100.0, 99.0 + CERTAIN_PATH, 101.0 + CERTAIN_PATH, 102.0 + CERTAIN_PATH):
        one.path.length = length
        finder._by_curves(one)
    rarely = [100.0, 101.0 + CERTAIN_PATH]
    assert asked == ([100.0, 99.0 + CERTAIN_PATH, *np.add(rarely[1], [0.0, 1.0])] if lost else rarely)
    is_near[0] = True
    finder._by_curves(one)
    assert len(asked) == (5 if lost else 3)


def test_a_return_is_relative_to_the_nearest_pose_of_the_beginning_in_the_same_direction() -> None:
    """The road leads there, back beside it, there again: the later passes are nearer."""
    x = np.arange(0.0, 21.0)
    passes = [(x, 1.0, 0.0), (x[::-1], 0.5, np.pi), (x, 0.2, 0.0), (x[:11][::-1], 0.1, np.pi)]
    poses = np.concatenate([np.column_stack([at, 0.0 * at + y, 0.0 * at + theta]) for at, y, theta in passes])
    newest = np.array([10.0, 0.1, 0.0])
    record: Any = SimpleNamespace(with_window=lambda _: np.vstack([poses, newest]))
    found: Any = SimpleNamespace(
        motion=Motion(newest[:2], np.array([2.0, 0.0, 0.0])), covariance=0.01 * np.eye(3)
    )
    finder = ReturnFinder(SETTINGS)
    early = finder._revisit_of(road(0, 0.0), record, found, 30.0)
    assert (early.earlier, early.later) == (12, len(poses))
    np.testing.assert_allclose(early.local, [0.0, -0.9, 0.0], atol=1e-9)
    assert finder._revisit_of(road(0, 0.0), record, found, 60.0).earlier == 2 * 21 + 12
