"""Options: a short help and a full one, settings from a file, and unknown names."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from math import inf
from pathlib import Path

import pytest

from pathspace_graph.cli import BROKEN_PIPE, main, parse_command
from pathspace_graph.io.files import write_json
from pathspace_graph.io.overrides import leaves
from pathspace_graph.options import help as help_texts
from pathspace_graph.options.help import ESSENTIAL
from pathspace_graph.settings.mapper import GateSettings, MapperSettings

SCREEN = 50
"""Lines of a screen."""
MOST_SETTINGS = 88
MOST_ESSENTIAL = 12
ONLINE = ["LOG", "--out", "MAP"]


def help_of(command: str, option: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main([command, option]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", ["online", "batch", "compare", "demo", "scale", "simulate", "convert"])
def test_the_short_help_fits_two_screens_and_names_the_long_one(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = help_of(command, "--help", capsys)
    assert len(text.splitlines()) <= 2 * SCREEN
    assert max(map(len, text.splitlines())) <= 100
    assert f"pathspace-graph {command} --help-all" in text


def test_the_short_help_has_the_essential_settings_and_the_long_one_has_all(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert set(ESSENTIAL) <= set(leaves(MapperSettings()))
    short, whole = help_of("online", "--help", capsys), help_of("online", "--help-all", capsys)
    assert "--lag 3 " in short
    for name in leaves(MapperSettings()):
        option = name.replace("_", "-").split(".")[-1]
        assert option in whole, name
        assert (f"--{name.replace('_', '-')} " in short or name == "calibration.sensor") == (
            name in ESSENTIAL
        )
    assert "--settings PATH" in short
    assert "--settings PATH" in whole


def test_a_flag_in_the_short_help_is_the_one_that_changes_something(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "--calibration.no-sensor" in help_of("online", "--help", capsys)
    command = parse_command("online", [*ONLINE, "--calibration.no-sensor"])
    assert command.settings.calibration.sensor is False


@pytest.mark.parametrize(
    ("command", "option"),
    [("convert", "--from bag|"), ("convert", "--sigma-range NUMBER"), ("export", "--as centerline|")],
)
def test_the_short_help_names_options_as_the_command_takes_them(
    command: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert option in help_of(command, "--help", capsys)


# --- settings from a file --------------------------------------------------------------------------------


CHANGED = replace(
    MapperSettings(),
    lag=2.0,
    scale=0.1,
    gate=GateSettings(chi=2.5, huber=inf),
    open_lap=replace(MapperSettings().open_lap, ends=(3, 7)),
)


@pytest.mark.parametrize("command", ["online", "batch", "compare", "scale", "demo"])
def test_every_command_that_estimates_reads_what_a_summary_holds(command: str, tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    write_json(file, {"estimator": "fixed-lag", "settings": asdict(CHANGED), "laps": 1})
    places = ["LOG"] if command in ("online", "batch", "compare") else []
    assert parse_command(command, [*places, "--out", "X", "--settings", str(file)]).settings == CHANGED


def test_options_on_the_command_line_stand_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("lag = 2\ngate.huber = inf\n[spline]\ndegree = 2\n")
    given = parse_command("online", [*ONLINE, "--gate.chi", "4", f"--settings={file}", "--lag", "5"])
    assert given.out == Path("MAP")
    assert given.settings.lag == 5.0
    assert given.settings.gate == GateSettings(chi=4.0, huber=inf)
    assert given.settings.spline == replace(MapperSettings().spline, degree=2)


BAD_FILES = {
    "unknown name": ("gate.chii = 3\n", "'gate.chii', the nearest is 'gate.chi'"),
    "name of a group": ("gate = 3\n", "'gate'"),
    "wrong type": ('lag = "long"\n', "lag: expected a number, found 'long'"),
    "wrong word": ('spline.knots = "none"\n', "spline.knots: expected"),
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
    assert len(ESSENTIAL) <= MOST_ESSENTIAL


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
def test_the_shell_completes_commands_and_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--completion"]) == 0
    script = capsys.readouterr().out
    assert "--as" in script and "--format" not in script, "an option that is called otherwise than its field"

    def completed(*words: str) -> list[str]:
        line = " ".join(("pathspace-graph", *words))
        asked = f'COMP_WORDS=({line}); COMP_CWORD={len(words)}; _pathspace_graph; echo "${{COMPREPLY[@]}}"'
        done = subprocess.run(
            ["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    assert completed("on") == ["online"]
    assert completed("online", "--spline.deg") == ["--spline.degree"]
    assert completed("batch", "MAP", "--spline.deg") == ["--spline.degree"]
    assert completed("simulate", "--ev") == ["--event"]
    assert completed("plot", "MAP", "--band") == ["--band-scale"]
    assert completed("convert", "--fro") == ["--from", "--from-poses"]
    assert completed("convert", "--sigma-b") == ["--sigma-bearing"]
    assert completed("verify", "--spline") == []
    assert completed("online", "LOG", "--estimator", "ck") == ["ckf"]
    assert completed("export", "MAP", "--as", "la") == ["lanelet2"]
    assert completed("ablate", "degr") == ["degree"]


def test_a_reader_that_has_seen_enough_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has closed the pipe before all was printed."""
    monkeypatch.setattr(help_texts, "completion", lambda *_: 100_000 * "x")
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(["--completion"]) == BROKEN_PIPE
    assert capsys.readouterr().err == ""
