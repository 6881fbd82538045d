"""Data frames of runs and studies for pandas, and data sets for xarray."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pandas as pd

from pathspace_graph.io.parsing import MAX_STAMP
from pathspace_graph.io.results import CYCLE_COLUMNS, CYCLES_FILE, RunResult
from pathspace_graph.io.tables import read_table

from .errors import InputError, SettingsError, install

if TYPE_CHECKING:
    import xarray

OPTIONAL: Final = ("offered", "health", "reason", "dropped")  # columns of `cycles.csv` that may be missing
RESULTS_FILE: Final = "results.csv"  # metrics of a study, a row per run and lap
TIMES_FILE: Final = "times.csv"  # wall times of a study, with the same rows
KEYS: Final = ("study", "track", "seed", "noise", "estimator", "variant", "lap")  # keys of a row
TEXTS: Final = ("study", "track", "noise", "estimator", "variant", "failure", "notices", "drive", "cell")
"""Text columns of a study, even if a value looks like a number."""
DIMENSIONS: Final = KEYS[1:]  # dimensions of a study's metrics


def read_cycles(folder: Path | str) -> pd.DataFrame:
    """Read the cycles of a run's folder, with the cycle as index; InputError on a wrong file."""
    file = Path(folder) / CYCLES_FILE
    table = read_table(file, [name for name in CYCLE_COLUMNS if name not in OPTIONAL])
    columns = {}
    for name, values in table.columns.items():
        kind = CYCLE_COLUMNS.get(name, "str")
        if kind != "str":
            values = table.numbers(name, MAX_STAMP if name == "t" else None)  # noqa: PLW2901
        if kind == "int64":
            table.require(values == values.round(), f"expected whole numbers in column '{name}'")
        columns[name] = pd.Series(values, dtype=kind)
    return pd.DataFrame(columns).set_index("cycle")


def run_frame(result: RunResult) -> pd.DataFrame:
    """Cycles of a run as in `read_cycles`, with the pose x, y (m) and theta (rad)."""
    columns = {name: [getattr(record, name) for record in result.cycles] for name in CYCLE_COLUMNS}
    frame = pd.DataFrame(columns).astype({name: CYCLE_COLUMNS[name] for name in columns}).set_index("cycle")
    return frame.assign(**dict(zip(("x", "y", "theta"), result.trajectory.T, strict=True)))


def read_study(folder: Path | str) -> pd.DataFrame:
    """Read a study written by `ablate`, with metrics and wall times: a tidy row per run and lap.

    A failed run has one row with its `failure`, without lap and metrics. InputError on a wrong file.
    """
    results, times = (_table(Path(folder) / name) for name in (RESULTS_FILE, TIMES_FILE))
    keys = list(KEYS)
    if not results[keys].equals(times[keys]):
        raise InputError(Path(folder) / TIMES_FILE, f"expected the rows of {RESULTS_FILE}, found other ones")
    place = results.columns.get_loc("failure") if "failure" in results else len(results.columns)
    parts = [results.iloc[:, :place], times.drop(columns=keys), results.iloc[:, place:]]
    return pd.concat(parts, axis=1)


def _table(file: Path) -> pd.DataFrame:
    """Read a file of a study; empty texts stay empty, and empty numbers are NaN."""
    read_table(file, KEYS)  # raises an InputError on a wrong file
    frame = pd.read_csv(file, dtype=dict.fromkeys(TEXTS, "str"), keep_default_na=False, na_values=[""])
    flags = [name for name in frame if name not in TEXTS and frame[name].dropna().isin([True, False]).all()]
    flags = [name for name in flags if frame[name].dtype.kind not in "fiu"]
    types = {"lap": "Int64", **dict.fromkeys(flags, "boolean")}
    return frame.astype(types).fillna({name: "" for name in TEXTS if name in frame})


def to_dataset(study: pd.DataFrame) -> xarray.Dataset:
    """Numbers of a study as a Dataset with the dimensions DIMENSIONS; True becomes 1.

    Values of failed and missing runs are NaN. Texts that are equal in all rows, such as versions, become
    attributes. SettingsError if xarray is not installed.
    """
    if find_spec("xarray") is None:
        raise SettingsError(f"to_dataset: expected xarray ({install('frames')}), found none")
    numbers = study.select_dtypes(["number", "bool", "boolean"]).columns.difference(DIMENSIONS, sort=False)
    finished = study[study["lap"].notna()].astype({"lap": "int64", **dict.fromkeys(numbers, "float64")})
    dataset: xarray.Dataset = finished.set_index(list(DIMENSIONS))[list(numbers)].to_xarray()
    whole = {name: study[name].dropna().unique() for name in DIMENSIONS}
    whole["lap"] = whole["lap"].astype("int64")
    texts = study.drop(columns=[*numbers, *DIMENSIONS])
    same = {name: texts[name].iloc[0] for name in texts if texts[name].nunique(dropna=False) == 1}
    return dataset.reindex(whole).assign_attrs(same)
