"""Help of a command and completion by a shell, both from its options and their docstrings."""

import ast
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from typing import Any, Final, get_type_hints

from pathspace_graph.settings.mapper import MapperSettings

from .parse import Option, options_of

ESSENTIAL: Final = (  # settings of the estimators that `--help` explains; the others are in `--help-all`
    *("lag", "noise", "scale", "limits.range_max", "spline.degree", "spline.size_share"),
    *("motion.doubt", "sides.colourless", "batch.start", "odometry.sigma_scale"),
    *("calibration.sensor", "calibration.trust"),
)
COLUMN: Final = 38  # in which the texts begin
MOST_COLUMNS: Final = 120


def help_of(command: type[Any], program: str, *, full: bool = False) -> str:
    """Help of a command: every option if `full`, else no groups, but the essential settings."""
    options = sorted(options_of(command), key=lambda option: option.group is not None)  # its own first
    places = "".join(f"{option.flag} " for option in options if option.is_place)
    lines = [f"usage: {program} {places}[OPTIONS]", "", *wrap(_sentences(command.__doc__, full), _columns())]
    settings = get_type_hints(command).get("settings")
    groups = Counter[tuple[str, Any]]()
    for option in options:
        of_mapper = settings is MapperSettings and option.path[0] == "settings" and option.name != "settings"
        group = option.name.split(".")[0], option.group
        if full and option.group and group not in groups:
            lines += ["", f"{group[0]}: {_sentences(option.group.__doc__, full)}"]
        if full or (option.name in ESSENTIAL if of_mapper else not option.group):
            lines += [""] * (option is options[0]) + _entry(option, full)
        if option.group and (full or not of_mapper):
            groups[group] += 1
    if not full:
        lines += [""] * bool(groups)
        lines += [f"--{name}.* ({n}): {_sentences(kind.__doc__)}" for (name, kind), n in groups.items()]
        lines += ["", f"{program} --help-all explains every option."]
    return "\n".join([*lines, ""])


def _columns() -> int:
    return min(get_terminal_size((MOST_COLUMNS, 50)).columns, MOST_COLUMNS)


def _entry(option: Option, full: bool) -> list[str]:
    """Lines of an option: its default or what it takes, and its text beside it."""
    name, default = option.usage, option.entry.default
    if option.kind is bool:
        name = option.flags[bool(default)]
    elif option.is_required:
        name += "" if option.is_place else " (required)"
    elif not option.choices and default not in (None, ()):
        values = default if isinstance(default, tuple) else (default,)
        words = (f"{value:g}" if isinstance(value, float) else str(value) for value in values)
        name = " ".join([option.flag, *words])
    homes = map(_texts, option.home.__mro__)
    text = next((texts[option.entry.name] for texts in homes if option.entry.name in texts), "")
    lines = wrap(_sentences(text, full), _columns() - COLUMN) or [""]
    beside = [f"{'':<{COLUMN}}{line}" for line in lines]
    return [name + beside[0][len(name) :], *beside[1:]] if len(name) <= COLUMN - 2 else [name, *beside]


def _sentences(text: str | None, full: bool = False) -> str:
    """A text on one line; only its first sentence unless `full`."""
    line = " ".join(str(text).split())
    return line if full else line.split(". ", 1)[0].removesuffix(".")


@cache
def _tree(file: str) -> ast.Module:
    return ast.parse(Path(file).read_text(encoding="utf-8"))


@cache
def _texts(kind: type[Any]) -> dict[str, str]:
    """Text below each field of a class, as its source has it."""
    file = getattr(sys.modules[kind.__module__], "__file__", None)
    classes = [node for node in _tree(file).body if isinstance(node, ast.ClassDef)] if file else []
    body = next((node.body for node in classes if node.name == kind.__name__), [])
    return {
        entry.target.id: " ".join(str(text.value.value).split())
        for entry, text in pairwise(body)
        if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


# --- completion ------------------------------------------------------------------------------------------

_COMPLETION: Final = """\
[ -n "$ZSH_VERSION" ] && autoload -U +X bashcompinit && bashcompinit
_pathspace_graph() {{
  local words
  case "$COMP_CWORD:${{COMP_WORDS[1]}}:${{COMP_WORDS[COMP_CWORD-1]}}" in
    1:*) words="{commands}" ;;
{cases}
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _pathspace_graph {program}"""


def completion(program: str, commands: Mapping[str, type[Any]], common: Iterable[str]) -> str:
    """A script for bash and zsh that completes commands, options, known values and names of files."""
    cases = []
    for name, command in commands.items():
        options = [*options_of(command)]
        for option in options:
            if words := option.choices or option.entry.metadata.get("words", ()):
                before = name if option.is_place else option.flag
                cases.append(f'    *:{name}:{before}) words="{" ".join(words)}" ;;')
        flags = [flag for option in options if not option.is_place for flag in option.flags]
        cases.append(f'    *:{name}:*) words="{" ".join((*flags, "--help", "--help-all", *common))}" ;;')
    return _COMPLETION.format(commands=" ".join(commands), cases="\n".join(cases), program=program)
