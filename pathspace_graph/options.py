"""The options of a command, made from its dataclass, their help, and what is wrong with them in one line."""

import io
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stderr
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from types import MappingProxyType
from typing import Any, Final, get_args, get_type_hints

import docstring_parser
import tyro

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.overrides import check_gone, leaves, read_settings
from pathspace_graph.io.parsing import MAX_INTEGER, shown
from pathspace_graph.settings.mapper import MapperSettings

HELP: Final = ("-h", "--help")
HELP_ALL: Final = "--help-all"
SETTINGS: Final = "--settings"
SETTINGS_TEXT: Final = (
    "TOML file of settings, or the summary.json of a run; options on the command line override it."
)
ESSENTIAL: Final = (
    *("lag", "max_poses", "steps", "noise", "scale"),
    *("limits.silence", "limits.range_max"),
    *("spline.degree", "spline.spacing", "spline.size_share", "spline.knots", "spline.sigma_model"),
    *("gate.chi", "gate.huber", "gate.view_ahead", "growth.sightings"),
    *("motion.doubt", "sides.colourless", "batch.start"),
    *("odometry.scale", "odometry.bias", "odometry.sigma_scale", "odometry.sigma_bias"),
    *("calibration.sensor", "calibration.trust", "calibration.yaw", "calibration.lateral"),
    *("calibration.latency", "calibration.range_scale", "calibration.range_bias"),
)
"""Settings of the estimators that `--help` explains; the others are in `--help-all`."""
COLUMN: Final = 38
"""Column of the short help in which the texts begin."""
MOST_COLUMNS: Final = 120

_ANSI: Final = re.compile(r"\x1b\[[0-9;]*m")
_FRAME: Final = " │\t"
_RULE: Final = "─╭╮╰╯"


def parse(command: type[Any], program: str, arguments: list[str]) -> Any:
    """Return the command, made from its options, or None where its help was asked for and printed.

    A command whose defaults depend on its options gives them in `start`. Bad usage is a SettingsError.
    """
    if not set(HELP).isdisjoint(arguments) and HELP_ALL not in arguments:
        sys.stdout.write(short_help(command, program))
        return None
    for word in arguments:
        if word.lstrip("+-").isdecimal() and len(word) > len(str(MAX_INTEGER)) + 1:
            raise SettingsError(f"{program}: expected whole numbers up to {MAX_INTEGER}, found {shown(word)}")
    if HELP_ALL in arguments:
        _set_help(command)
        arguments = ["--help"]
    default, arguments = _start(command, arguments)
    _check_options(command, arguments)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(command, prog=program, args=arguments, default=default)
    except SystemExit as end:
        if not end.code:
            if _estimates(command):
                sys.stdout.write(f"\n{SETTINGS} FILE\n    {SETTINGS_TEXT}\n")
            return None
    raise SettingsError(f"{one_line(complaint.getvalue())} (see {program} --help)")


def _estimates(command: type[Any]) -> bool:
    return get_type_hints(command).get("settings") is MapperSettings


def _start(command: type[Any], arguments: list[str]) -> tuple[Any, list[str]]:
    """Return the command before its options are set, or None, and the options without `--settings FILE`."""
    if not _estimates(command):
        start = getattr(command, "start", None)
        return start(arguments) if start else None, arguments
    words = [part for word in arguments for part in word.split("=", word.startswith(f"{SETTINGS}="))]
    if SETTINGS not in words:
        return None, arguments
    at = words.index(SETTINGS)
    before, given, after = words[:at], words[at + 1 : at + 2], words[at + 2 :]
    if not given or given[0].startswith("--") or SETTINGS in after:
        raise SettingsError(f"{SETTINGS}: expected one file, found {'two' if SETTINGS in after else 'none'}")
    required = {entry.name: tyro.MISSING for entry in fields(command) if _is_required(entry)}
    settings = read_settings(Path(given[0]), MapperSettings())
    return command(**required, settings=settings), before + after


def _is_required(entry: Field[Any]) -> bool:
    return entry.default is NO_DEFAULT and entry.default_factory is NO_DEFAULT


def _check_options(command: type[Any], arguments: list[str]) -> None:
    """Raise a SettingsError for an option of the estimators that is gone."""
    known = leaves(MapperSettings())
    for word in arguments if _estimates(command) else ():
        option = word.partition("=")[0]
        name = option.removeprefix("--").replace("-", "_")
        if option.startswith("--") and name not in known:
            check_gone(name, option)


# --- completion ------------------------------------------------------------------------------------------

_COMPLETION: Final = """\
[ -n "$ZSH_VERSION" ] && autoload -U +X bashcompinit && bashcompinit
_pathspace_graph() {{
  local words
  case "$COMP_CWORD:${{COMP_WORDS[1]}}" in
    1:*) words="{commands}" ;;
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _pathspace_graph {program}"""


def completion(program: str, commands: Mapping[str, type[Any]], common: Iterable[str]) -> str:
    """Return a script for bash and zsh that completes the commands, their options and names of files."""
    shared = ("--help", HELP_ALL, *common)
    cases = [
        f'    *:{name}) words="{" ".join((*_names(command), *shared))}" ;;'
        for name, command in commands.items()
    ]
    return _COMPLETION.format(commands=" ".join(commands), cases="\n".join(cases), program=program)


