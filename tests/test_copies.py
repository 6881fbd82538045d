"""Copies of a mapper, which a failed cycle goes back to: they stay as they are, and go on as it does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from pathspace_graph import FixedLagMapper
from pathspace_graph.front_end.front_end import FrontEnd
from pathspace_graph.io.log import Detections, Log, Odometry
from pathspace_graph.labels import LEFT
from pathspace_graph.loop.closed import Closed
from pathspace_graph.loop.drive import DriveRecord
from pathspace_graph.loop.known_loop import REPAIRED
from pathspace_graph.loop.open import Open
from pathspace_graph.mapping.road import Road
from pathspace_graph.online.fixed_lag import _Before
from pathspace_graph.run import CycleResult, split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import skidpad

from .scenes.digest import digest
from .scenes.drives import beginning, map_beginning, mapped, noisy_lap, replay
from .scenes.holes import unseen
from .scenes.kidnapped import laps_log, pear_track, put_down
from .shared.copied import copied

EVERY = 23
"""Cycles from one pair of copies to the next: no multiple of the periods at which things are done."""
GOES_ON = 50
"""Cycles of the original after which its copies are looked at."""
PARTS = "front_end", "road", "drive", "phase", "health"
"""Attributes of a mapper that a cycle changes."""


def closing() -> Log:
    """Return a lap and 40 m more: open, with a batch under way, and closed."""
    return noisy_lap()


def revisiting() -> Log:
    """Return both rounds to the right of a skidpad, the second of which is a revisit."""
    return beginning(simulate(skidpad(), SimulationSettings(), seed=2), 180)


def repairing() -> Log:
    """Return laps with a hole in the first one, which is repaired in the second."""
    log = unseen(laps_log(pear_track()), [LEFT], 6.0, 11.0)
    return replace(log, cycles=log.cycles[:350])


def losing() -> Log:
    """Return laps of a vehicle that is put down elsewhere in the second one."""
    log = put_down(laps_log(pear_track()), 20.0, 30.0)
    return replace(log, cycles=log.cycles[:300])


def slow(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.slow)


def state_of(held: _Before | FixedLagMapper) -> str:
    """Return the digest of what a cycle changes, of a mapper or of a copy of it."""
    return digest({name: getattr(held, name) for name in PARTS})


def met_in(mapper: FixedLagMapper, result: CycleResult) -> set[str]:
    """Return the name of the phase, and of what else a cycle has met."""
    met = {"batch": mapper.drive.solver.is_busy, "revisit": bool(mapper.revisits)}
    met["repaired"] = result.notice.startswith(REPAIRED)
    return {type(mapper.phase).__name__, *(name for name, is_met in met.items() if is_met)}


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (closing, {"Closed", "Open", "batch"}),
        (revisiting, {"Open", "revisit"}),
        slow(repairing, {"Closed", "Open", "batch", "repaired"}),
        slow(losing, {"Closed", "Lost", "Open", "batch"}),
    ],
)
def test_a_copy_stays_as_it_is_whatever_the_original_does(make: Any, expected: set[str]) -> None:
    """It is held against a deep copy of that moment, and goes on as the original has done.

    The original is given back what it was before each cycle, and ends with the bits of one that is not.
    """
    log, copies, met = make(), {}, set[str]()
    mapper = FixedLagMapper(None, log.noise)
    for k, cycle in enumerate(split_odometry(log)):
        before = _Before.of(mapper)
        mapper._go_back(before)
        if k % EVERY == 0:
            copies[k] = before, digest(copied({name: getattr(mapper, name) for name in PARTS}))
        earlier, known = copies.get(k - GOES_ON, (None, ""))
        if earlier is not None:
            assert state_of(earlier) == known
        met |= met_in(mapper, replay(mapper, *cycle))
    assert met >= expected
    assert state_of(mapper) == state_of(mapped(log)[0])
    assert len(copies) > 5
    for before, known in copies.values():
        assert state_of(before) == known
    first, (before, _) = list(copies.items())[-2]
    other = FixedLagMapper(None, log.noise)
    other._go_back(before)
    for cycle in islice(split_odometry(log), first, None):
        replay(other, *cycle)
    assert state_of(other) == state_of(mapper)


# --- a step that fails -----------------------------------------------------------------------------------

STAGES = [
    (FrontEnd, "update"),
    *((Road, name) for name in ("predict", "classify", "expand", "update", "marginalize")),
    *((DriveRecord, name) for name in ("measured", "estimated")),
    *((Open, name) for name in ("judge", "step")),
]
"""Methods that a cycle of an open road calls."""
CLOSED = [(Closed, "judge"), (Closed, "step"), (Road, "update"), (Road, "marginalize")]


@contextmanager
def failing(stage: tuple[type, str], times: int) -> Iterator[None]:
    """Let a method fail so many times, when its work is done."""
    owner, name = stage
    works, left = getattr(owner, name), [times]

    def fails(*arguments: Any, **options: Any) -> Any:
        found = works(*arguments, **options)
        if left[0] > 0:
            left[0] -= 1
            raise np.linalg.LinAlgError("no convergence")
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, fails)
        yield


def at_cycle(log: Log, cycle: int) -> tuple[FixedLagMapper, list[tuple[Odometry, Detections]]]:
    """Return a mapper of its own after the first cycles, and the ten that follow."""
    mapper, _ = map_beginning(log, cycle)
    return mapper, [*islice(split_odometry(log), cycle, cycle + 10)]


@pytest.mark.failing
@pytest.mark.parametrize(
    ("stage", "cycle"), [*((stage, 40) for stage in STAGES), *((stage, 165) for stage in CLOSED)]
)
def test_a_cycle_that_fails_leaves_no_trace(stage: tuple[type, str], cycle: int) -> None:
    mapper, (first, *rest) = at_cycle(closing(), cycle)
    assert mapper.closed == (cycle == 165)
    before, rested = digest(mapper), copied(mapper)
    with failing(stage, 1), pytest.raises(np.linalg.LinAlgError, match="no convergence"):
        mapper.update(*first, strict=True)
    assert digest(mapper) == before and mapper.failures == 0
    with failing(stage, 1):
        notice = mapper.update(*first).notice
    assert notice.startswith("an update failed: LinAlgError: no convergence; the loop is left as it is")
    rested.drive.rest(rested.road)
    rested.update(*first)
    for one in (mapper, rested):
        for later in rest:
            replay(one, *later)
    assert digest(mapper) == digest(rested) and mapper.failures == 1


@pytest.mark.failing
def test_a_cycle_in_which_every_attempt_fails_is_left_out() -> None:
    mapper, (first, second, *_) = at_cycle(closing(), 40)
    before, other = digest(mapper), copied(mapper)
    with failing((Road, "update"), 3):
        result = mapper.update(*first)
    assert digest(mapper) == before and result.notice.endswith("the cycle is not used")
    mapper.update(*second)
    other.update(first[0].followed_by(second[0]), second[1])  # its twists are not lost
    assert digest(mapper) == digest(other)
