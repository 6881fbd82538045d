"""A study's work in other processes: the same results, and what a death of one costs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from pathspace_graph.errors import SettingsError
from pathspace_graph.eval.experiment.run import WorkerDiedError, outcomes, run_study, workers
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


def test_a_worker_that_dies_takes_only_its_own_work_with_it() -> None:
    def work(item: int) -> int:
        if item == 3:
            import os  # noqa: PLC0415 - it runs elsewhere

            os._exit(1)
        return 10 * item

    with workers(2):
        found = dict(outcomes(work, list(range(6))))
    died = found.pop(3)
    assert isinstance(died, WorkerDiedError)
    assert found == {item: 10 * item for item in (0, 1, 2, 4, 5)}
