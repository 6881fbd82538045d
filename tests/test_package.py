"""The package is what it says: every folder listed, seen by mypy, imported lazily, and as in the README."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info

import pathspace_graph
from pathspace_graph.cli import COMMANDS, main
from pathspace_graph.io.log_files import write_log
from pathspace_graph.labels import LEFT, RIGHT

from .scenes.drives import ahead, corridor, exact_log
from .scenes.paths import ROOT
from .test_docs import blocks

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def python_folders() -> set[Path]:
    """Every folder with Python code, but for the root, tests, examples, pages and what is built."""
    skipped = {"tests", "examples", "docs", "build", "dist"}
    files = (file.relative_to(ROOT) for file in ROOT.rglob("*.py"))
    return {
        file.parent
        for file in files
        if file.parent != Path()
        and file.parts[0] not in skipped
        and not any(part.startswith(".") for part in file.parts)
    }


LINKS = ("factors", "sim", "eval")


def package_of(folder: Path) -> str:
    """The name of the package that a folder with Python code is."""
    parts = folder.parts if folder.parts[0] == "pathspace_graph" else ("pathspace_graph", *folder.parts)
    return ".".join(parts)


# --- packages --------------------------------------------------------------------------------------------


def test_the_package_holds_links_to_the_folders_beside_it() -> None:
    """So setuptools, mypy and editors find one ordinary package."""
    if not (ROOT / LINKS[0]).exists():
        pytest.skip("an sdist has folders in place of links")
    for name in LINKS:
        link = ROOT / "pathspace_graph" / name
        assert link.is_symlink() and link.resolve() == ROOT / name
    assert PROJECT["tool"]["setuptools"]["packages"]["find"]["include"] == ["pathspace_graph*"]
    assert {folder.parts[0] for folder in python_folders()} == {"pathspace_graph", *LINKS}


@pytest.mark.parametrize("folder", sorted(python_folders()), ids=str)
def test_each_folder_with_code_is_imported_as_a_package(folder: Path) -> None:
    assert (ROOT / folder / "__init__.py").is_file()
    home = Path(str(import_module(package_of(folder)).__file__)).parent
    names = {file.name for file in home.glob("*.py")}
    assert names == {file.name for file in (ROOT / folder).glob("*.py")}


# --- imports ---------------------------------------------------------------------------------------------


def test_every_public_name_is_found_where_it_is_said_to_be() -> None:
    assert sorted(pathspace_graph._HOME) == sorted(pathspace_graph.__all__)
    for name in pathspace_graph.__all__:
        home = import_module(f"pathspace_graph.{pathspace_graph._HOME[name]}")
        assert getattr(pathspace_graph, name) is getattr(home, name)
    with pytest.raises(AttributeError):
        pathspace_graph.nothing  # noqa: B018 - the access is the test


def modules_after(code: str) -> set[str]:
    """What is imported in a fresh interpreter after `code`."""
    script = f"{code}\nimport sys, json; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_the_command_line_starts_without_the_heavy_libraries() -> None:
    loaded = modules_after("from pathspace_graph.cli import main; main(['--help'])")
    assert not loaded & {"numpy", "scipy", "gtsam", "matplotlib", "tyro"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_waits_for_no_heavy_library(command: str) -> None:
    loaded = modules_after(f"from pathspace_graph.cli import main; main(['{command}', '--help'])")
    assert not loaded & {"gtsam", "matplotlib", "pandas", "joblib", "scipy.linalg", "scipy.spatial"}
    assert ("numpy" in loaded) == (command in ("simulate", "convert"))


def test_an_estimator_does_not_wait_for_what_reads_files() -> None:
    homes = ("online.fixed_lag", "batch.mapper", "loop.lap_solver", "ros.node", "sim.simulate")
    loaded = modules_after(f"import {', '.join(f'pathspace_graph.{home}' for home in homes)}")
    assert not loaded & {"pandas", "pathspace_graph.io.tables"}


def test_a_wrong_usage_waits_for_no_library_either() -> None:
    loaded = modules_after("from pathspace_graph.cli import main; main(['online', 'LOG', '--lag', 'x'])")
    assert not loaded & {"numpy", "gtsam", "rich", "docstring_parser"}


def test_the_version_names_gtsam_and_the_kernels(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    built = r"(gcc \d+\.\d+|clang \d+\.\d+|MSVC \d+)"
    assert re.fullmatch(rf"pathspace-graph \S+ \(GTSAM \S+, kernels: {built}\)\n", capsys.readouterr().out)


def test_a_package_that_is_not_built_says_what_to_do() -> None:
    kernels = "pathspace_graph.factors._kernels"
    code = f"import sys; sys.modules['{kernels}'] = None; import pathspace_graph.factors.se2"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == f"ImportError: {kernels} is missing: run pip install -e ."


def test_a_command_without_its_extra_says_how_to_install_it() -> None:
    run = "from pathspace_graph.cli import main; sys.exit(main(['compare', 'log', '--out', 'out']))"
    code = f"import sys; sys.modules['matplotlib'] = None; {run}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    said = (
        "pathspace-graph: expected the package matplotlib (pip install 'pathspace-graph[eval]'), found none\n"
    )
    assert (done.returncode, done.stderr) == (2, said)


def test_the_package_itself_imports_nothing_but_the_standard_library() -> None:
    loaded = modules_after("import pathspace_graph")
    assert not loaded & {"numpy", "scipy", "gtsam", "matplotlib", "pandas"}
    assert {name for name in loaded if name.startswith("pathspace_graph.")} == set()


def test_the_simulator_knows_no_estimator() -> None:
    loaded = modules_after("import pathspace_graph.sim.simulate, pathspace_graph.sim.track_generator")
    ours = {name for name in loaded if name.startswith("pathspace_graph.")}
    allowed = {"brief", "errors", "factors", "io", "labels", "lengths", "settings", "spline"}
    assert {name.split(".")[1] for name in ours} - {"sim"} <= allowed
    assert "gtsam" not in loaded


def test_the_factors_stand_on_their_own() -> None:
    allowed = {"__future__", "gtsam", "numpy", "scipy"}
    standard = set(sys.stdlib_module_names)
    for file in (ROOT / "factors").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                assert str(node.module).split(".")[0] in allowed | standard, file
            elif isinstance(node, ast.Import):
                assert {alias.name.split(".")[0] for alias in node.names} <= allowed | standard, file


def test_reading_metrics_and_plots_need_nothing_of_linux() -> None:
    """As on Windows: without `fcntl` and `resource`, and without the C library of the process."""
    code = """
