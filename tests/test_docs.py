"""The pages: their links lead somewhere, the code that they name exists, and their examples run."""

from __future__ import annotations

import ast
import csv
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import cache, partial
from importlib import import_module
from itertools import chain, takewhile
from operator import attrgetter
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import gtsam
import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, Log
from pathspace_graph.cli import COMMANDS, main, parse
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log_files import write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.results import write_result
from pathspace_graph.io.tables import read_trajectory
from pathspace_graph.labels import NAMES
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.checked import leaves
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from .scenes.drives import beginning
from .scenes.paths import ROOT, modules
from .test_prose import texts
from .test_rooms import ARROWS, LEAVES

PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
TUTORIAL = ROOT / "docs" / "tutorial.md"
PACKAGE = "pathspace_graph"

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), flags=re.DOTALL | re.MULTILINE)


def prose(page: Path) -> str:
    """The page without its code blocks."""
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.DOTALL | re.MULTILINE)


def file_blocks(page: Path) -> dict[str, str]:
    """The code blocks that begin with a comment that names their file, by that name."""
    named = re.findall(r"^```\w+\n# (\S+\.\w+)\n(.*?)^```", text_of(page), flags=re.DOTALL | re.MULTILINE)
    return dict(named)


# --- links -----------------------------------------------------------------------------------------------


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@every_page
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" not in target:
            file, _, anchor = target.partition("#")
            linked = (page.parent / file).resolve() if file else page
            assert linked.exists(), target
            assert linked.is_relative_to(ROOT), target
            assert not anchor or anchor in anchors(linked), target


# --- code that is named ----------------------------------------------------------------------------------

NAMED = re.compile(r"`([a-z_]+(?:\.[a-z_]+)*):([A-Za-z_]\w*(?:\.\w+)*)`")
"""`module.path:Name.member`, without the package's own name."""
FILE = re.compile(r"`((?!\.venv|\w+_msgs/)\.?[a-z_][\w/.-]*/[\w-]*(?:\.(?:py|md))?|\w+\.(?:py|md))`")
"""`folder/file.py` or `folder/`, below the root or below the package; other suffixes are of data, and
types of ROS are no files."""
OUTSIDE = {
    "map.json",
    "build/api",
    "cells/",
    "figures/",
    "captions.md",
    "table.md",
    "summary.md",
    "pacsim/",
    "fssim/",
    "eufs/",
}
"""Files and folders that commands write, and folders of track files."""


def has(owner: Any, name: str) -> bool:
    """Whether a module or class has a name; fields count, and what the methods of a class set."""
    if hasattr(owner, name) or not inspect.isclass(owner):
        return hasattr(owner, name)
    declared = {field.name for field in fields(owner)} if is_dataclass(owner) else set()
    return name in declared or f"self.{name}" in inspect.getsource(owner)


def exists(module: str, path: str) -> bool:
    """Whether `path`, a name or a name and its member, is in a module of the package."""
    try:
        home = import_module(f"{PACKAGE}.{module}")
    except ModuleNotFoundError:
        return False
    name, _, member = path.partition(".")
    return has(home, name) and (not member or has(getattr(home, name), member))


@every_page
def test_named_code_exists(page: Path) -> None:
    named = NAMED.findall(prose(page))
    assert [f"{module}:{path}" for module, path in named if not exists(module, path)] == []


@every_page
def test_named_files_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":
        return
    homes = (ROOT, ROOT / PACKAGE, page.parent)
    named = set(FILE.findall(prose(page))) - OUTSIDE
    assert [name for name in named if not any((home / name).exists() for home in homes)] == []


@every_page
def test_named_commands_are_accepted(page: Path) -> None:
    """Every command of a shell block has only options that there are."""
    for line in "\n".join(blocks(page, "sh")).replace("\\\n", " ").splitlines():
        command = re.search(r"(?:^|/|\s)pathspace-graph (\S.*)$", line)
        if command is not None:
            name, *arguments = re.sub(r"\s+#.*", "", command[1]).split()
            assert name in COMMANDS, line
            assert parse([name, *arguments]) is not None, line


REFERENCE = re.compile(r"`([a-z_]+(?:\.\w+)+)`")
"""A dotted name in the text of a module: another module, something in one, a setting, or a file."""
SUFFIXES = {"csv", "json", "toml", "md", "tum"}
"""Files of data have these."""


def is_found(reference: str, beside: str) -> bool:
    """Whether a dotted name is a module or in one, from the package on or from the package `beside`."""
    for path in (f"{beside}.{reference}".split("."), reference.split(".")):
        for length in range(len(path), 0, -1):
            module, name = ".".join(path[:length]), ".".join(path[length:])
            if module in modules():
                return not name or exists(module, name)
    return False


