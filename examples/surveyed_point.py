"""Add factors of your own on control points: a boundary passes through a surveyed point.

The position of one cone of the left boundary is known to a few centimetres. After the curve has grown past
it, the mapper gets a factor on the control points there. The factor stays nonlinear while these control
points are active, and then becomes part of the map's prior.

    python examples/surveyed_point.py
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph import FixedLagMapper, Log
from pathspace_graph.factors.gtsam_factors import boundary_point_factor
from pathspace_graph.labels import LEFT
from pathspace_graph.run import split_odometry
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

Array = NDArray[np.float64]

SIGMA_SURVEY = 0.02
"""Standard deviation of the surveyed point (m)."""
REACH = 3.0
"""Length along the curve, to both sides, in which its foot point is searched (m)."""
AWAY = 5.0
"""Distance from the point beyond which a curve has not grown past it yet (m)."""


def build_log(laps: int = 1, seed: int = 0) -> Log:
    """Simulate a drive on a generated track."""
    track = generate_track(np.random.default_rng(seed))
    return simulate(track, SimulationSettings(laps=laps), seed)


def survey(log: Log, share: float = 0.4) -> Array:
    """Return the left cone (2,) nearest to the vehicle after a share of the drive, in m, map frame."""
    assert log.truth is not None
    cones = log.truth.cones[log.truth.cone_labels == LEFT]
    pose = log.truth.poses[int(share * len(log.truth.poses)), :2]
    return np.asarray(cones[np.hypot(*(cones - pose).T).argmin()])


def survey_factor(mapper: FixedLagMapper, point: Array) -> gtsam.NonlinearFactor | None:
    """Build a factor of the left boundary and a point (2,); None until the curve has grown past it."""
    if LEFT not in mapper.boundaries:
        return None
    boundary, points = mapper.boundaries[LEFT], mapper.control_points(LEFT)
    end = np.array([boundary.confirmed_end])
    foot = boundary.find(points, point[None], np.zeros(1), end)
    if not foot.interior[0] or abs(foot.distance[0]) > AWAY:
        return None
    return boundary_point_factor(
        mapper.control_keys(LEFT),
        boundary.tables,
        points_map=point[None],
        sigma=np.array([SIGMA_SURVEY]),
        low=np.maximum(foot.u - REACH, 0.0),
        high=np.minimum(foot.u + REACH, end),
    )


def drive(log: Log, point: Array | None) -> FixedLagMapper:
    """Map a log with a surveyed point (2,) or without; return the mapper."""
    mapper = FixedLagMapper(odometry_sigma=log.noise)
    added = False
    for odometry, detections in split_odometry(log):
        factor = None if added or point is None else survey_factor(mapper, point)
        added = added or factor is not None
        mapper.update(odometry, detections, [] if factor is None else [factor])
    return mapper


def distance(mapper: FixedLagMapper, point: Array) -> float:
    """Distance (m) of the left boundary from a point (2,)."""
    boundary, points = mapper.boundaries[LEFT], mapper.control_points(LEFT)
    curve = boundary.evaluate(points, np.linspace(boundary.tables.low, boundary.tables.high, 4000))
    return float(np.hypot(*(curve - point).T).min())


def main(laps: int = 1, seed: int = 0) -> tuple[float, float]:
    """Return the distance (m) of the boundary from the surveyed point, without and with the factor."""
    log = build_log(laps, seed)
    point = survey(log)
    return distance(drive(log, None), point), distance(drive(log, point), point)


if __name__ == "__main__":
    without, with_survey = main()
    print(f"distance of the boundary: {without:.3f} m without the factor, {with_survey:.3f} m with it")
