from dataclasses import replace

import numpy as np
from pit_lane import PitLane

from pathspace_graph import FixedLagMapper
from pathspace_graph.loop.closed import Closed
from pathspace_graph.loop.open import Open


class Circuit(Closed):
    lane = np.array([0.0, 0.0]), 0.0  # middle (2,) and radius of the pit lane (m), map frame

    def is_in_lane(self, road):
        middle, radius = self.lane
        return np.hypot(*(road.poses[-1, :2] - middle)) < radius

    def step(self, road, drive, reading, spent):
        step = super().step(road, drive, reading, spent)
        enters = self.is_in_lane(road) and not drive.solver.is_busy
        return replace(step, phase=PitLane(step.phase)) if enters else step


class OpenCircuit(Open):
    CLOSED = Circuit


class PitMapper(FixedLagMapper):
    FIRST_PHASE = OpenCircuit
