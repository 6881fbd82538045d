"""The recording of a run: what is shown, and what of the run it leaves as it is."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from pathspace_graph.cli import main
from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.estimators import make_online
from pathspace_graph.eval.view import recording as entities
from pathspace_graph.eval.view import recording as module
from pathspace_graph.eval.view.recording import BAND_EVERY, DISPLAYS, check_recording, recording
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import write_log
from pathspace_graph.labels import LEFT, RIGHT
from pathspace_graph.run import run_online
from pathspace_graph.settings.mapper import MapperSettings

from ...scenes.drives import ahead, corridor, exact_log
from .conftest import OrangeMapper, Watched

Rows = dict[str, dict[int, dict[str, Any]]]


def read(file: Any) -> Rows:
    """What was recorded, by path, cycle and component; what is for all times has the cycle -1."""
    rows: Rows = defaultdict(lambda: defaultdict(dict))
    for chunk in RrdReader(file).stream():
        table = chunk.to_record_batch().to_pydict()
        cycles = table.get(entities.TIMELINE, [-1] * chunk.num_rows)
        for name, column in table.items():
            for cycle, value in zip(cycles, column, strict=True):
                if value is not None:
                    rows[chunk.entity_path.strip("/")][cycle][name] = value
    return rows


@pytest.fixture(scope="module")
def rows(run: Watched) -> Rows:
    return read(run.rrd)


def of(rows: Rows, path: str, component: str) -> dict[int, Any]:
    """A component of an entity by cycle."""
    return {cycle: row[component] for cycle, row in rows[path].items() if component in row}


def test_watching_a_run_changes_nothing_to_the_bit(run: Watched) -> None:
    np.testing.assert_array_equal(run.watched.trajectory, run.alone.trajectory)
    assert run.alone.map.closed
    for label, boundary in run.alone.map.boundaries.items():
        other = run.watched.map.boundaries[label]
        np.testing.assert_array_equal(other.spline.control_points, boundary.spline.control_points)
        np.testing.assert_array_equal(other.covariance, boundary.covariance)


def test_every_cycle_has_its_figures(rows: Rows, run: Watched) -> None:
    count = len(run.log.cycles)
    for path, expected in {
        f"{entities.SIZES}/left": [r.size_left for r in run.watched.cycles],
        f"{entities.SIZES}/right": [r.size_right for r in run.watched.cycles],
        f"{entities.READING_COUNTS}/offered": [r.offered for r in run.watched.cycles],
        f"{entities.READING_COUNTS}/used": [r.readings for r in run.watched.cycles],
        f"{entities.UPDATE}/milliseconds": [1e3 * r.seconds for r in run.watched.cycles],
    }.items():
        found = of(rows, path, "Scalars:scalars")
        assert sorted(found) == list(range(count))
        assert [found[cycle][0] for cycle in range(count)] == pytest.approx(expected)


def test_the_time_of_the_log_is_a_timeline(run: Watched) -> None:
    stamps = {}
    for chunk in RrdReader(run.rrd).stream():
        if chunk.entity_path.strip("/") == entities.VEHICLE and not chunk.is_static:
            assert set(chunk.timeline_names) == set(entities.TIMELINES)
            table = chunk.to_record_batch().to_pydict()
            stamps |= dict(zip(table[entities.TIMELINE], table[entities.TIME], strict=True))
    seconds = [stamps[cycle].total_seconds() for cycle in range(len(run.log.cycles))]
    assert seconds == pytest.approx([cycle.t for cycle in run.log.cycles], abs=1e-6)


def test_readings_used_and_gated_add_up_and_have_their_feet(rows: Rows, run: Watched) -> None:
    used, gated = (
        of(rows, f"{entities.READINGS}/{name}", "Points2D:positions") for name in ("used", "gated")
    )
    feet = of(rows, entities.FEET, "LineStrips2D:strips")
    for record in run.watched.cycles:
        assert len(used[record.cycle]) == len(feet[record.cycle]) == record.readings
        assert len(used[record.cycle]) + len(gated[record.cycle]) == record.offered


def test_vehicle_trajectory_and_window_follow_the_run(rows: Rows, run: Watched) -> None:
    way = of(rows, entities.TRAJECTORY, "LineStrips2D:strips")
    ends = np.array([way[cycle][0][1] for cycle in range(len(run.watched.trajectory))])
    np.testing.assert_allclose(ends, run.watched.trajectory[:, :2], atol=1e-4)  # of single precision
    window = of(rows, entities.WINDOW, "LineStrips2D:strips")
    assert [len(window[cycle][0]) for cycle in range(len(run.window))] == run.window
    assert sorted(of(rows, entities.VEHICLE, "LineStrips2D:strips")) == list(range(len(run.window)))


def test_curves_are_there_in_every_cycle_and_bands_in_some(rows: Rows, run: Watched) -> None:
    replaced = {r.cycle for r in run.watched.cycles if r.jump is not None}
    closing = next(r.cycle for r in run.watched.cycles if r.closed)
    last = len(run.log.cycles) - 1
    for label, name in ((LEFT, "left"), (RIGHT, "right")):
        curve = of(rows, f"{entities.MAP}/{name}/curve", "LineStrips2D:strips")
        assert sorted(curve) == list(range(min(curve), last + 1))
        band = of(rows, f"{entities.MAP}/{name}/band", "LineStrips2D:strips")
        regular = {cycle for cycle in curve if cycle % BAND_EVERY == 0}
        assert set(band) == regular | replaced | {closing}
        assert {len(edges) for edges in band.values()} == {2}
        tentative = of(rows, f"{entities.MAP}/{name}/tentative", "LineStrips2D:strips")
        assert any(tentative[cycle] for cycle in curve if cycle < closing)
        dashes = [np.asarray(dash) for cycle in curve for dash in tentative[cycle]]
        assert all(len(dash) == 2 for dash in dashes)
        assert not any(tentative[cycle] for cycle in curve if cycle >= closing)
        final = run.watched.map.boundaries[label].spline
        away = np.linalg.norm(final.foot_points(np.array(curve[last][0])).position - curve[last][0], axis=1)
        assert away.max() < 1e-3
        points = of(rows, f"{entities.MAP}/{name}/points", "Points2D:positions")[last]
        np.testing.assert_allclose(points, final.distinct_control_points, atol=1e-4)


def test_health_and_what_happened_is_told(rows: Rows, run: Watched) -> None:
    states = of(rows, entities.HEALTH, "StateChange:state")
    expected, last = {}, ""
    for record in run.watched.cycles:
        if record.health != last:
            expected[record.cycle] = [record.health]
        last = record.health
    assert states == expected
    closing = next(r.cycle for r in run.watched.cycles if r.closed)
    texts = [text[0] for text in of(rows, entities.MESSAGES, "TextLog:text").values()]
    closed = f"the loop is closed, on {run.watched.map.size} points; the pose has jumped by "
    assert sum(text.startswith(closed) for text in texts) == 1
    assert closing in rows[entities.MESSAGES]


def test_true_cones_and_the_arrangement_are_in_the_file(rows: Rows, run: Watched) -> None:
    assert run.log.truth is not None
    cones = of(rows, entities.TRUE_CONES, "Points2D:positions")[-1]
    np.testing.assert_allclose(cones, run.log.truth.cones, atol=1e-4)
    assert len(RrdReader(run.rrd).recordings()) == 1
    assert len(RrdReader(run.rrd).blueprints()) == 1


@pytest.fixture(scope="module")
def corridor_log() -> Log:
    return exact_log(ahead(8.0, 2.0), *corridor(40.0))


@pytest.mark.parametrize("name", ["landmark-fixed-lag", "ckf", "landmark-ckf"])
def test_every_online_estimator_is_shown_as_far_as_it_says_something(
    name: str, corridor_log: Log, tmp_path: Any
) -> None:
    with recording(tmp_path / "a.rrd") as recorder:
        result = run_online(
            corridor_log, make_online(name, MapperSettings(), corridor_log), observers=[recorder]
        )
    rows, last = read(tmp_path / "a.rrd"), len(corridor_log.cycles) - 1
    for boundary, side in ((result.map.boundaries[LEFT], "left"), (result.map.boundaries[RIGHT], "right")):
        points = of(rows, f"{entities.MAP}/{side}/points", "Points2D:positions")[last]
        assert len(points) == boundary.size
        assert of(rows, f"{entities.MAP}/{side}/band", "LineStrips2D:strips")
    kind = "used" if name.endswith("fixed-lag") else "detected"
    assert of(rows, f"{entities.READINGS}/{kind}", "Points2D:positions")[last]
    assert (last in rows[entities.WINDOW]) == name.endswith("fixed-lag")


def test_orange_cones_are_shown_in_every_cycle(corridor_log: Log, tmp_path: Any) -> None:
    with recording(tmp_path / "a.rrd") as recorder:
        mapper = OrangeMapper(odometry_sigma=corridor_log.odometry_sigma)
        run_online(corridor_log, mapper, observers=[recorder])
    shown = of(read(tmp_path / "a.rrd"), f"{entities.MAP}/orange/points", "Points2D:positions")
    assert set(range(len(corridor_log.cycles))) <= set(shown)
    np.testing.assert_allclose(shown[0], OrangeMapper.cones)


@pytest.fixture
def log_folder(tmp_path: Path) -> Path:
    write_log(exact_log(ahead(8.0, 1.0), *corridor(30.0)), tmp_path / "log")
    return tmp_path / "log"


def refused(capsys: pytest.CaptureFixture[str], log: Path, *options: str) -> str:
    """What a run with these options says when it is refused, before anything is written."""
    assert main(["online", str(log), "--out", str(log.parent / "map"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert {path.name for path in log.parent.iterdir()} == {"log"}
    return line


@pytest.mark.parametrize("option", ["--view", "--save-view"])
def test_without_the_package_one_line_says_how_to_install_it(
    option: str, log_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    given = [option] if option == "--view" else [option, str(log_folder.parent / "a.rrd")]
    assert refused(capsys, log_folder, *given) == (
        f"pathspace-graph: {option}: expected the package rerun-sdk, found none; "
        "pip install 'pathspace-graph[view]'"
    )


def test_without_a_display_no_window_is_tried(
    log_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    line = refused(capsys, log_folder, "--view")
    assert "--view: expected a display (DISPLAY or WAYLAND_DISPLAY), found none" in line
    assert "--save-view" in line


def test_a_viewer_that_does_not_start_is_told(
    log_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**_: object) -> None:
        raise RuntimeError("no viewer here\nPATH=...")

    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr(module.import_rerun("--view"), "spawn", fail)
    assert refused(capsys, log_folder, "--view").endswith(
        "--view: the viewer could not be started: no viewer here"
    )


def test_a_viewer_that_does_not_answer_is_told(
    log_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":99")
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(module.import_rerun("--view"), "spawn", lambda **options: asked.append(options))
    monkeypatch.setattr(module, "PORT", 1)
    assert "--view: expected the viewer on port 1, found none" in refused(capsys, log_folder, "--view")
    # without its recording, rerun opens a window only for a global one, which is not used here
    assert [(options["port"], options["recording"] is None) for options in asked] == [(1, False)]


def test_a_recording_needs_its_suffix_and_its_folder(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"a\.bin: expected a recording's name that ends in \.rrd"):
        check_recording(tmp_path / "a.bin", False)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="expected a folder, found a file"):
        check_recording(tmp_path / "file" / "a.rrd", False)


def test_a_recording_that_fails_leaves_nothing_and_another_one_is_replaced(tmp_path: Path) -> None:
    file = tmp_path / "a.rrd"
    with pytest.raises(ZeroDivisionError), recording(file):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    for _ in range(2):
        with recording(file):
            pass
    assert {path.name for path in tmp_path.iterdir()} == {"a.rrd"}