def test_references_in_docstrings_exist() -> None:
    """`room.module.name`, and `module.name` of a module beside the one that says it."""
    settings = set(leaves(MapperSettings()))
    broken = []
    for module, file in modules().items():
        heads = {other.stem for other in file.parent.glob("*.py")} | {
            name.partition(".")[0] for name in ARROWS
        }
        for text in texts(ast.parse(file.read_text())):
            for reference in REFERENCE.findall(text.text):
                head, _, last = reference.partition(".")
                if head not in heads - {"settings"} or reference in settings or last in SUFFIXES:
                    continue
                found = (file.parent / reference).exists() or is_found(reference, module.rpartition(".")[0])
                broken += [] if found else [f"{module}: {reference}"]
    assert broken == []


# --- blocks of Python ------------------------------------------------------------------------------------


@every_page
def test_lines_that_include_a_file_are_as_the_site_reads_them(page: Path) -> None:
    included = re.findall(r"^.*\b8 ?<.*$", text_of(page), flags=re.MULTILINE)
    assert [line for line in included if not re.fullmatch(r'--8<-- "examples/[\w/]+\.(py|toml)"', line)] == []


@every_page
def test_python_blocks_import_what_exists(page: Path) -> None:
    nodes = [node for block in blocks(page, "python") for node in ast.walk(ast.parse(block))]
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    named = [(str(node.module), alias.name) for node in froms for alias in node.names]
    own = [(module, name) for module, name in named if module.partition(".")[0] == PACKAGE]
    assert [(module, name) for module, name in own if not hasattr(import_module(module), name)] == []


@cache
def eight_seconds() -> Log:
    """The beginning of a drive on a generated track."""
    drive = simulate(generate_track(np.random.default_rng(0)), SimulationSettings(laps=1), seed=0)
    first = beginning(drive, 80)
    return replace(first, odometry=drive.odometry.between(0.0, first.cycles[-1].t))


@pytest.fixture(scope="module")
def log() -> Log:
    return eight_seconds()


def test_the_graph_is_asked_as_the_page_on_python_does(log: Log) -> None:
    mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    for odometry, detections in split_odometry(log):
        mapper.update(odometry, detections)
    *_, block = blocks(ROOT / "docs" / "python.md", "python")
    make, show, *asks = ast.parse(block).body
    names: dict[str, Any] = {"mapper": mapper, "gtsam": gtsam}
    exec(compile(ast.Module([make, show], []), "python.md", "exec"), names)
    assert names["graph"].size() > 0 and set(names["graph"].keyVector()) == set(names["values"].keys())
    own, in_map = (eval(ast.unparse(ask), names) for ask in asks)
    turn = np.eye(3)
    turn[:2, :2] = rotation(mapper.poses[-1, 2])
    np.testing.assert_allclose(turn @ own @ turn.T, in_map, rtol=0.02, atol=1e-3 * np.abs(in_map).max())


def test_the_bridge_of_the_page_on_ros_maps_json_lines(log: Log) -> None:
    bridge = (ROOT / "examples" / "ros2_bridge" / "mapper.py").read_text()
    lines = [
        (float(t), "twist", twist.tolist()) for t, twist in zip(*vars(log.odometry).values(), strict=True)
    ]
    for cycle in log.cycles[:30]:
        rows = zip(*cycle.points_vehicle.T.tolist(), (NAMES[label] for label in cycle.labels), strict=True)
        lines.append((cycle.t, "detections", [{"x": x, "y": y, "label": label} for x, y, label in rows]))
    lines.sort(key=lambda line: line[0])
    text = "".join(json.dumps({"t": t, kind: content}) + "\n" for t, kind, content in lines)
    command = [sys.executable, "-c", bridge]
    run = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    assert run.stderr == ""
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    assert [answer["t"] for answer in answers] == [cycle.t for cycle in log.cycles[:30]]
    assert answers[-1]["pose"][0] > 1.0


# --- the page on the architecture ------------------------------------------------------------------------

ARCHITECTURE = ROOT / "docs" / "architecture.md"


def table_below(page: Path, heading: str) -> list[list[str]]:
    """The cells of the first table below a heading, row by row, without its header."""
    text = text_of(page)
    lines = text[text.index(f"\n## {heading}\n") :].splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("| "))
    rows = takewhile(lambda line: line.startswith("|"), lines[first + 2 :])
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in rows]


