"""The pages: their links lead somewhere, the code that they name exists, and their examples run."""

from __future__ import annotations

import ast
import csv
import inspect
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import gtsam
import numpy as np
import pytest

from pathspace_graph import FixedLagMapper, Log
from pathspace_graph.cli import COMMANDS, main, parse_command
from pathspace_graph.errors import InputError
from pathspace_graph.factors.se2 import rotation
from pathspace_graph.io.log import write_log
from pathspace_graph.io.map import read_map
from pathspace_graph.io.overrides import leaves
from pathspace_graph.io.results import read_trajectory, write_result
from pathspace_graph.labels import NAMES
from pathspace_graph.loop.open import Open
from pathspace_graph.mapping.road import Road
from pathspace_graph.run import run_online, split_odometry
from pathspace_graph.settings.mapper import MapperSettings
from pathspace_graph.sim import track_files
from pathspace_graph.sim.simulate import SimulationSettings, simulate
from pathspace_graph.sim.track_generator import generate_track

from .scenes.drives import beginning
from .scenes.jacobians import numeric_jacobian
from .scenes.paths import ROOT, modules
from .scenes.pretenders import write_round_track
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
    """The anchors of a page's headings, as GitHub makes them."""
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


def test_every_page_is_found_from_the_readme() -> None:
    linked = set(re.findall(r"\]\(((?:docs/)?\w+\.md)[)#]", text_of(ROOT / "README.md")))
    assert {str(page.relative_to(ROOT)) for page in PAGES} - {"README.md"} == linked


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
ELSEWHERE = {"dead_reckoning", "compass"}
"""Modules that a page tells its reader to write."""


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
    named = [named for named in NAMED.findall(prose(page)) if named[0] not in ELSEWHERE]
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
            assert parse_command(name, arguments) is not None, line


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
def test_python_blocks_import_what_exists(page: Path) -> None:
    nodes = [node for block in blocks(page, "python") for node in ast.walk(ast.parse(block))]
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    named = [(str(node.module), alias.name) for node in froms for alias in node.names]
    own = [(module, name) for module, name in named if module.partition(".")[0] == PACKAGE]
    assert [(module, name) for module, name in own if not hasattr(import_module(module), name)] == []


@pytest.fixture(scope="module")
def log() -> Log:
    """The first eight seconds of a drive on a generated track."""
    drive = simulate(generate_track(np.random.default_rng(0)), SimulationSettings(laps=1), seed=0)
    first = beginning(drive, 80)
    return replace(first, odometry=drive.odometry.between(0.0, first.cycles[-1].t))


def test_the_graph_is_asked_as_the_page_on_python_does(log: Log) -> None:
    mapper = FixedLagMapper(odometry_sigma=log.odometry_sigma)
    for odometry, detections in split_odometry(log):
        mapper.update(odometry, detections)
    _, block = blocks(ROOT / "docs" / "python.md", "python")
    make, show, *asks = ast.parse(block).body
    names: dict[str, Any] = {"mapper": mapper, "gtsam": gtsam}
    exec(compile(ast.Module([make, show], []), "python.md", "exec"), names)
    assert names["graph"].size() > 0 and set(names["graph"].keyVector()) == set(names["values"].keys())
    own, in_map = (eval(ast.unparse(ask), names) for ask in asks)
    turn = np.eye(3)
    turn[:2, :2] = rotation(mapper.poses[-1, 2])
    np.testing.assert_allclose(turn @ own @ turn.T, in_map, rtol=0.02, atol=1e-3 * np.abs(in_map).max())


def test_the_bridge_of_the_page_on_ros_maps_json_lines(log: Log) -> None:
    files = file_blocks(ROOT / "docs" / "ros2.md")
    lines = [
        (float(t), "twist", twist.tolist()) for t, twist in zip(*vars(log.odometry).values(), strict=True)
    ]
    for cycle in log.cycles[:30]:
        rows = zip(*cycle.points_vehicle.T.tolist(), (NAMES[label] for label in cycle.labels), strict=True)
        lines.append((cycle.t, "detections", [{"x": x, "y": y, "label": label} for x, y, label in rows]))
    lines.sort(key=lambda line: line[0])
    text = "".join(json.dumps({"t": t, kind: content}) + "\n" for t, kind, content in lines)
    command = [sys.executable, "-c", files["mapper.py"]]
    run = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    assert run.stderr == ""
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    assert [answer["t"] for answer in answers] == [cycle.t for cycle in log.cycles[:30]]
    assert answers[-1]["pose"][0] > 1.0


