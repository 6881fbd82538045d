"""Output appears as a whole or not at all, and keeps what was there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError, OutputError
from pathspace_graph.io.files import (
    atomic_file,
    atomic_folder,
    check_file_target,
    check_target,
    write_json,
)
from pathspace_graph.io.parsing import read_json


def write_result(target: Path, text: str) -> None:
    with atomic_folder(target, "marker") as folder:
        (folder / "marker").write_text(text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_new_folder_with_its_parents(tmp_path: Path) -> None:
    write_result(tmp_path / "a" / "b", "1")
    assert (tmp_path / "a" / "b" / "marker").read_text() == "1"
    assert names(tmp_path / "a") == ["b"]


def test_empty_folder_is_used(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_result(tmp_path / "out", "1")
    assert names(tmp_path) == ["out"]


def test_earlier_results_become_numbered_backups(tmp_path: Path) -> None:
    for text in "123":
        write_result(tmp_path / "out", text)
    assert names(tmp_path) == ["out", "out.~1~", "out.~2~"]
    assert [(tmp_path / name / "marker").read_text() for name in names(tmp_path)] == ["3", "1", "2"]


def test_foreign_things_are_refused_and_kept(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thing").write_text("mine")
    for target in ("file", "foreign", "file/below"):
        with pytest.raises(OutputError, match="expected"):
            check_target(tmp_path / target, "marker")
        with pytest.raises(OutputError):
            write_result(tmp_path / target, "1")
    assert names(tmp_path) == ["file", "foreign"]
    assert names(tmp_path / "foreign") == ["thing"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failure_leaves_nothing_and_keeps_the_earlier_result(
    tmp_path: Path, error: type[BaseException]
) -> None:
    write_result(tmp_path / "out", "1")
    for target in (tmp_path / "out", tmp_path / "new" / "deep"):
        with pytest.raises(error), atomic_folder(target, "marker") as folder:
            (folder / "half").write_text("?")
            raise error
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "marker").read_text() == "1"


def test_what_appears_meanwhile_is_not_lost(tmp_path: Path) -> None:
    with pytest.raises(OutputError), atomic_folder(tmp_path / "out", "marker") as folder:
        (folder / "marker").write_text("1")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "foreign").write_text("mine")
    assert names(tmp_path) == ["out"]
    assert names(tmp_path / "out") == ["foreign"]


def test_single_file(tmp_path: Path) -> None:
    for text in "12":
        with atomic_file(tmp_path / "deep" / "plot.png") as path:
            assert path.suffix == ".png"
            path.write_text(text)
    assert (tmp_path / "deep" / "plot.png").read_text() == "2"
    assert (tmp_path / "deep" / "plot.png.~1~").read_text() == "1"
    with pytest.raises(OutputError, match="found a folder"):
        check_file_target(tmp_path / "deep")


def test_single_file_that_fails(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no"), atomic_file(tmp_path / "deep" / "plot.png") as path:
        path.write_text("half")
        raise ValueError("no")
    assert names(tmp_path) == []


# --- JSON ------------------------------------------------------------------------------------------------


def test_arrays_scalars_tuples_and_paths_become_plain_values(tmp_path: Path) -> None:
    content = {
        "array": np.array([[1.5, 2.0]]),
        "scalars": (np.float64(0.1), np.int64(3), np.bool_(True)),
        "path": Path("a/b"),
        "nothing": None,
        4: "a key that is a number",
    }
    write_json(tmp_path / "f.json", content)
    read = json.loads((tmp_path / "f.json").read_text())
    assert read == {
        "array": [[1.5, 2.0]],
        "scalars": [0.1, 3, True],
        "path": "a/b",
        "nothing": None,
        "4": "a key that is a number",
    }


def test_nan_becomes_null_and_infinity_a_text(tmp_path: Path) -> None:
    write_json(tmp_path / "f.json", [np.nan, np.inf, {"low": -np.inf}, np.array([np.nan])])
    assert read_json(tmp_path / "f.json", "a list") == [None, "inf", {"low": "-inf"}, [None]]


def test_what_cannot_be_written_leaves_the_earlier_file(tmp_path: Path) -> None:
    write_json(tmp_path / "f.json", [1])
    with pytest.raises(TypeError):
        write_json(tmp_path / "f.json", {"a": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["f.json"]
    assert read_json(tmp_path / "f.json", "a list") == [1]


def test_an_error_of_reading_names_what_was_expected_and_the_row(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"f\.json: expected a list, found none"):
        read_json(tmp_path / "f.json", "a list")
    (tmp_path / "f.json").write_text('[1,\n2,\n"')
    with pytest.raises(InputError, match=r"f\.json, row 3: expected JSON"):
        read_json(tmp_path / "f.json", "a list")