def code_of(module: str, path: str) -> CodeType:
    """The code of a function, or of a method, which may be inherited."""
    function = attrgetter(path)(import_module(f"{PACKAGE}.{module}"))
    return inspect.unwrap(getattr(function, "__func__", function)).__code__


def first_calls(update: Callable[[], object], wanted: Mapping[CodeType, str]) -> list[str]:
    """The wanted functions that are called in an update, by the order of their first calls."""
    called = dict[str, None]()

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code in wanted:
            called.setdefault(wanted[frame.f_code])

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        update()
    finally:
        sys.setprofile(before)
    return [*called]


def test_a_cycle_has_the_stages_of_the_architecture_page(log: Log) -> None:
    """In the order of the page, in one and the same cycle."""
    path = [str(cells[-1]).strip("`") for cells in table_below(ARCHITECTURE, "One cycle")]
    assert len(path) == 10
    wanted = {code_of(*name.split(":")): name for name in path}
    mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    paths = [first_calls(partial(mapper.update, *cycle), wanted) for cycle in split_odometry(log)]
    assert path in paths, max(paths, key=len)


def named_rooms(cell: str) -> list[str]:
    return re.findall(r"`([a-z_.]+)`", cell)


def test_the_architecture_page_has_the_rooms_and_what_they_may_import() -> None:
    """As `test_rooms` has it: a room imports from rooms above it, or before it in its row."""
    above: list[str] = []
    for rooms, _, imports in table_below(ARCHITECTURE, "Rooms"):
        only, _, but = imports.partition(" but ")
        allowed = {*above} - {*named_rooms(but)} if "all above" in only else {*named_rooms(only)}
        row = named_rooms(rooms)
        for place, room in enumerate(row):
            assert ARROWS[room] <= allowed | {*row[:place]}, room
            assert imports.startswith("some of") or ARROWS[room] == allowed, room
        above += row
    assert set(above) == set(ARROWS) - LEAVES - {"cli", "__main__"}


# --- figures ---------------------------------------------------------------------------------------------


@pytest.fixture
def hooks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The hook that shows figures on the pages of the site."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    return import_module("hooks")


def test_every_table_is_on_a_page_and_says_what_made_it(hooks: Any) -> None:
    pages = "".join(map(text_of, PAGES))
    for file in hooks.FIGURES.iterdir():
        assert f"](figures/{file.name})\n" in pages, file.name
        for row in hooks.read(file.name):
            assert row["commit"] and row["machine"] and re.fullmatch(r"20\d\d-\d\d-\d\d", row["date"])
            assert re.match(r"pathspace-graph (report|ablate)\b(?!.*--quick)", row["command"])


def test_a_line_that_links_figures_becomes_their_table(
    hooks: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hooks, "FIGURES", tmp_path)
    rows = ("a,x,1.0,0.1,abc,m,d", "a,y,,,abc,m,d", "b,x,2.0,,abc,m,d", "b,y,3,,abc,m,d")
    (tmp_path / "one.csv").write_text("\n".join(["of,column,value,half_width,commit,machine,date", *rows]))
    page = hooks.on_page_markdown("[all](figures/)\n\n[One](figures/one.csv)\n\nsee [it](figures/one.csv)\n")
    assert page.splitlines() == [
        "*Measured d at abc (machine: m).*",
        "",
        "| of | x | y |",
        "| :--- | ---: | ---: |",
        "| a | 1.0&nbsp;±&nbsp;0.1 |  |",
        "| b | 2.0 | 3 |",
        "",
        "*[One](figures/one.csv)*",
        "",
        "see [it](figures/one.csv)",
    ]


