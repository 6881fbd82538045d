"""Scenes of any size: a log s times as large gives s times the map, and estimators know one size."""

from __future__ import annotations

import ast
import inspect
import re
from dataclasses import fields, is_dataclass, replace
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph import SettingsError
from pathspace_graph.batch.joint import solve_together
from pathspace_graph.cli import main
from pathspace_graph.estimators import BATCH, ONLINE, make_batch, make_online
from pathspace_graph.eval.metrics.measures import laps_of, measure, summarize
from pathspace_graph.factors.noise import KnownNoise, MeasuredNoise, RayNoise
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import SplineBoundary, read_map
from pathspace_graph.io.results import RunResult, VehicleState
from pathspace_graph.lengths import scaled
from pathspace_graph.plausibility.judge import hints
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

from .scenes.drives import short_drive
from .scenes.paths import modules

CLOSE = 1e-7  # of rounding, which the first steps of an optimum amplify
"""Results agree to this share of the map's size."""


def scalable() -> list[type]:
    """Every dataclass that says which of its fields are lengths."""
    found = []
    for name, file in modules().items():
        if "LENGTHS: ClassVar" not in file.read_text():
            continue
        module = import_module(f"pathspace_graph.{name}".removesuffix(".__init__"))
        found += [own for own in vars(module).values() if isinstance(own, type) and "LENGTHS" in vars(own)]
    return [one for one in dict.fromkeys(found) if is_dataclass(one)]


@pytest.mark.parametrize("kind", scalable(), ids=lambda kind: kind.__name__)
def test_every_field_that_is_said_to_be_in_metres_has_a_power(kind: Any) -> None:
    """The texts of the fields are held against `LENGTHS`: what is in m, m^2 or m/s changes with the scale."""
    powers = {*kind.LENGTHS, *getattr(kind, "COVARIANCES", {})}
    body = ast.parse(inspect.getsource(kind)).body[0].body  # type: ignore[attr-defined]
    for node, text in pairwise(body):
        if isinstance(node, ast.AnnAssign) and isinstance(text, ast.Expr):
            name, said = ast.unparse(node.target), ast.unparse(text.value)
            in_metres = re.search(r"\bin m\b|\(m\)|\bm\^2|\bm/s|\bm, m\b", said)
            if in_metres and name not in powers and not name.startswith("LENGTHS"):
                pytest.fail(f"{kind.__name__}.{name}: {said}")
    assert powers <= {field.name for field in fields(kind)}


def test_each_number_changes_by_its_own_power() -> None:
    noise = MeasuredNoise(
        np.array([1.0, 2.0, 3.0]), np.ones(3), 0.1, RayNoise(np.array([0.1, 0.2])), sensor=np.arange(5.0)
    )
    larger = scaled(KnownNoise(np.ones(3), measured=noise), 10.0).measured
    assert larger is not None
    assert larger.along is not None
    np.testing.assert_allclose(larger.odometry, [10.0, 20.0, 3.0])
    np.testing.assert_allclose(larger.along.sigma, [1.0, 0.2])
    np.testing.assert_allclose(larger.sensor, [0.0, 10.0, 2.0, 3.0, 40.0])
    state = scaled(VehicleState(np.ones(3), np.ones(2), np.ones((5, 5))), 10.0)
    np.testing.assert_allclose(state.pose, [10.0, 10.0, 1.0])
    np.testing.assert_allclose(state.covariance[0], [100.0, 100.0, 10.0, 10.0, 10.0])
    np.testing.assert_allclose(state.covariance[2:, 2:], 1.0)


@settings(max_examples=20)
@given(st.floats(0.01, 100.0))
def test_there_and_back_is_the_same_log(factor: float) -> None:
    log = short_drive()
    larger = scaled(log, factor)
    assert larger.scale == factor
    again = larger.at_scale_one()
    assert again.scale == pytest.approx(1.0)
    np.testing.assert_allclose(again.odometry.twist, log.odometry.twist, rtol=1e-12)
    for one, other in zip(again.cycles, log.cycles, strict=True):
        np.testing.assert_allclose(one.points_vehicle, other.points_vehicle, rtol=1e-12)
        np.testing.assert_allclose(one.covariances, other.covariances, rtol=1e-12)
    assert scaled(log, 1.0) is log


def test_the_header_states_the_scale_and_the_files_are_in_metres(tmp_path: Path) -> None:
    log = scaled(short_drive(), 0.1)
    write_log(log, tmp_path / "log")
    again = read_log(tmp_path / "log")
    assert again.scale == 0.1
    np.testing.assert_array_equal(again.odometry.twist, log.odometry.twist)
    np.testing.assert_allclose(again.noise.odometry, short_drive().odometry_sigma, rtol=1e-12)


