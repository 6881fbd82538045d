"""Builds the API pages from the docstrings into `build/api`, or into the folder that is given.

    python -W error docs/api.py [FOLDER]

`-W error` turns every warning into a failure: a module that can't be imported, a type that can't be resolved.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from pkgutil import iter_modules

import pdoc

import pathspace_graph

ROOT = Path(__file__).resolve().parents[1]


def modules() -> list[str]:
    """Returns the package, its rooms, whose modules pdoc finds, and its top modules.

    pdoc doesn't look for them itself, since the package has an `__all__` of other names.
    """
    rooms = [module.name for module in iter_modules(pathspace_graph.__path__) if module.name != "__main__"]
    return ["pathspace_graph", *(f"pathspace_graph.{name}" for name in rooms)]


def main(folder: Path = ROOT / "build" / "api") -> None:
    """Writes a page for each module; the first page is `index.html`."""
    # pdoc reads a module's namespace, where names that are imported on first use are missing until then
    vars(pathspace_graph).update({name: getattr(pathspace_graph, name) for name in pathspace_graph.__all__})
    # pdoc resolves the types of inherited fields in the module of the heir, where they need not be known
    warnings.filterwarnings("ignore", r"Error parsing type annotation .* for .*\.__init__\.")
    pdoc.render.configure(docformat="markdown", math=True)
    pdoc.pdoc(*modules(), output_directory=folder)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