def test_the_figures_of_the_readme_are_those_of_the_files(hooks: Any) -> None:
    """Figures with an interval, in their order, and the ranges over five real drives."""

    def row_of(file: str, label: str) -> dict[str, str]:
        rows = hooks.read(f"{file}.csv")
        return {row["column"]: hooks.figure(row) for row in rows if next(iter(row.values())) == label}

    ours, theirs = (row_of("accuracy_estimators", name) for name in ("fixed-lag", "landmark-fixed-lag"))
    compared = ("rmse [m]", "missed [%]", "size", "trajectory error (ATE) [m]")
    pairs: list[tuple[str, ...]] = [(ours[name], theirs[name]) for name in compared]
    for row in (
        row_of("accuracy_laps", "1"),
        row_of("accuracy_metrics", "curve distance, mapped to truth [m]"),
    ):
        pairs.append((row["fixed-lag"], row["landmark-fixed-lag"]))
    isam2 = row_of("speed", "mean update relative to iSAM2 with known data association")["measured"]
    known = row_of("known", "drawn, another drive's (24 drives)")
    lines = [row_of("lines", f"1 m, {estimator}") for estimator in ("fixed-lag", "spline")]
    assert all(row["missed [%]"] == "0.0 ± 0.0" for row in lines)
    readme = text_of(ROOT / "README.md")
    quoted = re.findall(r"[\d.]+ ± [\d.]+", readme)
    assert quoted == [
        isam2,
        known["pose error [m]"],
        *(row["rmse [m]"] for row in lines),
        *chain.from_iterable(pairs),
    ]
    assert known["found [%]"] == "100 ± 0"
    runs = [row_of("real_runs", f"a{number}, online") for number in range(9, 14)]
    for name in ("end off by [m]", "dead reckoning off by [m]"):
        found = sorted((run[name] for run in runs), key=float)
        assert f"{found[0]} to {found[-1]} m" in readme.replace("\n", " ")


# --- formats ---------------------------------------------------------------------------------------------


def keys_of(content: Any) -> Iterator[str]:
    """Every key of a JSON object and of the objects in it."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield key
            yield from keys_of(value)


def test_the_formats_page_has_every_file_column_and_key(log: Log, tmp_path: Path) -> None:
    page = text_of(ROOT / "docs" / "formats.md")
    write_log(log, tmp_path / "log")
    result = run_online(log, FixedLagMapper(odometry_sigma=log.odometry_sigma))
    write_result(tmp_path / "map", result, {})
    for file in (*(tmp_path / "log").iterdir(), *(tmp_path / "map").iterdir()):
        assert f"`{file.name}`" in page
        if file.suffix == ".csv":
            header = file.read_text().splitlines()[0]
            assert f"`{header}`" in page
    for key in keys_of(json.loads((tmp_path / "map" / "map.json").read_text())):
        assert f"`{key}`" in page, key
    for key in tomllib.loads((tmp_path / "log" / "log.toml").read_text())["sensor"]:
        assert f"`{key}`" in page, key


# --- the tutorial ----------------------------------------------------------------------------------------


def csv_rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def tutorial() -> Iterator[str]:
    """Every line of the pages' shell blocks, and each Python block."""
    text = text_of(TUTORIAL)
    found = re.findall(r"^```(sh|python)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    for language, text in found:
        yield from [text] if language == "python" else text.strip().splitlines()


def run_line(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Does in this process what a line of the page does in one of its own."""
    if "\n" in line:
        exec(compile(line, "tutorial.md", "exec"), {"__name__": "__main__"})
        return
    program, *arguments = shlex.split(line)
    if program == "python":
        script = str(ROOT / arguments[0])
        monkeypatch.setattr(sys, "argv", [script, *arguments[1:]])
        runpy.run_path(script, run_name="__main__")
    else:
        assert program == "pathspace-graph"
        assert main(arguments) == 0, line


def test_the_tutorial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], png_only: None
) -> None:
    """As a new user types it, on a lap of half the length."""
    pytest.importorskip("rosbags")
    pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    said = []
    for line in tutorial():
        half = line.replace("200 240 --generator.cones 150", "100 130 --generator.cones 80")
        run_line(half.replace("--laps 2", "--laps 1 --vehicle.overrun 40"), monkeypatch)
        said.append(capsys.readouterr().out)
    online, reference = (read_map(tmp_path / name) for name in ("map", "reference"))
    assert online.closed
    assert reference.closed
    with_truth = tmp_path / "comparison" / "fixed-lag"
    truth = read_map(with_truth)
    assert abs(online.size - truth.size) < 10  # the bag lost nothing that matters
    poses = [read_trajectory(at / "trajectory.tum")[1] for at in (tmp_path / "map", with_truth)]
    cycles = [csv_rows(at / "cycles.csv") for at in (tmp_path / "map", with_truth)]
    left = [np.array([float(row["size_left"]) for row in rows]) for rows in cycles]
    alike = np.abs(left[0] - left[1]) < 0.25 * online.size  # a curve becomes smaller where the loop closes
    assert (~alike).sum() <= 2
    assert np.hypot(*(poses[0] - poses[1])[alike, :2].T).max() < 1.5
    assert (tmp_path / "drive.rrd").stat().st_size > 0
    assert (tmp_path / "comparison" / "table.md").exists()
    widths = np.loadtxt(tmp_path / "centerline.csv", delimiter=",")[:, 2:]
    assert 1.0 < widths.mean() < 3.0
    assert "a lap of" in said[-1]
