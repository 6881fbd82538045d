"""Twists that can't be, poses in place of twists, and twists that are too slow to be held."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.cli import main
from pathspace_graph.commands.convert import with_measured_noise
from pathspace_graph.convert import recording
from pathspace_graph.convert.recording import strays
from pathspace_graph.factors.odometry import integrate_poses
from pathspace_graph.io.log import Log, Odometry
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.plausibility.judge import read_plausible_log
from pathspace_graph.settings.mapper import LimitSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..scenes.drives import SHORT


@cache
def drive(seed: int = 0) -> Log:
    return simulate(generate_track(np.random.default_rng(seed), SHORT), SimulationSettings(laps=1), seed)


def table(log: Log, step: int = 1) -> np.ndarray:
    """Rows [t, vx, vy, wz] of every step-th twist."""
    return np.column_stack([log.odometry.t, log.odometry.twist])[::step]


def true_poses(log: Log, t: np.ndarray) -> np.ndarray:
    assert log.truth is not None
    x, y, theta = log.truth.poses.T
    return np.column_stack([np.interp(t, log.truth.pose_t, of) for of in (x, y, np.unwrap(theta))])


def wrapped(yaw: np.ndarray) -> np.ndarray:
    return (yaw + np.pi) % (2.0 * np.pi) - np.pi


def differenced(log: Log, step: int, *, central: bool) -> tuple[np.ndarray, set[int]]:
    """Rows whose yaw rate is differenced from a yaw that wraps, and which of them are wrong."""
    rows = table(log, step)
    t, yaw = rows[:, 0], true_poses(log, rows[:, 0])[:, 2]
    forward = np.append(np.diff(wrapped(yaw)), 0.0) / np.append(np.diff(t), 1.0)
    rows[:, 3] = np.gradient(wrapped(yaw), t) if central else forward
    right = np.gradient(yaw, t) if central else np.append(np.diff(yaw) / np.diff(t), 0.0)
    return rows, {*np.flatnonzero(np.abs(rows[:, 3] - right) > 1e-6).tolist()}


def write(folder: Path, log: Log, rows: np.ndarray, header: str = "t,vx,vy,wz") -> Path:
    """A folder of CSV files with these rows of odometry and the detections of a log."""
    write_log(log, folder / "whole")
    source = folder / "csv"
    source.mkdir()
    shutil.copy(folder / "whole" / "detections.csv", source)
    np.savetxt(source / "odometry.csv", rows, fmt="%.12g", delimiter=",", header=header, comments="")
    return source


def convert(source: Path, *options: str, code: int = 0) -> Path:
    out = source.parent / "log"
    assert main(["convert", str(source), "--from", "csv", "--out", str(out), "--force", *options]) == code
    assert out.exists() == (code == 0)
    return out


# --- what can't be ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [1, 5, 10, 25])
@pytest.mark.parametrize("seed", range(2))
def test_no_row_of_a_drive_as_it_is_jumps(seed: int, step: int) -> None:
    t, *rest = table(drive(seed), step).T
    assert not recording.jumps(t, np.array(rest).T).any()


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("step", [1, 2, 5, 10, 25])
@pytest.mark.parametrize("seed", range(2))
def test_a_yaw_that_wraps_is_found_at_any_rate(seed: int, step: int, central: bool) -> None:
    rows, wrong = differenced(drive(seed), step, central=central)
    off = recording.jumps(rows[:, 0], rows[:, 1:])
    assert wrong
    assert {*np.flatnonzero((off != 0.0).any(axis=1)).tolist()} == wrong


@pytest.mark.parametrize(("column", "most"), [(0, 50.0 * 0.02), (1, 50.0 * 0.02), (2, 37.5 * 0.02)])
def test_a_jump_is_one_beyond_what_a_vehicle_accelerates(column: int, most: float) -> None:
    """At 50 Hz without noise: 2.5 intervals of 20 m/s^2 or of 15 rad/s^2."""
    t = np.arange(0.0, 4.0, 0.02)
    for jump, found in ((0.99 * most, []), (1.01 * most, [100])):
        values = np.ones((len(t), 3))
        values[100, column] += jump
        assert np.flatnonzero(recording.jumps(t, values).any(axis=1)).tolist() == found


def test_a_ramp_a_step_and_what_lies_behind_a_gap_do_not_jump() -> None:
    t = np.arange(0.0, 4.0, 0.02)
    ramp = np.clip(15.0 * (t - 1.0), 0.0, 20.0)
    step = np.where(t < 2.0, 0.0, 8.0)  # wheels that spin
    assert not recording.jumps(t, np.column_stack([ramp, step, step])).any()
    beyond = np.where(t < 3.98, 10.0, 2.0)
    t[-1] += 2.0
    assert not recording.jumps(t, np.column_stack([beyond, 0.0 * t, 0.0 * t])).any()


@pytest.mark.parametrize("central", [False, True])
def test_rows_that_can_not_be_are_a_gap_and_named(
    central: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows, wrong = differenced(drive(), 1, central=central)
    out = convert(write(tmp_path, drive(), rows))
    said = capsys.readouterr().out
    told = f"{len(wrong)} odometry samples can't be, and were left out as a gap: wz = "
    assert told in said and "the yaw was differenced where it wraps by a whole turn" in said
    assert f"in odometry.csv, row {min(wrong) + 2}" in said
    log = read_plausible_log(out, LimitSettings())[0]  # as `online` reads it
    np.testing.assert_allclose(log.odometry.t, np.delete(rows[:, 0], sorted(wrong)))


@pytest.mark.parametrize("jump", [0.3, 1.9, 30.0])
def test_a_position_that_jumps_is_named(
    jump: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.column_stack([table(drive())[:, 0], true_poses(drive(), table(drive())[:, 0])])
    poses[200:, 1:3] += [0.6 * jump, 0.8 * jump]
    poses[:, 3] = wrapped(poses[:, 3])
    out = convert(write(tmp_path, drive(), poses, "t,x,y,yaw"))
    said = capsys.readouterr().out
    assert "1 odometry samples can't be" in said and "a position jumps, in odometry.csv, row 201" in said
    log = read_plausible_log(out, LimitSettings())[0]
    assert np.abs(log.odometry.twist).max() < 20.0


@pytest.mark.parametrize(("share", "code"), [(0.045, 0), (0.055, 2)])
def test_a_few_rows_beyond_any_vehicle_are_left_out_and_many_refused(
    share: float, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = table(drive())
    wrong = np.linspace(10, len(rows) - 10, int(share * len(rows))).astype(int)
    rows[wrong, 3] = 40.0
    convert(write(tmp_path, drive(), rows), code=code)
    said = capsys.readouterr()
    if code:
        assert said.err.count("\n") == 1 and "--units states others" in said.err
        assert (
            f"{len(wrong)} of {len(rows)} beyond, at first wz = 40 rad/s in odometry.csv, row 12" in said.err
        )
    else:
        assert f"{len(wrong)} odometry samples can't be" in said.out


@pytest.mark.parametrize("row", [0, 300, -1])
@pytest.mark.parametrize("stamp", [-1.7e9, 1.7e9])
def test_a_stamp_far_from_the_others_is_left_out(
    row: int, stamp: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = table(drive())
    rows[row, 0] = stamp
    out = convert(write(tmp_path, drive(), rows))
    number = range(len(rows))[row] + 2
    assert f"were left out: odometry.csv, row {number}\n" in capsys.readouterr().out
    assert len(read_plausible_log(out, LimitSettings())[0].odometry.t) == len(rows) - 1


def test_a_pause_is_not_a_stray_stamp() -> None:
    t = np.array([0.0, 1.0, 2.0, 40.0, 41.0, 42.0])
    assert not strays(t).any()
    assert strays(np.array([0.0, 1.0, 40.0, 2.0, 3.0])).tolist() == [False, False, True, False, False]
    assert not strays(np.array([0.0, 1.0, 31.0, 2.0, 3.0])).any()  # 29 s, as long as a silence may be


# --- poses -----------------------------------------------------------------------------------------------


def as_poses(form: str, t: np.ndarray, poses: np.ndarray) -> tuple[str, np.ndarray, list[str]]:
    """Header, rows and options of poses in a form."""
    (x, y, yaw), zero = poses.T, np.zeros(len(t))
    far_x = 500.0 + np.cos(2.0) * x - np.sin(2.0) * y
    far_y = 4000.0 + np.sin(2.0) * x + np.cos(2.0) * y
    of_quaternion = t, x, y, zero, zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)
    named = ["--columns", "yaw=heading", "--units", "angle=deg"]
    header, columns, options = {
        "wrapped": ("t,x,y,yaw", (t, x, y, wrapped(yaw)), []),
        "theta": ("t,x,y,theta", (t, x, y, yaw), []),
        "degrees": ("t,x,y,heading", (t, x, y, np.rad2deg(wrapped(yaw))), named),
        "clockwise": ("t,x,y,turn", (t, x, y, -yaw), ["--columns", "yaw=-turn"]),
        "quaternion": ("t,tx,ty,tz,qx,qy,qz,qw", of_quaternion, []),
        "moved": ("t,x,y,yaw", (t, far_x, far_y, wrapped(yaw + 2.0)), []),
        "beside zeros": ("t,vx,vy,wz,x,y,yaw", (t, zero, zero, zero, x, y, wrapped(yaw)), ["--from-poses"]),
    }[form]
    return header, np.column_stack(columns), options


FORMS = ("wrapped", "theta", "degrees", "clockwise", "quaternion", "moved", "beside zeros")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("step", [1, 10])
def test_poses_in_a_table_give_the_way_that_was_driven(
    form: str, step: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = table(drive(), step)[:, 0]
    poses = true_poses(drive(), t)
    header, rows, options = as_poses(form, t, poses)
    log = read_log(convert(write(tmp_path, drive(), rows, header), *options))
    assert "are differences of poses" in capsys.readouterr().out
    odometry = log.odometry
    driven = integrate_poses(np.diff(np.append(odometry.t, t[-1])), odometry.twist)
    np.testing.assert_allclose(driven[-1], poses[-1] - poses[0], atol=1e-3)


def test_a_trajectory_of_tum_is_read_as_poses(tmp_path: Path) -> None:
    t = table(drive(), 5)[:, 0]
    _, rows, _ = as_poses("quaternion", t, true_poses(drive(), t))
    source = write(tmp_path, drive(), rows, "t,x")
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    (source / "poses.txt").write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *lines, ""]))
    log = read_log(convert(source, "--odometry", "poses.txt"))
    np.testing.assert_allclose(log.odometry.t, t[:-1])


@pytest.mark.parametrize(
    ("header", "options", "said"),
    [
        ("t,x,y,yaw", [], "expected speeds of at most 100 m/s and yaw rates of 10 rad/s, found"),
        ("t,vx,vy,wz", ["--from-poses"], "expected a column 'x' for --from-poses"),
        ("t,x,y,course", [], "expected a column 'vx', or a pose x, y, yaw (--columns vx=NAME)"),
        ("t,x,y,course", ["--from-poses"], "expected a column 'yaw' for --from-poses"),
        ("0.1,2,3,4", [], "odometry.csv, row 1: expected a header with the names of the columns"),
    ],
)
def test_what_is_no_pose_is_told(
    header: str, options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = table(drive(), 5)[:, 0]
    _, rows, _ = as_poses("degrees", t, true_poses(drive(), t))
    convert(write(tmp_path, drive(), rows, header), *options, code=2)
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and said in told


def test_twists_that_are_zero_while_the_pose_moves_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = table(drive(), 5)[:, 0]
    header, rows, _ = as_poses("beside zeros", t, true_poses(drive(), t))
    convert(write(tmp_path, drive(), rows, header), code=2)
    assert "found zeros while the pose moves; --from-poses" in capsys.readouterr().err


def test_json_lines_may_have_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "drive.jsonl"
    file.write_text(
        '{"t": 0, "pose": [0, 0, 0]}\n{"t": 1, "pose": [2, 0, 0], "detections": [{"x": 4, "y": 1}]}\n'
        '{"t": 2, "pose": [4, 0, 0]}\n'
    )
    convert = ["convert", str(file), "--from", "jsonl", "--out", str(tmp_path / "log")]
    assert main(convert) == 0
    np.testing.assert_allclose(read_log(tmp_path / "log").odometry.twist, [[2.0, 0.0, 0.0]] * 2, atol=1e-9)
    file.write_text('{"t": 0, "twist": [1, 0, 0]}\n{"t": 1, "detections": [{"x": 4, "y": 1}]}\n')
    assert main([*convert, "--from-poses", "--force"]) == 2
    assert "--from-poses: expected lines with pose" in capsys.readouterr().err


def test_a_pose_that_was_not_measured_anew_is_no_pose() -> None:
    """A receiver of 10 Hz whose pose comes at 50 Hz; then the vehicle stands for 2 s."""
    t = np.arange(0.0, 4.0, 0.02)
    x = np.minimum(np.floor(t / 0.1 + 1e-9) * 0.5, 10.0)
    new = recording.measured_anew(t, np.column_stack([x, x, x]))
    assert new[t <= 2.0 + 1e-9].sum() == 21
    assert not new[(t > 2.01) & (t < 3.19)].any()
    assert new[t > 3.21].all()


# --- slow twists -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("period", "parts"), [(0.02, 1), (0.1, 1), (0.119, 1), (0.121, 3), (0.2, 4), (1.0, 20)]
)
def test_twists_slower_than_a_tenth_of_a_second_are_interpolated(period: float, parts: int) -> None:
    assert recording.parts_of(period * np.arange(30)) == parts
    assert recording.parts_of(period * np.arange(10)) == 1  # too few to know their period
    assert recording.parts_of(1e3 * np.arange(30)) == 1  # milliseconds, which a hint tells


def test_interpolated_twists_have_the_means_of_what_was_driven() -> None:
    """A sine of 0.25 Hz, sampled at 5 Hz: its integral to any part is exact to a thousandth."""
    t = np.arange(0.0, 8.01, 0.2)

    def speed(at: np.ndarray) -> np.ndarray:
        return np.outer(np.sin(0.5 * np.pi * at), np.ones(3))

    odometry = recording.interpolated(t, speed(t), 4)
    np.testing.assert_allclose(np.diff(odometry.t), 0.05)
    driven = np.cumsum(np.diff(odometry.t)[:, None] * odometry.twist[:-1], axis=0)
    whole = (1.0 - np.cos(0.5 * np.pi * odometry.t[1:])) / (0.5 * np.pi)
    np.testing.assert_allclose(driven[:, 0], whole, atol=1e-3)
    held = np.cumsum(np.repeat(0.2 * speed(t)[:-1, 0], 4) / 4)
    assert np.abs(held - whole).max() > 0.1  # where it is held it lags


def test_nothing_is_interpolated_over_a_gap() -> None:
    t = np.array([0.0, 0.2, 0.4, 0.6, 2.0, 2.2, 2.4])
    odometry = recording.interpolated(t, np.outer(np.arange(7.0), np.ones(3)), 2)
    assert odometry.t.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 2.0, 2.1, 2.2, 2.3, 2.4])
    assert odometry.twist[6].tolist() == [3.0, 3.0, 3.0]


def test_slow_twists_are_interpolated_unless_they_are_held(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = table(drive(), 10)
    source = write(tmp_path, drive(), rows)
    log = read_log(convert(source))
    said = capsys.readouterr().out
    assert "odometry samples at 5" in said and "hardly show the bends" not in said
    assert len(log.odometry.t) == 4 * len(rows) - 3
    convert(write(tmp_path / "rare", drive(), rows[::3]))
    assert "odometry samples at 1" in (said := capsys.readouterr().out) and "hardly show the bends" in said
    held = read_log(convert(source, "--held"))
    np.testing.assert_allclose(held.odometry.twist, rows[:, 1:])


def test_the_noise_of_interpolated_twists_is_that_of_the_samples() -> None:
    """The parts of a sample, each with twice its noise, move the vehicle as uncertainly as it."""
    log = drive()
    t, rows = log.odometry.t[::10], log.odometry.twist[::10]
    slow = replace(log, odometry=Odometry(t, rows), odometry_stated=False)
    fine = replace(slow, odometry=recording.interpolated(t, rows, 4))
    held, found = with_measured_noise(slow).measured, with_measured_noise(fine, 4).measured
    assert held is not None and found is not None
    assert found.interval == pytest.approx(0.25 * held.interval)
    np.testing.assert_allclose(found.odometry, 2.0 * held.odometry, rtol=0.3)
    stated = with_measured_noise(replace(fine, odometry_stated=True), 4)
    np.testing.assert_allclose(stated.odometry_sigma, 2.0 * log.odometry_sigma)


def test_an_odometry_of_five_hertz_maps_the_first_lap(tmp_path: Path) -> None:
    log = drive()
    out = convert(write(tmp_path, log, table(log, 10)))
    for name in ("truth_poses.csv", "truth_cones.csv"):
        shutil.copy(tmp_path / "whole" / name, out)
    assert main(["online", str(out), "--out", str(tmp_path / "map")]) == 0
    lap = json.loads((tmp_path / "map" / "summary.json").read_text())["laps"][0]
    assert lap["missed"] == 0.0
    assert lap["rmse"] < 0.5
