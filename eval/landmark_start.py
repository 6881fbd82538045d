"""Where the landmark batch begins: told, or at what an online run of the same log has found."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.batch_data import Chain, collect_readings
from pathspace_graph.factors.odometry import CALIBRATION_SIZE
from pathspace_graph.factors.projection import to_map
from pathspace_graph.labels import BOUNDARIES, LEFT, RIGHT, UNKNOWN
from pathspace_graph.log import Log
from pathspace_graph.run import split_odometry
from pathspace_graph.settings import MapperSettings
from pathspace_graph.window import POSE

from .landmark_association import NONE
from .landmark_fixed_lag import LandmarkFixedLag
from .landmark_state import LandmarkReadings, LandmarkState

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


def as_landmark_readings(log: Log) -> LandmarkReadings:
    """Every reading of a log, none in use; `slot` is the cycle's number."""
    plain = collect_readings(log)
    shared = {column.name: getattr(plain, column.name) for column in fields(plain)}
    return LandmarkReadings(**shared, landmark=np.full(len(plain), NONE, np.intp))


def start_told(readings: LandmarkReadings, chain: Chain, associations: Ints) -> LandmarkState:
    """Dead reckoning, each landmark where it was seen first; its colour that of most of its readings."""
    told = np.flatnonzero(associations >= 0)
    ids, first, landmark = np.unique(associations[told], return_index=True, return_inverse=True)
    readings.take(told, landmark)
    poses = chain.dead_reckoned(np.zeros(CALIBRATION_SIZE))
    points = to_map(readings.point[told[first]], poses[readings.slot[told[first]]])
    labels, colours = readings.label[told], (LEFT, RIGHT, UNKNOWN)
    votes = np.stack([np.bincount(landmark[labels == label], minlength=len(ids)) for label in colours])
    state = LandmarkState()
    state.labels, state.ids = votes.argmax(axis=0).astype(np.intp), ids.astype(np.intp)
    state.votes = votes[: len(BOUNDARIES)].T
    state.vector = np.concatenate([points.ravel(), np.zeros(CALIBRATION_SIZE), poses.ravel()])
    return state


def start_online(
    log: Log, readings: LandmarkReadings, settings: MapperSettings, sigma: Array
) -> LandmarkState:
    """The online run's last map, and each pose and association as it left the window."""
    online = LandmarkFixedLag(settings, sigma)
    smoother = online.smoother
    poses = np.zeros((len(log.cycles), POSE))
    number = np.full(len(readings), NONE, np.intp)
    begins = np.searchsorted(readings.slot, np.arange(len(log.cycles)))
    for odometry, cycle in split_odometry(log):
        online.update(odometry, cycle)
        window, first = smoother.readings, smoother.first_cycle
        poses[first : first + len(smoother.times)] = smoother.state.poses
        rows = slice(begins[first], begins[first] + len(window))
        number[rows] = window.numbers(smoother.state.ids)
    state = LandmarkState()
    state.labels, state.ids, state.born = smoother.state.labels, smoother.state.ids, smoother.state.born
    state.votes = smoother.state.votes
    final = np.arange(state.born)
    for gone, became in sorted(smoother.merged.items()):  # the newer became the older
        final[gone] = final[became]
    known = np.flatnonzero(number != NONE)
    readings.take(known, np.searchsorted(state.ids, final[number[known]]))
    state.vector = np.concatenate(
        [smoother.state.landmarks.ravel(), smoother.state.calibration, poses.ravel()]
    )
    return state
