"""The factor graph of a batch on the command line: written on demand, and exported for other programs."""

from __future__ import annotations

import json
from pathlib import Path

import gtsam
import pytest

from pathspace_graph.cli import main
from pathspace_graph.graph.exchange import GRAPH_FILE, read_graph
from pathspace_graph.io.log_files import write_log

from ..scenes.drives import noisy_lap


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder of a batch with its graph; its log is beside it."""
    folder = tmp_path_factory.mktemp("graph")
    write_log(noisy_lap(), folder / "log")
    assert main(["batch", str(folder / "log"), "--out", str(folder / "map"), "--graph", "-q"]) == 0
    return folder / "map"


def test_every_form_is_read_by_its_program(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for form in ("graph", "dot", "g2o"):
        assert main(["export", str(solved), "--as", form, "--out", str(tmp_path / form)]) == 0
    whole, values = read_graph(tmp_path / "graph")
    assert (tmp_path / "dot").read_text().startswith("graph {")
    poses, placed = gtsam.readG2o(str(tmp_path / "g2o"), False)
    assert placed.size() == len(noisy_lap().cycles)
    left_out = whole.size() - poses.size()
    assert f"{left_out} other factors are left out" in capsys.readouterr().err
    assert gtsam.LevenbergMarquardtOptimizer(whole, values).optimize().size() == values.size()


@pytest.mark.parametrize("content", [None, "no json", '{"graph": "none", "values": ""}', "{}"])
def test_where_there_is_no_graph_there_is_one_line(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / GRAPH_FILE).write_text(content)
    assert main(["export", str(tmp_path), "--as", "dot", "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert GRAPH_FILE in line and "expected a factor graph" in line
    assert not (tmp_path / "out").exists()


def test_a_graph_that_gtsam_cannot_read_is_one_line_also_where_its_poses_can_be_read(
    solved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((solved / GRAPH_FILE).read_text())
    (tmp_path / GRAPH_FILE).write_text(json.dumps(content | {"graph": "none"}))
    assert main(["export", str(tmp_path), "--as", "g2o", "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected a factor graph" in line and not (tmp_path / "out").exists()


def test_only_the_batch_of_one_log_has_a_graph(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, out = str(solved.parent / "log"), str(solved.parent / "other")
    for words in ([log, log], [log, "--estimator", "landmark-batch"]):
        assert main(["batch", *words, "--out", out, "--graph"]) == 2
        assert "--graph: expected one log" in capsys.readouterr().err
