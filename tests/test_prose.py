"""The prose: docstrings, and the texts of fields and constants, are whole sentences.

A field's text is the string below it. Those of settings are the command line's help.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from typing import Literal

import pytest

from .scenes.paths import ROOT, modules

DOTS = ("...", "…")
BEGINS_WELL = re.compile(r"[A-Z0-9`'\"(\[{|<=~+\-\u0370-\u03ff\u2200-\u22ff]")
"""A text begins with an upper-case letter, a digit, a quote, a bracket or a symbol of a formula."""
BLOCK = re.compile(r" {4}|- |\| ")
"""A line that begins so belongs to a formula, a list or a table, which needs no full stop."""
FRAGMENT = re.compile(r"The same |(Of|Where|As) [^,]*$")
"""The text of a field or a class that reads so is neither a sentence nor a noun phrase."""
VERB = re.compile(r"[A-Z][a-z]+\b")
"""A function's docstring begins with a verb: imperative in new ones, in the third person in older ones."""

Kind = Literal["module", "class", "function", "field"]
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Text:
    """A docstring, or the text of a field or a constant."""

    line: int
    kind: Kind
    text: str


def texts(tree: ast.Module) -> Iterator[Text]:
    """Yields every text of a module with the line that it begins on."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for before, statement in zip([None, *body], body, strict=False):
            kind = kind_of(node, before)
            if kind and isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                yield Text(statement.lineno, kind, cleandoc(str(statement.value.value)))


def kind_of(parent: ast.AST, before: ast.AST | None) -> Kind | None:
    """Returns what a string says something about; None where it is no text at all."""
    if isinstance(before, ast.Assign | ast.AnnAssign):
        return "field"
    if before is not None:
        return None
    if isinstance(parent, ast.Module):
        return "module"
    if isinstance(parent, Function):
        return "function" if parent.name != "__init__" else "class"
    return "class" if isinstance(parent, ast.ClassDef) else None


def faults(text: Text) -> Iterator[str]:
    """Yields what is wrong with a text."""
    last = text.text.splitlines()[-1] if text.text else ""
    if text.text.startswith(DOTS):
        yield "begins with dots"
    elif not BEGINS_WELL.match(text.text):
        yield "does not begin with an upper-case letter"
    elif text.kind in ("field", "class") and FRAGMENT.match(text.text):
        yield "is a fragment without a verb"
    elif text.kind == "function" and not VERB.match(text.text):
        yield "does not begin with a verb"
    if text.text.endswith(DOTS):
        yield "ends with dots"
    elif not last.endswith((".", ".)")) and not BLOCK.match(last):
        yield "does not end with a full stop"


def offenders(file: Path) -> Iterator[str]:
    """Yields a line for each fault of a file's texts."""
    for text in texts(ast.parse(file.read_text())):
        for fault in faults(text):
            yield f"{file.relative_to(ROOT)}:{text.line}: {fault}: {text.text.splitlines()[0][:80]}"


def test_docstrings_and_texts_of_fields_are_whole_sentences() -> None:
    found = [line for file in modules().values() for line in offenders(file)]
    assert not found, f"{len(found)} texts break the rules of the prose:\n" + "\n".join(found)


@pytest.mark.parametrize(
    ("kind", "text", "fault"),
    [
        ("field", "... and so far behind it (m).", "begins with dots"),
        ("field", "Distance (m) within which it may close, ...", "ends with dots"),
        ("field", "Stamp, s", "full stop"),
        ("class", "the vehicle's pose.", "upper-case"),
        ("class", "Of a sensor.", "fragment"),
        ("function", "the pose at a stamp.", "upper-case"),
    ],
)
def test_a_riddle_is_found(kind: Kind, text: str, fault: str) -> None:
    assert any(fault in found for found in faults(Text(1, kind, text)))


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("field", "Poses stay in the window for this time (s)."),
        ("function", "Returns the distance `n . (p - S(u))` (m,) of points (m, 2)."),
        ("module", "`S(u) = sum_j beta_j(u) c_j` is a B-spline."),
        ("class", "Solves the system by one of\n\n- a dense factorization\n- a sparse one"),
        ("function", "Evaluates the formula:\n\n    r = n . (p - S(u))"),
    ],
)
def test_a_sentence_is_left_alone(kind: Kind, text: str) -> None:
    assert not list(faults(Text(1, kind, text)))
