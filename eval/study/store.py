"""What a study keeps on disk: every cell in a file of its own, and the logs while cells are left to run."""

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
    """The cells and logs of a study on disk."""

    folder: Path
    """The study's own."""

    @property
    def logs(self) -> Path:
        """Where logs are while cells are left to run."""
        return self.folder / "logs"

    def read(self, cell: Cell) -> Record | None:
        """The cell's record; None where there is none, or none that can be read."""
        try:
            record: Record = json.loads(self._file(cell).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if record.get("format") == FORMAT and record.get("id") == cell.id else None

    def write(self, cell: Cell, record: Record) -> None:
        """The record as a file of its own, whole or not at all."""
        write_json(self._file(cell), record, indent=1)

    def has_log(self, drive: Drive) -> bool:
        """Whether the drive has been simulated."""
        return self._log(drive).is_file()

    def read_log(self, drive: Drive) -> Log:
        """The log of a drive; one that can't be read, as of another version, is simulated again."""
        try:
            log: Log = pickle.loads(self._log(drive).read_bytes())
        except Exception:  # there is no telling what a damaged pickle raises
            return drive.simulate()
        return log

    def write_log(self, drive: Drive, log: Log) -> None:
        """A simulated log, whole or not at all."""
        with replacing(self._log(drive)) as temporary:
            temporary.write_bytes(pickle.dumps(log))

    def drop_logs(self) -> None:
        """Remove the logs: they can be simulated again."""
        for file in self.logs.glob("*.pickle"):
            file.unlink()
        if self.logs.is_dir():
            self.logs.rmdir()

    def _file(self, cell: Cell) -> Path:
        return self.folder / "cells" / f"{cell.id}.json"

    def _log(self, drive: Drive) -> Path:
        return self.logs / f"{drive.id}.pickle"