def test_each_step_of_the_paper_is_two_calls_from_the_update() -> None:
    page = text_of(ROOT / "docs" / "architecture.md")
    owners = {"Open": Open, "Road": Road}
    steps = re.findall(r"^\| [^|]* \| `(\w+)\.(\w+)` \| ([^|]*) \|", page, flags=re.MULTILINE)
    steps = [step for step in steps if step[0] in owners]
    assert len(steps) == 7
    update = inspect.getsource(FixedLagMapper._process)
    for owner, method, functions in steps:
        assert f".{method}(" in update
        for _, function in NAMED.findall(functions):
            called = function.rpartition(".")[2]
            assert f"{called}(" in inspect.getsource(getattr(owners[owner], method)), function


def test_the_architecture_page_has_the_rooms_in_the_order_of_their_imports() -> None:
    """A room stands below all that it may import, as `test_rooms` has it."""
    page = text_of(ROOT / "docs" / "architecture.md")
    table = page[page.index("## Rooms") : page.index("## What flows where")]
    listed = re.findall(r"^\| `([a-z_.]+)` \|", table, flags=re.MULTILINE)
    assert set(listed) == set(ARROWS) - LEAVES - {"cli", "__main__"}
    for place, room in enumerate(listed):
        assert ARROWS[room] <= set(listed[:place]), room


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


# --- extending -------------------------------------------------------------------------------------------

EXTENDING = ROOT / "docs" / "extending.md"


def module_of(name: str, code: str) -> ModuleType:
    module = ModuleType(name)
    exec(compile(code, f"{name}.py", "exec"), vars(module))
    return module


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the page's estimator as pip would install it: the module beside its metadata."""
    folder = tmp_path_factory.mktemp("site")
    files = file_blocks(EXTENDING)
    (folder / "dead_reckoning.py").write_text(files["dead_reckoning.py"])
    project = tomllib.loads(files["pyproject.toml"])["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    groups = [
        "\n".join([f"[{group}]", *(f"{name} = {target}" for name, target in points.items())])
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups) + "\n")
    return folder


@pytest.fixture(scope="module")
def log_folder(installed: Path, log: Log) -> Path:
    """The short drive as a log folder."""
    write_log(log, installed / "log")
    return installed / "log"


