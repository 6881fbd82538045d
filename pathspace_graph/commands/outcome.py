"""Outcome of a command: its files, a summary for `--json`, and objections to the result."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pathspace_graph.console import note, say
from pathspace_graph.io.files import to_plain


@dataclass(frozen=True)
class Outcome:
    """The end of a command."""

    written: Sequence[Path]
    summary: Mapping[str, Any] = field(default_factory=dict)
    wrong: Sequence[str] = ()  # a line each, and exit code 3; empty for a trustworthy result

    def show(self, *, as_json: bool) -> None:
        """Print the summary as JSON, or the paths of the files; objections go to standard error."""
        files = [path for path in self.written if path.is_file() or path.is_dir()]  # no pipe or terminal
        if as_json and (files or self.summary):
            content = to_plain({**self.summary, "written": files, "wrong": self.wrong})
            print(json.dumps(content, indent=2, allow_nan=False))
        elif files:
            say(f"written to {', '.join(map(str, files))}")
        note(*self.wrong)