def _names(command: type[Any]) -> Iterator[str]:
    """Yield the names of all options of a command."""
    hints = get_type_hints(command)
    for entry in fields(command):
        prefix = "" if entry.name == "settings" else f"{entry.name}."
        if is_dataclass(hints[entry.name]):
            names = [f"{prefix}{leaf}" for leaf in leaves(hints[entry.name]())]
        else:
            names = [] if "Positional" in str(entry.type) else [_name(command, entry.name)]
        yield from (f"--{name.replace('_', '-')}" for name in names)
    if _estimates(command):
        yield SETTINGS


# --- help ------------------------------------------------------------------------------------------------


def short_help(command: type[Any], program: str) -> str:
    """Return a command's own options and the essential settings of the estimators, with their defaults.

    Groups of other options have a line each.
    """
    entries, groups = [*_entries(command)], [*_groups(command)]
    width = min(get_terminal_size((MOST_COLUMNS, 50)).columns, MOST_COLUMNS) - COLUMN
    places = [f"{name} " for name, _ in entries if not name.startswith("--")]
    lines = [f"usage: {program} {''.join(places)}[OPTIONS]", "", _first_sentence(_description(command)), ""]
    for name, text in entries:
        first, *others = wrap(text, width) or [""]
        beside = len(name) <= COLUMN - 2
        lines += [f"{name:<{COLUMN}}{first}" if beside else name]
        lines += [f"{'':<{COLUMN}}{line}" for line in (others if beside else [first, *others])]
    lines += ["", *(f"{name}: {text}" for name, text in groups)] if groups else []
    return "\n".join([*lines, "", f"{program} {HELP_ALL} explains every option.", ""])


def _entries(command: type[Any]) -> Iterator[tuple[str, str]]:
    """Yield the options that are explained, each with what it takes by default, and the first sentence."""
    hints, texts = get_type_hints(command), _texts(command)
    for entry in fields(command):
        if entry.name == "settings" and _estimates(command):
            yield f"{SETTINGS} FILE", SETTINGS_TEXT
            settings = MapperSettings()
            for name in ESSENTIAL:
                group, _, last = name.rpartition(".")
                home = getattr(settings, group) if group else settings
                hint, text = get_type_hints(type(home))[last], _texts(type(home))[last]
                yield _option(name, hint, getattr(home, last)), _first_sentence(text)
        elif entry.name == "settings":
            yield from _entries(hints["settings"])
        elif not is_dataclass(hints[entry.name]):
            text = _first_sentence(texts.get(entry.name, ""))
            if "Positional" in str(entry.type):
                yield entry.name.upper(), text
            else:
                yield _option(_name(command, entry.name), hints[entry.name], entry.default), text


def _name(command: type[Any], field: str) -> str:
    """Return the name of a field on the command line, which its annotation may give, as `--as`."""
    hint = get_type_hints(command, include_extras=True)[field]
    given = (getattr(extra, "name", None) for extra in getattr(hint, "__metadata__", ()))
    return next(filter(None, given), field)


def _groups(command: type[Any]) -> Iterator[tuple[str, str]]:
    """Yield the groups of options that are not explained, with their number and what they are."""
    hints, texts = get_type_hints(command), _texts(command)
    for entry in fields(command):
        kind: Any = hints[entry.name]
        if entry.name == "settings":
            yield from () if _estimates(command) else _groups(kind)
        elif is_dataclass(kind):
            yield (
                f"--{entry.name}.* ({len(leaves(hints[entry.name]()))})",
                _first_sentence(texts.get(entry.name, "")),
            )


def _option(name: str, hint: Any, value: Any) -> str:
    """Return an option with its default, or with what it takes; of several words the first is the default."""
    option = f"--{name.replace('_', '-')}"
    if hint is bool:
        return f"--{'.no-'.join(option[2:].rsplit('.', 1))}" if value else option
    inner = [hint, *get_args(hint)]
    words = [word for one in inner for word in get_args(one) if isinstance(word, str)]
    if words:
        return f"{option} {'|'.join(sorted(dict.fromkeys(words), key=lambda word: word != value))}"
    if value not in (None, NO_DEFAULT, ()):
        return f"{option} {value}"
    takes = "PATH" if Path in inner else "TEXT" if str in inner else "NUMBER"
    return f"{option} {takes}{' (required)' if value is NO_DEFAULT else ''}"


def _first_sentence(text: str) -> str:
    return text.split(". ", 1)[0].removesuffix(".")


def _description(command: type[Any]) -> str:
    return " ".join((docstring_parser.parse_from_object(command).short_description or "").split())


def _texts(settings: type[Any]) -> dict[str, str]:
    """Return the text of each field; a group of settings without one has that of its class."""
    hints = get_type_hints(settings)
    kinds = {name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)}
    groups = {name: _description(kind) for name, kind in kinds.items()}
    return groups | {
        text.arg_name: " ".join((text.description or "").split())
        for home in reversed(settings.__mro__)
        if is_dataclass(home)
        for text in docstring_parser.parse_from_object(home).params
    }


def _set_help(settings: type[Any]) -> None:
    """Give tyro the text of each field as one paragraph; it would break lines where the source does."""
    texts = _texts(settings)
    for entry in fields(settings):
        entry.metadata = MappingProxyType({"help": texts.get(entry.name, "")})
    for hint in get_type_hints(settings).values():
        if isinstance(hint, type) and is_dataclass(hint):
            _set_help(hint)


def one_line(box: str) -> str:
    """Return the first part of tyro's framed message as one line."""
    words: list[str] = []
    for line in _ANSI.sub("", box).splitlines():
        text = line.strip(_FRAME)
        if not text.strip(_RULE + " ") or text[0] in _RULE:
            if words:
                break
            continue
        words.extend(text.split())
    return " ".join(words)
