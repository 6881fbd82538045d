"""The search for a lost vehicle: when it is asked, and when its answer counts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.loop.relocalization import APART, SEARCH_INTERVAL, Place, Search
from pathspace_graph.mapping.registration import Motion, RefinedMotion
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.drives import detections

NOTHING = np.zeros((0, 2)), np.zeros(0, np.intp)


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
