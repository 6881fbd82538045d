"""`online --on`: what is written and said of a known map, and which options go together."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.batch.joint import OTHER_TRACK
from pathspace_graph.cli import main
from pathspace_graph.commands.estimate import of_kind, read_known_map, unique_names
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import Map, read_map
from pathspace_graph.io.results import RunResult
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.lengths import scaled
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track import acceleration, skidpad

from ..batch.joint.several import lap
from ..scenes.kidnapped import begun_later, laps_log, pear_track
from ..scenes.maps import point_map, ring_map
from ..scenes.paths import ROOT

TRACKS = ROOT.parent / "shared" / "tracks"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log of two laps, its map, a log that begins later, and one of another track."""
    folder = tmp_path_factory.mktemp("drives")
    laps = laps_log(pear_track(), laps=2)
    later, _ = begun_later(laps, 8.0)
    other = laps_log(pear_track(skew=0.4), laps=1)
    for name, log in (("laps", laps), ("later", later), ("other", other)):
        write_log(log, folder / name)
    assert main(["online", str(folder / "laps"), "--out", str(folder / "map")]) == 0
    return folder


def summary(folder: Path) -> dict[str, object]:
    content: dict[str, object] = json.loads((folder / "summary.json").read_text())
    return content


def test_a_later_drive_is_written_in_the_frame_of_the_known_map(drives: Path, tmp_path: Path) -> None:
    _, begin = begun_later(laps_log(pear_track(), laps=2), 8.0)
    arguments = ["online", str(drives / "later"), "--on", str(drives / "map"), "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    written = summary(tmp_path / "out")
    known = written["known_map"]
    assert isinstance(known, dict)
    assert 8.0 < known["found_at"] < 16.0
    assert written["differences"] == []
    assert "laps" not in written  # the truth of the log is in another frame
    assert read_map(tmp_path / "out").closed
    smoothed = read_trajectory(tmp_path / "out" / "smoothed.tum")[1]
    assert np.hypot(*(smoothed[0] - begin)[:2]) < 0.4
    assert abs(np.sin(smoothed[0, 2] - begin[2])) < 0.05


def test_the_cones_of_a_closed_map_are_written_with_it(drives: Path) -> None:
    track = pear_track()
    left = read_map(drives / "map").boundaries[LEFT]
    assert 0.9 * len(track.left) < len(left.cones) <= len(track.left)  # type: ignore[union-attr]
    assert (left.cones[:, 1] < 0.2).all()  # type: ignore[union-attr]


def test_on_another_track_the_map_of_its_own_road_is_written(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["online", str(drives / "other"), "--on", str(drives / "map"), "--out", str(out)]) == 3
    line = f"the vehicle was not found on {drives / 'map'}: this is the map of its own road"
    assert line in capsys.readouterr().err
    assert summary(out)["known_map"] == {"map": str(drives / "map"), "found_at": None}
    assert (out / "map.json").exists()


@pytest.mark.parametrize("event", [skidpad, acceleration])
def test_the_events_of_the_rules_are_known_by_name(event: object) -> None:
    track = event()  # type: ignore[operator]
    known = read_known_map(Path(track.name), 0.1, MapperSettings())
    assert not known[0].closed
    np.testing.assert_array_equal(known[1], track.start)
    for label, row in enumerate(track.rows):
        boundary = known[0].boundaries[label]
        on_curve = boundary.spline.evaluate(boundary.cones[:, 0])  # type: ignore[union-attr]
        assert np.hypot(*(on_curve - row).T).max() < 0.2
        assert (np.diff(boundary.cones[:, 0]) > 0.0).all()  # type: ignore[union-attr]


@pytest.mark.skipif(not TRACKS.exists(), reason="the track files are beside the repository")
def test_a_track_file_is_a_known_map() -> None:
    file = sorted(TRACKS.rglob("*.csv"))[0]
    known = read_known_map(file, 0.15, MapperSettings())
    assert known[0].closed
    assert known[1] is None
    left = known[0].boundaries[LEFT]
    np.testing.assert_allclose(np.diag(left.covariance), 0.15**2)


def test_a_drive_of_the_acceleration_needs_no_start(tmp_path: Path) -> None:
    write_log(simulate(acceleration(), SimulationSettings(), seed=3), tmp_path / "log")
    assert (
        main(["online", str(tmp_path / "log"), "--on", "acceleration", "--out", str(tmp_path / "out")]) == 0
    )
    assert summary(tmp_path / "out")["known_map"] == {
        "map": "acceleration",
        "found_at": pytest.approx(1.5, abs=1.5),
    }


# --- one centre line in place of the boundaries ----------------------------------------------------------


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


# --- several drives of a track ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs: two of a track, of which one began elsewhere, and one of another track."""
    home = tmp_path_factory.mktemp("drives")
    for name, log in (("a", lap(0)), ("b", lap(1, 9.0)), ("other", lap(0, 0.0, 5))):
        write_log(log, home / name)
    return home


def test_several_logs_give_one_map_and_a_trajectory_for_each(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "map"
    logs = [str(folder / name) for name in ("a", "b", "other")]
    assert main(["batch", *logs, "--out", str(out)]) == 3
    printed = capsys.readouterr()
    assert printed.err.splitlines()[-1] == f"other is left out: {OTHER_TRACK}"
    assert "b: 1 lap, begins at" in printed.out
    assert read_map(out).closed
    assert sorted(path.name for path in (out / "drives").iterdir()) == ["a", "b"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["left_out"] == {"other": OTHER_TRACK}
    for name, log in (("a", lap(0)), ("b", lap(1, 9.0))):
        t, poses = read_trajectory(out / "drives" / name / "trajectory.tum")
        np.testing.assert_array_equal(t, [cycle.t for cycle in log.cycles])
        drive = summary["drives"][name]
        assert drive["final"]["missed"] == 0.0 and drive["ate"] < 0.35
        np.testing.assert_allclose(poses[0][:2], drive["frame"][:2], atol=0.8)  # at the first cycle
    np.testing.assert_allclose(summary["drives"]["a"]["frame"], 0.0, atol=1e-6)
    assert (out / "trajectory.tum").read_bytes() == (out / "drives/a/trajectory.tum").read_bytes()


def test_logs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [tmp_path / part for part in ("day1/run", "day2/run", "day2/run-2", "day3/run")]
    assert list(unique_names(folders)) == ["run", "run-2", "run-2-2", "run-3"]
