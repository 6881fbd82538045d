"""Where a recording cannot be opened, one line says why, and nothing is left behind."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import OutputError, SettingsError
from pathspace_graph.eval.view import recording as module
from pathspace_graph.eval.view.recording import DISPLAYS, check_recording, has_display, recording
from pathspace_graph.io.log_files import write_log

from ...scenes.drives import ahead, corridor, exact_log


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


def test_a_display_is_known_by_the_environment_on_linux_only() -> None:
    assert has_display("darwin", {}) and has_display("win32", {})
    assert not has_display("linux", {"DISPLAY": ""})
    assert has_display("linux", {"DISPLAY": ":0"}) and has_display("linux", {"WAYLAND_DISPLAY": "wayland-0"})


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
