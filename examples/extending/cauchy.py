import numpy as np

from pathspace_graph import FixedLagMapper
from pathspace_graph.graph.rows import Rows
from pathspace_graph.mapping.curve_map import CurveMap
from pathspace_graph.mapping.road import Road
from pathspace_graph.mapping.smoother import CurveSmoother

SCALE = 2.0  # of the loss, in sigmas


class CauchyMap(CurveMap):
    def rows(self, cycles):
        return [
            weighted(rows, 1.0 / np.sqrt(1.0 + (rows.residual / SCALE) ** 2)) for rows in super().rows(cycles)
        ]


def weighted(rows, root):
    return Rows(rows.keys, rows.jacobian * root[:, None], rows.residual * root, rows.owner)


CauchySmoother = type("CauchySmoother", (CurveSmoother,), {"MAP": CauchyMap})
CauchyRoad = type("CauchyRoad", (Road,), {"SMOOTHER": CauchySmoother})
CauchyMapper = type("CauchyMapper", (FixedLagMapper,), {"ROAD": CauchyRoad})
