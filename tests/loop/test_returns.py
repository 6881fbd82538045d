"""The searches for a return and for a lost vehicle: when each is asked, and when its answer counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.loop import returns
from pathspace_graph.loop.relocalization import APART, SEARCH_INTERVAL, Place, Search
from pathspace_graph.loop.returns import CERTAIN_PATH, RECOGNITION_INTERVAL, RETURN_CYCLES, ReturnFinder
from pathspace_graph.mapping.registration import Motion, RefinedMotion
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import detections

SETTINGS = MapperSettings().closing
NOTHING = np.zeros((0, 2)), np.zeros(0, np.intp)


# --- a return: three ways take turns, so that no cycle pays for two of them --------------------------------


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


# --- a lost vehicle --------------------------------------------------------------------------------------


@pytest.fixture
def search(monkeypatch: pytest.MonkeyPatch) -> Search:
    """A search that began at 0 s."""
    monkeypatch.setattr(Search, "_places", lambda *_: [])
    road: Any = SimpleNamespace(
        settings=MapperSettings(), next_cycle=0, smoother=SimpleNamespace(times=[0.0])
    )
    return Search(road)


def shifted(x: float, sigma: float = 0.1) -> RefinedMotion:
    nothing: Any = None
    return RefinedMotion(Motion(np.zeros(2), np.array([x, 0.0, 0.0])), nothing, sigma**2 * np.eye(3))


def answers(search: Search, places: Sequence[float | None]) -> Iterator[bool]:
    """Whether each of several attempts that find these shifts along x, or nothing, is an answer."""
    for k, x in enumerate(places, 1):
        search.observe(np.zeros(3), detections(k * 1.01 * SEARCH_INTERVAL, *NOTHING))
        found = search.find(None, lambda _, x=x: None if x is None else shifted(x))  # type: ignore[arg-type, misc]
        yield found is not None


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ([0.0, 0.5 * APART], [False, True]),
        ([0.0, 2.0 * APART, 0.0, 2.0 * APART], [False] * 4),
        ([0.0, None, 0.0, 0.0], [False, False, False, True]),
        ([0.0, 0.0, 2.0 * APART, 2.0 * APART], [False, True, False, True]),
    ],
)
def test_two_attempts_in_a_row_must_agree(
    search: Search, places: list[float | None], expected: list[bool]
) -> None:
    assert list(answers(search, places)) == expected


def test_between_attempts_nothing_is_asked(search: Search) -> None:
    asked = list[float]()
    for t in np.arange(0.1, 2.3 * SEARCH_INTERVAL, 0.1).tolist():
        search.observe(np.zeros(3), detections(t, *NOTHING))
        search.find(None, lambda _, t=t: asked.append(t))  # type: ignore[arg-type, misc]
    assert len(asked) == 2
    assert np.diff([0.0, *asked]).min() >= SEARCH_INTERVAL - 1e-9


@pytest.mark.parametrize(
    ("scores", "sigma", "is_sure"),
    [
        ([0.85], 0.1, True),
        ([0.55], 0.1, False),
        ([0.85, 0.80], 0.1, False),
        ([0.85, 0.70], 0.1, True),
        ([0.85], 0.6, False),
    ],
)
def test_a_place_must_be_good_alone_and_certain(
    search: Search, scores: list[float], sigma: float, is_sure: bool
) -> None:
    """Other places are 10 m away."""
    places = [Place(score, shifted(10.0 * k, sigma)) for k, score in enumerate(scores)]
    assert (search.by_score(places) is places[0].found) == is_sure


def test_a_second_registration_of_one_place_is_no_rival(search: Search) -> None:
    places = [Place(score, shifted(x)) for score, x in ((0.85, 0.0), (0.84, 0.5 * APART), (0.6, 3.0 * APART))]
    assert search.by_score(places) is places[0].found
