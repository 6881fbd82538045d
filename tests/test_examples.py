"""The examples do what they say; each is run as it stands."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from .scenes.paths import ROOT

EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_example_has_a_test() -> None:
    tested = {"carmen", "gnss", "surveyed_point", "look_at_graph"}
    tested |= {"write_bag"}  # by the tutorial
    assert {file.stem for file in EXAMPLES.glob("*.py")} == tested


def test_a_scan_of_a_carmen_log_gets_the_twist_to_the_next_pose(tmp_path: Path) -> None:
    """A metre ahead in 8 s, facing along y; the log is driven eight times as fast."""
    carmen = example("carmen")
    poses = ("0 0 1.5707963 0", "0 1 1.5707963 8")
    (tmp_path / "log").write_text(
        "".join(f"FLASER 2 1.5 2.5 {pose[:-2]} 0 0 0 {pose[-1]}\n" for pose in poses)
    )
    first, second = carmen.scans(tmp_path / "log")
    line = json.loads(carmen.line(first, second))
    assert line["t"] == 0.0
    assert line["twist"] == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    assert line["scan"]["ranges"] == [1.5, 2.5]


@pytest.mark.slow
def test_gnss_holds_the_vehicle_where_cones_let_it_drift() -> None:
    alone, with_gnss = example("gnss").main()
    assert with_gnss < 0.4
    assert with_gnss < 0.25 * alone


@pytest.mark.slow
def test_a_boundary_passes_through_the_surveyed_point() -> None:
    """Curves of few knots pass cones by a decimetre or two, the surveyed one as well."""
    without, with_survey, in_batch = example("surveyed_point").main()
    assert with_survey < 0.3
    assert with_survey < 0.2 * without
    assert in_batch < 0.06  # samples of the curve are 0.08 m apart


def test_the_graph_can_be_looked_at(tmp_path: Path) -> None:
    errors = example("look_at_graph").main(tmp_path, cycles=100)
    kinds = {"spline projection", "place of a control point", "smoothness", "odometry", "prior of the window"}
    assert set(errors) == kinds
    assert all(count > 0 and error >= 0.0 for count, error in errors.values())
    assert (tmp_path / "graph.png").stat().st_size > 0


@pytest.mark.parametrize("name", ["gnss", "surveyed_point", "look_at_graph"])
def test_an_example_says_how_to_run_it(name: str) -> None:
    assert f"python examples/{name}.py" in (EXAMPLES / f"{name}.py").read_text()
