"""Rules for the docstrings of the package, and for the texts below its fields and constants."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from typing import NamedTuple

import pytest

from .scenes.paths import ROOT, modules

DOTS = ("...", "…")
BLOCK = ("    ", "- ", "| ")
"""Beginnings of a line of a formula, a list or a table, which needs no full stop."""


class Text(NamedTuple):
    """A docstring, or the string below a field or a constant."""

    line: int
    text: str


def texts(tree: ast.Module) -> Iterator[Text]:
    """Yield the texts of a module."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else []:
            match statement:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    yield Text(statement.lineno, cleandoc(text))


def faults(text: str) -> Iterator[str]:
    """Yield what is wrong with a text."""
    last = text.splitlines()[-1] if text else ""
    if text.startswith(DOTS) or text.endswith(DOTS):
        yield "dots at an edge"
    elif text[:1].islower():
        yield "lower-case beginning"
    if not last.endswith((".", ".)", *DOTS)) and not last.startswith(BLOCK):
        yield "no full stop"


def offenders(file: Path) -> Iterator[str]:
    """Yield a line for each fault of a file's texts."""
    for line, text in texts(ast.parse(file.read_text())):
        for fault in faults(text):
            yield f"{file.relative_to(ROOT)}:{line}: {fault}: {text[:80]}"


def test_texts_keep_the_rules() -> None:
    found = [line for file in modules().values() for line in offenders(file)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("... and so far behind it (m).", "dots at an edge"),
        ("Distance (m) within which it may close, ...", "dots at an edge"),
        ("Stamp, s", "no full stop"),
        ("the vehicle's pose.", "lower-case beginning"),
    ],
)
def test_a_fault_is_found(text: str, fault: str) -> None:
    assert list(faults(text)) == [fault]


@pytest.mark.parametrize(
    "text",
    [
        "Stamp (s).",
        "Return the distance `n . (p - S(u))` (m,) of points (m, 2).",
        "`S(u) = sum_j beta_j(u) c_j` is a B-spline.",
        "Solve the system by one of\n\n- a dense factorization\n- a sparse one",
        "Evaluate the formula:\n\n    r = n . (p - S(u))",
    ],
)
def test_a_good_text_is_left_alone(text: str) -> None:
    assert not list(faults(text))
