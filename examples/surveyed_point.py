"""Add factors of your own on control points: a boundary passes through a surveyed point.

The position of one cone of the left boundary is known to a few centimetres. After the curve has grown past
it, the mapper gets a factor on the control points there. The factor stays nonlinear until the loop closes;
then it becomes part of the map's prior. A batch makes the same factor whenever its curves have new knots.

    python examples/surveyed_point.py
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from pathspace_graph import BatchMapper, FixedLagMapper, Log
from pathspace_graph.factors.gtsam_factors import boundary_point_factor
from pathspace_graph.labels import LEFT
from pathspace_graph.mapping.state import State
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


def survey_factors(curves: FixedLagMapper | State, point: Array) -> list[gtsam.NonlinearFactor]:
    """Build the factor of the left boundary and a point (2,); none until the curve has grown past it."""
    if LEFT not in curves.boundaries:
        return []
    boundary, points = curves.boundaries[LEFT], curves.control_points(LEFT)
    end = np.array([boundary.confirmed_end])
    foot = boundary.find(points, point[None], np.zeros(1), end)
    if not foot.interior[0] or abs(foot.distance[0]) > AWAY:
        return []
    factor = boundary_point_factor(
        curves.control_keys(LEFT),
        boundary.tables,
        points_map=point[None],
        sigma=np.array([SIGMA_SURVEY]),
        low=np.maximum(foot.u - REACH, 0.0),
        high=np.minimum(foot.u + REACH, end),
    )
    return [factor]


def drive(log: Log, point: Array | None) -> FixedLagMapper:
    """Map a log with a surveyed point (2,) or without; return the mapper."""
    mapper = FixedLagMapper(odometry_sigma=log.noise)
    added = False
    for odometry, detections in split_odometry(log):
        factors = [] if added or point is None else survey_factors(mapper, point)
        added = added or len(factors) > 0
        mapper.update(odometry, detections, factors)
    return mapper


def solve(log: Log, point: Array) -> State:
    """Map a log as a batch with a surveyed point (2,); return the optimum on dense curves."""
    batch = BatchMapper(odometry_sigma=log.noise, online=FixedLagMapper)
    return batch.solve(log, factors=lambda state: survey_factors(state, point)).optimum.state


def distance(curves: FixedLagMapper | State, point: Array) -> float:
    """Distance (m) of the left boundary from a point (2,)."""
    boundary, points = curves.boundaries[LEFT], curves.control_points(LEFT)
    curve = boundary.evaluate(points, np.linspace(boundary.tables.low, boundary.tables.high, 4000))
    return float(np.hypot(*(curve - point).T).min())


def main(laps: int = 1, seed: int = 0) -> tuple[float, float, float]:
    """Return the distance (m) of the boundary from the surveyed point: without the factor, with it, batch."""
    log = build_log(laps, seed)
    point = survey(log)
    free, held = drive(log, None), drive(log, point)
    return distance(free, point), distance(held, point), distance(solve(log, point), point)


if __name__ == "__main__":
    free, held, batch = main()
    print(f"distance of the boundary without the factor: {free:.3f} m, with it: {held:.3f} m")
    print(f"with it in a batch: {batch:.3f} m")