def run_command(folder: Path, command: str) -> str:
    """What a command prints; the folder is both where it runs and where the estimator is installed."""
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    arguments = [sys.executable, "-m", PACKAGE, *command.split()]
    done = subprocess.run(arguments, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def csv_rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def test_the_new_estimator_maps_online(installed: Path, log_folder: Path) -> None:
    printed = run_command(installed, f"online {log_folder} --out map --estimator dead-reckoning")
    assert "loop not closed" in printed
    assert len((installed / "map" / "trajectory.tum").read_text().splitlines()) == 80


@pytest.mark.slow
def test_the_new_estimator_is_compared(installed: Path, log_folder: Path) -> None:
    names = ["dead-reckoning", "landmark-fixed-lag"]
    run_command(installed, f"compare {log_folder} --out comparison --estimators {' '.join(names)}")
    rows = csv_rows(installed / "comparison" / "table.csv")
    assert [row["estimator"] for row in rows] == names
    assert all(0.0 < float(row["rmse"]) < 1.0 and float(row["missed"]) < 0.9 for row in rows)


@pytest.mark.slow
def test_the_new_estimator_is_ablated(installed: Path) -> None:
    (installed / "study.toml").write_text(file_blocks(EXTENDING)["dead_reckoning.toml"])
    track = write_round_track(installed)
    run_command(installed, f"ablate study.toml --out study --tracks {track} --jobs 1")
    rows = csv_rows(installed / "study" / "results.csv")
    assert {row["estimator"] for row in rows} == {"fixed-lag", "dead-reckoning"}
    assert all(0.0 < float(row["rmse"]) < 1.0 and float(row["missed"]) < 0.9 for row in rows)


@pytest.mark.slow
def test_the_new_estimator_is_scaled(installed: Path) -> None:
    run_command(installed, "scale --out scaling --quick --estimators dead-reckoning")
    rows = csv_rows(installed / "scaling" / "points.csv")
    assert {row["estimator"] for row in rows} == {"dead-reckoning"}


def test_the_new_factor_has_the_jacobian_that_it_says() -> None:
    factor = module_of("compass", file_blocks(EXTENDING)["compass.py"]).compass_factor(0, 3.1, 0.5)

    def whitened(pose: np.ndarray) -> np.ndarray:
        values = gtsam.Values()
        values.insert(0, gtsam.Pose2(1.0, 2.0, -3.0).retract(pose))
        return np.asarray(factor.whitenedError(values))

    values = gtsam.Values()
    values.insert(0, gtsam.Pose2(1.0, 2.0, -3.0))
    jacobian, _ = factor.linearize(values).jacobian()
    np.testing.assert_allclose(jacobian, numeric_jacobian(whitened, np.zeros(3)), atol=1e-6)
    np.testing.assert_allclose(whitened(np.zeros(3)), [(2.0 * np.pi - 6.1) / 0.5])


def test_the_new_factor_holds_the_heading(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    files = file_blocks(EXTENDING)
    monkeypatch.setitem(sys.modules, "compass", module_of("compass", files["compass.py"]))
    drive = module_of("drive", files["drive.py"]).drive
    assert log.truth is not None
    stamps = [cycle.t for cycle in log.cycles]
    headings = np.interp(stamps, log.truth.pose_t, np.unwrap(log.truth.poses[:, 2]))
    offset = drive(log, headings + 0.05).poses[-1, 2] - drive(log, headings).poses[-1, 2]
    assert 0.02 < offset < 0.06


def test_the_new_track_format_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    namespace = dict(vars(track_files))
    exec(compile(file_blocks(EXTENDING)["sim/track_files.py"], "extending.md", "exec"), namespace)
    line = blocks(EXTENDING, "python")[-1]
    added: tuple[track_files.TrackFormat, ...] = eval(line, namespace)
    monkeypatch.setattr(track_files, "FORMATS", (*track_files.FORMATS, *added))
    file = tmp_path / "oval.json"
    file.write_text(oval())
    track = track_files.read_track(file)
    assert len(track.left) == len(track.right) == 30
    assert track.name == "oval"
    file.write_text('{"left": [["a", 0]], "right": []}')
    with pytest.raises(InputError, match="expected 2 numbers at left"):
        track_files.read_track(file)


def oval() -> str:
    """A round track in the page's format, driven counterclockwise."""
    angles = 2.0 * np.pi * np.arange(30) / 30.0
    left, right = (
        [[float(radius * np.cos(a)), float(radius * np.sin(a))] for a in angles] for radius in (18.0, 22.0)
    )
    return f'{{"left": {left}, "right": {right}, "start": [20.0, 0.0, {np.pi / 2}]}}'


def sections(page: Path) -> Iterator[str]:
    yield from re.findall(r"^## (.*)$", prose(page), flags=re.MULTILINE)


def test_the_page_has_what_it_promises() -> None:
    assert list(sections(EXTENDING)) == ["A new estimator", "A new factor", "A new track format"]


# --- the tutorial ----------------------------------------------------------------------------------------


def tutorial() -> Iterator[str]:
    """Every line of the page's shell blocks, and each Python block."""
    found = re.findall(r"^```(sh|python)\n(.*?)^```$", text_of(TUTORIAL), flags=re.DOTALL | re.MULTILINE)
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
    """As a new user types it, on a track of half the length."""
    pytest.importorskip("rosbags")
    pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    said = []
    for line in tutorial():
        run_line(line.replace("200 240 --generator.cones 150", "100 130 --generator.cones 80"), monkeypatch)
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
    assert "a lap of" in said[-2]
