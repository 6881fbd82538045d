"""The command line: cyclopts reads it, and errors become one line and an exit code."""

import os
import re
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from itertools import takewhile
from traceback import print_exc
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, cast, get_args

import cyclopts
from cyclopts import App, ArgumentCollection
from cyclopts.help.formatters import DefaultFormatter

from .errors import PathspaceError, SolveError, check_name, install

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

PROGRAM: Final = "pathspace-graph"
DONE, BAD_INPUT, NOT_SOLVED, INTERRUPTED, BROKEN_PIPE, TERMINATED = 0, 2, 3, 130, 141, 143  # exit codes
ASK_COMPLETION: Final = "__complete"  # by which a script of `--completion` asks for names
HELP_ALL: Final = "--help-all"
HELP: Final = ("--help", "-h", HELP_ALL)
PARAMETER: Final = cyclopts.Parameter(
    consume_multiple=1, negative_iterable=(), json_dict=False, json_list=False
)
ESSENTIAL: Final = (  # options of groups that `--help` explains; the others are in `--help-all`
    *("--limits.range-max", "--spline.degree", "--spline.size-share", "--motion.doubt", "--sides.colourless"),
    *("--batch.start", "--odometry.sigma-scale", "--calibration.sensor", "--calibration.trust"),
)
WHOLE: Final = re.compile(r"[+-]?\d{1,18}|none", re.IGNORECASE)  # cyclopts would round any other number


class Entry(NamedTuple):
    """Where a command is: imported only after its name is known, so that help need not wait for GTSAM."""

    options: str  # module of `options` and dataclass in it
    module: str  # of `commands`, with the function that runs it
    summary: str