import sys
sys.modules["fcntl"] = sys.modules["resource"] = None
import ctypes
real = ctypes.CDLL
def library(name, *rest, **named):
    assert name is not None, "the library of the process"
    return real(name, *rest, **named)
ctypes.CDLL = library
import pathspace_graph as package
[getattr(package, name) for name in package.__all__]
import pathspace_graph.eval.metrics.accuracy, pathspace_graph.eval.figures.drawing
import pathspace_graph.eval.benchmark
"""
    assert "pathspace_graph.eval.figures.drawing" in modules_after(code)


def test_each_script_is_a_function() -> None:
    for target in PROJECT["project"]["scripts"].values():
        module, _, name = target.partition(":")
        assert callable(getattr(import_module(module), name)), target


# --- README ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("page", "log", "printed"),
    [("README.md", "pathspace-demo/log", ["False"]), ("docs/python.md", "log", [str(LEFT), str(RIGHT)])],
)
def test_the_first_example_of_a_page_runs(
    page: str,
    log: str,
    printed: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    example = blocks(ROOT / page, "python")[0]
    assert len(example.strip().splitlines()) <= 12
    (tmp_path / log).parent.mkdir(exist_ok=True)
    write_log(exact_log(ahead(8.0, 4.0), *corridor(60.0)), tmp_path / log)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, page, "exec"), {})
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == printed


def test_the_readme_sets_up_with_one_command_each() -> None:
    demo, tests = (block.strip() for block in blocks(ROOT / "README.md", "sh")[:2])
    assert demo.endswith(".venv/bin/pathspace-graph demo")
    assert tests.endswith(".venv/bin/pytest -n auto --dist loadfile")
    assert all("\n" not in command for command in (demo, tests))
    assert (ROOT / "docs" / "track.png").stat().st_size < 300_000


def test_blas_has_one_thread_in_tests_and_in_commands() -> None:
    assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    script = "from pathspace_graph.cli import main; main(['--help']); import numpy, threadpoolctl as t;"
    script += "print({pool['num_threads'] for pool in t.threadpool_info() if pool['user_api'] == 'blas'})"
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "{1}"
