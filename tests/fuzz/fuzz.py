"""Fuzzes the readers with atheris, guided by coverage.

`python tests/fuzz/fuzz.py --seconds 600 [TARGET ...]` runs each target for ten minutes. Anything else than a
PathspaceError is a find: a traceback, a warning, or an input that takes a minute or three gigabytes. It is
written to the folder of finds. Once it is mended, it becomes a file of the corpus, which ordinary tests read.
The exit code is 1 where anything was found. Where atheris is missing, a line says so, and the exit code is 0.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import warnings
from contextlib import redirect_stderr
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any

CORPUS = Path(__file__).with_name("corpus")
LIMITS = ("-timeout=60", "-rss_limit_mb=3072", "-max_len=8192", "-len_control=0", "-print_final_stats=1")
"""An input may take a minute and three gigabytes."""
TRACK_LENGTH = 2e3
"""Tracks are at most this long (m) here: one of 30 km takes the time of thousands of short ones."""
INSTRUMENTED = [
    "tomllib",
    *(f"pathspace_graph.{room}" for room in ("io", "sim", "spline", "eval.experiment", "settings")),
]
"""Branches of these modules guide the fuzzer."""


class Fuzzer:
    """Runs each target in a child of this process, which has imported and instrumented everything once."""

    def __init__(self, finds: Path) -> None:
        import atheris  # noqa: PLC0415 - an extra

        quiet = redirect_stderr(StringIO())
        with quiet, atheris.instrument_imports(include=INSTRUMENTED):
            from targets import TARGETS  # noqa: PLC0415 - what is imported here is instrumented

            from pathspace_graph.errors import PathspaceError  # noqa: PLC0415 - the same
            from pathspace_graph.sim import track_files  # noqa: PLC0415 - the same
        track_files.MAX_TRACK_LENGTH = TRACK_LENGTH  # type: ignore[misc]
        self._atheris, self._targets, self._refusal = atheris, TARGETS, PathspaceError
        self._finds = finds

    def run(self, name: str, seconds: int) -> bool:
        """Fuzzes a target and reports; returns whether anything was found."""
        (self._finds / name).mkdir(parents=True, exist_ok=True)
        log = self._finds / f"{name}.log"
        with tempfile.TemporaryDirectory(dir=_memory()) as folder:
            child = os.fork()
            if child == 0:
                self._fuzz(name, seconds, Path(folder), log)
            found = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
        told = log.read_text(errors="replace")
        count = re.search(r"stat::number_of_executed_units: *(\d+)", told)
        verdict = f"found something, see {self._finds}/{name}-*" if found else "nothing found"
        print(f"{name}: {count[1] if count else 'unknown'} executions in {seconds} s, {verdict}", flush=True)
        if found:
            print(told[-4000:], flush=True)
        return found

    def _fuzz(self, name: str, seconds: int, folder: Path, log: Path) -> None:
        """Fuzzes in the child until the time is up or something is found, and ends the process."""
        with log.open("w") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
        warnings.simplefilter("error")
        target: Any = self._targets[name]

        def once(data: bytes) -> None:
            try:
                target.run(data, folder)
            except self._refusal as error:
                assert "\n" not in str(error), "expected a message of one line"

        options = [*LIMITS, f"-max_total_time={seconds}", f"-artifact_prefix={self._finds / name}-"]
        folders = [str(self._finds / name), str(CORPUS / name)]
        self._atheris.Setup([sys.argv[0], *options, *folders], once)
        self._atheris.Fuzz()
        os._exit(0)


def _memory() -> str | None:
    """Returns a folder in memory, where the system has one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def main() -> int:
    """Fuzzes the targets one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="these readers, all of them by default")
    parser.add_argument("--seconds", type=int, default=600, help="time for each target")
    parser.add_argument("--finds", type=Path, default=Path("build/fuzz"), help="folder of finds")
    options = parser.parse_args()
    if find_spec("atheris") is None:
        print(f"nothing is fuzzed: there is no atheris for this Python {sys.version.split()[0]}")
        return 0
    fuzzer = Fuzzer(options.finds)
    names = options.targets or sorted(folder.name for folder in CORPUS.iterdir())
    return max(int(fuzzer.run(name, options.seconds)) for name in names)


if __name__ == "__main__":
    sys.exit(main())
