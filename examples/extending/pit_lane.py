from pathspace_graph.health import DEGRADED, Health
from pathspace_graph.loop.drive import Phase, Step


class PitLane(Phase):
    uses_detections = False  # the pose is predicted by odometry alone, and nothing changes the map

    def __init__(self, circuit):
        self.circuit = circuit  # phase to return to

    def judge(self, road, drive, classified, reading):
        return self, Health(DEGRADED, "the vehicle is in the pit lane")

    def step(self, road, drive, reading, spent):
        drive.record.estimated(road)
        return Step(self if self.circuit.is_in_lane(road) else self.circuit)
