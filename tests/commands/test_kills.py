"""A command that is killed at any of its steps on the disk leaves the old result or the new, whole.

What is computed is recorded, since the writers are what is tested.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import pytest
from matplotlib.figure import Figure

from pathspace_graph import estimators as registry
from pathspace_graph.cli import parse_command, run_command
from pathspace_graph.commands.outcome import Outcome
from pathspace_graph.eval.benchmark.lanes import CONES, LAPS, READINGS, fit_slope
from pathspace_graph.eval.benchmark.scaling import Scaling
from pathspace_graph.eval.experiment.cells import run_estimator
from pathspace_graph.eval.experiment.compare import Comparison, compare, plan_of
from pathspace_graph.eval.experiment.tables import Table
from pathspace_graph.eval.metrics.measures import Row
from pathspace_graph.eval.metrics.summary import versions
from pathspace_graph.io.log import Log, read_log, write_log
from pathspace_graph.io.manifest import MANIFEST_FILE, verify_all
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.settings.evaluation import ScalingSettings
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes import rings
from ..scenes.kills import Contents, content_of, kills, leftovers, results
from ..scenes.pretenders import write_round_track

LEAST_STEPS = 4
"""Every command takes more steps than this."""


def slow(name: str) -> object:
    return pytest.param(name, marks=pytest.mark.slow)


LONG = ("compare", "demo")
"""These commands take many steps, so that the next run is done after every third kill only."""


@dataclass(frozen=True)
class Recorded:
    """A short log, and what an estimator has made of it."""

    folder: Path
    log: Log
    result: RunResult


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")
    with pytest.MonkeyPatch.context() as patch:
        rings.register(patch)
        log = read_log(rings.write_logs(folder / "drives") / "a")
        truth = replace(log.truth, associations=None) if log.truth else None
        short = replace(log, cycles=log.cycles[:3], truth=truth)
        write_log(short, folder / "log")
        result = run_estimator("rings", MapperSettings(), short)
    write_result(folder / "map", result, {"estimator": "rings"})
    return Recorded(folder, short, result)


@pytest.fixture(scope="module")
def comparison(recorded: Recorded) -> Comparison:
    with pytest.MonkeyPatch.context() as patch:
        rings.register(patch)
        return compare(plan_of(recorded.folder / "log", ["rings"]), recorded.folder / "cells")


@pytest.fixture(autouse=True)
def quick(recorded: Recorded, comparison: Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is computed is taken from the record, a picture is a few bytes, and nothing is printed."""
    rings.register(monkeypatch)
    monkeypatch.setitem(registry.ONLINE, "fixed-lag", rings.Rings)  # the shipped studies name it
    picture = Figure()
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: Path(file).write_bytes(b"picture"))
    answers = {
        "commands.simulate.simulate": recorded.log,
        "commands.compare.simulate": recorded.log,
        "commands.compare.map_with_both": (recorded.result, recorded.result),
        "commands.compare.plot_map": picture,
        "commands.compare.side_by_side": Table((), ()),
        "commands.estimate.map_online": recorded.result,
        "commands.estimate.report": None,
        "commands.plot.plot_map": picture,
        "commands.compare.compare": comparison,
        "commands.compare.report": Outcome([]),
        "commands.studies.make_drives": Roads(),
        "commands.studies.measure_scaling": scaling(),
        "eval.experiment.compare.plot_maps": picture,
        "eval.experiment.compare.tables": {"table": Table(("a",), (("1",),))},
        "eval.benchmark.scaling.plot_laps": picture,
        "eval.benchmark.scaling.plot_scaling": picture,
        "eval.benchmark.scaling._process_megabytes": 1.0,
    }
    judged = recorded.log, []
    answers["commands.estimate.read_plausible_log"] = judged
    answers["commands.plot.read_log"] = recorded.log
    rooms = ("commands.compare", "commands.estimate", "eval.experiment.cells")
    answers |= {f"{room}.summarize": {} for room in rooms}
    for name, answer in answers.items():
        monkeypatch.setattr(f"pathspace_graph.{name}", lambda *_, _answer=answer, **__: _answer)
    monkeypatch.setattr("pathspace_graph.eval.figures.style.SUFFIXES", (".png",))


@dataclass(frozen=True)
class Roads:
    cycles: int = 1


def scaling() -> Scaling:
    points = pd.DataFrame({"at": [100.0, 200.0, 300.0], "seconds": 0.002, "cycles": 9, "size": 50.0})
    points = points.assign(sweep=CONES, estimator="rings")
    slopes = pd.DataFrame([fit_slope(sweep, "rings", points) for sweep in (CONES, READINGS, LAPS)])
    return Scaling(ScalingSettings(), {}, points, slopes, {"rings": 1.0})


