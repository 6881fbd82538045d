"""Frames: the types and rows of a run's cycles and of a study, and the dimensions of its Dataset."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pathspace_graph import read_cycles, read_study
from pathspace_graph.errors import InputError, SettingsError
from pathspace_graph.frames import DIMENSIONS, to_dataset

CYCLES = """cycle,t,seconds,size_left,size_right,readings,lap,offered,health,reason,dropped
0,0.5,0.01,4,5,3,1,6,good,,0
1,0.6,0.02,4,6,4,1,7,lost,"no cones, for long",2
"""
KEYS = "study,track,seed,noise,estimator,variant,lap"
RESULTS = f"""{KEYS},rmse,size,closed,failure,said,python
s,07,0,none,a,default,1,0.5,10,False,,,3.11.7
s,07,0,none,a,default,2,0.25,12,True,,"said ""so"" twice",3.11.7
s,07,0,none,b,default,1,1.5,20,False,,,3.11.7
s,07,0,none,b,default,2,1.25,22,True,,,3.11.7
s,07,1,none,a,default,1,2.5,30,False,,,3.11.7
s,07,1,none,a,default,2,2.25,32,True,,,3.11.7
s,07,1,none,b,default,,,,,boom,,3.11.7
"""


def times(rows: str = RESULTS) -> str:
    lines = [",".join(line.split(",")[:7]) for line in rows.splitlines()]
    return "\n".join([f"{lines[0]},ms_mean", *(f"{line},{k}.5" for k, line in enumerate(lines[1:]))]) + "\n"


@pytest.fixture
def study(tmp_path: Path) -> Path:
    (tmp_path / "results.csv").write_text(RESULTS)
    (tmp_path / "times.csv").write_text(times())
    return tmp_path


def test_cycles_have_their_types_and_the_cycle_as_index(tmp_path: Path) -> None:
    (tmp_path / "cycles.csv").write_text(CYCLES)
    frame = read_cycles(tmp_path)
    assert frame.index.name == "cycle"
    assert frame.index.tolist() == [0, 1]
    assert frame.t.tolist() == [0.5, 0.6]
    assert frame.readings.dtype == np.int64
    assert frame.reason.tolist() == ["", "no cones, for long"]


def test_stamps_since_1970_are_read(tmp_path: Path) -> None:
    (tmp_path / "cycles.csv").write_text(CYCLES.replace("0,0.5", "0,1700000000.5", 1))
    assert read_cycles(tmp_path).t.tolist() == [1700000000.5, 0.6]


def test_optional_columns_of_cycles_may_be_missing(tmp_path: Path) -> None:
    lines = [",".join(line.split(",")[:7]) for line in CYCLES.splitlines()]
    (tmp_path / "cycles.csv").write_text("\n".join(lines))
    assert list(read_cycles(tmp_path)) == ["t", "seconds", "size_left", "size_right", "readings", "lap"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0,0.5,0.01,4", "0,0.5,0.01,4.5", "row 2: expected whole numbers in column 'size_left'"),
        ("0,0.5", "0,soon", "row 2: expected a number in column 't', found 'soon'"),
        ("seconds", "minutes", "expected a column 'seconds', found none"),
    ],
)
def test_wrong_cycles_are_an_input_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "cycles.csv").write_text(CYCLES.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_cycles(tmp_path)


def test_a_study_is_tidy_with_its_times(study: Path) -> None:
    frame = read_study(study)
    assert len(frame) == 7
    assert frame.rmse.tolist()[:6] == [0.5, 0.25, 1.5, 1.25, 2.5, 2.25]
    assert frame.ms_mean.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5]
    assert frame.track.tolist() == ["07"] * 7  # a name, not a number
    assert frame.failure.tolist() == [""] * 6 + ["boom"]
    assert frame.said[1] == 'said "so" twice'
    assert str(frame.lap.dtype) == "Int64"
    assert frame.lap.isna().tolist() == [False] * 6 + [True]
    assert str(frame.closed.dtype) == "boolean"


def test_a_study_whose_times_are_of_other_rows_is_refused(study: Path) -> None:
    (study / "times.csv").write_text(times().replace("07,1", "07,2"))
    with pytest.raises(InputError, match=r"times.csv: expected the rows of results.csv"):
        read_study(study)


def test_what_is_no_study_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"results.csv"):
        read_study(tmp_path)


def test_a_dataset_has_a_value_for_each_run_and_lap(study: Path) -> None:
    dataset = to_dataset(read_study(study))
    assert dict(dataset.sizes) == dict(zip(DIMENSIONS, (1, 2, 1, 2, 1, 2), strict=True))
    assert float(dataset.rmse.sel(track="07", seed=0, estimator="b", lap=2).item()) == 1.25
    assert dataset.rmse.sel(seed=1, estimator="b").isnull().all()  # the run that failed
    assert dataset.rmse.sel(estimator="a").mean("seed").values.ravel().tolist() == [1.5, 1.25]
    assert dataset.closed.sel(estimator="a", seed=0).values.ravel().tolist() == [0.0, 1.0]
    assert dataset.attrs == {"study": "s", "python": "3.11.7"}


def test_without_xarray_one_line_says_how_to_install_it(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathspace_graph.frames.find_spec", lambda name: None)
    with pytest.raises(SettingsError, match=r"pip install 'pathspace-graph\[frames\]'"):
        to_dataset(read_study(study))
    assert importlib.util.find_spec("xarray") is not None