def assert_alike(found: RunResult, known: RunResult, scale: float) -> None:
    """A result is that of a scene `scale` times as large, to rounding."""
    assert found.scale == scale
    assert found.map.closed == known.map.closed
    assert found.laps == known.laps
    size = scale * np.ptp(known.trajectory[:, :2])
    weights = np.array([scale, scale, 1.0])
    np.testing.assert_allclose(found.trajectory, known.trajectory * weights, rtol=0.0, atol=CLOSE * size)
    assert (found.smoothed is None) == (known.smoothed is None)
    if known.smoothed is not None:
        np.testing.assert_allclose(found.smoothed, known.smoothed * weights, rtol=0.0, atol=CLOSE * size)
    for label, boundary in known.map.boundaries.items():
        other = found.map.boundaries[label]
        assert isinstance(boundary, SplineBoundary)
        assert isinstance(other, SplineBoundary)
        points = boundary.spline.control_points
        np.testing.assert_allclose(other.spline.control_points, scale * points, rtol=0.0, atol=CLOSE * size)
        largest = scale**2 * np.abs(boundary.covariance).max()
        np.testing.assert_allclose(
            other.covariance, scale**2 * boundary.covariance, rtol=0.0, atol=1e-6 * largest
        )


@cache
def of_scale_one(name: str) -> RunResult:
    return result_of(short_drive(), name)


def result_of(log: Log, name: str) -> RunResult:
    settings = MapperSettings()
    if name in BATCH:
        return make_batch(name, settings, log).solve(log)
    return run_online(log, make_online(name, settings, log))


@pytest.mark.parametrize(("name", "scale"), [("fixed-lag", 0.37), ("fixed-lag", 10.0), ("spline", 3.0)])
def test_a_log_s_times_as_large_gives_s_times_the_map(name: str, scale: float) -> None:
    found, known = result_of(scaled(short_drive(), scale), name), of_scale_one(name)
    assert_alike(found, known, scale)
    weights = np.array([scale, scale, 1.0, 1.0, 1.0])
    assert found.vehicle is not None
    assert known.vehicle is not None
    np.testing.assert_allclose(found.vehicle.pose, known.vehicle.pose * weights[:3], rtol=1e-6)
    covariance = known.vehicle.covariance * np.outer(weights, weights)
    np.testing.assert_allclose(found.vehicle.covariance, covariance, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("name", [*ONLINE, "landmark-batch"])
def test_every_estimator_knows_one_size(name: str) -> None:
    """Of a tenth of a log it makes a tenth of the map."""
    log = replace(short_drive(), cycles=short_drive().cycles[:60])
    known, found = result_of(log, name), result_of(scaled(log, 0.1), name)
    np.testing.assert_allclose(found.trajectory, known.trajectory * [0.1, 0.1, 1.0], rtol=0.0, atol=1e-8)
    assert found.map.size == known.map.size
    assert found.scale == 0.1


def test_logs_of_several_scales_give_no_map() -> None:
    logs = {"one": short_drive(), "ten": scaled(short_drive(), 10.0)}
    with pytest.raises(SettingsError, match="expected logs of one scale"):
        solve_together(logs, lambda *_: pytest.fail("it is refused before"))


def test_metrics_are_those_of_scale_one_times_the_scale() -> None:
    log, known = short_drive(), of_scale_one("fixed-lag")
    larger = scaled(log, 10.0)
    found = result_of(larger, "fixed-lag")
    first, second = summarize(known, log), summarize(found, larger)
    assert second["scale"] == 10.0
    assert second["ate"] == pytest.approx(10.0 * first["ate"], rel=1e-6)
    assert second["final"]["rmse"] == pytest.approx(10.0 * first["final"]["rmse"], rel=1e-6)
    assert second["final"]["missed"] == first["final"]["missed"]
    assert len(laps_of(found, larger)) == len(laps_of(known, log))
    over_scale = measure(found, larger)[-1]
    assert over_scale["rmse"] == pytest.approx(measure(known, log)[-1]["rmse"], rel=1e-6)


def test_a_small_scene_is_no_mistake_of_a_log_that_says_so() -> None:
    assert hints(scaled(short_drive(), 0.1)) == []


def test_commands_map_a_small_scene_in_its_metres(tmp_path: Path) -> None:
    """`--scale` replaces the scale of the header, and a known map is of the log's size as well."""
    small = scaled(short_drive(), 0.1)
    write_log(replace(small, scale=1.0), tmp_path / "log")
    log, out = str(tmp_path / "log"), str(tmp_path / "map")
    assert main(["online", log, "--out", out, "--scale", "0.1"]) == 0
    track = read_map(tmp_path / "map")
    reach = np.abs(track.curve(0, "a test").spline.control_points).max()
    assert reach == pytest.approx(0.1 * np.abs(short_drive().truth.cones).max(), rel=0.2)
    on = ["--on", out, "--start", "0", "0", "0"]
    again = ["online", log, "--out", str(tmp_path / "again"), "--scale", "0.1", *on]
    assert main(again) == 0


@pytest.mark.parametrize("scale", ["0", "-1", "nan"])
def test_a_scale_that_is_none_is_refused(scale: str, tmp_path: Path) -> None:
    write_log(short_drive(), tmp_path / "log")
    assert main(["online", str(tmp_path / "log"), "--out", str(tmp_path / "map"), "--scale", scale]) == 2
    assert main(["batch", str(tmp_path / "log"), "--out", str(tmp_path / "map"), "--scale", scale]) == 2
