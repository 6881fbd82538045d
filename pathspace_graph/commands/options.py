"""The options of a command, made from its dataclass, their help, and what is wrong with them in one line."""

import io
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import redirect_stderr
from dataclasses import MISSING as NO_DEFAULT
from dataclasses import fields, is_dataclass
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple, get_args, get_origin, get_type_hints

import docstring_parser
import tyro

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.overrides import leaves, read_settings
from pathspace_graph.io.parsing import MAX_INTEGER, shown
from pathspace_graph.settings.mapper import MapperSettings

HELP: Final = ("-h", "--help")
HELP_ALL: Final = "--help-all"
SETTINGS: Final = "--settings"
SETTINGS_TEXT: Final = (
    "TOML file of settings, or the summary.json of a run; options on the command line override it."
)
ESSENTIAL: Final = (  # settings of the estimators that `--help` explains; the others are in `--help-all`
    *("lag", "noise", "scale", "limits.range_max", "spline.degree", "spline.size_share"),
    *("motion.doubt", "sides.colourless", "batch.start", "odometry.sigma_scale"),
    *("calibration.sensor", "calibration.trust"),
)
COLUMN: Final = 38  # column of the short help in which the texts begin
MOST_COLUMNS: Final = 120
REQUIRED: Final = " (required)"

_ANSI: Final = re.compile(r"\x1b\[[0-9;]*m")
_FRAME: Final = " │\t"
_RULE: Final = "─╭╮╰╯"
_VALUE: Final = re.compile(r"(?:Error parsing|for argument|Missing value) '?(?:for argument ')?(--[\w.-]+)")
_KINDS: Final = {int: "a whole number", float: "a number", Path: "a path", str: "a text", bool: "a flag"}
_SIMILAR: Final = re.compile(r"(?:Perhaps you meant|Arguments similar to).*\n\W*(--\S+)")


def parse(command: type[Any], program: str, arguments: list[str]) -> Any:
    """Return the command, made from its options, or None after its help; SettingsError for bad usage."""
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
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(command, prog=program, args=arguments, default=default)
    except SystemExit as end:
        if not end.code:
            if _estimates(command):
                sys.stdout.write(f"\n{SETTINGS} FILE\n    {SETTINGS_TEXT}\n")
            return None
    near, wrong = _SIMILAR.findall(_ANSI.sub("", complaint.getvalue())), one_line(complaint.getvalue())
    if wrong.startswith("Missing from"):
        required = [option for option in _options(command) if option.default is NO_DEFAULT]
        missing = [one for one in required if (one.text if one.is_place else f"{one.flag} ") in wrong]
        names = " and ".join(one.shown.removesuffix(REQUIRED) for one in missing)
        wrong = f"{program.rsplit(maxsplit=1)[-1]}: expected {names}, found none"
    wrong = _in_words(wrong, command, arguments)
    nearest = f", the nearest is {', '.join(near)}" if near else ""
    raise SettingsError(f"{wrong}{nearest} (see {program} --help)")


def _in_words(wrong: str, command: type[Any], arguments: list[str]) -> str:
    """Return what is wrong with the value of an option in our words, and any other complaint as it is."""
    named = _VALUE.search(wrong)
    option = next((one for one in _options(command) if named and one.flag == named[1]), None)
    if option is None:
        return wrong
    words = [part for word in arguments for part in word.split("=", word.startswith("--"))]
    flags = [word.replace("_", "-") if word.startswith("--") else "" for word in words]
    at = len(flags) - flags[::-1].index(option.flag)
    end = next((k for k, flag in enumerate(flags[at:], at) if flag), len(words))
    found = " ".join(words[at:end])
    return f"{option.flag}: expected {option.expected}, found {shown(found) if found else 'none'}"


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
    required = {option.name: tyro.MISSING for option in _options(command) if option.default is NO_DEFAULT}
    return command(**required, settings=read_settings(Path(given[0]), MapperSettings())), before + after


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
    cases = []
    for name, command in commands.items():
        options = [option.flag for option in _options(command) if not option.is_place]
        words = " ".join((*options, *[SETTINGS] * _estimates(command), "--help", HELP_ALL, *common))
        cases.append(f'    *:{name}) words="{words}" ;;')
    return _COMPLETION.format(commands=" ".join(commands), cases="\n".join(cases), program=program)


# --- help ------------------------------------------------------------------------------------------------


