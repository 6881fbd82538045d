"""Options: a short help and a full one, settings from a file, and unknown names."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from math import inf
from pathlib import Path
from typing import Any

import pytest

from pathspace_graph.cli import BROKEN_PIPE, ESSENTIAL, main, parse
from pathspace_graph.io.files import write_json
from pathspace_graph.settings.checked import leaves
from pathspace_graph.settings.mapper import GateSettings, MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, preset

SCREEN = 50
"""Lines of a screen."""
MOST_SETTINGS = 55
ONLINE = ["LOG", "--out", "MAP"]
COMMAND = ["online", *ONLINE]


def help_of(command: str, option: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main([command, option]) == 0
    return capsys.readouterr().out


def options_of(*words: str) -> Any:
    return parse(words)[1]


@pytest.mark.parametrize("command", ["online", "batch", "compare", "demo", "scale", "simulate", "convert"])
def test_the_short_help_fits_two_screens(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = help_of(command, "--help", capsys)
    assert len(text.splitlines()) <= 2 * SCREEN
    assert max(map(len, text.splitlines())) <= 100
    assert ("--help-all also explains" in text) == (command != "convert"), "it has no settings in groups"


def test_the_short_help_has_the_essential_settings_and_the_long_one_has_all(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    short, whole = help_of("online", "--help", capsys), help_of("online", "--help-all", capsys)
    options = {f"--{name.replace('_', '-')}" for name in leaves(MapperSettings())}
    assert options >= set(ESSENTIAL)
    for option in options:
        assert f" {option} " in whole, option
        assert (f" {option} " in short) == (option in ESSENTIAL or "." not in option), option


def test_help_shows_each_text_as_one_paragraph_with_choices_and_default(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    shown = help_of("online", "--help-all", capsys)
    assert "Time that poses stay in the window, s. [default: 3.0]" in shown
    assert "are measured unless this is `stated`. [choices: measured, stated]" in shown
    short = help_of("online", "--help", capsys)
    assert "measured where nothing is [choices: measured, stated]" in short, "the first sentence only"


# --- options as the commands take them -------------------------------------------------------------------


def test_options_of_each_kind() -> None:
    words = "--start 1 -2 -0.5e-1 LOG --out=MAP --max_poses 7 --calibration.no-sensor --spline.degree 2"
    given = options_of("online", *words.split(), "--kind", "None")
    assert (given.log, given.out, given.start) == (Path("LOG"), Path("MAP"), (1.0, -2.0, -0.05))
    assert (given.settings.max_poses, given.settings.kind) == (7, None)
    assert given.settings.calibration.sensor is False
    assert given.settings.spline.degree == 2
    assert given == replace(options_of(*COMMAND), start=given.start, settings=given.settings)


def test_options_of_several_values() -> None:
    given = options_of("ablate", "lag", "--out", "D", "--tracks", "a.csv", "7", "--seeds", "1", "2")
    assert (given.tracks, given.seeds) == (("a.csv", "7"), (1, 2))
    given = options_of("convert", "B", "--out", "L", "--labels", "left=1", "right=0", "--columns", "wz=-yaw")
    assert (given.labels, given.columns) == (("left=1", "right=0"), ("wz=-yaw",))
    assert options_of("batch", "a", "b", "--out", "M").log == (Path("a"), Path("b"))

    assert options_of("convert", "B", "--out", "L", "--from", "csv").kind == "csv"
    assert options_of("export", "M", "--as", "tum", "--out", "-").out == Path("-")


def test_presets_set_what_no_option_sets() -> None:
    command = ["simulate", "--event", "skidpad", "--out", "L"]
    given = options_of(*command, "--sensor", "camera", "--sensor.range-max", "9", "--odometry", "ins")
    expected = preset({"sensor": "camera", "odometry": "ins"})
    assert given.settings.sensor == replace(expected.sensor, range_max=9.0) != SimulationSettings().sensor
    assert given.settings.faults == expected.faults != SimulationSettings().faults
    assert given.settings.odometry == expected.odometry != SimulationSettings().odometry
    assert options_of(*command).settings == SimulationSettings()


def test_flags_of_every_command_stand_before_or_after_it() -> None:
    for words in (["-q", *COMMAND, "-v"], [*COMMAND, "--quiet", "--verbose"]):
        given = options_of(*words)
        assert (given.quiet, given.verbose, given.json) == (True, True, False)


# --- settings from a file --------------------------------------------------------------------------------


CHANGED = replace(
    MapperSettings(),
    lag=2.0,
    gate=GateSettings(chi=2.5, huber=inf),
    open_lap=replace(MapperSettings().open_lap, ends=(3, 7)),
)


@pytest.mark.parametrize("command", ["online", "batch", "compare", "scale", "demo"])
def test_every_command_that_estimates_reads_what_a_summary_holds(command: str, tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    write_json(file, {"estimator": "fixed-lag", "settings": asdict(CHANGED), "laps": 1})
    places = ["LOG"] if command in ("online", "batch", "compare") else []
    assert options_of(command, *places, "--out", "X", "--settings", str(file)).settings == CHANGED


def test_options_on_the_command_line_stand_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("lag = 2\ngate.huber = inf\n[spline]\ndegree = 2\n")
    given = options_of(*COMMAND, "--gate.chi", "4", f"--settings={file}", "--lag", "5")
    assert given.out == Path("MAP")
    assert given.settings.lag == 5.0
    assert given.settings.gate == GateSettings(chi=4.0, huber=inf)
    assert given.settings.spline == replace(MapperSettings().spline, degree=2)


BAD_FILES = {
    "unknown name": ("gate.chii = 3\n", "'gate.chii', the nearest is 'gate.chi'"),
    "name of a group": ("gate = 3\n", "'gate'"),
    "wrong type": ('lag = "long"\n', "lag: expected a positive number, found 'long'"),
    "wrong word": ('batch.start = "none"\n', "batch.start: expected"),
    "out of range": ("gate.chi = -1\n", "gate.chi: expected a positive number, found -1"),
    "no TOML": ("lag 3\n", "row 1"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_file_is_one_line_with_file_and_name(
    case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, (content, says) = tmp_path / "my.toml", BAD_FILES[case]
    file.write_text(content)
    assert main(["online", *ONLINE, "--settings", str(file)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(file) in error
    assert says in error


@pytest.mark.parametrize("content", ["[1]", '{"settings": 3}', "{", '{"settings": {"lag": null}}'])
def test_a_bad_summary_is_one_line_too(
    content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "summary.json"
    file.write_text(content)
    assert main(["batch", *ONLINE, "--settings", str(file)]) == 2
    assert capsys.readouterr().err.startswith(f"pathspace-graph: {file}")


def test_the_estimators_have_few_settings() -> None:
    """A number that neither a user nor a study changes is a constant."""
    assert len(leaves(MapperSettings())) <= MOST_SETTINGS


# --- what every command takes ----------------------------------------------------------------------------


def test_a_quiet_command_prints_no_result_and_a_verbose_one_says_where_an_error_comes_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "--out", str(tmp_path / "loud"), "--event", "acceleration"]) == 0
    assert str(tmp_path / "loud") in capsys.readouterr().out
    assert main(["-q", "simulate", "--out", str(tmp_path / "log"), "--event", "acceleration"]) == 0
    assert capsys.readouterr() == ("", "")
    assert (tmp_path / "log" / "log.toml").exists()
    for option in ("--quiet", "-v"):
        assert main(["plot", option, str(tmp_path / "none"), "--out", str(tmp_path / "map.png")]) == 2
        *before, last = capsys.readouterr().err.splitlines()
        assert last.endswith("none/map.json: expected a map, found none")
        assert (before[:1] == ["Traceback (most recent call last):"]) == (option == "-v")
    assert main(["simulate", "--out", str(tmp_path / "again"), "--event", "acceleration"]) == 0
    assert capsys.readouterr().out, "quiet holds for one call"


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash isn't installed")
def test_the_shell_completes_commands_options_and_values(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHELL", "/bin/bash")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    assert main(["--completion"]) == 0
    script = capsys.readouterr().out

    def completed(*words: str) -> list[str]:
        line = " ".join(("pathspace-graph", *words))
        asked = f'COMP_WORDS=({line}); COMP_CWORD={len(words)}; _pathspace_graph; echo "${{COMPREPLY[@]}}"'
        done = subprocess.run(
            ["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    assert completed("on") == ["online"]
    assert completed("batch", "MAP", "--spline.deg") == ["--spline.degree"]
    assert completed("convert", "--fro") == ["--from", "--from-poses"]
    assert completed("plot", "--spline") == []
    assert completed("export", "MAP", "--as", "la") == ["lanelet2"]
    assert completed("online", "LOG", "--estimator", "ck") == ["ckf"], "names that are no choices"
    assert completed("ablate", "degr") == ["degree"]
    monkeypatch.setenv("SHELL", "/usr/bin/zsh")
    assert main(["--completion"]) == 0
    assert capsys.readouterr().out.endswith("\ncompdef _cyclopts_pathspace-graph pathspace-graph\n")


@pytest.mark.parametrize("words", [["--completion"], ["online", "--help-all"]])
def test_a_reader_that_has_seen_enough_is_no_error(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has closed the pipe before all was printed."""
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(words) == BROKEN_PIPE
    assert capsys.readouterr().err == ""
