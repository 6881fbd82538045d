"""The noise section of a log: a round trip to the bit, and every bad value in one line with the file."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.factors.noise import MeasuredNoise, RayNoise
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log, write_log

from .test_log import assert_same, small_log

HEADER = 'format = "pathspace-log/1"\n[odometry]\nsigma = [0.1, 0.1, 0.01]\n'
MEASURED = {
    "odometry": "[0.1, 0.2, 0.01]",
    "drift": "[0.012, 0.006, 0.0017]",
    "interval": "0.02",
    "along": "[0.1, 0.02, 0.5, 2.0]",
    "across": "[0.0, 0.01, 0.8, 1.0]",
    "count": "17",
    "period": "0.1",
    "per_cycle": "8.5",
    "yaw": "[0.01, 0.001]",
    "lateral": "[-0.2, 0.02]",
    "latency": "[-0.05, 0.004]",
    "range_scale": "[0.07, 0.003]",
    "range_bias": "[0.1, 0.02]",
    "seconds": "40.0",
}


def measured() -> MeasuredNoise:
    rng = np.random.default_rng(0)
    return MeasuredNoise(
        odometry=rng.uniform(size=3),
        drift=rng.uniform(size=3) / 3.0,
        interval=1.0 / 70.0,
        along=RayNoise(rng.uniform(size=2), 1.0 / 3.0, 0.7),
        across=RayNoise(np.array([0.0, 1e-3 / 7.0]), 0.9, 16.0),
        count=23,
        period=1.0 / 9.0,
        per_cycle=11.0 / 7.0,
        sensor=rng.normal(size=5),
        sensor_sigma=rng.uniform(size=5),
        range_bend=-1e-3 / 3.0,
        seconds=100.0 / 3.0,
    )


def assert_same_noise(ours: MeasuredNoise, theirs: MeasuredNoise) -> None:
    for one in fields(MeasuredNoise):
        first, second = getattr(ours, one.name), getattr(theirs, one.name)
        if isinstance(first, RayNoise):
            np.testing.assert_array_equal(first.sigma, second.sigma)
            assert (first.share, first.time) == (second.share, second.time)
        else:
            np.testing.assert_array_equal(first, second, err_msg=one.name)


def header(folder: Path, section: str) -> Log:
    """Returns a log with this text in its header."""
    (folder / "log.toml").write_text(HEADER + section)
    (folder / "odometry.csv").write_text("t,vx,vy,wz\n0,1,0,0\n0.5,1,0,0.1\n")
    (folder / "detections.csv").write_text("t,x,y,label,xx,xy,yy\n0,3,1,left,0.1,0,0.1\n")
    return read_log(folder)


def section(**changed: str) -> str:
    entries = {name: value for name, value in (MEASURED | changed).items() if value}
    return "[noise.measured]\n" + "\n".join(f"{name} = {value}" for name, value in entries.items())


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("detections", [True, False])
def test_measured_noise_comes_back_to_the_bit(odometry: bool, detections: bool, tmp_path: Path) -> None:
    stated = {"odometry_stated": odometry, "detections_stated": detections}
    log = replace(small_log(), **stated, measured=measured())
    write_log(log, tmp_path / "log")
    found = read_log(tmp_path / "log")
    assert_same(found, log)
    assert (found.odometry_stated, found.detections_stated) == (odometry, detections)
    assert found.measured is not None
    assert_same_noise(found.measured, measured())
    known = found.noise
    assert (known.odometry_stated, known.detections_stated) == (odometry, detections)
    assert known.measured is found.measured
    np.testing.assert_array_equal(known.odometry, log.odometry_sigma)


def test_noise_of_the_odometry_alone_comes_back_too(tmp_path: Path) -> None:
    """Where too few cones were seen, nothing is known of detections and sensor: their sigmas are infinite."""
    own = MeasuredNoise(np.array([0.1, 0.2, 0.3]), np.array([0.01, 0.02, 0.03]), 0.02, seconds=3.0)
    log = replace(small_log(), odometry_stated=False, detections_stated=False, measured=own)
    write_log(log, tmp_path / "log")
    text = (tmp_path / "log" / "log.toml").read_text()
    assert '[noise]\nodometry = "measured"\ndetections = "assumed"\n' in text
    found = read_log(tmp_path / "log")
    assert found.measured is not None and found.measured.along is None and not found.detections_stated
    assert_same_noise(found.measured, own)


def test_noise_that_is_neither_stated_nor_measured_is_assumed(tmp_path: Path) -> None:
    write_log(replace(small_log(), odometry_stated=False), tmp_path / "log")
    text = (tmp_path / "log" / "log.toml").read_text()
    assert '[noise]\nodometry = "assumed"\ndetections = "stated"\n' in text
    found = read_log(tmp_path / "log")
    assert not found.odometry_stated and found.detections_stated and found.measured is None


def test_a_log_without_the_section_has_stated_its_noise(tmp_path: Path) -> None:
    write_log(small_log(), tmp_path / "log")
    assert "noise" not in (tmp_path / "log" / "log.toml").read_text().split("[source]")[0]
    for log in (read_log(tmp_path / "log"), header(tmp_path, ""), header(tmp_path, "[noise]\n")):
        assert log.odometry_stated and log.detections_stated and log.measured is None


@pytest.mark.parametrize("value", ["measured", "assumed"])
def test_measured_or_assumed_noise_is_not_stated(value: str, tmp_path: Path) -> None:
    log = header(tmp_path, f'[noise]\nodometry = "{value}"\n')
    assert not log.odometry_stated and log.detections_stated


def test_a_hand_written_section_is_read(tmp_path: Path) -> None:
    found = header(tmp_path, section()).measured
    assert found is not None and found.along is not None and found.across is not None
    assert found.along.sigma.tolist() == [0.1, 0.02] and (found.across.share, found.across.time) == (0.8, 1.0)
    assert found.sensor.tolist() == [0.01, -0.2, -0.05, 0.07, 0.1]
    assert (found.count, found.period, found.per_cycle, found.seconds) == (17, 0.1, 8.5, 40.0)


@pytest.mark.parametrize(
    "text",
    [
        '[noise]\nodometry = "known"\n',
        "[noise]\nmeasured = 3\n",
        *(section(**{name: value}) for name in MEASURED if name != "along" for value in ("", "nan", "inf")),
        section(along="[0.1, 0.02, 0.5]"),
        section(along="[0.1, -0.02, 0.5, 2.0]"),
        section(along="[0.0, 0.0, 0.5, 2.0]"),
        section(along="[0.1, 0.02, 1.5, 2.0]"),
        section(along="[0.1, 0.02, 0.5, 0.0]"),
        section(odometry="[0.0, 0.2, 0.01]", drift="[0.0, 0.006, 0.0017]"),
        section(interval="0.0"),
        section(period="0.0"),
        section(per_cycle="0.0"),
        section(count="0"),
        section(count="2.5"),
        section(yaw="[0.01, -0.001]"),
    ],
)
def test_a_value_that_no_estimator_can_use_is_refused(text: str, tmp_path: Path) -> None:
    """No number, no noise at all, a share above one, no time between cycles, or a sigma below zero."""
    with pytest.raises(InputError, match=r"log\.toml.*expected") as refused:
        header(tmp_path, text)
    assert "\n" not in str(refused.value)
