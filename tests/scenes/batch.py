"""A short straight drive as the batch's problem, for tests of its optimum and of its covariance."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch.association import associate, locate_poses
from pathspace_graph.batch.dead_reckoning import start_odometry
from pathspace_graph.batch.mapper import own_settings
from pathspace_graph.batch.system import BatchSystem, Biweight, moved
from pathspace_graph.mapping.measurements import Chain, collect_detections, integrate_log
from pathspace_graph.mapping.state import State
from pathspace_graph.settings.mapper import MapperSettings

from .drives import ahead, corridor, exact_log

Array = NDArray[np.float64]

LEAST_SQUARES = 1e3
"""Gate (sigmas) so wide that the loss is the square."""


SMOOTHNESS = 20.0
"""Where errors are looked at, the curves' smoothness must not help: the truth is smoother than noise."""


def straight(seconds: float = 6.0, smoothness: float = SMOOTHNESS) -> tuple[BatchSystem, State]:
    """An exact drive of 6 m/s between two rows of cones, at the curves through them; every reading in use."""
    whole = MapperSettings()
    whole = replace(whole, batch=replace(whole.batch, sigma_smoothness=smoothness))
    cones, labels = corridor(60.0)
    log = exact_log(ahead(6.0, seconds), cones, labels)
    settings = own_settings(whole)
    chain, detections = integrate_log(log, log.odometry_sigma, settings.odometry), collect_detections(log)
    state = start_odometry(chain, detections, settings)
    system = BatchSystem(detections, chain, settings, Biweight(LEAST_SQUARES))
    system.begin(state)
    locate_poses(state, settings.batch.association)
    associate(state, detections, settings, settings.batch.gate, True)
    system.evaluate(state, hold=True)
    return system, settled(system, state)


def settled(system: BatchSystem, state: State, steps: int = 4) -> State:
    """After some Gauss-Newton steps."""
    for _ in range(steps):
        at = system.evaluate(state)
        for projected in at.projected.values():
            system.detections.u[projected.rows] = projected.foot.u
        problem = system.eliminated(at)
        state = moved(state, problem.step(np.zeros(problem.map.size)))
    return state


def drawn(system: BatchSystem, rng: np.random.Generator) -> tuple[BatchSystem, Array]:
    """The same drive measured with noise as the problem has it; also the calibration (2,) that it hides."""
    detections, chain = system.detections, system.chain
    odometry = system.settings.odometry
    calibration = rng.normal(0.0, [odometry.sigma_scale, odometry.sigma_bias])
    sigma = np.sqrt(detections.covariance[:, 0, 0] + system.settings.spline.sigma_model**2)
    points = detections.point + sigma[:, None] * rng.normal(size=detections.point.shape)
    driven = chain.odometry
    noise = np.linalg.solve(driven.whiteners, rng.normal(size=(*driven.deltas.shape, 1)))[..., 0]
    local = noise + driven.by_calibration @ calibration
    first = rng.multivariate_normal(chain.first, np.linalg.inv(chain.first_information))
    noisy = BatchSystem(
        replace(detections, point=points, u=detections.u.copy()),
        _turned(replace(chain, first=first), local),
        system.settings,
        system.kernel,
    )
    return noisy, calibration


def _turned(chain: Chain, local: Array) -> Chain:
    """With errors (P - 1, 3) in the frame of each motion's end."""
    odometry = copy(chain.odometry)
    c, s = np.cos(odometry.deltas[:, 2]), np.sin(odometry.deltas[:, 2])
    turned = np.column_stack([c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1]])
    odometry.deltas = odometry.deltas + np.column_stack([turned, local[:, 2]])
    return replace(chain, odometry=odometry)
