"""Studies as they run: resumed and broken, and what is kept of them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pathspace_graph.errors import OutputError, SettingsError, SolveError
from pathspace_graph.eval.experiment import run as study_run
from pathspace_graph.eval.experiment import study as study_module
from pathspace_graph.eval.experiment.run import rows_of, run_study
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import TIMES, without_times, write_study

from ...scenes.pretenders import Fragile, Pretender, contents, register, write_round_track

pytestmark = pytest.mark.usefixtures("png_only")

CALLS = 6
"""Runs of `pretender` in the study: three settings on two logs."""


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_round_track(tmp_path_factory.mktemp("tracks"))


@pytest.fixture(autouse=True)
def pretenders(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch)


@pytest.fixture(scope="module")
def study(track: Path) -> Study:
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        return Study(
            name="small",
            tracks=(track,),
            seeds=(0, 1),
            laps=1,
            estimators=("pretender", "fragile"),
            grids=({"lag": [1.0, 2.0]},),
        )


@pytest.fixture(scope="module")
def ran(study: Study, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame]:
    """The folder of a finished study, and its frame."""
    folder = tmp_path_factory.mktemp("ran") / "study"
    with pytest.MonkeyPatch.context() as patch:
        register(patch)
        return folder, run_study(study, folder)


@pytest.fixture
def finished(ran: tuple[Path, pd.DataFrame], tmp_path: Path) -> Path:
    """A copy of the folder of a finished study."""
    return copytree(ran[0], tmp_path / "finished")


# --- results ---------------------------------------------------------------------------------------------


def test_a_row_for_every_run_and_lap(study: Study) -> None:
    frame = run_study(replace(study, laps=2, noise={"nominal": {}, "loud": {"sensor.bearing_sigma": 0.1}}))
    done, failed = frame[frame["failure"] == ""], frame[frame["failure"] != ""]
    assert len(done) == 2 * 2 * (3 + 2) * 2
    assert len(failed) == 2 * 2
    assert set(failed["variant"]) == {"lag=1"}
    assert set(failed["failure"]) == {"ValueError: lost"}
    assert failed["lap"].isna().all() and failed["rmse"].isna().all()
    keys = ["track", "seed", "noise", "estimator", "variant", "lap"]
    assert not frame.duplicated(keys).any()
    assert dict(zip(frame["variant"], frame["lag"], strict=True)) == {
        "default": 3.0,
        "lag=1": 1.0,
        "lag=2": 2.0,
    }
    assert set(frame["simulation.sensor.bearing_sigma"]) == {0.1, np.deg2rad(0.9)}
    assert set(frame["track"]) == {"round"}
    assert {"python", "gtsam", "numpy", "pathspace-graph", *TIMES} <= set(frame)


def test_results_load_into_pandas(study: Study, ran: tuple[Path, pd.DataFrame], finished: Path) -> None:
    _, frame = ran
    write_study(study, frame, finished)
    loaded = pd.read_csv(finished / "results.csv", keep_default_na=True)
    assert list(loaded) == list(without_times(frame))
    np.testing.assert_array_equal(loaded["rmse"], frame["rmse"].astype(float))
    times = pd.read_csv(finished / "times.csv")
    merged = loaded.merge(times, on=["study", "track", "seed", "noise", "estimator", "variant", "lap"])
    assert len(merged) == len(frame)


def test_a_log_is_simulated_once(study: Study, monkeypatch: pytest.MonkeyPatch) -> None:
    simulated = []
    real = study_module.simulate
    monkeypatch.setattr(study_module, "simulate", lambda *args: simulated.append(args) or real(*args))
    monkeypatch.setattr(study_module, "_latest", {})
    run_study(study)
    assert len(simulated) == len({seed for *_, seed in simulated}) == 2


def test_a_study_all_of_whose_cells_fail_has_rows_and_a_summary(study: Study, tmp_path: Path) -> None:
    hopeless = replace(study, estimators=("fragile",), variants={"only": {"lag": 1.0}}, grids=())
    frame = run_study(hopeless)
    frame = frame[frame["variant"] == "only"]
    assert (frame["failure"] != "").all()
    assert "2 runs (2 failed)" in write_study(hopeless, frame, tmp_path)


# --- resuming --------------------------------------------------------------------------------------------


def interrupt_after(cells: int) -> Any:
    def told(done: int, total: int) -> None:
        if done == cells:
            raise KeyboardInterrupt

    return told


def test_a_killed_study_goes_on_where_it_was_with_the_same_results(
    study: Study, ran: tuple[Path, pd.DataFrame], finished: Path, tmp_path: Path
) -> None:
    killed = tmp_path / "killed"
    write_study(study, ran[1], finished)
    for cells in (3, 2):
        with pytest.raises(KeyboardInterrupt):
            run_study(study, killed, on_cell=interrupt_after(cells))
    assert len(list((killed / "cells").iterdir())) == 5
    # what a kill in the middle of writing leaves
    cell = next((killed / "cells").iterdir())
    cell.with_name(".half.tmp.json").write_text("{")
    write_study(study, run_study(study, killed), killed)
    assert Pretender.calls == CALLS
    first, second = contents(finished), contents(killed)
    for name in ("results.csv", "study.json"):
        assert first[name] == second[name]


def test_cells_of_other_code_are_run_again_and_counted(
    study: Study, ran: tuple[Path, pd.DataFrame], finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, first = ran
    assert study_run.of_other_code(finished, study_run.make_plan(study).cells) == 0
    code = study_run.code_from(Pretender.__module__)
    monkeypatch.setattr(study_run, "code_from", lambda module: code | {"tests": "other"})
    monkeypatch.setattr(study_run, "check_code", lambda *_: None)
    assert study_run.of_other_code(finished, study_run.make_plan(study).cells) == len(first)
    again = run_study(study, finished)
    assert not set(again["cell"]) & set(first["cell"])
    pd.testing.assert_frame_equal(*(without_times(of).drop(columns="cell") for of in (again, first)))
    assert Pretender.calls == CALLS


def test_failed_cells_are_kept_until_they_are_to_be_retried(
    study: Study, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = [json.loads(file.read_text()) for file in (finished / "cells").iterdir()]
    (failure, *_) = [record for record in records if record["failure"]]
    assert "in update" in failure["traceback"]
    monkeypatch.setattr(Fragile, "broken", False)
    assert (run_study(study, finished)["failure"] != "").sum() == 2
    calls = Fragile.calls
    assert (run_study(study, finished, retry_failed=True)["failure"] == "").all()
    assert Fragile.calls == calls + 2


def test_a_study_that_grows_keeps_every_cell_that_means_the_same(study: Study, finished: Path) -> None:
    grown = replace(study, seeds=(0, 1, 2), grids=({"lag": [1.0, 2.0, 4.0]},), metrics=("size",))
    frame = run_study(grown, finished)
    assert (Pretender.calls, Fragile.calls) == (3 * 4 - CALLS, 3 * 4 - CALLS)
    assert len(frame) == 2 * 3 * 4
    assert set(json.loads((finished / "study.json").read_text())["variants"]) == {*grown.points}
    run_study(replace(grown, seeds=(2,), estimators=("pretender",), question="Why?"), finished)
    assert Pretender.calls == 3 * 4 - CALLS


def test_a_folder_of_another_study_is_refused(study: Study, finished: Path, tmp_path: Path) -> None:
    before = contents(finished)
    with pytest.raises(OutputError, match=r"expected the study other, found 'small'"):
        run_study(replace(study, name="other"), finished)
    assert contents(finished) == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("mine")
    with pytest.raises(OutputError, match=r"study\.json"):
        run_study(study, tmp_path / "thesis")
    assert [file.name for file in (tmp_path / "thesis").iterdir()] == ["thesis.tex"]


# --- other processes ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(track: Path) -> Study:
    """A study that other processes can run: they know no pretenders."""
    return Study(tracks=(track,), laps=1, grids=({"lag": [1.0]},))


@pytest.fixture(scope="module")
def alone(real: Study) -> pd.DataFrame:
    """Its results from this process."""
    frame = run_study(real)
    assert (frame["failure"] == "").all()
    assert frame["jump"].notna().any(), "the batch of a lap replaces the map, which takes another process"
    return without_times(frame)


@pytest.mark.slow
def test_processes_give_the_same_as_one(real: Study, alone: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(without_times(run_study(real, jobs=2)), alone)


@pytest.fixture
def cluster() -> Iterator[str]:
    distributed = pytest.importorskip("distributed", reason="dask isn't installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None
    ) as local:
        yield local.scheduler_address


def test_a_dask_cluster_gives_the_same(real: Study, alone: pd.DataFrame, cluster: str) -> None:
    pd.testing.assert_frame_equal(without_times(run_study(real, cluster=cluster)), alone)


def test_a_cluster_that_is_not_there_is_refused(
    real: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask isn't installed")
    monkeypatch.setattr("pathspace_graph.eval.experiment.run.CONNECT_SECONDS", 0.3)
    with pytest.raises(SettingsError, match=r"tcp://127\.0\.0\.1:9"):
        run_study(real, tmp_path / "out", cluster="tcp://127.0.0.1:9")
    assert not (tmp_path / "out").exists()


TENFOLD = """
import os


def tenfold(item):
    if item == 3:
        os._exit(7)
    return [{"item": item, "times": 10 * item}]
"""
"""A module of rows, each ten times an item; three kills its process."""


def test_a_worker_that_dies_takes_only_its_own_work_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "module").mkdir()
    (tmp_path / "module" / "tenfold_rows.py").write_text(TENFOLD, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path / "module")  # other processes cannot import the tests
    tenfold = import_module("tenfold_rows").tenfold
    with pytest.raises(SolveError, match=r"^3: WorkerDiedError: .*EXIT\(7\)"):
        rows_of(tenfold, [{"item": item} for item in range(6)], tmp_path, jobs=2)
    assert len([*(tmp_path / "cells").iterdir()]) == 6
    left = rows_of(tenfold, [{"item": item} for item in (0, 1, 2, 4, 5)], tmp_path)
    assert left["times"].tolist() == [0, 10, 20, 40, 50]
