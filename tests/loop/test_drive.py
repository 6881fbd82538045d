"""The drive: what it does after a failure."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.loop.drive import Drive
from pathspace_graph.mapping.road import Road
from pathspace_graph.settings.mapper import MapperSettings


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
