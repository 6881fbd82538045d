import numpy as np

from pathspace_graph import FixedLagMapper
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother

REACH = 8.0  # of the detections that are used (m)


class NearSmoother(CurveSmoother):
    def associate(self, retest, use=True):
        tested, detections = super().associate(retest, use), self.map.detections
        detections.release(np.flatnonzero(detections.used & (np.hypot(*detections.measured.T) > REACH)))
        return tested


NearRoad = type("NearRoad", (Road,), {"SMOOTHER": NearSmoother})
NearMapper = type("NearMapper", (FixedLagMapper,), {"ROAD": NearRoad})
