"""What made a result: the sources that it depends on, and the libraries, the commit and the machine."""

import ast
import json
import os
import platform
import sys
from functools import cache
from hashlib import sha256
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from pathspace_graph import estimators as registry
from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.results import commit_of, machine, now

HOUSE: Final = __name__.partition(".")[0]
MEASURED: Final = (  # modules on which every result depends, whatever the estimator is
    *("run", "sim.simulate", "sim.track_generator", "plausibility.diagnosis"),
    "eval.metrics.measures",
)
NUMERICS: Final = {name: version(name) for name in ("gtsam", "numpy", "scipy")}
Code = dict[str, str]  # digest of each source by its module, and version of each library by its name


def identity(**parts: Any) -> str:
    """Return a text that is the same for the same values, which are JSON's types only."""
    return sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:20]


def code_of(estimator: str) -> Code:
    """Return what a result of an estimator depends on: its sources, those of the metrics, libraries."""
    return code_from(registry.module_of(estimator))


def code_from(module: str) -> Code:
    """Return what a result of what is in a module depends on."""
    return _code((module, *(f"{HOUSE}.{one}" for one in MEASURED)))


@cache
def _code(roots: tuple[str, ...]) -> Code:
    """Return the code of modules and of all that they import; it is that of this process, which has read it.

    Of what is installed, the version stands for the sources, except in the packages of the roots: an editable
    package has no version that changes with it. The standard library doesn't count.
    """
    for root in roots:
        if _spec(root) is None:  # a class of a notebook, or of the program itself
            raise SettingsError(f"estimators: expected one of a module with sources, found {root}")
    own, found, libraries = {root.partition(".")[0] for root in roots}, Code(), set[str]()
    remaining = [(root, HOUSE) for root in roots]
    while remaining:
        name, importer = remaining.pop()
        package, spec = name.partition(".")[0], None if name in found else _spec(name)
        if spec is None or spec.origin is None:
            continue  # known already, an optional package that is not here, or a folder without sources
        if package not in own and {"site-packages", "dist-packages"} & set(Path(spec.origin).parts):
            libraries |= {package} - ({package} if importer == HOUSE else set())
            continue
        found[name] = _digest(Path(spec.origin))
        remaining += [(imported, package) for imported in _imports(name)]
    known = packages_distributions() if libraries else {}
    used = {distribution for library in libraries for distribution in known.get(library, [])}
    return dict(sorted(found.items())) | NUMERICS | {name: version(name) for name in sorted(used)}


@cache
def _spec(name: str) -> ModuleSpec | None:
    """Return where a module is; None where it is none, is not here, or is of the standard library."""
    if name.partition(".")[0] in sys.stdlib_module_names:
        return None
    try:
        return find_spec(name)
    except (ImportError, ValueError):  # something else than a module, in a module or in a program
        return None


def _digest(file: Path) -> str:
    """Return the digest of a source; for a compiled module it is that of its sources, if they are here."""
    compiled = file.name.endswith(tuple(EXTENSION_SUFFIXES))
    files = sorted(file.parent.rglob("*.[ch]pp")) if compiled else []
    return sha256(b"".join(one.read_bytes() for one in files or [file])).hexdigest()[:12]


@cache
def _imports(name: str) -> tuple[str, ...]:
    """Return the modules that a module imports anywhere in it, and the package that it lies in.

    Our own package runs nothing in its root that a module in it needs.
    """
    spec, parents = _spec(name), name.split(".")[:-1]
    found = [".".join(parents)] if parents and parents[0] != HOUSE else []
    if spec is None or not str(spec.origin).endswith(".py"):
        return tuple(found)
    package = name.split(".") if spec.submodule_search_locations is not None else parents
    for node in ast.walk(ast.parse(Path(str(spec.origin)).read_bytes())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *filter(None, [node.module])])
            of_base = _spec(base)
            is_package = of_base is not None and of_base.submodule_search_locations is not None
            inner = [f"{base}.{alias.name}" for alias in node.names] if is_package else []
            modules = [one for one in inner if _spec(one) is not None]
            found += [base] * (len(modules) < len(node.names)) + modules  # the one that has the other names
    return tuple(dict.fromkeys(found))


def check_code(module: str, expected: Code, began: str) -> None:
    """Raise a SettingsError that names both unless this process has the code with which a study began."""
    found = code_from(module)
    if found == expected:
        return
    name = next(name for name in [*expected, *found] if expected.get(name) != found.get(name))
    own, other = (code.get(name, "missing") for code in (found, expected))
    raise SettingsError(
        f"{module}: expected the code of {began}, where the study began, "
        f"with {name} {other}, found {name} {own} on {here()}"
    )


def here() -> str:
    return f"{platform.node()} (process {os.getpid()})"


# --- where and when ----------------------------------------------------------------------------------------


def origin_of(module: str) -> dict[str, Any]:
    """Return where and when a result of what is in a module is made, and with which libraries."""
    packages = {HOUSE, module.partition(".")[0]}
    specs = {name: _spec(name) for name in sorted(packages)}
    folders = {name: Path(spec.origin).parent for name, spec in specs.items() if spec and spec.origin}
    commits = {name: commit for name, folder in folders.items() if (commit := commit_of(folder))}
    return {
        **versions(),
        "commit": " ".join(commits.values() if len(packages) == 1 else map(" ".join, commits.items())),
        **machine(),
        "date": now(),
    }
