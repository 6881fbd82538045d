"""The cones near the vehicle, in the frame of the front end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pathspace_graph.labels import BOUNDARIES, UNKNOWN
from pathspace_graph.mapping.tentative import nearest_within, newest_of
from pathspace_graph.settings.front_end import SidesSettings

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]


class NearCones:
    """Holds cones as means of their detections, with the colours in which they were seen."""

    def __init__(self, settings: SidesSettings) -> None:
        self.settings = settings
        self.points: Array = np.zeros((0, 2))
        """(n, 2) Each cone is at this point in m."""
        self.counts: IntArray = np.zeros(0, np.intp)
        """(n,) Each cone was detected this number of times."""
        self.votes: IntArray = np.zeros((0, len(BOUNDARIES)), np.intp)
        """(n, 2) Each cone was given the label of the left and of the right boundary this number of times."""
        self.judged: BoolArray = np.zeros(0, bool)
        """(n,) The flag is set when the colour of the cone has been compared with its side."""
        self._last: Array = np.zeros(0)

    def add(self, t: float, points: Array, labels: IntArray) -> IntArray:
        """Adds detections at points (m, 2) with labels (m,), seen at t (s); returns the cone (m,) of each."""
        self._forget(t)
        cones = self._cones_of(points)
        new = int(cones.max(initial=-1)) + 1 - len(self.points)
        if new > 0:
            self.points = np.concatenate([self.points, np.zeros((new, 2))])
            self.counts = np.concatenate([self.counts, np.zeros(new, np.intp)])
            self.votes = np.concatenate([self.votes, np.zeros((new, len(BOUNDARIES)), np.intp)])
            self.judged = np.concatenate([self.judged, np.zeros(new, bool)])
            self._last = np.concatenate([self._last, np.full(new, t)])
        coloured = labels != UNKNOWN
        np.add.at(self.votes, (cones[coloured], labels[coloured]), 1)
        np.add.at(self.counts, cones, 1)
        np.add.at(self.points, cones, (points - self.points[cones]) / self.counts[cones, None])
        self._last[cones] = t
        return cones

    def _cones_of(self, points: Array) -> IntArray:
        """Returns the nearest cone (m,) of each point (m, 2), or the number of a new one."""
        cones, known = nearest_within(points, self.points, self.settings.merge_radius)
        cones[~known] = len(self.points) + np.arange(int((~known).sum()))
        return cones

    def _forget(self, t: float) -> None:
        kept = newest_of(self._last, self.settings.max_cones) & (self._last > t - self.settings.forget_after)
        self.points, self.counts = self.points[kept], self.counts[kept]
        self.votes, self.judged = self.votes[kept], self.judged[kept]
        self._last = self._last[kept]
