from math import inf

import numpy as np

from pathspace_graph import Detections, MapperSettings
from pathspace_graph.io.log import ray_covariances
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.settings.mapper import CalibrationSettings
from pathspace_graph.settings.mapper import MotionSettings

SETTINGS = MapperSettings(motion=MotionSettings(doubt=inf), calibration=CalibrationSettings(sensor=False))


def wall_detections(t, ranges, bearings):
    """Return points of two walls, about 1 m apart, by a scan from right to left: (n,) in m and rad."""
    points = ranges[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    steps = np.hypot(*np.diff(points, axis=0).T)
    labels = np.where(np.arange(len(points)) > steps.argmax(), LEFT, RIGHT)  # the walls end far apart
    few = np.unique(np.append(0.0, steps.cumsum()) // 1.0, return_index=True)[1]
    return Detections(t, points[few], ray_covariances(points[few], (0.05, 0.0, 0.01)), labels[few])
