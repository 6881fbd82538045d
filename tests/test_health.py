"""The monitor of health, on sequences of numbers that are put in by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pathspace_graph.health import (
    DEGRADED,
    GOOD,
    LOST,
    MIN_OFFERED,
    Evidence,
    Health,
    HealthMonitor,
    HealthStretch,
    counts,
    stretches,
)

PERIOD = 0.1
"""Perception cycles are this far apart (s)."""
CLEAN = Evidence(0.0, offered=10, explained=9, used=9, innovations=3.0, closed=True, sigma=0.1)
"""Nine detections of ten are explained, a third of a standard deviation squared each."""


def drive(*parts: tuple[Evidence, float]) -> list[Health]:
    """Returns the health in each cycle of a drive whose parts repeat a cycle for some seconds."""
    monitor, healths = HealthMonitor(), []
    for evidence, seconds in parts:
        for _ in range(round(seconds / PERIOD)):
            healths.append(monitor.update(replace(evidence, t=PERIOD * len(healths))))
    return healths


def test_a_vehicle_whose_detections_are_explained_is_good() -> None:
    assert drive((CLEAN, 5.0)) == [Health(GOOD)] * 50


def test_lost_is_told_within_a_second_of_the_last_explained_detection() -> None:
    healths = drive((CLEAN, 5.0), (replace(CLEAN, explained=1, used=1), 2.0))
    conditions = [health.condition for health in healths]
    # of ten cycles, k explain one detection and the others nine: lost below 55 of 100 is k = 5
    assert conditions.index(LOST) == 50 + 4
    assert conditions[50] == GOOD and conditions[51] == DEGRADED
    assert conditions[54:] == [LOST] * 16
    assert healths[-1].reason == "10 % of the detections lie on the map"


def test_half_of_the_detections_beside_the_curves_is_no_alarm_while_the_loop_is_open() -> None:
    hairpin = replace(CLEAN, explained=5, used=5, closed=False)
    assert drive((hairpin, 3.0))[-1] == Health(GOOD)
    assert drive((replace(hairpin, closed=True), 3.0))[-1].condition == LOST
    assert drive((replace(hairpin, explained=1, used=1), 3.0))[-1].condition == DEGRADED


def test_a_boundary_that_is_wrong_beside_one_that_is_right_does_not_lose_the_vehicle() -> None:
    right_holds = replace(CLEAN, explained=5, used=5, offered_by=(5, 5), explained_by=(0, 5))
    health = drive((CLEAN, 3.0), (right_holds, 3.0))[-1]
    assert health == Health(DEGRADED, "the left boundary is not where the map has it")
    left_holds = replace(right_holds, explained_by=(5, 0))
    assert "right" in drive((CLEAN, 3.0), (left_holds, 3.0))[-1].reason
    neither = replace(CLEAN, explained=5, used=5, offered_by=(5, 5), explained_by=(2, 3))
    assert drive((CLEAN, 3.0), (neither, 3.0))[-1].condition == LOST


def test_a_boundary_that_was_wrong_stays_wrong_while_the_other_one_is_not_mapped() -> None:
    left_wrong = replace(CLEAN, explained=5, used=5, offered_by=(5, 5), explained_by=(0, 5))
    right_in_gap = replace(CLEAN, offered=5, explained=0, used=0, offered_by=(5, 0), unmapped=(0, 5))
    assert drive((CLEAN, 3.0), (left_wrong, 3.0), (right_in_gap, 3.0))[-1].condition == DEGRADED
    assert drive((CLEAN, 3.0), (right_in_gap, 3.0))[-1].condition == LOST
    neither = replace(CLEAN, explained=0, used=0, offered_by=(5, 5))
    assert drive((CLEAN, 3.0), (left_wrong, 3.0), (neither, 3.0))[-1].condition == LOST
    again = drive((CLEAN, 3.0), (left_wrong, 3.0), (CLEAN, 3.0), (right_in_gap, 3.0))
    assert again[-1].condition == LOST


def test_a_boundary_of_few_detections_does_not_hold_the_vehicle() -> None:
    single = replace(CLEAN, offered=10, explained=1, used=1, offered_by=(9, 1), explained_by=(0, 1))
    health = HealthMonitor().update(replace(single, t=1.0, offered=20, offered_by=(19, 1)))
    assert health.condition == LOST


def test_beside_a_gap_of_the_map_it_is_said_which_boundary_is_not_mapped() -> None:
    beside = replace(CLEAN, offered=5, explained=5, used=5, unmapped=(5, 0))
    assert drive((beside, 3.0))[-1] == Health(DEGRADED, "the left boundary is not mapped here")
    both = replace(beside, offered=2, explained=2, used=2, innovations=0.6, unmapped=(5, 5))
    assert drive((both, 3.0))[-1].reason == "no boundary is mapped here"
    assert drive((replace(CLEAN, unmapped=(1, 1)), 3.0))[-1] == Health(GOOD)


def test_a_few_detections_are_not_judged_alone() -> None:
    sparse = replace(CLEAN, offered=1, explained=0, used=0)
    healths = drive((CLEAN, 2.0), (sparse, 0.5))
    assert healths[-1] == Health(GOOD)
    alone = drive((sparse, 3.0))
    assert [health.condition for health in alone[: MIN_OFFERED - 1]] == [GOOD] * 11
    assert alone[MIN_OFFERED - 1].condition == LOST


def test_a_vehicle_that_sees_nothing_is_degraded() -> None:
    blind = Evidence(0.0, closed=True, sigma=0.3)
    healths = drive((CLEAN, 1.0), (blind, 3.0))
    assert healths[25].condition == GOOD and healths[-1].condition == DEGRADED
    assert healths[-1].reason == "no detection in view of the map for 3.0 s"


def test_large_innovations_are_degraded() -> None:
    healths = drive((CLEAN, 1.0), (replace(CLEAN, innovations=36.0), 2.0))
    assert healths[-1] == Health(DEGRADED, "detections lie 2.0 standard deviations beside the map")


@pytest.mark.parametrize(("sigma", "condition"), [(0.9, GOOD), (1.1, DEGRADED), (5.1, LOST)])
def test_an_uncertain_position_is_told(sigma: float, condition: str) -> None:
    health = drive((replace(CLEAN, sigma=sigma), 1.0))[-1]
    assert health.condition == condition
    assert (f"{sigma:.1f} m" in health.reason) == (condition != GOOD)


def test_closing_and_restarting_forget_the_evidence_before() -> None:
    opened = replace(CLEAN, explained=4, used=4, closed=False)
    assert {health.condition for health in drive((opened, 2.0), (CLEAN, 2.0))} == {GOOD}
    monitor = HealthMonitor()
    for cycle in range(20):
        monitor.update(replace(CLEAN, t=PERIOD * cycle, explained=0, used=0))
    monitor.restart()
    assert monitor.update(replace(CLEAN, t=2.0)) == Health(GOOD)


def test_stretches_and_counts_of_a_run() -> None:
    healths = [Health(GOOD), Health(LOST, "a"), Health(LOST, "b"), Health(GOOD), Health(DEGRADED, "c")]
    assert stretches([0.0, 0.1, 0.2, 0.3, 0.4], healths) == [
        HealthStretch(LOST, 0.1, 0.2, "a"),
        HealthStretch(DEGRADED, 0.4, 0.4, "c"),
    ]
    assert counts(healths) == {"good": 2, "degraded": 1, "lost": 2}
    assert stretches([0.0], [Health()]) == []
