"""Logs of a real car: their maps, their last poses, and their tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pathspace_graph.cli import main
from pathspace_graph.eval.cars import real_tables
from pathspace_graph.io.log import Log
from pathspace_graph.sim.simulate import preset, simulate
from pathspace_graph.sim.track_generator import generate_track

from ..convert.recorded import SHORT, write_recorded

CONVERT = ["--from", "csv", "--columns", "label=colour", "--labels", "left=1", "right=0", "--y", "right"]


def standing_drive() -> Log:
    """One lap of a short track by a car with cameras that stands before it and after."""
    settings = replace(preset({"sensor": "camera", "odometry": "ins"}), laps=1)
    vehicle = replace(settings.vehicle, rest=4.0, stand=5.0)
    return simulate(generate_track(np.random.default_rng(4), SHORT), replace(settings, vehicle=vehicle), 4)


def test_real_logs_are_mapped_and_held_against_each_other(tmp_path: Path) -> None:
    for name in ("first", "second"):
        recorded = write_recorded(standing_drive(), tmp_path / "recorded" / name)
        assert main(["-q", "convert", str(recorded), *CONVERT, "--out", str(tmp_path / name)]) == 0
    logs, cells = [tmp_path / name for name in ("first", "second")], list[int]()
    real_tables(logs, tmp_path / "out")
    tables = real_tables(logs, tmp_path / "out", on_cell=lambda _, remaining: cells.append(remaining))
    assert cells == [0], "what was mapped is kept"
    online = tables["runs"].records()[0]
    assert online["track, estimator"] == "first, fixed-lag"
    assert online["closed [%]"] == "100"
    assert float(online["end off by [m]"]) < 1.0
    assert tables["maps"].records()[0] | {"landmark-fixed-lag [m]": ""} == {
        "maps": "first, second",
        "fixed-lag [m]": "0.00",
        "spline [m]": "0.00",
        "landmark-fixed-lag [m]": "",
    }
    first, second, both = tables["measured"].records()
    assert [row["log"] for row in (first, second, both)] == ["first", "second", "all drives"]
    assert both["scale [%]"].partition(" ")[0] == first["scale [%]"].partition(" ")[0]


def test_a_report_of_real_logs_needs_some(tmp_path: Path, capsys: object) -> None:
    assert main(["report", "--out", str(tmp_path), "--only", "real"]) == 2