GROUPS: Final = {
    "Maps": {
        "demo": Entry("runs:Demo", "studies", "Map a generated track online: a table, a map, its picture."),
        "online": Entry("runs:Online", "estimate", "Map a log online, cycle by cycle."),
        "batch": Entry("runs:Batch", "estimate", "Optimize whole logs at once, as the ground reference."),
        "plot": Entry("runs:Plot", "pictures", "Draw a map with its uncertainty band."),
        "view": Entry("runs:View", "pictures", "Write a result as a page for any browser."),
        "export": Entry("runs:Export", "export", "Write a map as planners and other tools read it."),
    },
    "Data": {
        "simulate": Entry("data:Simulate", "simulate", "Write the log of a simulated drive, with truth."),
        "convert": Entry("data:Convert", "convert", "Write a ROS bag, CSV files or JSON lines as a log."),
    },
    "Studies": {
        "compare": Entry("runs:Compare", "studies", "Run every estimator on logs: the paper's table."),
        "ablate": Entry("runs:Ablate", "studies", "Run a study of estimators and settings."),
        "faults": Entry("runs:FaultSuite", "studies", "Measure what each fault of a car costs."),
        "scale": Entry("runs:Scale", "studies", "Measure update time against map size."),
        "report": Entry("runs:Report", "studies", "Measure the figures of the pages."),
    },
}
EXTRAS: Final = {  # packages that the core does without, and the extra that has them
    **dict.fromkeys(("tabulate", "matplotlib"), "eval"),
    "distributed": "cluster",
    "bokeh": "page",
}
COMMANDS: Final = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return 0, or say what is wrong and return 2 for bad input, 3 for a bad estimate."""
    if threading.current_thread() is threading.main_thread():
        # temporary files are removed on the way
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads stall systems as small as these
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        name, options = parse(words)
        return DONE if options is None else run_command(name, options)
    except (cyclopts.CycloptsError, PathspaceError) as error:
        # a message about the command line may hold any word of it
        message = str(error) if isinstance(error, PathspaceError) else f"{error!s:.400}"
        return _refuse(message, words, NOT_SOLVED if isinstance(error, SolveError) else BAD_INPUT)
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        if package not in EXTRAS:
            raise
        return _refuse(f"expected the package {package} ({install(EXTRAS[package])}), found none", words)
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        return _refuse(f"{error.filename or 'output'}: {error.strerror or error}", words)
    except KeyboardInterrupt:
        for worker in import_module("multiprocessing").active_children():  # they are spared by the signal
            if worker.pid is not None:
                os.kill(worker.pid, signal.SIGTERM)
        print(f"{PROGRAM}: interrupted", file=sys.stderr)
        return INTERRUPTED


def parse(words: Sequence[str]) -> tuple[str, Any]:
    """Name of the command and its options, or None where help, version or completion was printed."""
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    before = [*takewhile(lambda word: word.startswith("-"), words)]
    name, *rest = words[len(before) :] or [""]
    if name not in ("", ASK_COMPLETION):
        check_name(name, COMMANDS, f"expected a command ({', '.join(COMMANDS)})")
        words = [name, *before, *rest]
    app = application(name)
    if name != ASK_COMPLETION and (not words or not set(HELP).isdisjoint(words)):
        app.help_formatter = Help(short=HELP_ALL not in words)
        app.help_print([name] if name else [], console=import_module(".console", __package__).output())
        return name, None
    if before == ["--completion"]:
        shell: Literal["zsh", "bash"] = "zsh" if "zsh" in os.environ.get("SHELL", "") else "bash"
        print(app.generate_completion(shell=shell))
        print(f"compdef _cyclopts_{PROGRAM} {PROGRAM}" * (shell == "zsh"))
        return name, None
    command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    return name, command(*bound.args, **bound.kwargs)


def application(name: str = "") -> App:
    """All commands, of which only `name` is imported."""
    app = App(
        name=PROGRAM,
        help="B-spline SLAM of race tracks on GTSAM factor graphs.",
        help_flags=HELP,
        help_format="plaintext",
        error_console=cast(Any, sys.stderr),  # nothing is printed there, and rich takes long to import
        help_epilogue="" if name else f"{PROGRAM} --completion prints a script for bash or zsh.",
        version=_version,
        version_format="plaintext",
        default_parameter=PARAMETER,
        config=(_fill_in, _check),
    )
    for number, (title, commands) in enumerate(GROUPS.items()):
        group = cyclopts.Group(title, sort_key=number)
        for one, command in commands.items():
            summary = None if one == name else command.summary  # or it would replace the docstring
            path = f"{__package__}.options.{command.options}"
            app.command(path, name=one, help=summary, group=group)
    return app


class Help(DefaultFormatter):
    """Help with every option, or if `short` without most options of groups, whose names stand below it."""

    def __init__(self, short: bool) -> None:
        super().__init__()
        self.short = short

    def __call__(self, console: "Console", options: "ConsoleOptions", panel: "HelpPanel") -> None:
        shown, hidden = list["HelpEntry"](), dict[str, None]()
        for entry in panel.entries:
            name = "".join(entry.positive_names[:1])
            if self.short and "." in name and name not in ESSENTIAL:
                hidden[f"{name.split('.')[0]}.*"] = None
            else:
                text = " ".join(entry.description.primary_renderable.plain.split())
                shown.append(entry.copy(description=text.split(". ")[0] if self.short else text))
        super().__call__(console, options, panel.copy(entries=shown))
        if hidden:
            console.print(f"--help-all also explains {', '.join(hidden)}", highlight=False, markup=False)


def _version() -> str:
    compiler = import_module(".factors", __package__).COMPILER
    version = import_module("importlib.metadata").version
    return f"{PROGRAM} {version(PROGRAM)} (GTSAM {version('gtsam')}, kernels: {compiler})"


def _fill_in(app: App, names: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill in the settings of a file or of presets where the command line has none."""
    given = {
        argument.field_info.name: [token.value for token in argument.tokens]
        for argument in arguments
        if argument.tokens and not argument.keys
    }
    settings = getattr(app.default_command, "base", lambda _: None)(given)
    if settings is not None:
        import_module("cyclopts.config").Dict({names[-1]: asdict(settings)})(app, names, arguments)


def _check(_: App, __: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Refuse what cyclopts would accept: a value of a whole group, and `2.7` rounded to a whole number."""
    for argument in arguments:
        for token in (token for token in argument.tokens if token.source == "cli"):
            if argument.children:
                raise cyclopts.UnknownOptionError(
                    token=token, argument_collection=arguments.filter_by(show=True)
                )
            if int in (argument.hint, *get_args(argument.hint)) and not WHOLE.fullmatch(token.value):
                raise cyclopts.CoercionError(token=token, argument=argument, target_type=int)


def run_command(name: str, options: Any) -> int:
    """Run a command with its options; return 3 where the result is written, but can't be trusted."""
    module = import_module(f".commands.{COMMANDS[name].module}", __package__)
    level = "QUIET" if options.quiet or options.json else "VERBOSE" if options.verbose else "NORMAL"
    with import_module(".console", __package__).verbosity(level):
        outcome = getattr(module, f"{name}_command")(options)
        outcome.show(as_json=options.json)
    return NOT_SOLVED if outcome.wrong else DONE


def _refuse(message: str, words: Sequence[str], code: int = BAD_INPUT) -> int:
    if not {"-v", "--verbose"}.isdisjoint(words):
        print_exc()
    print(f"{PROGRAM}: {' '.join(message.split())}", file=sys.stderr)
    return code