def commands(recorded: Recorded) -> dict[str, list[str]]:
    """Every command that writes at once, but for its target, by the name of its target."""
    log, track = str(recorded.folder / "log"), str(recorded.folder / "map")
    return {
        "simulate": ["--generate", "0"],
        "convert": [log, "--from", "csv"],
        "online": [log, "--estimator", "rings"],
        "batch": [log, "--estimator", "rings-batch"],
        "compare": [log, "--estimators", "rings", "gaps"],
        "scale": ["--estimators", "rings"],
        "demo": [],
        "plot": [track],
    }


def work_of(name: str, options: list[str], out: Path) -> Callable[[], None]:
    command = parse_command(name, [*options, "--out", str(out)])

    def work() -> None:
        assert run_command(name, command) in (0, 3)  # a batch that did not converge is written all the same

    return work


def check(target: Path, expected: list[Contents]) -> None:
    """The target is one of these, and every folder with a manifest in it is as that says."""
    assert content_of(target) in expected
    for manifest in target.rglob(MANIFEST_FILE) if target.is_dir() else ():
        verify_all(manifest.parent)


def place(target: Path, like: Contents) -> None:
    """An old result: the new one with other bytes, but for its manifests, which are left out."""
    for name, data in like.items():
        if Path(name).name != MANIFEST_FILE:
            file = target / name if name else target
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(b"old " + data)


@pytest.mark.parametrize("old", [False, True], ids=["first", "again"])
@pytest.mark.parametrize(
    "name", ["simulate", "convert", "online", "batch", "scale", "plot", *map(slow, LONG)]
)
def test_a_kill_at_any_step_leaves_the_old_or_the_new(
    name: str, old: bool, recorded: Recorded, tmp_path: Path
) -> None:
    out = "out.png" if name == "plot" else "out"
    folder = tmp_path / "folder"
    target = folder / out
    work = work_of(name, commands(recorded)[name], target)
    work()
    new = content_of(target)
    every = 3 if name in LONG else 1
    shutil.rmtree(folder)
    folder.mkdir()
    if old:
        place(target, new)
    before = [content_of(target)] if old else []
    for step, _ in enumerate(kills(work, folder), 1):
        if target.exists():
            check(target, [*before, new])
        if old and step % every == 0:
            work()
            check(target, [new])
            assert leftovers(folder) == []
        assert all(content in results(folder, out) for content in before), "the old result is kept"
    assert check(target, [new]) is None
    assert step > LEAST_STEPS


STUDY = """
tracks = ["{track}"]
seeds = [0, 1]
laps = 1
estimators = ["rings"]
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ablate", "faults"])
def test_a_study_that_is_killed_at_any_step_goes_on_with_whole_files(
    name: str, recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, rows = "pathspace_graph.eval.experiment", [Row(1, {"rmse": 0.5}), Row(None, {})]
    monkeypatch.setattr(f"{study}.drives.Drive.load", lambda _: (recorded.log, ()))
    monkeypatch.setattr(f"{study}.cells.measure", lambda *_, **__: rows)
    monkeypatch.setattr(f"{study}.cells.stage_times", lambda _: [])
    monkeypatch.setattr(f"{study}.runner.made", lambda _: versions() | {"date": "then"})
    monkeypatch.setattr(f"{study}.tables.plot_differences", lambda *_: Figure())
    monkeypatch.setattr(f"{study}.faults.plot_faults", lambda *_: Figure())
    track = write_round_track(tmp_path)
    (tmp_path / "small.toml").write_text(STUDY.format(track=track))
    folder = tmp_path / "folder"
    options = [str(tmp_path / "small.toml"), "--jobs", "1"]
    if name == "faults":
        drives = ["--tracks", str(track), "--seeds", "0", "--laps", "1", "--jobs", "1"]
        options = [*drives, "--only", "no colours", "--quick", "--estimator", "rings"]
    work = work_of(name, options, folder / "out")
    work()
    new = content_of(folder / "out")
    shutil.rmtree(folder)
    folder.mkdir()
    for step, died in enumerate(kills(work, folder), 1):
        for file, data in content_of(folder / "out").items() if (folder / "out").exists() else ():
            assert file.startswith("logs/") or "/." in f"/{file}" or data == new[file], file
        if died and step % 4 == 0:  # it goes on in the folder of the run that died
            work()
            assert content_of(folder / "out") == new
            assert leftovers(folder) == []
    assert step > LEAST_STEPS
