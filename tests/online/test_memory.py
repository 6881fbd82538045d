"""The memory of a long drive grows by the results of its cycles alone."""

from __future__ import annotations

import gc
import tracemalloc
from dataclasses import replace

import pytest

from pathspace_graph.online.fixed_lag import FixedLagMapper
from pathspace_graph.run import ObservedCycle, run_online

from ..scenes.kidnapped import laps_log, pear_track

FIRST, LAST = 250, 400  # cycles of the second lap, on a closed map


@pytest.mark.slow
def test_a_cycle_on_a_closed_map_leaves_little_more_than_its_row_of_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """About 450 bytes for 17 columns, six times of stages and a pose, and some detections for the noise."""
    memory = dict[int, int]()

    def look(cycle: ObservedCycle) -> None:
        if cycle.number in (FIRST, LAST):
            assert cycle.result.closed
            gc.collect()
            memory[cycle.number] = tracemalloc.get_traced_memory()[0]

    monkeypatch.setattr("pathspace_graph.loop.drive.MOST_CYCLES", FIRST - 20)
    mapper = FixedLagMapper()
    log = laps_log(pear_track(), 3)
    tracemalloc.start(1)
    try:
        run_online(replace(log, cycles=log.cycles[: LAST + 1]), mapper, observers=[look], outlines=True)
    finally:
        tracemalloc.stop()
    growth = (memory[LAST] - memory[FIRST]) / (LAST - FIRST)
    assert growth < 1_600, f"{growth:.0f} bytes a cycle"
