"""The project's folder, and the modules of the package."""

from __future__ import annotations

from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The project lies in this folder."""
PACKAGE = "pathspace_graph"
BESIDE = ("factors", "sim", "eval")
"""These folders at the root are parts of the package."""


@cache
def modules() -> dict[str, Path]:
    """Returns every module of the package by its name without the package's own."""
    files = {}
    for home in (ROOT / PACKAGE, *(ROOT / folder for folder in BESIDE)):
        for file in sorted(home.rglob("*.py")):
            parts = file.relative_to(ROOT / PACKAGE if home.name == PACKAGE else ROOT).with_suffix("").parts
            files[".".join(parts)] = file
    return files


def room_of(module: str) -> str:
    """Returns the folder that a module lies in, or the module itself where it lies at the top."""
    return module.rpartition(".")[0] or module
