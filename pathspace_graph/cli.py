"""The command line: it finds the command, and turns errors into one line and an exit code."""

import os
import signal
import sys
import threading
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from multiprocessing import active_children
from traceback import print_exc
from typing import Any, Final

from .errors import PathspaceError, SettingsError, SolveError, check_name

PROGRAM: Final = "pathspace-graph"
DONE, BAD_INPUT, NOT_SOLVED, INTERRUPTED, BROKEN_PIPE, TERMINATED = 0, 2, 3, 130, 141, 143  # exit codes
# options of every command, each with its level of `console.Verbosity`
LEVELS: Final = {"-q": "QUIET", "--quiet": "QUIET", "-v": "VERBOSE", "--verbose": "VERBOSE"}
EXTRAS: Final = {  # packages that the core does without, and the extra that has them
    **dict.fromkeys(("pandas", "tabulate", "matplotlib", "PIL"), "eval"),
    "distributed": "cluster",
}
COMMANDS: Final = {  # module of `commands`, dataclass of the options in it, and line of the overview
    "demo": ("compare", "Demo", "maps a generated track online, and shows a table, a map and its picture"),
    "simulate": ("simulate", "Simulate", "writes the log of a simulated drive, with truth"),
    "convert": ("convert", "Convert", "writes a ROS bag, CSV files or a known data set as a log"),
    "online": ("estimate", "Online", "maps a log online, cycle by cycle"),
    "batch": ("estimate", "Batch", "optimizes a whole log at once, as the ground reference"),
    "compare": ("compare", "Compare", "runs every estimator on one log or many, and gives the paper's table"),
    "ablate": ("studies", "Ablate", "runs a study of estimators and settings over many drives"),
    "faults": ("studies", "FaultSuite", "measures what each fault of a car costs, and what is said of it"),
    "report": ("studies", "Report", "measures the figures of the pages, and writes their tables"),
    "scale": ("studies", "Scale", "measures the time of an update against map size, detections and laps"),
    "plot": ("plot", "Plot", "draws a map with its uncertainty band"),
    "export": ("export", "Export", "writes a map in a format that planners and other tools read"),
    "verify": ("plot", "Verify", "checks that the files of a folder are as they were written"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0, or say what is wrong and return 2 for bad input, 3 for a failed estimate."""
    if threading.current_thread() is threading.main_thread():
        # temporary files are removed on the way
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads stall systems as small as these
    given = list(sys.argv[1:] if arguments is None else arguments)
    level = next((LEVELS[word] for word in reversed(given) if word in LEVELS), "NORMAL")
    try:
        _run([word for word in given if word not in LEVELS], level)
    except PathspaceError as error:
        return _refuse(str(error), level, NOT_SOLVED if isinstance(error, SolveError) else BAD_INPUT)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        install = f"pip install -e '.[{EXTRAS[error.name]}]'"
        return _refuse(f"expected the package {error.name} ({install}), found none", level)
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        return _refuse(f"{error.filename or 'output'}: {error.strerror or error}", level)
    except KeyboardInterrupt:
        for worker in active_children():  # they are spared by the signal
            if worker.pid is not None:
                os.kill(worker.pid, signal.SIGTERM)
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED
    return DONE


def _run(arguments: list[str], level: str) -> None:
    first = arguments[0] if arguments else ""
    if first in ("-h", "--help"):
        print(overview())
    elif first == "--version":
        compiler = import_module(".factors", __package__).COMPILER
        print(f"{PROGRAM} {version(PROGRAM)} (GTSAM {version('gtsam')}, kernels: {compiler})")
    elif first == "--completion":
        options = import_module(".commands.options", __package__)
        print(options.completion(PROGRAM, {name: command_class(name) for name in COMMANDS}, LEVELS))
    elif first in COMMANDS:
        with import_module(".console", __package__).verbosity(level):
            command = parse_command(first, arguments[1:])
            if command is not None:
                command.run()
    else:
        expected = f"expected a command ({', '.join(COMMANDS)})"
        if not first:
            raise SettingsError(f"{expected}, found none")
        check_name(first, COMMANDS, expected)


def overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    lines = [
        f"usage: {PROGRAM} COMMAND [OPTIONS]\n",
        *(f"  {name:<{width}}{summary}" for name, (_, _, summary) in COMMANDS.items()),
        f"\n{PROGRAM} COMMAND --help explains each command.",
        "-q prints errors and hints only, -v progress in lines and where an error comes from.",
        f'eval "$({PROGRAM} --completion)" completes commands and options in bash and zsh.',
    ]
    return "\n".join(lines)


def parse_command(name: str, arguments: list[str]) -> Any:
    options = import_module(".commands.options", __package__)
    return options.parse(command_class(name), f"{PROGRAM} {name}", arguments)


def command_class(name: str) -> type[Any]:
    """Return the class of a command, whose module is imported only now: help need not wait for GTSAM."""
    module, found, _ = COMMANDS[name]
    command: type[Any] = getattr(import_module(f".commands.{module}", __package__), found)
    return command


def _refuse(message: str, level: str, code: int = BAD_INPUT) -> int:
    if level == "VERBOSE":
        print_exc()
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr)
    return code
