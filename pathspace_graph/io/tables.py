"""CSV files and trajectories in the TUM format, read by pandas."""

import re
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array

from .parsing import LABEL, MAX_FILE_BYTES, MAX_STAMP, Column, Table, read_text, shown

DELIMITERS: Final = ",;\t"  # of CSV files of other programs
TUM: Final[dict[str, Column]] = {
    "t": Column(MAX_STAMP, "s"),
    **dict.fromkeys(("tx", "ty", "tz"), Column(unit="m")),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), Column()),
}


def read_table(
    file: Path,
    required: Mapping[str, Column] | Sequence[str] = (),
    *,
    comment: str = "",
    most: int = MAX_FILE_BYTES,
    delimiters: str = ",",
    header: Sequence[str] = (),
) -> Table:
    """Read a CSV file whose header holds at least the required columns; an InputError says what is wrong.

    Quotes, blanks around fields, empty lines, Windows line ends, a byte-order mark and a `comment` in front
    of the header are tolerated. A file without a header has its columns in the order of `header`. Of several
    `delimiters` it is the most frequent one in the first line; where that is no comma, numbers may have a
    decimal comma.
    """
    text = read_text(file, most=most)
    first = re.search(r"\S[^\r\n]*", text)
    if first is None and not header:
        raise InputError(file, f"expected a header {','.join(required)}, found an empty file", 1)
    delimiter = max(delimiters, key=first[0].count) if first else ","
    frame = _read_csv(file, text, delimiter, header)
    if delimiter != ",":
        frame = frame.replace(r"^\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*$", r"\1.\2", regex=True)
    names = [name.strip() for name in frame.iloc[0]]
    names[0] = names[0].removeprefix(comment).strip()
    names = names[: max((k + 1 for k, name in enumerate(names) if name), default=0)]
    for name in required:
        if names.count(name) != 1:
            found = f"{'more than one' if name in names else 'none'} in {shown(','.join(names))}"
            raise InputError(file, f"expected a column '{name}', found {found}", int(frame.index[0]))
    return _table(file, frame, names, required if isinstance(required, Mapping) else {})


def read_tum(file: Path) -> Table:
    """Read a trajectory in the TUM format as a table; comments and empty lines are tolerated."""
    text = re.sub(r"(?m)^[ \t]*#.*$", "", read_text(file, "a trajectory"))
    text = re.sub(r"[ \t]+", " ", re.sub(r"(?m)^[ \t]+|[ \t]+$", "", text))
    return _table(file, _read_csv(file, text, " ", [*TUM]), [*TUM], TUM)


def read_trajectory(file: Path) -> tuple[Array, Array]:
    """Read stamps (n,) in s and poses [x, y, theta] (n, 3), map frame; an InputError names a wrong row."""
    values = read_tum(file).stack([*TUM])
    theta = 2 * np.arctan2(values[:, 6], values[:, 7])
    return values[:, 0], np.column_stack([values[:, 1:3], theta])


def _table(file: Path, frame: pd.DataFrame, names: Sequence[str], declared: Mapping[str, Column]) -> Table:
    """Table of named columns below their header: texts, but numbers in those declared and no label."""
    frame = frame.iloc[1:]
    columns = {name: frame[k].to_numpy() for k, name in enumerate(names)}
    table = Table(file, columns, frame.index.to_numpy(), declared)
    is_long = (frame.iloc[:, len(names) :] != "").any(axis=1).to_numpy()
    table.require(~is_long, f"expected {len(names)} fields, found more")
    columns |= {name: table.parsed(name) for name in declared if name != LABEL}
    return table


def _read_csv(file: Path, text: str, delimiter: str, header: Sequence[str]) -> pd.DataFrame:
    """Fields of the rows that are not empty, by their number in the file; a `header` is row 0.

    There is one column more than in the first row, for a delimiter at the end of the others. Of a short row
    pandas fills the end with empty fields; where no text has quotes, its line tells.
    """
    if "\0" in text:  # some versions of pandas end a field there
        zero = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(file, "expected a table of texts, found a zero byte", zero)
    above, text = len(header) > 0, "\n".join([delimiter.join(header), text] if header else [text])
    lines = re.split(r"\r\n?|\n", text)
    width = next(line for line in lines if line.strip()).count(delimiter) + 1
    try:
        frame = pd.read_csv(
            StringIO(text),
            sep=delimiter,
            header=None,
            names=range(width + 1),
            dtype=object,
            keep_default_na=False,
            skipinitialspace=True,
            skip_blank_lines=False,
        )
    except pd.errors.ParserError as error:
        told, row = str(error).strip(), None
        if found := re.search(r"in line (\d+), saw (\d+)", told):
            told, row = f"expected {width} fields, found {found[2]}", int(found[1]) - above
            raise InputError(file, told, row) from None
        if found := re.search(r"at row (\d+)", told):
            row = int(found[1]) + 1 - above
        raise InputError(file, f"expected a table of texts: {told}", row) from None
    if not isinstance(frame.index, pd.RangeIndex):  # fields too many of the first row became its index
        raise InputError(file, f"expected {width} fields, found more: a quote goes on in the next line", 1)
    frame = frame[(frame != "").any(axis=1)]
    for row in frame.index[frame[width - 1] == ""] if '"' not in text else ():
        if (count := lines[row].count(delimiter) + 1) < width:
            raise InputError(file, f"expected {width} fields, found {count}", row + 1 - above)
    return frame.set_axis(frame.index + (1 - above))
