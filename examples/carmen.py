"""JSON lines for `pathspace-graph convert` from the scans and corrected poses of a CARMEN log."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FASTER = 8.0  # a robot of 0.25 m/s drives as a car of 2 m/s does
Scan = tuple[float, NDArray[np.float64], list[float]]


def scans(file: Path) -> Iterator[Scan]:
    """Yield time, pose and ranges of each scan."""
    for words in map(str.split, file.read_text().splitlines()):
        if words[:1] == ["FLASER"]:
            count = int(words[1])
            pose = np.array(words[2 + count : 5 + count], dtype=float)
            yield float(words[-1]) / FASTER, pose, [float(word) for word in words[2 : 2 + count]]


def line(scan: Scan, later: Scan) -> str:
    """A scan with the twist (vehicle frame) that leads to the pose of the later one."""
    t, pose, ranges = scan
    step, turn = later[1][:2] - pose[:2], np.angle(np.exp(1j * (later[1][2] - pose[2])))
    c, s = np.cos(pose[2] + turn / 2), np.sin(pose[2] + turn / 2)
    twist = np.array([c * step[0] + s * step[1], c * step[1] - s * step[0], turn]) / (later[0] - t)
    beams = {"angle_min": -np.pi / 2, "angle_increment": np.pi / len(ranges), "range_max": 8.0}
    return json.dumps({"t": t, "twist": twist.tolist(), "scan": {**beams, "ranges": ranges}})


if __name__ == "__main__":
    for pair in pairwise(scans(Path(sys.argv[1]))):
        print(line(*pair))
