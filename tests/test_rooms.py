"""The house: which room may import which, no circles, no import inside a function."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from .scenes.paths import PACKAGE, modules, room_of

ROS = {"rclpy", *(f"{name}_msgs" for name in ("geometry", "nav", "sensor", "std", "tf2", "visualization"))}
EXTRAS = {"distributed", "rerun", "rosbags", "builtin_interfaces"} | ROS
"""Optional packages, which are imported only where they are needed."""

LATE = {
    "commands.estimate": {"eval.view.recording", "commands.pictures"},
    "commands.pictures": {"eval.view.page"},
    "options.runs": {"io.parsing"},
    "brief": {"eval.figures.notebook"},
    "io.log": {"eval.figures.drawing"},
    "io.map": {"eval.figures.drawing"},
    "io.results": {"eval.figures.notebook", "frames"},
}
"""Modules that are imported by name when needed, since matplotlib is slow."""
ASKED = {"brief", "io.log", "io.map", "io.results"}
"""Modules that import from above by name where a user asks a record for its picture or its frame."""

LEAVES = {"errors", "labels", "console", "lengths", "copies", "brief"}
"""Modules that any room may import; `errors` is the only one that they import themselves."""
ESTIMATORS = {"online", "batch", "baselines"}
BELOW_MAPPING = {
    *("factors", "settings", "spline", "io", "graph", "laps", "health", "run"),
}
BELOW_ESTIMATORS = BELOW_MAPPING | {"mapping", "front_end", "places"}
BELOW_EVAL = BELOW_ESTIMATORS | ESTIMATORS | {"loop", "sim", "estimators", "plausibility", "options"}

ARROWS: dict[str, set[str]] = {
    **{leaf: set() for leaf in sorted(LEAVES)},
    "factors": set(),
    "settings": set(),
    "laps": set(),
    "spline": {"factors", "settings"},
    "io": {"spline", "factors", "settings"},
    "sim": {"factors", "io", "settings"},
    "options": {"settings", "io", "sim", "convert"},
    "convert": {"io", "factors", "settings"},
    "graph": {"factors"},
    "health": set(),
    "run": {"factors", "io", "laps", "health"},
    "mapping": BELOW_MAPPING,
    "front_end": BELOW_MAPPING | {"mapping"},
    "places": BELOW_MAPPING | {"mapping"},
    "plausibility": {"factors", "settings", "spline", "io", "health", "run", "front_end"},
    **dict.fromkeys(sorted(ESTIMATORS), BELOW_ESTIMATORS),
    "loop": BELOW_ESTIMATORS | {"batch"},  # the open lap is solved as a batch when the loop closes
    "online": BELOW_ESTIMATORS | {"loop"},
    "baselines": BELOW_ESTIMATORS | {"loop", "batch", "online"},
    "estimators": BELOW_ESTIMATORS | ESTIMATORS,
    "eval.metrics": BELOW_EVAL,
    "eval.figures": BELOW_EVAL | {"eval.metrics"},
    "eval.experiment": BELOW_EVAL | {"eval.metrics", "eval.figures"},
    "eval": BELOW_EVAL | {"eval.metrics", "eval.figures", "eval.experiment"},
    "eval.view": BELOW_MAPPING | {"eval.metrics", "eval.figures"},
    "commands": BELOW_EVAL
    | {"convert", "frames", "options"}
    | {"eval"}
    | {f"eval.{room}" for room in ("metrics", "figures", "experiment", "view")},
    "ros": BELOW_ESTIMATORS | {"convert", "online", "loop"},
    "frames": {"io"},
    "cli": {"commands", "options"},
    "__main__": {"cli"},
}
"""What each room may import, beside itself and the leaves: arrows point down only."""


@cache
def nodes(file: Path) -> list[ast.AST]:
    """Every node of a module's source, which most tests walk over."""
    return [*ast.walk(ast.parse(file.read_text()))]


def imports(module: str, file: Path) -> Iterator[tuple[str, ast.ImportFrom]]:
    """Modules of the package that one imports, by name without the package's own, and the statements."""
    for node in nodes(file):
        if not isinstance(node, ast.ImportFrom):
            continue
        if node.level:
            parts = [*module.split(".")[: -node.level], *(node.module.split(".") if node.module else [])]
        elif (node.module or "").split(".")[0] == PACKAGE:
            parts = str(node.module).split(".")[1:]
        else:
            continue
        home = ".".join(parts)
        for alias in node.names:
            inner = f"{home}.{alias.name}".strip(".")
            yield (inner if inner in modules() else home), node


def test_every_room_has_its_arrows_written_down() -> None:
    rooms = {room_of(module) for module in modules() if not module.endswith("__init__")}
    assert rooms == set(ARROWS)


@pytest.mark.parametrize("room", ARROWS)
def test_a_room_imports_only_what_lies_below_it(room: str) -> None:
    allowed = ARROWS[room] | LEAVES | {room}
    for module, file in modules().items():
        if room_of(module) == room and not module.endswith("__init__"):
            for imported, _ in imports(module, file):
                assert room_of(imported) in allowed, f"{module} imports {imported}"


