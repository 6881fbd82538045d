"""Fuzzes the readers with atheris, guided by coverage.

`python tests/fuzz/fuzz.py --seconds 600 [TARGET ...]` runs each target for ten minutes. Anything else than a
PathspaceError is a find: a traceback, a warning, or an input that takes a minute or three gigabytes. It is
written to the folder of finds. Once it is mended, it becomes a file of the corpus, which ordinary tests read.
The exit code is 1 where anything was found. Where atheris is missing, a line says so, and the exit code is 0.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import warnings
from importlib.util import find_spec
from pathlib import Path

CORPUS = Path(__file__).with_name("corpus")
LIMITS = ("-timeout=60", "-rss_limit_mb=3072", "-max_len=8192", "-len_control=0", "-print_final_stats=1")
"""An input may take a minute and three gigabytes: a track of 30 km takes a third of both."""
INSTRUMENTED = [
    "tomllib",
    *(f"pathspace_graph.{room}" for room in ("io", "sim", "spline", "eval.study", "settings")),
]
"""Branches of these modules guide the fuzzer."""


def fuzz_one(name: str, arguments: list[str]) -> None:
    """Fuzzes one target in this process, until the time is up or something is found."""
    import atheris  # noqa: PLC0415 - an extra

    with atheris.instrument_imports(include=INSTRUMENTED):
        from targets import TARGETS  # noqa: PLC0415 - what is imported here is watched

        from pathspace_graph.errors import PathspaceError  # noqa: PLC0415 - the same

    warnings.simplefilter("error")
    target = TARGETS[name]
    with tempfile.TemporaryDirectory(dir=_memory()) as folder:

        def once(data: bytes) -> None:
            try:
                target.run(data, Path(folder))
            except PathspaceError as error:
                assert "\n" not in str(error), "expected a message of one line"

        atheris.Setup([sys.argv[0], *arguments], once)
        atheris.Fuzz()


def _memory() -> str | None:
    """Returns a folder in memory, where the system has one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def main() -> int:
    """Fuzzes the targets one after the other, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="these readers, all of them by default")
    parser.add_argument("--seconds", type=int, default=600, help="time for each target")
    parser.add_argument(
        "--finds", type=Path, default=Path("build/fuzz"), help="folder of new inputs and finds"
    )
    parser.add_argument("--one", help=argparse.SUPPRESS)  # with options and folders of libFuzzer
    options, rest = parser.parse_known_args()
    if find_spec("atheris") is None:
        print(f"nothing is fuzzed: there is no atheris for this Python {sys.version.split()[0]}")
        return 0
    if options.one:
        fuzz_one(options.one, [*rest, *options.targets])
        return 0
    names = options.targets or sorted(folder.name for folder in CORPUS.iterdir())
    return max(_campaign(name, options.seconds, options.finds) for name in names)


def _campaign(name: str, seconds: int, finds: Path) -> int:
    grown = finds / name
    grown.mkdir(parents=True, exist_ok=True)
    limits = [*LIMITS, f"-max_total_time={seconds}", f"-artifact_prefix={finds / name}-"]
    command = [sys.executable, __file__, f"--one={name}", *limits, str(grown), str(CORPUS / name)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, errors="replace")
    count = re.search(r"stat::number_of_executed_units: *(\d+)", done.stderr)
    found = done.returncode != 0
    verdict = f"found something, see {finds}/{name}-*" if found else "nothing found"
    print(f"{name}: {count[1] if count else 'an unknown number of'} executions in {seconds} s, {verdict}")
    if found:
        print(done.stderr[-4000:])
    return int(found)


if __name__ == "__main__":
    sys.exit(main())
