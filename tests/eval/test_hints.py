"""The study of hints: what counts as named, and its rows."""

from __future__ import annotations

import pandas as pd
import pytest

from pathspace_graph.eval.hints import (
    AS_SIMULATED,
    CAUSES,
    SIMULATED,
    backs_up,
    causes_of,
    good_log,
    hints_table,
    judge,
    judged,
    parts_of,
)
from pathspace_graph.io.overrides import leaves, override
from pathspace_graph.sim.mistakes import MISTAKES
from pathspace_graph.sim.simulate import SimulationSettings

from ..scenes.drives import short_drive


def test_every_mistake_has_its_causes_by_the_longest_beginning() -> None:
    assert all(causes_of(mistake) for mistake in MISTAKES)
    assert causes_of("speeds in km/h") == ("speeds",)
    assert causes_of("speeds in the map frame") == CAUSES["speeds in the map frame"] == ("odometry",)


def test_every_kind_of_good_log_has_settings_of_its_own() -> None:
    for name, changes in SIMULATED.items():
        changed = leaves(override(SimulationSettings(), changes, name))
        assert {key: changed[key] for key in changes} == changes, name
    kinds = [changes for changes in SIMULATED.values() if "draw" not in changes]
    assert all(kinds.count(kind) == 1 for kind in kinds)


def test_each_drawn_car_is_another_one() -> None:
    first, second = (good_log(0, f"drawn car {number}") for number in (0, 1))
    assert [len(cycle.labels) for cycle in first.cycles] != [len(cycle.labels) for cycle in second.cycles]


def test_a_wrong_cause_does_not_count() -> None:
    log = MISTAKES["y to the right"](short_drive())
    assert judged(log, ("y to the right",))["named"]
    wrong = judged(log, ("stamps",))
    assert (wrong["accused"], wrong["named"]) == (True, False)


def test_a_good_log_is_judged_and_spoiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathspace_graph.eval.hints.SIMULATED", {AS_SIMULATED: {}})
    monkeypatch.setattr("pathspace_graph.eval.hints.PRESET", {})
    monkeypatch.setattr("pathspace_graph.eval.hints.EDITED", {"backs up": backs_up})
    (arguments, other) = parts_of((0,), ("y to the right",))
    assert (arguments["mistakes"], other["mistakes"]) == (("y to the right",), ())
    rows = judge(**arguments)
    assert [(row["kind"], row["accused"], row["named"]) for row in rows] == [
        ("good", False, False),
        ("spoiled", True, True),
    ]
    table = hints_table(pd.DataFrame(rows)).records()
    assert [tuple(row.values()) for row in table] == [
        ("y to the right", "1", "1"),
        ("all mistakes", "1", "1"),
        ("good logs, accused of any", "0", "1"),
    ]
