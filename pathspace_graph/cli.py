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
from typing import Any, Final, NamedTuple

from .errors import PathspaceError, SolveError, check_name, install

PROGRAM: Final = "pathspace-graph"
DONE, BAD_INPUT, NOT_SOLVED, INTERRUPTED, BROKEN_PIPE, TERMINATED = 0, 2, 3, 130, 141, 143  # exit codes
HELP: Final = ("-h", "--help", "--help-all")
JSON: Final = "--json"
# options of every command, each with its level of `console.Verbosity`
LEVELS: Final = {"-q": "QUIET", "--quiet": "QUIET", "-v": "VERBOSE", "--verbose": "VERBOSE"}


class Command(NamedTuple):
    """Where a command is: imported only after its name is known, so that help need not wait for GTSAM."""

    options: str  # module of `options` and dataclass in it
    module: str  # of `commands`, with the function that runs it
    summary: str


GROUPS: Final = {
    "maps": {
        "demo": Command("map.Demo", "compare", "maps a generated track online: a table, a map, its picture"),
        "online": Command("map.Online", "estimate", "maps a log online, cycle by cycle"),
        "batch": Command("map.Batch", "estimate", "optimizes whole logs at once, as the ground reference"),
        "plot": Command("map.Plot", "plot", "draws a map with its uncertainty band"),
        "export": Command("map.Export", "export", "writes a map as planners and other tools read it"),
    },
    "data": {
        "simulate": Command("data.Simulate", "simulate", "writes the log of a simulated drive, with truth"),
        "convert": Command("data.Convert", "convert", "writes a ROS bag, CSV files or JSON lines as a log"),
        "verify": Command("data.Verify", "plot", "checks that files are as they were written"),
    },
    "studies": {
        "compare": Command("study.Compare", "compare", "runs every estimator on logs: the paper's table"),
        "ablate": Command("study.Ablate", "studies", "runs a study of estimators and settings"),
        "faults": Command("study.FaultSuite", "studies", "measures what each fault of a car costs"),
        "scale": Command("study.Scale", "studies", "measures update time against map size"),
        "report": Command("study.Report", "studies", "measures the figures of the pages"),
    },
}
EXTRAS: Final = {  # packages that the core does without, and the extra that has them
    **dict.fromkeys(("pandas", "tabulate", "matplotlib"), "eval"),
    "distributed": "cluster",
}
COMMANDS: Final = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0, or say what is wrong and return 2 for bad input, 3 for a bad estimate."""
    if threading.current_thread() is threading.main_thread():
        # temporary files are removed on the way
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads stall systems as small as these
    words = list(sys.argv[1:] if arguments is None else arguments)
    level = next((LEVELS[word] for word in reversed(words) if word in LEVELS), "NORMAL")
    try:
        return _run([word for word in words if word not in LEVELS], level)
    except PathspaceError as error:
        return _refuse(str(error), level, NOT_SOLVED if isinstance(error, SolveError) else BAD_INPUT)
    except ModuleNotFoundError as error:
        if error.name not in EXTRAS:
            raise
        way = install(EXTRAS[error.name])
        return _refuse(f"expected the package {error.name} ({way}), found none", level)
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


def _run(words: list[str], level: str) -> int:
    name, *rest = words or ["help"]
    if name in ("help", *HELP) and not rest:
        print(overview())
    elif name == "help":
        print(help_of(rest[0]), end="")
    elif name == "--version":
        compiler = import_module(".factors", __package__).COMPILER
        print(f"{PROGRAM} {version(PROGRAM)} (GTSAM {version('gtsam')}, kernels: {compiler})")
    elif name == "--completion":
        classes = {one: options_class(one) for one in COMMANDS}
        print(import_module(".options.help", __package__).completion(PROGRAM, classes, (*LEVELS, JSON)))
    elif found := next((word for word in rest if word in HELP), None):
        print(help_of(name, full=found == "--help-all"), end="")
    else:
        options = parse_command(name, [word for word in rest if word != JSON])
        return run_command(name, options, level, as_json=JSON in rest)
    return DONE


def overview() -> str:
    width = max(map(len, COMMANDS)) + 2
    lines = [f"usage: {PROGRAM} COMMAND [OPTIONS]"]
    for title, group in GROUPS.items():
        lines += [f"\n{title}:", *(f"  {name:<{width}}{command.summary}" for name, command in group.items())]
    return "\n".join([
        *lines,
        f"\n{PROGRAM} COMMAND --help explains a command. Each takes these options as well:",
        "  -q      prints errors and hints only",
        "  -v      prints progress in lines, and where an error comes from",
        "  --json  prints the result as JSON",
        f'eval "$({PROGRAM} --completion)" completes commands, options and values in bash and zsh.',
    ])  # fmt: skip


def help_of(name: str, *, full: bool = False) -> str:
    helper = import_module(".options.help", __package__)
    text: str = helper.help_of(options_class(name), f"{PROGRAM} {name}", full=full)
    return text


def options_class(name: str) -> type[Any]:
    """Dataclass of a command's options; SettingsError for an unknown command."""
    check_name(name, COMMANDS, f"expected a command ({', '.join(COMMANDS)})")
    module, found = COMMANDS[name].options.split(".")
    options: type[Any] = getattr(import_module(f".options.{module}", __package__), found)
    return options


def parse_command(name: str, words: list[str]) -> Any:
    """Parse the options of a command; SettingsError for bad usage."""
    options = options_class(name)
    return import_module(".options.parse", __package__).parse(options, f"{PROGRAM} {name}", words)


def run_command(name: str, options: Any, level: str = "NORMAL", *, as_json: bool = False) -> int:
    """Run a command with its options; return 3 where the result is written, but can't be trusted."""
    module = import_module(f".commands.{COMMANDS[name].module}", __package__)
    with import_module(".console", __package__).verbosity("QUIET" if as_json else level):
        outcome = getattr(module, f"{name}_command")(options)
        outcome.show(as_json=as_json)
    return NOT_SOLVED if outcome.wrong else DONE


def _refuse(message: str, level: str, code: int = BAD_INPUT) -> int:
    if level == "VERBOSE":
        print_exc()
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr)
    return code
