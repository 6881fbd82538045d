"""Logs that several tests of the landmark estimators read."""

from __future__ import annotations

import pytest

from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import SimulationSettings, simulate

from ...scenes.drives import bean_track


@pytest.fixture(scope="session")
def bean() -> Log:
    """Returns a simulated log of two laps on the small track."""
    return simulate(bean_track(), SimulationSettings(laps=2), seed=3)
