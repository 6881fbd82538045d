"""The files of a study: each cell has one of its own, and logs are kept while cells are missing.

All of them are data. A folder that comes from elsewhere can be resumed without running anything in it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pathspace_graph.errors import InputError
from pathspace_graph.eval.harness.drives import Drive, identity
from pathspace_graph.io.files import replacing, to_plain, write_json
from pathspace_graph.io.log import Log
from pathspace_graph.io.parsing import read_json

from .cells import FORMAT, Cell, Record
from .log_file import read_log_file, write_log_file

DIGEST: Final = "digest"
"""The record of a cell has its digest under this key in the file."""
_KEYS: Final = {"format", "id", "cell", "versions", "failure", "traceback", "said", "laps"}
"""A record has these keys."""


@dataclass(frozen=True)
class Store:
    """Keeps the cells and logs of a study on disk."""

    folder: Path
    """This is the study's folder."""

    @property
    def logs(self) -> Path:
        """Returns the folder of the logs, which is there while cells are missing."""
        return self.folder / "logs"

    def read(self, cell: Cell) -> Record | None:
        """Returns the cell's record, or None if there is none that is as it was written."""
        try:
            record = read_json(self._file(cell), "a cell")
        except InputError:
            return None
        return record if _is_record(record) and record["id"] == cell.id else None

    def write(self, cell: Cell, record: Record) -> None:
        """Writes the record as a file of its own, whole or not at all."""
        write_json(self._file(cell), {**record, DIGEST: _digest(record)}, indent=1)

    def has_log(self, drive: Drive) -> bool:
        """Returns whether the drive has been simulated."""
        return self._log(drive).is_file()

    def read_log(self, drive: Drive) -> Log:
        """Returns the log of a drive; one that can't be read, for example of another version, is
        simulated again."""
        try:
            return read_log_file(self._log(drive))
        except InputError:
            return drive.simulate()

    def write_log(self, drive: Drive, log: Log) -> None:
        """Writes a simulated log, whole or not at all."""
        with replacing(self._log(drive)) as temporary:
            write_log_file(temporary, log)

    def drop_logs(self) -> None:
        """Removes the logs, since they can be simulated again."""
        for file in (*self.logs.glob("*.log"), *self.logs.glob("*.pickle")):  # pickles of older versions
            file.unlink()
        with suppress(OSError):  # there is none, or it holds something else
            self.logs.rmdir()

    def _file(self, cell: Cell) -> Path:
        return self.folder / "cells" / f"{cell.id}.json"

    def _log(self, drive: Drive) -> Path:
        return self.logs / f"{drive.id}.log"


def _is_record(record: Any) -> bool:
    """Returns whether this is a whole record with the right digest; older ones have none."""
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        return False
    digest = record.pop(DIGEST, None)
    return record.keys() == _KEYS and digest in (None, _digest(record))


def _digest(record: Record) -> str:
    return identity(record=to_plain(record))
