"""Estimators that make no map worth the name, but at once, for tests of what runs them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pathspace_graph import estimators as registry
from pathspace_graph.io.log import Detections, Odometry
from pathspace_graph.io.map import Map, PointBoundary
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import CycleResult
from pathspace_graph.settings.mapper import MapperSettings


class Pretender:
    """Maps two cones a boundary, one as far from the origin as its lag."""

    calls = 0

    def __init__(self, settings: MapperSettings, odometry_sigma: NDArray[np.float64]) -> None:
        type(self).calls += 1
        self.settings = settings

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        return CycleResult(detections.t, np.zeros(3), (2, 2), 1, False)

    def map(self) -> Map:
        points = np.array([[self.settings.lag, 0.0], [0.0, -10.0]])
        return Map(False, {label: PointBoundary(points, np.eye(4)) for label in (LEFT, RIGHT)})


class Fragile(Pretender):
    """Fails wherever the lag is 1 s, as long as it is broken."""

    broken = True

    def update(self, odometry: Odometry, detections: Detections) -> CycleResult:
        if self.broken and self.settings.lag == 1.0:
            raise ValueError("lost")
        return super().update(odometry, detections)


def register(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make `pretender` and `fragile` known for a test, none of them called yet."""
    monkeypatch.setitem(registry.ONLINE, "pretender", Pretender)  # type: ignore[misc]
    monkeypatch.setitem(registry.ONLINE, "fragile", Fragile)  # type: ignore[misc]
    monkeypatch.setattr(Fragile, "broken", True)
    monkeypatch.setattr(Pretender, "calls", 0)
    monkeypatch.setattr(Fragile, "calls", 0)


def write_round_track(folder: Path) -> Path:
    """A track of 63 m with 40 cones."""
    angles = np.arange(20) * 2 * np.pi / 20
    rows = ["tag,x,y,direction", "car_start,0,-10,0"]
    for tag, radius in (("blue", 8.0), ("yellow", 12.0)):
        rows += [f"{tag},{radius * np.cos(a):.4f},{radius * np.sin(a):.4f},0" for a in angles]
    file = folder / "round.csv"
    file.write_text("\n".join(rows) + "\n")
    return file


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder and its subfolders."""
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}
