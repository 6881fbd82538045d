"""The options of a command from its dataclass, and what is wrong with them in one line."""

from __future__ import annotations

import io
import re
from contextlib import redirect_stderr
from typing import Any, Final

import tyro

from pathspace_graph.errors import SettingsError

_ANSI: Final = re.compile(r"\x1b\[[0-9;]*m")
_FRAME: Final = " │\t"
_RULE: Final = "─╭╮╰╯"


def parse(command: type[Any], program: str, arguments: list[str]) -> Any:
    """The command, made from its options; None where it was asked for help, which is printed by then.

    SettingsError on bad usage.
    """
    complaint = io.StringIO()
    try:
        with redirect_stderr(complaint):
            return tyro.cli(command, prog=program, args=arguments)
    except SystemExit as end:
        if not end.code:
            return None
    raise SettingsError(f"{one_line(complaint.getvalue())} (see {program} --help)")


def one_line(box: str) -> str:
    """What the first part of tyro's framed message says, on one line."""
    words: list[str] = []
    for line in _ANSI.sub("", box).splitlines():
        text = line.strip(_FRAME)
        if not text.strip(_RULE + " ") or text[0] in _RULE:
            if words:
                break
            continue
        words.extend(text.split())
    return " ".join(words)
