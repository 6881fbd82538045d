"""The schedule of the batches: when a lap is due, how long a cycle waits, and the rest after a failure."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathspace_graph.batch.lap import LapMarginal
from pathspace_graph.batch.system import Convergence
from pathspace_graph.loop import lap_solver
from pathspace_graph.loop.drive import Drive
from pathspace_graph.loop.lap_solver import LapSolver
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings, OpenLapSettings

PERIOD = 0.1


class Lap(Future[Any]):
    """A lap under way, with the timeouts of the cycles that asked for it."""

    def __init__(self) -> None:
        super().__init__()
        self.timeouts: list[float] = []

    def result(self, timeout: float | None = None) -> Any:
        self.timeouts.append(-1.0 if timeout is None else timeout)
        return super().result(0.0)


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[Lap]:
    laps: list[Lap] = []

    def submit(*_: Any) -> Lap:
        laps.append(Lap())
        return laps[-1]

    monkeypatch.setattr(lap_solver, "submit", submit)
    return laps


def solver(**changes: Any) -> LapSolver:
    return LapSolver(MapperSettings(open_lap=OpenLapSettings(cycles=20, **changes)))


def begin(solver: LapSolver, first: int, cycle: int) -> None:
    lap: Any = lambda first_kept: SimpleNamespace(first_kept=first_kept)  # noqa: E731
    solver.begin(lap, (first, cycle), PERIOD * cycle)


def solved(seconds: float) -> LapMarginal:
    empty: dict[str, Any] = dict.fromkeys(field.name for field in fields(LapMarginal))
    convergence = Convergence(True, "", 1, 1, 0.0, 0.0)
    return LapMarginal(**{**empty, "convergence": convergence, "seconds": seconds, "objection": ""})


def outcome(solver: LapSolver, cycle: int, first: int, spent: float = 0.0) -> Any:
    return solver.outcome(cycle, (PERIOD * np.arange(first, cycle + 1)).tolist(), first, spent)


@pytest.mark.parametrize(
    ("first", "cycle", "due", "first_kept"),
    [(270, 300, 320, 290), (290, 300, 310, 300), (970, 1000, 1030, 1000), (2970, 3000, 3090, 3000)],
)
def test_a_long_lap_waits_for_a_share_of_its_cycles(
    sent: list[Lap], first: int, cycle: int, due: int, first_kept: int
) -> None:
    """A short one for 20 cycles, or as many as its window has."""
    one = solver()
    begin(one, first, cycle)
    assert one.first_kept == first_kept
    for early in (cycle + 1, due - 1):
        assert outcome(one, early, first) is None and sent[0].timeouts == []
    sent[0].set_result(solved(1.0))
    assert isinstance(outcome(one, due, first), LapMarginal)


def test_a_replay_takes_the_recorded_ends_in_their_turn(sent: list[Lap]) -> None:
    one = solver(ends=(327, 645))
    for (first, cycle), end in zip([(270, 300), (570, 600)], (327, 645), strict=True):
        begin(one, first, cycle)
        sent[-1].set_result(solved(1.0))
        assert outcome(one, end - 1, first) is None
        assert outcome(one, end, first) is not None
    assert one.ends(700) == (327, 645)


def test_a_batch_that_is_late_when_the_drive_ends_is_recorded_past_its_last_cycle(
    sent: list[Lap], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So a replay does not use it in its last cycle either."""
    monkeypatch.setattr("pathspace_graph.loop.lap_solver.MOST_LATE", 30)
    one = solver()
    begin(one, 270, 300)
    assert one.ends(320) == ()
    assert one.ends(321) == (351,)
    again = solver(ends=(351,))
    begin(again, 270, 300)
    sent[-1].set_result(solved(1.0))
    assert outcome(again, 350, 270) is None
    assert outcome(again, 351, 270) == lap_solver.BATCH_LATE


def test_the_wait_of_a_cycle_ends_with_its_period(sent: list[Lap]) -> None:
    one = solver()
    begin(one, 270, 300)
    for cycle, spent in ((320, 0.0), (321, 0.03), (322, 0.2)):
        assert outcome(one, cycle, 270, spent) is None
    assert sent[0].timeouts == pytest.approx([0.1, 0.07, 0.0], abs=1e-9)


def test_the_slowest_batch_counts(sent: list[Lap]) -> None:
    """Each has two seconds; the first takes five, which is 30 cycles more, and the second 2.5."""
    one, late = solver(), []
    for first, seconds in ((270, 5.0 - 1e-6), (570, 2.5), (870, 1.0)):
        begin(one, first, first + 30)
        sent[-1].set_result(solved(seconds))
        assert outcome(one, 360 - 270 + first, first) is not None
        late.append(one.late_cycles)
    assert late == [30, 30, 30]


def test_a_drive_gives_up_its_batch_and_rests_for_ten_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    road, drive, given_up = Road(MapperSettings()), Drive(MapperSettings()), list[int]()
    monkeypatch.setattr(drive.solver, "give_up", given_up.append)
    for x in (0.0, 1.0):
        road.path.update(np.array([x, 0.0, 0.0]))
    assert not drive.rests(road)
    drive.rest(road)
    assert given_up == [road.next_cycle]
    rests = {}
    for x in (1.5, 10.9, 11.1):
        road.path.update(np.array([x, 0.0, 0.0]))
        rests[x] = drive.rests(road)
    assert rests == {1.5: True, 10.9: True, 11.1: False}
