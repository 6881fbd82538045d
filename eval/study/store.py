"""The files of a study: each cell has one of its own, and logs are kept while cells are missing."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path

from pathspace_graph.eval.harness.drives import Drive
from pathspace_graph.io.files import replacing
from pathspace_graph.io.json_file import write_json
from pathspace_graph.io.log import Log

from .cells import FORMAT, Cell, Record


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
        """Returns the cell's record, or None if there is none that can be read."""
        try:
            record: Record = json.loads(self._file(cell).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if record.get("format") == FORMAT and record.get("id") == cell.id else None

    def write(self, cell: Cell, record: Record) -> None:
        """Writes the record as a file of its own, whole or not at all."""
        write_json(self._file(cell), record, indent=1)

    def has_log(self, drive: Drive) -> bool:
        """Returns whether the drive has been simulated."""
        return self._log(drive).is_file()

    def read_log(self, drive: Drive) -> Log:
        """Returns the log of a drive; one that can't be read, for example of another version, is
        simulated again."""
        try:
            log: Log = pickle.loads(self._log(drive).read_bytes())
        except Exception:  # there is no telling what a damaged pickle raises
            return drive.simulate()
        return log

    def write_log(self, drive: Drive, log: Log) -> None:
        """Writes a simulated log, whole or not at all."""
        with replacing(self._log(drive)) as temporary:
            temporary.write_bytes(pickle.dumps(log))

    def drop_logs(self) -> None:
        """Removes the logs, since they can be simulated again."""
        for file in self.logs.glob("*.pickle"):
            file.unlink()
        if self.logs.is_dir():
            self.logs.rmdir()

    def _file(self, cell: Cell) -> Path:
        return self.folder / "cells" / f"{cell.id}.json"

    def _log(self, drive: Drive) -> Path:
        return self.logs / f"{drive.id}.pickle"
