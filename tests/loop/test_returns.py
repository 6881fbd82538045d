"""When the search for a return is due, some metres or cycles after the last attempt, and what it does."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.loop import open as open_road
from pathspace_graph.loop.open import ASTRAY, RETURN_CYCLES, SERVES, ReturnFinder
from pathspace_graph.places.find import NEWEST_PATHS, REACH
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.spline.bspline import BSpline

STEP = MapperSettings().closing.check_interval


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that gets what is tried."""
    ways: list[str] = []

    def attempt(seen_in: Any, poses: Any, covariance: Any, settings: Any, curves: Any, lengths: Any) -> None:
        ways.append(f"{'cones' if curves is None else 'curves'} of {lengths[0]:.0f} m by {covariance}")

    monkeypatch.setattr(open_road, "return_to_beginning", attempt)
    return ways


def searched(finder: ReturnFinder, cycle: int, length: float, away: float = 0.0) -> None:
    """Search on a road with a curve whose first 30 m count, at a distance from the start of the drive (m).

    A covariance takes a cycle, which is repeated.
    """
    line = BSpline.open_uniform(np.column_stack([np.arange(9.0), np.zeros(9)]))
    smoother = SimpleNamespace(
        variables=SimpleNamespace(sensor=None),
        newest_covariance=lambda: f"covariance at {length:.0f} m",
        transform_to_origin=lambda: None,
        refresh=lambda: None,
        map=SimpleNamespace(state=SimpleNamespace(splines={0: line})),
    )
    path = SimpleNamespace(length=length, near_beginning=lambda *_: True)
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 300.0, 0.0], [away, 0.0, 0.0]])
    of_drive: Any = lambda *_: poses  # noqa: E731
    record = SimpleNamespace(seen_in=lambda *_: None, with_newest_path=of_drive, with_window=of_drive)
    boundaries = {0: SimpleNamespace(confirmed_end=50.0)}
    road = {
        "path": path,
        "next_cycle": cycle,
        "poses": [None],
        "boundaries": boundaries,
        "smoother": smoother,
    }
    known = finder._known
    for _ in range(2):
        finder.find(SimpleNamespace(**road, settings=None), record, None)  # type: ignore[arg-type]
        if finder._known is known:
            break


@pytest.mark.parametrize(("kind", "way"), [(None, "cones"), ("cones", "cones"), ("line", "curves")])
def test_cones_are_recognized_and_of_lines_the_curves(kind: Any, way: str, tried: list[str]) -> None:
    searched(ReturnFinder(MapperSettings(kind=kind)), 0, 100.0)
    assert tried == [f"{way} of 30 m by covariance at 100 m"]


def test_a_covariance_has_a_cycle_of_its_own_and_serves_for_some_metres(tried: list[str]) -> None:
    finder = ReturnFinder(MapperSettings())
    for length in np.arange(100.0, 100.0 + SERVES + 2.0 * STEP, STEP):
        searched(finder, 1, length)
    assert tried == [f"cones of 30 m by covariance at {at} m" for at in (100, 100, 100, 100, 100, 100, 112)]


def test_each_length_of_the_newest_path_has_a_cycle_of_its_own(tried: list[str]) -> None:
    finder, long = ReturnFinder(MapperSettings()), 10.0 * NEWEST_PATHS[-1]
    for attempt in range(4):
        searched(finder, 1, long + attempt * STEP)
    assert [one[9:13].strip() for one in tried] == ["60 m", "30 m", "60 m", "30 m"]


def test_no_covariance_is_needed_far_away_from_the_start(tried: list[str]) -> None:
    finder, farthest = ReturnFinder(MapperSettings()), REACH[0] + ASTRAY * 500.0
    searched(finder, 1, 500.0, 1.01 * farthest)
    assert tried == [] and finder._known[0] == -np.inf
    searched(finder, 1, 500.0 + STEP, 0.99 * farthest)
    assert len(tried) == 1


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
