"""Copies of the front end: the original's further cycles don't change them, and they go on as it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pathspace_graph.factors.noise import KnownNoise
from pathspace_graph.front_end.front_end import FrontEnd, Reading
from pathspace_graph.io.log import SIGMA_ODOMETRY, Detections, Odometry
from pathspace_graph.labels import UNKNOWN
from pathspace_graph.run import split_odometry
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.digest import digest
from ..scenes.drives import short_drive
from ..shared.copied import copied

Cycle = tuple[Odometry, Detections]

COPIED_AT = (0, 3, 50, 83, 100, 138)
"""Cycles: the first ones, one without colours, two while noise is measured, and one without odometry."""
GOES_ON = 20


def drive() -> list[Cycle]:
    """Returns a drive whose detections lose their colours, and whose odometry fails later."""
    cycles = list(split_odometry(short_drive()))
    for k in range(136, 144):
        cycles[k] = Odometry(np.zeros(0), np.zeros((0, 3))), cycles[k][1]
    for k in range(10, 100):
        odometry, seen = cycles[k]
        cycles[k] = odometry, replace(seen, labels=np.full(len(seen.labels), UNKNOWN))
    return cycles


def update(front_end: FrontEnd, cycle: Cycle) -> Reading:
    admitted = front_end.admit(*cycle)
    return front_end.update(admitted.odometry, admitted.detections)


def digests(front_end: FrontEnd) -> tuple[str, str]:
    return digest(front_end), digest(vars(front_end.gate))


def test_a_copy_stays_as_it_is_and_goes_on_as_the_original() -> None:
    cycles = drive()
    noise = KnownNoise(np.array(SIGMA_ODOMETRY), odometry_stated=False, detections_stated=False)
    original, copies, readings = FrontEnd(MapperSettings(), noise), {}, []
    for k, cycle in enumerate(cycles):
        if k in COPIED_AT:
            copies[k] = original.copy(), copied(original)
        readings.append(digest(update(original, cycle)))
    assert len(cycles) > COPIED_AT[-1] + GOES_ON
    for k, (copy, expected) in copies.items():
        assert digests(copy) == digests(expected)
        for n in range(k, k + GOES_ON):
            assert digest(update(copy, cycles[n])) == readings[n]
