"""Every strange file that fuzzing began with, or found, is refused in one line with exit code 2."""

from __future__ import annotations

from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import PathspaceError

from ..fuzz.targets import INPUTS, READ, TARGETS

COMMANDS = {
    "log": ["online", "{folder}", "--out", "{out}"],
    "map": ["plot", "{folder}", "--out", "{out}.png"],
    "track": ["simulate", "--track", "{track}", "--out", "{out}"],
    "study": ["ablate", "{folder}/study.toml", "--out", "{out}"],
}
STRANGE = [file for file in INPUTS if file.name not in READ]


@pytest.mark.parametrize("digits", [20, 400, 5000])
def test_a_number_of_many_digits_is_refused(
    digits: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "out")
    assert main(["simulate", "--generate", "0", "--laps", "1" + digits * "0", "--out", out]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "--laps: unable to convert" in line and len(line) < 500


@pytest.mark.parametrize("file", [file for file in INPUTS if file.name in READ], ids=lambda file: file.name)
def test_a_good_file_of_the_corpus_is_read(file: Path, tmp_path: Path) -> None:
    TARGETS[file.parent.name].run(file.read_bytes(), tmp_path)


@pytest.mark.parametrize("file", STRANGE, ids=lambda file: f"{file.parent.name}-{file.name}")
def test_a_strange_file_ends_in_one_line(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    if file.parent.name not in COMMANDS:
        with pytest.raises(PathspaceError):
            TARGETS[file.parent.name].run(file.read_bytes(), folder)
        return
    TARGETS[file.parent.name].write(file.read_bytes(), folder)
    track = next(iter(folder.glob("track.*")), folder)
    command = [
        word.format(folder=folder, track=track, out=tmp_path / "out") for word in COMMANDS[file.parent.name]
    ]
    assert main(command) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "expected" in line and str(folder) in line
    assert len(line) < 600
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
