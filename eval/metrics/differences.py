"""Where a map differs from the one that was known before the drive."""

from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from scipy.spatial import KDTree

from pathspace_graph.factors.arrays import Array
from pathspace_graph.io.map import Map
from pathspace_graph.labels import NAMES
from pathspace_graph.spline.bspline import BSpline

DIFFERENT: Final = 0.5  # distance of both curves from which on they differ (m): more than a refinement
STEP: Final = 0.5  # step at which a curve is compared (m)


@dataclass(frozen=True)
class MapDifference:
    """A stretch of a boundary that is not where the known map has it."""

    LENGTHS: ClassVar = {"x": 1, "y": 1, "length": 1, "distance": 1}

    boundary: str
    x: float
    """Place of the largest distance, m, map frame."""
    y: float
    length: float
    """Length of the stretch, m."""
    distance: float
    """Largest distance of the curve from the known one, m."""

    @property
    def line(self) -> str:
        place = f"at x = {self.x:.1f} m, y = {self.y:.1f} m"
        off = f"up to {self.distance:.2f} m from the known map"
        return f"the {self.boundary} boundary is {off} on {self.length:.0f} m, {place}"


def _spaced(spline: BSpline, step: float) -> Array:
    """Return points (n, 2) along a curve, about this step (m) apart."""
    return spline.evaluate(np.linspace(*spline.domain, int(spline.length() / step) + 2))


def differences(known: Map, found: Map) -> list[MapDifference]:
    """Return the stretches of a found map that lie beside those of the known one, at scale 1."""
    stretches = list[MapDifference]()
    for label, spline in found.splines.items():
        if label not in known.splines:
            continue
        points = _spaced(spline, STEP)
        away = np.asarray(KDTree(_spaced(known.splines[label], 0.1 * STEP)).query(points)[0])
        differs = away > DIFFERENT
        begins = np.flatnonzero(differs & ~np.append(False, differs[:-1]))
        for begin in begins.tolist():
            end = begin + int(np.append(differs[begin:], False).argmin())
            worst = begin + int(away[begin:end].argmax())
            x, y = points[worst].tolist()
            length = STEP * (end - begin)
            stretches.append(MapDifference(NAMES[label], x, y, length, float(away[worst])))
    return stretches
