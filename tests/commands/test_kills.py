"""A run that is killed at any of its steps on the disk leaves the old result or the new, whole."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from pathspace_graph import estimators as registry
from pathspace_graph.cli import parse, run_command
from pathspace_graph.eval.experiment.run import run_estimator
from pathspace_graph.eval.metrics.measures import versions
from pathspace_graph.io.files import atomic_file, atomic_folder
from pathspace_graph.io.log import Log
from pathspace_graph.io.log_files import read_log, write_log
from pathspace_graph.io.results import RunResult, write_result
from pathspace_graph.settings.mapper import MapperSettings

from ..scenes import rings
from ..scenes.kills import content_of, kills
from ..scenes.pretenders import write_round_track

LEAST_STEPS = 4
"""Every writer takes more steps than this."""


@dataclass(frozen=True)
class Recorded:
    """A short log, and the result of an estimator."""

    log: Log
    result: RunResult


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    with pytest.MonkeyPatch.context() as patch:
        rings.register(patch)
        log = read_log(rings.write_logs(tmp_path_factory.mktemp("recorded") / "drives") / "a")
        truth = replace(log.truth, associations=None) if log.truth else None
        short = replace(log, cycles=log.cycles[:3], truth=truth)
        return Recorded(short, run_estimator("rings", MapperSettings(), short))


@pytest.fixture(autouse=True)
def at_one_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every run writes the same bytes."""
    monkeypatch.setattr("pathspace_graph.io.results.made", lambda: {"date": "then"})


def write_map(recorded: Recorded, out: Path) -> None:
    write_result(out, recorded.result, {"estimator": "rings"}, force=True)


def write_both(recorded: Recorded, out: Path) -> None:
    """Write a folder of folders, as `demo` does."""
    with atomic_folder(out, "picture.png", force=True) as folder:
        write_picture(recorded, folder / "picture.png")
        write_log(recorded.log, folder / "log")
        write_map(recorded, folder / "map")


def write_picture(_: Recorded, out: Path) -> None:
    with atomic_file(out) as file:
        file.write_bytes(b"picture")


WRITERS: dict[str, Callable[[Recorded, Path], None]] = {
    "log": lambda recorded, out: write_log(recorded.log, out, force=True),
    "map": write_map,
    "both": write_both,
    "picture.png": write_picture,
}
"""Every command writes by one of these."""


@pytest.mark.parametrize("old", [False, True], ids=["first", "again"])
@pytest.mark.parametrize("name", WRITERS)
def test_a_kill_at_any_step_leaves_the_old_or_the_new(
    name: str, old: bool, recorded: Recorded, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    target = folder / name

    def work() -> None:
        WRITERS[name](recorded, target)

    work()
    new = content_of(target)
    shutil.rmtree(folder)
    folder.mkdir()
    for file, data in new.items() if old else ():
        place = target / file if file else target
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(b"old " + data)
    before = [content_of(target)] if old else []
    steps = 0
    for _ in kills(work, folder):
        steps += 1
        assert not before or target.exists()
        assert not target.exists() or content_of(target) in [*before, new]
    assert content_of(target) == new
    assert [path.name for path in folder.iterdir()] == [name]
    assert steps > LEAST_STEPS


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
    rings.register(monkeypatch)
    monkeypatch.setitem(registry.ONLINE, "fixed-lag", rings.Rings)  # the shipped study names it
    monkeypatch.setattr(Figure, "savefig", lambda self, file, **_: Path(file).write_bytes(b"picture"))
    monkeypatch.setattr("pathspace_graph.eval.figures.drawing.SUFFIXES", (".png",))
    study, rows = "pathspace_graph.eval.experiment", [{"lap": 1, "rmse": 0.5}, {"lap": None}]
    monkeypatch.setattr(f"{study}.study.StudyDrive.load", lambda _: (recorded.log, ()))
    monkeypatch.setattr("pathspace_graph.eval.metrics.measures.measure", lambda *_, **__: rows)
    monkeypatch.setattr("pathspace_graph.eval.metrics.measures.stage_times", lambda _: [])
    monkeypatch.setattr("pathspace_graph.eval.metrics.measures.summarize", lambda *_, **__: {})
    monkeypatch.setattr(f"{study}.run.origin_of", lambda _: versions() | {"date": "then"})
    monkeypatch.setattr(f"{study}.tables.plot_differences", lambda *_: Figure())
    track = write_round_track(tmp_path)
    (tmp_path / "small.toml").write_text(STUDY.format(track=track))
    folder = tmp_path / "folder"
    options = [str(tmp_path / "small.toml"), "--jobs", "1"]
    if name == "faults":
        drives = ["--tracks", str(track), "--seeds", "0", "--laps", "1", "--jobs", "1"]
        options = [*drives, "--only", "no colours", "--quick", "--estimator", "rings"]
    _, command = parse([name, *options, "--out", str(folder / "out")])

    def work() -> None:
        assert run_command(name, command) == 0

    work()
    new = content_of(folder / "out")
    shutil.rmtree(folder)
    folder.mkdir()
    for step, died in enumerate(kills(work, folder), 1):
        for file, data in content_of(folder / "out").items() if (folder / "out").exists() else ():
            assert file.startswith("logs/") or "/." in f"/{file}" or data == new[file], file
        if died and step % 4 == 0:  # it goes on in the folder of the run that died
            work()
            found = content_of(folder / "out")
            hidden = {file for file in found if file.rsplit("/")[-1].startswith(".")}
            assert {file: data for file, data in found.items() if file not in hidden} == new
    assert step > LEAST_STEPS
