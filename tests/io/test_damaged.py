"""What is damaged in a file is refused in one line with file and row, or else is read."""

from __future__ import annotations

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pathspace_graph.cli import main
from pathspace_graph.errors import InputError
from pathspace_graph.eval.experiment.run import make_plan, read_record, write_record
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.io.log import COLUMNS
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.parsing import is_number
from pathspace_graph.io.results import CYCLE_COLUMNS, write_result
from pathspace_graph.io.tables import TUM
from pathspace_graph.sim.track_files import TUM_COLUMNS

from ..scenes.pretenders import write_round_track
from .test_log import small_log
from .test_results import result


@dataclass(frozen=True)
class Damaged:
    """A table that a command reads, and its columns of numbers."""

    file: str
    columns: tuple[str, ...]
    command: tuple[str, ...]
    delimiter: str = ","
    header: int = 1  # number of rows before the first one

    def spoil(self, folder: Path, row: int, column: int, text: str) -> int:
        """Replace a cell of the table; return its row in the file, from 1."""
        rows = [line.split(self.delimiter) for line in (folder / self.file).read_text().splitlines()]
        names = rows[0] if self.header else [*self.columns]
        row = self.header + row % (len(rows) - self.header)
        rows[row][names.index(self.columns[column % len(self.columns)])] = text
        (folder / self.file).write_text("".join(self.delimiter.join(one) + "\n" for one in rows))
        return row + 1


NUMBERS = {name: tuple(column for column in of if column != "label") for name, of in COLUMNS.items()}
ONLINE, PLOT = ("online", "log", "--out", "out"), ("plot", "map", "--out", "out.png")
TABLES = (
    *(Damaged(f"log/{name}", columns, ONLINE) for name, columns in NUMBERS.items()),
    Damaged("map/cycles.csv", tuple(name for name, kind in CYCLE_COLUMNS.items() if kind != "str"), PLOT),
    Damaged("map/trajectory.tum", tuple(TUM), PLOT, " ", 0),
    Damaged("round.csv", ("x", "y"), ("simulate", "--track", "round.csv", "--out", "out")),
    Damaged("circle.csv", TUM_COLUMNS, ("simulate", "--track", "circle.csv", "--out", "out")),
)
WORDS = ("x", "nan", "-inf", "1e999", "1_0", "٣", "--1", "0x1F", "1:2", "None", "\x00", '"', "1e", "é")
RUBBISH = st.sampled_from(WORDS) | st.text(
    st.characters(codec="utf-8", exclude_categories=("C", "Z"))
).filter(
    lambda text: text and not is_number(text) and not set(text) & set(',"#')
)  # a lone quote is among the words


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    write_log(small_log(), folder / "log")
    write_result(folder / "map", result(), {"estimator": "fixed-lag"})
    write_round_track(folder)
    angles = np.arange(40) * 2 * np.pi / 40
    rows = "".join(f"{20 * np.cos(a)},{20 * np.sin(a)},2,2\n" for a in angles)
    (folder / "circle.csv").write_text(",".join(TUM_COLUMNS) + f"\n{rows}")
    return folder


@settings(max_examples=150, deadline=None)
@given(table=st.sampled_from(TABLES), row=st.integers(0, 999), column=st.integers(0, 9), text=RUBBISH)
def test_rubbish_in_any_cell_is_refused_with_file_and_row(
    table: Damaged, row: int, column: int, text: str, written: Path
) -> None:
    good = (written / table.file).read_bytes()
    at = table.spoil(written, row, column, text)
    command = [str(written / word) if (written / word).exists() else word for word in table.command]
    command[-1] = str(written / command[-1])
    with redirect_stderr(io.StringIO()) as said, redirect_stdout(io.StringIO()):
        code = main(command)
    (written / table.file).write_bytes(good)
    assert code == 2
    assert said.getvalue().startswith(f"pathspace-graph: {written / table.file}, row {at}: expected ")
    assert said.getvalue().count("\n") == 1
    assert not [path for path in written.iterdir() if path.name.startswith(("out", "."))]


@settings(max_examples=400, deadline=None)
@given(
    name=st.sampled_from(("log/log.toml", "map/map.json")), at=st.integers(0, 9999), mask=st.integers(1, 255)
)
def test_a_flipped_byte_of_a_header_or_a_map_is_read_or_refused(
    name: str, at: int, mask: int, written: Path
) -> None:
    file = written / name
    good = file.read_bytes()
    at %= len(good)
    file.write_bytes(good[:at] + bytes([good[at] ^ mask]) + good[at + 1 :])
    try:
        read_log(file.parent) if file.suffix == ".toml" else read_map(file)
    except InputError as error:
        assert error.file == file and "\n" not in str(error)
    finally:
        file.write_bytes(good)


def test_a_damaged_cell_of_a_study_is_run_again(tmp_path: Path) -> None:
    cell = make_plan(Study(tracks=(write_round_track(tmp_path),))).cells[0]
    record = cell.failed(ValueError("lost")) | {"rows": [{"lap": 1, "rmse": 0.123456}]}
    write_record(tmp_path, cell, record)
    assert read_record(tmp_path, cell) == record
    (file,) = (tmp_path / "cells").iterdir()
    good, rng = file.read_bytes(), np.random.default_rng(0)
    for at, mask in zip(rng.integers(len(good), size=300), rng.integers(1, 256, 300), strict=True):
        file.write_bytes(good[:at] + bytes([good[at] ^ mask]) + good[at + 1 :])
        found = read_record(tmp_path, cell)
        assert found is None or found == record  # another blank between two values is no other content
    file.write_text("[]")
    assert read_record(tmp_path, cell) is None
