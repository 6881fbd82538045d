"""A copy of a baseline goes on to the same bits, and leaves what it was copied from as it was."""

from __future__ import annotations

from itertools import islice

import pytest

from pathspace_graph.baselines.filters import CkfMapper, LandmarkCkf
from pathspace_graph.baselines.landmark_fixed_lag import LandmarkFixedLag
from pathspace_graph.baselines.online import OnlineBaseline
from pathspace_graph.run import split_odometry

from ..scenes.digest import digest
from ..scenes.drives import ahead, corridor, exact_log


@pytest.mark.parametrize("kind", [LandmarkFixedLag, CkfMapper, LandmarkCkf])
def test_a_copy_goes_on_alone(kind: type[OnlineBaseline]) -> None:
    log = exact_log(ahead(4.0, 10.0), *corridor(60.0))
    first = kind(None, log.odometry_sigma)
    cycles = list(islice(split_odometry(log), 38))
    for odometry, detections in cycles[:25]:
        first.update(odometry, detections)
    before, twin = digest(first), first.copy()
    assert digest(twin) == before
    for odometry, detections in cycles[25:]:
        twin.update(odometry, detections)
    assert digest(first) == before
    assert twin.map().size > first.map().size
    for odometry, detections in cycles[25:]:
        first.update(odometry, detections)
    assert digest(first) == digest(twin) != before
