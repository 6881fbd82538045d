"""JSON files hold strict JSON only, and are written whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph.errors import InputError
from pathspace_graph.io.json_file import read_json, write_json


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
