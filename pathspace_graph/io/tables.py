"""CSV files and trajectories in the TUM format, read by pandas."""

import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, Final

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
CHUNK: Final = 50_000  # number of rows whose texts are in memory at a time
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
    frames = _read_csv(file, text, count, delimiter)
    if delimiter != ",":
        frames = (frame.replace(_DECIMAL_COMMA, r"\1.\2", regex=True) for frame in frames)
    begin = next(frames)
    row, names = 1, [*header]
    if not header:
        if begin.empty:
            raise InputError(file, f"expected a header {','.join(required)}, found an empty file", 1)
        row, names = int(begin.index[0]), [name.strip() for name in begin.iloc[0]]
        names[0] = names[0].removeprefix(comment).strip()
        begin = begin.iloc[1:]
    width = max((k + 1 for k, name in enumerate(names) if name), default=0)
    for name in required:
        if names.count(name) != 1:
            found = f"{'more than one' if name in names else 'none'} in {shown(','.join(names[:width]))}"
            raise InputError(file, f"expected a column '{name}', found {found}", row)
    return _table(file, chain([begin], frames), names[:width], required)


def read_tum(file: Path) -> Table:
    """Read a trajectory in the TUM format as a table; comments and empty lines are tolerated."""
    text = re.sub(r"(?m)^[ \t]*#.*$", "", read_text(file, "a trajectory"))
    return _table(file, _read_csv(file, text, len(TUM), r"\s+"), [*TUM], TUM)


def _table(
    file: Path,
    frames: Iterable[pd.DataFrame],
    names: Sequence[str],
    required: Mapping[str, Column] | Sequence[str],
) -> Table:
    """Table of named columns: all of them as texts, or the declared ones, as numbers but for labels.

    Numbers take a tenth of the memory of their texts, of which there are those of a frame at a time.
    """
    declared = required if isinstance(required, Mapping) else {}
    parts: dict[str, list[Any]] = {name: [] for name in declared or names}
    rows = list[Any]()
    for frame in frames:
        columns = {name: frame[k].to_numpy() for k, name in enumerate(names)}
        table = Table(file, columns, frame.index.to_numpy(), declared)
        is_long = (frame.iloc[:, len(names) :] != "").any(axis=1).to_numpy()
        table.require(~is_long, f"expected {len(names)} fields, found more")
        rows.append(table.rows)
        for name, part in parts.items():
            part.append(table.parsed(name) if name in declared and name != LABEL else columns[name])
    joined = {name: np.concatenate(part) for name, part in parts.items()}
    return Table(file, joined, np.concatenate(rows), declared)


def read_trajectory(file: Path) -> tuple[Array, Array]:
    """Read stamps (n,) in s and poses [x, y, theta] (n, 3), map frame; an InputError names a wrong row."""
    values = read_tum(file).stack([*TUM])
    theta = 2 * np.arctan2(values[:, 6], values[:, 7])
    return values[:, 0], np.column_stack([values[:, 1:3], theta])


def _read_csv(file: Path, text: str, width: int, delimiter: str) -> Iterator[pd.DataFrame]:
    """Yield fields of the rows that are not empty, by their number in the file; at least one frame.

    There is one column more than the width, which shows rows that are too long. Of a short one pandas fills
    the end with empty fields; where no text has quotes, its line tells.
    """
    lines, has_lines = list[str](), '"' not in text and len(delimiter) == 1
    if "\0" in text:  # some versions of pandas end a field there
        zero = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(file, "expected a table of texts, found a zero byte", zero)
    try:
        reader = pd.read_csv(
            BytesIO(text.encode()),
            sep=delimiter,
            header=None,
            names=range(width + 1),
            index_col=False,
            dtype=object,
            keep_default_na=False,
            skipinitialspace=True,
            skip_blank_lines=False,
            chunksize=CHUNK,
        )
        while True:
            with warnings.catch_warnings():  # of fields beyond the last one, which would be dropped
                warnings.simplefilter("error", pd.errors.ParserWarning)
                frame = next(reader, None)
            if frame is None:
                break
            begins_empty = frame[frame[0] == ""]
            kept = frame.drop(begins_empty.index[(begins_empty == "").all(axis=1)])
            for row in kept.index[kept[width - 1] == ""] if has_lines else ():
                lines = lines or re.split(r"\r\n?|\n", text)
                if (found := lines[row].count(delimiter) + 1) < width:
                    raise InputError(file, f"expected {width} fields, found {found}", row + 1)
            yield kept.set_axis(kept.index + 1)
        if not text:
            yield pd.DataFrame(columns=range(width + 1), dtype=object)
    except pd.errors.ParserWarning:
        fields = r"\s+" if len(delimiter) > 1 else re.escape(delimiter)
        rows = enumerate(re.split(r"\r\n?|\n", text), start=1)
        long_row = next((k for k, line in rows if len(re.split(fields, line.strip())) > width), 1)
        raise InputError(file, f"expected {width} fields, found more", long_row) from None
    except pd.errors.ParserError as error:
        told = str(error).strip()
        if long := re.search(r"in line (\d+), saw (\d+)", told):
            raise InputError(file, f"expected {width} fields, found {long[2]}", int(long[1])) from None
        row = int(found[1]) + 1 if (found := re.search(r"at row (\d+)", told)) else None
        raise InputError(file, f"expected a table of texts: {told}", row) from None
