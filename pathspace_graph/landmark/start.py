"""Where the landmark batch begins: told, or at what an online run of the same log has found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.se2 import to_map
from pathspace_graph.graph.keys import CALIBRATION_KEY, POSE, pose_keys
from pathspace_graph.io.log import Log
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.mapping.measurements import Chain, collect_detections
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from .association import NONE
from .fixed_lag import LandmarkFixedLag
from .state import LandmarkDetections, LandmarkState

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def as_landmark_detections(log: Log) -> LandmarkDetections:
    """Every reading of a log, none in use."""
    plain = collect_detections(log)
    nothing = np.full(len(plain), NONE, np.intp)
    return LandmarkDetections(plain.cycle, plain.point, plain.covariance, plain.label, nothing, plain.changed)


def start_oracle(detections: LandmarkDetections, chain: Chain, associations: Ints) -> LandmarkState:
    """Dead reckoning, each landmark where it was seen first; its colour that of most of its readings."""
    told = np.flatnonzero(associations >= 0)
    numbers, first, landmark = np.unique(associations[told], return_index=True, return_inverse=True)
    detections.take(told, numbers[landmark])
    calibration = np.zeros(CALIBRATION_SIZE)
    poses = chain.dead_reckoned(calibration)
    points = to_map(detections.point[told[first]], poses[detections.cycle[told[first]]])
    labels, colours = detections.label[told], (LEFT, RIGHT, UNKNOWN)
    votes = np.stack([np.bincount(landmark[labels == label], minlength=len(numbers)) for label in colours])
    state = LandmarkState()
    state.add(points, votes.argmax(axis=0).astype(np.intp), numbers.astype(np.intp))
    state.votes = votes[: len(BOUNDARIES)].T
    _drive(state, calibration, poses)
    return state


def start_online(
    log: Log, detections: LandmarkDetections, settings: MapperSettings, sigma: Array
) -> LandmarkState:
    """The online run's last map, and each pose and association as it left the window."""
    online = LandmarkFixedLag(settings, sigma)
    smoother, found = online.smoother, online.smoother.map
    poses = np.zeros((len(log.cycles), POSE))
    number = np.full(len(detections), NONE, np.intp)
    begins = np.searchsorted(detections.cycle, np.arange(len(log.cycles)))
    for odometry, cycle in split_odometry(log):
        online.update(odometry, cycle)
        first = smoother.first_cycle
        poses[first : smoother.next_cycle] = smoother.variables.poses
        number[begins[first] : begins[first] + len(found.detections)] = found.detections.landmark
    final = np.arange(found.state.born)
    for gone, became in sorted(found.became.items()):  # the newer became the older
        final[gone] = final[became]
    known = np.flatnonzero(number >= 0)
    detections.take(known, final[number[known]])
    state = LandmarkState()
    state.add(found.state.landmarks, found.state.labels, found.state.numbers)
    state.votes, state.born = found.state.votes, found.state.born
    _drive(state, smoother.variables.calibration, poses)
    return state


def _drive(state: LandmarkState, calibration: Array, poses: Array) -> None:
    """The calibration (2,) and the poses (P, 3) of the whole log are variables."""
    state.variables.insert(np.array([CALIBRATION_KEY]), calibration)
    state.variables.insert(pose_keys(np.arange(len(poses))), poses.ravel())
