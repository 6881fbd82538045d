"""The options of a command, made from its dataclass, and what is wrong with them in one line."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stderr
from dataclasses import fields, is_dataclass
from types import MappingProxyType
from typing import Any, Final, get_type_hints

import docstring_parser
import tyro

from pathspace_graph.errors import SettingsError
from pathspace_graph.io.limits import MAX_INTEGER, shown

_HELP: Final = ("-h", "--help")
_ANSI: Final = re.compile(r"\x1b\[[0-9;]*m")
_FRAME: Final = " │\t"
_RULE: Final = "─╭╮╰╯"


def parse(command: type[Any], program: str, arguments: list[str]) -> Any:
    """Returns the command, made from its options, or None where its help was asked for and printed.

    A command whose defaults depend on its options gives them in `start`. Bad usage is a SettingsError.
    """
    start = getattr(command, "start", None)
    for word in arguments:
        if word.lstrip("+-").isdecimal() and len(word) > len(str(MAX_INTEGER)) + 1:
            raise SettingsError(f"{program}: expected whole numbers up to {MAX_INTEGER}, found {shown(word)}")
    if not set(_HELP).isdisjoint(arguments):
        _set_help(command)
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(
                command, prog=program, args=arguments, default=start(arguments) if start else None
            )
    except SystemExit as end:
        if not end.code:
            return None
    raise SettingsError(f"{one_line(complaint.getvalue())} (see {program} --help)")


def _set_help(settings: type[Any]) -> None:
    """Gives tyro the text of each field as one paragraph; it would break lines where the source does."""
    texts = {
        text.arg_name: text.description or ""
        for home in reversed(settings.__mro__)
        if is_dataclass(home)
        for text in docstring_parser.parse_from_object(home).params
    }
    for entry in fields(settings):
        entry.metadata = MappingProxyType({"help": " ".join(texts.get(entry.name, "").split())})
    for hint in get_type_hints(settings).values():
        if isinstance(hint, type) and is_dataclass(hint):
            _set_help(hint)


def one_line(box: str) -> str:
    """Returns the first part of tyro's framed message as one line."""
    words: list[str] = []
    for line in _ANSI.sub("", box).splitlines():
        text = line.strip(_FRAME)
        if not text.strip(_RULE + " ") or text[0] in _RULE:
            if words:
                break
            continue
        words.extend(text.split())
    return " ".join(words)
