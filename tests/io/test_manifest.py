"""The manifest of a folder: what it lists, what is verified, and what is left alone."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from pathspace_graph.cli import main
from pathspace_graph.errors import InputError
from pathspace_graph.io.files import atomic_folder, write_manifest
from pathspace_graph.io.manifest import MANIFEST_FILE, verify_all


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a file, a plain subfolder, and a subfolder with a manifest of its own."""
    with atomic_folder(tmp_path / "out", "marker") as out:
        (out / "marker").write_text("1")
        (out / "figures").mkdir()
        (out / "figures" / "a.png").write_bytes(b"a")
        with atomic_folder(out / "map", "map.json") as own:
            (own / "map.json").write_text("{}")
    return tmp_path / "out"


def test_it_lists_size_and_digest_of_every_file(folder: Path) -> None:
    content = json.loads((folder / MANIFEST_FILE).read_text())
    assert content["format"] == "pathspace-manifest/1"
    assert list(content["files"]) == ["figures/a.png", "map/manifest.json", "marker"]
    assert content["files"]["marker"] == {"size": 1, "sha256": hashlib.sha256(b"1").hexdigest()}
    assert verify_all(folder) == 4


@pytest.mark.parametrize("name", ["marker", "figures/a.png", "map/map.json", "map/manifest.json"])
def test_what_has_changed_or_is_missing_is_named(folder: Path, name: str) -> None:
    file = folder / name
    file.write_bytes(file.read_bytes() + b" ")
    with pytest.raises(InputError, match="as it was written") as changed:
        verify_all(folder)
    assert changed.value.file == file
    file.unlink()
    with pytest.raises(InputError) as missing:
        verify_all(folder)
    assert missing.value.file in (file, folder / "map")


def test_what_a_user_adds_is_left_alone(folder: Path) -> None:
    (folder / "notes.txt").write_text("mine")
    (folder / ".hidden").write_text("mine")
    assert verify_all(folder) == 4
    (folder / "marker").write_text("mine")
    with pytest.raises(InputError, match="as it was written"):
        verify_all(folder)


def test_a_folder_without_a_manifest_cannot_be_verified(folder: Path) -> None:
    (folder / MANIFEST_FILE).unlink()
    (folder / "marker").write_text("2")
    with pytest.raises(InputError, match=r"manifest\.json.*found none"):
        verify_all(folder)


def test_the_manifest_of_another_program_is_refused(folder: Path) -> None:
    (folder / MANIFEST_FILE).write_text('{"name": "an app", "icons": []}')
    with pytest.raises(InputError, match="expected format"):
        verify_all(folder)


def test_a_manifest_that_was_written_anew_holds_for_what_is_there_now(folder: Path) -> None:
    (folder / "marker").write_text("2")
    write_manifest(folder)
    assert verify_all(folder) == 4
    (folder / "marker").write_text("1")  # as it was at first
    with pytest.raises(InputError, match="as it was written"):
        verify_all(folder)


def test_the_command_says_how_many_files_are_good_and_which_is_not(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", str(folder)]) == 0
    assert "4 files" in capsys.readouterr().out
    (folder / "marker").write_text("2")
    assert main(["verify", str(folder)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and str(folder / "marker") in line
