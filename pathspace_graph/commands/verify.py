"""`verify`: whether the files of a folder are as they were written."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from pathspace_graph.io.manifest import verify_all


@dataclass(frozen=True, kw_only=True)
class Verify:
    """Check every file of a folder against its manifest, which each command writes beside its files."""

    folder: Positional[Path]
    """Folder of a log, a map, or the result of another command, with its subfolders."""

    def run(self) -> None:
        """Check and report; a file that is missing or has changed ends it."""
        count = verify_all(self.folder)
        line = f"{self.folder}: {count} files are as they were written"
        Console().print(line, highlight=False, soft_wrap=True, markup=False)