def circle_of(graph: Mapping[str, set[str]]) -> list[str]:
    """Returns the nodes of a circle, the first one twice; none where there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [*error.args[1]]
    return []


def test_the_arrows_have_no_circle() -> None:
    assert circle_of(ARROWS) == []
    assert set(circle_of(ARROWS | {"factors": {"online"}})) >= {"factors", "online"}


def test_the_imports_have_no_circle() -> None:
    known = {module: {name for name, _ in imports(module, file)} for module, file in modules().items()}
    del known["__init__"]  # its imports are for type checkers; at run time names are looked up when asked for
    known = {module: names - {module} for module, names in known.items()}
    assert circle_of(known) == []
    back = {"factors.se2": {*known["factors.se2"], "online.fixed_lag"}}
    assert set(circle_of(known | back)) >= {"factors.se2", "online.fixed_lag"}


def test_no_import_hides_inside_a_function() -> None:
    for module, file in modules().items():
        for function in nodes(file):
            if isinstance(function, ast.FunctionDef):
                hidden = {name for node in ast.walk(function) for name in imported_by(node)}
                assert hidden <= EXTRAS, f"{module}: {function.name}"


def test_imports_by_name_are_declared_and_follow_the_arrows() -> None:
    found = {module: set(imports_by_name(file)) for module, file in modules().items()}
    assert {module: names for module, names in found.items() if names} == LATE
    for module, names in ((module, names) for module, names in LATE.items() if module not in ASKED):
        rooms = {room_of(name) for name in names}
        assert rooms <= ARROWS[room_of(module)] | {room_of(module)}, module


def imports_by_name(file: Path) -> Iterator[str]:
    """Modules of the package that `import_module` gets as a literal, without the package's own name."""
    for node in nodes(file):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0].value if isinstance(node.args[0], ast.Constant) else ""
            if str(name).startswith(f"{PACKAGE}."):
                yield str(name).removeprefix(f"{PACKAGE}.")


def imported_by(node: ast.AST) -> list[str]:
    """Top-level names of the packages that a statement imports."""
    if isinstance(node, ast.Import):
        return [alias.name.split(".")[0] for alias in node.names]
    return [(node.module or "").split(".")[0]] if isinstance(node, ast.ImportFrom) else []


# --- names -----------------------------------------------------------------------------------------------

TWICE = {"main"}
"""Public functions and classes that stand in two modules: each is an entry point's. No name joins them."""


def test_a_public_name_stands_once() -> None:
    homes: dict[str, set[str]] = {}
    for module, file in modules().items():
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, set()).add(module)
    assert {name for name, found in homes.items() if len(found) > 1} == TWICE


# --- owners ----------------------------------------------------------------------------------------------

VIEWS = {"values", "linearized", "poses", "calibrations", "mean"}
"""Arrays of numbers that other rooms write through views (docs/architecture.md, "Owners")."""
ASSIGNED = {
    "batch.association": {"state.pose_u"},
    "baselines.filters": {"state.pose_u"},
    "graph.smoother": {f"smoother.{part}" for part in ("prior", "inactive", "held", "calibration_prior")}
    | {"smoother.variables.first_cycle", "self.variables.first_cycle"},
    "baselines.landmarks": {"detections.landmark"},
    "baselines.landmark_graph": {"self.smoother.window.exact", "detections.landmark"}
    | {f"state.{part}" for part in ("votes", "next_number")},
    "mapping.road": {"self.smoother.attached"},
    "mapping.smoother": {"self.window.exact"},
    "ros.node": {f"marker.{part}" for part in ("scale.x", "pose.orientation.w", "color.a")}
    | {
        "position.x",
        "position.y",
        "orientation.z",
        "orientation.w",
    },  # of messages, which are filled in
}
"""Attributes that a module assigns to objects of others: no module may have another one."""


def test_what_changes_is_changed_by_its_owner() -> None:
    found: dict[str, set[str]] = {}
    for module, file in modules().items():
        for function in nodes(file):
            if isinstance(function, ast.FunctionDef):
                found.setdefault(module, set()).update(assigned_to_others(function))
    others = {
        module: {name for name in names if not VIEWS & set(name.split("."))}
        for module, names in found.items()
    }
    assert {module: names for module, names in others.items() if names} == ASSIGNED


def assigned_to_others(function: ast.FunctionDef) -> Iterator[str]:
    """Attributes, whole or in part, that a function assigns to objects that it has not made itself."""
    made = {"self", "cls"}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            made |= {
                ast.unparse(part) for target in node.targets for part in getattr(target, "elts", [target])
            }
    for node in ast.walk(function):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if not isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            continue
        for part in (part for whole in targets for part in getattr(whole, "elts", [whole])):
            attribute = stripped(part)
            own = isinstance(attribute, ast.Attribute) and ast.unparse(attribute.value) in made
            if isinstance(attribute, ast.Attribute) and not own:
                yield ast.unparse(attribute)


def stripped(target: ast.expr) -> ast.expr:
    """What is changed where a part of it is assigned: `a.b` of `a.b[i]`."""
    return stripped(target.value) if isinstance(target, ast.Subscript) else target
