"""A study's work in other processes: the same results, and what a death of one costs."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError, SolveError
from pathspace_graph.eval.experiment.run import rows_of, run_study
from pathspace_graph.eval.experiment.study import Study
from pathspace_graph.eval.experiment.tables import without_times

from ...scenes.pretenders import write_round_track


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study that other processes can run: they know no pretenders."""
    track = write_round_track(tmp_path_factory.mktemp("tracks"))
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
