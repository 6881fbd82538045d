"""Every lane gets every cycle in turn, and one that fails or is too slow stops alone; never how fast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from pathspace_graph.eval import benchmark
from pathspace_graph.eval.benchmark import JUDGED, Lane, Part, run_lanes
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.settings.mapper import MapperSettings


def empty(cycles: int) -> Part:
    """A log without detections."""
    t = 0.1 * np.arange(cycles + 1)
    nothing = (np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=int))
    seen = tuple(Detections(s, *nothing) for s in t[1:])
    return Part(Log(Odometry(t, np.zeros((cycles + 1, 3))), seen, np.ones(3)), np.ones(cycles))


@dataclass
class Pretender:
    """An estimator that only notes when it was called."""

    name: str
    calls: list[str]
    settings: MapperSettings = field(default_factory=MapperSettings)
    fails_at: int = 10**9
    sizes = (3, 4)

    def update(self, odometry: object, detections: object) -> Pretender:
        if self.calls.count(self.name) >= self.fails_at:
            raise ValueError("no\nmore")
        self.calls.append(self.name)
        return self


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Puts pretenders in place of the estimators; gives the list of calls."""

    def put(**fails_at: int) -> list[str]:
        calls: list[str] = []

        def make(name: str, settings: MapperSettings, log: Log) -> Any:
            return Pretender(name, calls, fails_at=fails_at.get(name, 10**9))

        monkeypatch.setattr(benchmark, "make_online", make)
        return calls

    return put


def test_every_lane_gets_each_cycle_and_the_first_one_changes(pretend: Callable[..., list[str]]) -> None:
    calls = pretend()
    times = [Lane(name, empty(5)) for name in "abc"]
    run_lanes(times, MapperSettings(), budget=10.0)
    assert "".join(calls) == "abcbcacababcbca"
    assert all(len(t.seconds) == len(t.sizes) == 5 and not t.stopped for t in times)
    assert all(t.sizes == [7] * 5 for t in times)


def test_a_lane_ends_with_its_log(pretend: Callable[..., list[str]]) -> None:
    calls, told = pretend(), []
    short, long = Lane("a", empty(2)), Lane("b", empty(4))
    run_lanes([short, long], MapperSettings(), 10.0, lambda: told.append(1))
    assert (len(short.seconds), len(long.seconds), len(told)) == (2, 4, 4)
    assert "".join(calls) == "abbabb"
    assert not short.stopped


def test_one_that_is_too_slow_or_fails_stops_alone(pretend: Callable[..., list[str]]) -> None:
    pretend(b=4)
    log = empty(20)
    good, bad, slow = Lane("a", log), Lane("b", log), Lane("a", log)
    run_lanes([good, bad], MapperSettings(), budget=10.0)
    assert len(good.seconds) == 20
    assert not good.stopped
    assert len(bad.seconds) == 4
    assert bad.stopped == "ValueError: no more"
    run_lanes([slow], MapperSettings(), budget=1e-12)
    assert len(slow.seconds) == JUDGED
    assert "over 1e-12 s" in slow.stopped
