"""`--map centerline`: the edges of a ribbon in place of the boundaries, at any scale and in every lap."""

from __future__ import annotations

import numpy as np
import pytest

from pathspace_graph.commands.estimate import of_kind
from pathspace_graph.io.map import Map
from pathspace_graph.io.results import RunResult
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.lengths import scaled
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes.maps import point_map, ring_map

SETTINGS = MapperSettings()


def result(track: Map, scale: float) -> RunResult:
    """A run without a cycle; the map is also that of the first lap, and a snapshot."""
    map_at_scale = scaled(track, scale)
    maps: tuple[tuple[int, Map], ...] = ((1, map_at_scale),)
    return RunResult(
        "fixed-lag",
        {},
        map_at_scale,
        np.zeros(0),
        np.zeros((0, 3)),
        (),
        1,
        maps,
        (map_at_scale,),
        scale=scale,
    )


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_every_map_of_a_run_has_the_edges_of_its_ribbon(scale: float) -> None:
    made = of_kind(result(ring_map(), scale), "centerline", SETTINGS)
    for track in (made.map, made.lap_maps[0][1], made.snapshots[0]):
        for label, radius in ((LEFT, 18.0), (RIGHT, 22.0)):
            spline = track.curve(label, "a test").spline
            at = np.linspace(*spline.domain, 50)
            np.testing.assert_allclose(np.hypot(*spline.evaluate(at).T), scale * radius, rtol=1e-3)
        # knots of the line are 3 m apart at scale 1, and an edge has two spans for each
        assert track.size == 2 * 2 * round(2 * np.pi * 20.0 / 3.0)


def test_boundaries_stay_where_they_are_asked_for() -> None:
    run = result(ring_map(), 1.0)
    assert of_kind(run, "boundaries", SETTINGS) is run


def test_landmarks_stay_and_it_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    run = result(point_map(), 1.0)
    assert of_kind(run, "centerline", SETTINGS) is run
    error = capsys.readouterr().err
    assert "--map centerline: a centre line: expected a curve as left boundary" in error
    assert error.count("\n") == 1
