"""CSV files and trajectories in the TUM format, read by pandas."""

import re
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from pathspace_graph.errors import InputError
from pathspace_graph.factors.arrays import Array

from .parsing import MAX_FILE_BYTES, MAX_STAMP, Column, Table, read_text, shown

DELIMITERS: Final = ",;\t"  # of CSV files of other programs
TUM: Final[dict[str, Column]] = {
    "t": Column(MAX_STAMP, "s"),
    **dict.fromkeys(("tx", "ty", "tz"), Column(unit="m")),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), Column()),
}
_DECIMAL_COMMA: Final = r"^\s*([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)\s*$"


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
    delimiter = max(delimiters, key=first[0].count) if first else ","
    count = first[0].count(delimiter) + 1 if first else 1
    frame = _read_csv(file, text, count, sep=delimiter, skipinitialspace=True)
    if delimiter != ",":
        frame = frame.replace(_DECIMAL_COMMA, r"\1.\2", regex=True)
    row, names = 1, [*header]
    if not header:
        if frame.empty:
            raise InputError(file, f"expected a header {','.join(required)}, found an empty file", 1)
        row, names = int(frame.index[0]), [name.strip() for name in frame.iloc[0]]
        names[0] = names[0].removeprefix(comment).strip()
        frame = frame.iloc[1:]
    width = max((k + 1 for k, name in enumerate(names) if name), default=0)
    for name in required:
        if names.count(name) != 1:
            found = f"{'more than one' if name in names else 'none'} in {shown(','.join(names[:width]))}"
            raise InputError(file, f"expected a column '{name}', found {found}", row)
    columns = {name: frame[k].to_numpy() for k, name in enumerate(names[:width])}
    declared = required if isinstance(required, Mapping) else {}
    table = Table(file, columns, frame.index.to_numpy(), declared)
    is_long = (frame.iloc[:, width:] != "").any(axis=1).to_numpy()
    table.require(~is_long, f"expected {width} fields, found more")
    return table


def read_tum(file: Path) -> Table:
    """Read a trajectory in the TUM format as a table; comments and empty lines are tolerated."""
    text = re.sub(r"(?m)^[ \t]*#.*$", "", read_text(file, "a trajectory"))
    frame = _read_csv(file, text, len(TUM), sep=r"\s+")
    columns = {name: frame[k].to_numpy() for k, name in enumerate(TUM)}
    table = Table(file, columns, frame.index.to_numpy(), TUM)
    table.require((frame[len(TUM)] == "").to_numpy(), f"expected {len(TUM)} numbers, found more")
    return table


def read_trajectory(file: Path) -> tuple[Array, Array]:
    """Read stamps (n,) in s and poses [x, y, theta] (n, 3), map frame; an InputError names a wrong row."""
    values = read_tum(file).stack([*TUM])
    theta = 2 * np.arctan2(values[:, 6], values[:, 7])
    return values[:, 0], np.column_stack([values[:, 1:3], theta])


def _read_csv(file: Path, text: str, width: int, **form: Any) -> pd.DataFrame:
    """Fields of the rows that are not empty, by their number in the file.

    There is one column more than the width, which shows rows that are too long.
    """
    if "\0" in text:  # some versions of pandas end a field there
        raise InputError(
            file, "expected a table of texts, found a zero byte", text.count("\n", 0, text.index("\0")) + 1
        )
    form |= {"header": None, "names": range(width + 1), "index_col": False, "dtype": object}
    try:
        frame = pd.read_csv(StringIO(text), keep_default_na=False, skip_blank_lines=False, **form)
    except pd.errors.ParserError as error:
        told = str(error).strip()
        if long := re.search(r"in line (\d+), saw (\d+)", told):
            raise InputError(file, f"expected {width} fields, found {long[2]}", int(long[1])) from None
        row = re.search(r"at row (\d+)", told)  # from 0
        raise InputError(
            file, f"expected a table of texts: {told}", int(row[1]) + 1 if row else None
        ) from None
    frame = frame.set_axis(frame.index + 1)
    begins_empty = frame[frame[0] == ""]
    return frame.drop(begins_empty.index[(begins_empty == "").all(axis=1)])