class Option(NamedTuple):
    """An option of a command, as tyro makes it of a field."""

    name: str  # dotted, or that of a place
    group: tuple[str, str]  # name and text of the group; two empty ones for an option of the command itself
    text: str
    hint: Any
    default: Any
    is_place: bool

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    @property
    def expected(self) -> str:
        """Return in words what the option takes."""
        if words := self.words:
            return f"one of {', '.join(sorted(words))}"
        inner = [kind for one in (self.hint, *get_args(self.hint)) for kind in (one, *get_args(one))]
        many = next((get_args(one) for one in inner if get_origin(one) is tuple), (self.hint,))
        name = next((name for kind, name in _KINDS.items() if kind in inner), "a value")
        if len(many) == 1 or Ellipsis in many:
            return name
        return f"{len(many)} {name.split(maxsplit=1)[1]}s"

    @property
    def words(self) -> list[str]:
        """Return the words between which the option chooses, if it does."""
        inner = [self.hint, *get_args(self.hint)]
        return list(dict.fromkeys(word for one in inner for word in get_args(one) if isinstance(word, str)))

    @property
    def shown(self) -> str:
        """Return the option with its default, the first of several words, or with what it takes."""
        if self.is_place:
            return self.name.upper()
        value, inner = self.default, [self.hint, *get_args(self.hint)]
        if self.hint is bool:
            return f"--{'.no-'.join(self.flag[2:].rsplit('.', 1))}" if value else self.flag
        if words := self.words:
            return f"{self.flag} {'|'.join(sorted(words, key=lambda word: word != value))}"
        if value not in (None, NO_DEFAULT, ()):
            return f"{self.flag} {value}"
        takes = "PATH" if Path in inner else "TEXT" if str in inner else "NUMBER"
        return f"{self.flag} {takes}{REQUIRED if value is NO_DEFAULT else ''}"


def _options(
    kind: type[Any], values: Any = None, prefix: str = "", group: tuple[str, str] = ("", "")
) -> Iterator[Option]:
    """Yield the options of a command, or of settings in it with these values."""
    hints, texts = get_type_hints(kind, include_extras=True), _texts(kind)
    for entry in fields(kind):
        hint, name = hints[entry.name], entry.name
        if get_origin(hint) is Annotated:
            hint, *marks = get_args(hint)
            name = next((mark.name for mark in marks if isinstance(getattr(mark, "name", None), str)), name)
        text = _first_sentence(texts.get(entry.name, ""))
        value = getattr(values, entry.name, entry.default)
        if isinstance(hint, type) and is_dataclass(hint):
            inside = hint() if values is None else value
            own = group if group[0] or not name else (name, text)
            yield from _options(hint, inside, f"{prefix}{name}." if name else prefix, own)
        else:
            yield Option(prefix + name, group, text, hint, value, "Positional" in str(entry.type))


def short_help(command: type[Any], program: str) -> str:
    """Return a command's options and essential settings with defaults, and a line for each other group."""
    options = {option.name: option for option in _options(command)}
    settings = leaves(MapperSettings()) if _estimates(command) else {}
    others = [option for name, option in options.items() if name not in settings]
    entries = [(option.shown, option.text) for option in others if not option.group[0]]
    if settings:
        entries.append((f"{SETTINGS} FILE", SETTINGS_TEXT))
        entries += [(options[name].shown, options[name].text) for name in ESSENTIAL]
    width = min(get_terminal_size((MOST_COLUMNS, 50)).columns, MOST_COLUMNS) - COLUMN
    places = [f"{name} " for name, _ in entries if not name.startswith("--")]
    lines = [f"usage: {program} {''.join(places)}[OPTIONS]", "", _first_sentence(_description(command)), ""]
    for name, text in entries:
        texts = [f"{'':<{COLUMN}}{line}" for line in wrap(text, width) or [""]]
        beside = len(name) <= COLUMN - 2
        lines += [name + texts[0][len(name) :], *texts[1:]] if beside else [name, *texts]
    groups = Counter(option.group for option in others if option.group[0])
    lines += [""] * bool(groups)
    lines += [f"--{name}.* ({count}): {text}" for (name, text), count in groups.items()]
    return "\n".join([*lines, "", f"{program} {HELP_ALL} explains every option.", ""])


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
    """Return the first part of tyro's framed message as one line; without UTF-8 the frame is of hyphens."""
    lines = [line.strip(_FRAME) for line in _ANSI.sub("", box).splitlines()]
    rules = [k for k, line in enumerate(lines) if line[:1] in (*_RULE,) or (line and not line.strip("-"))]
    begin, end = [*rules, len(lines)][:2] if rules else (-1, len(lines))
    return " ".join(" ".join(lines[begin + 1 : end]).split())
