"""The suite of faults: a study whose noises are single faults, `fault: strength`, each beside a clean run."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import pandas as pd

from pathspace_graph.errors import SettingsError, check_name
from pathspace_graph.eval.metrics.metric import METRICS
from pathspace_graph.io.files import write_json
from pathspace_graph.plausibility.diagnosis import PRIOR_LIMIT

from .frame import RUN, last_laps, write_csv, write_results
from .study import Study, find_study, read_study_file
from .tables import Quantity, Table

CLEAN: Final = "clean"  # name of the noise without a fault, which every other one is compared with
Values = Mapping[str, Any]  # values of an outcome by name
COLUMNS: Final = {  # of the table of faults: value and digits
    "runs": ("runs", 0),
    "failed": ("failed", 0),
    "rmse by clean": ("ratio_mean", 2),
    "least": ("ratio_min", 2),
    "most": ("ratio_max", 2),
    "size by clean": ("size_ratio", 2),
    "missed [%]": ("missed", 1),
    "closed [%]": ("closed", 0),
    "lost at the end [%]": ("lost", 0),
    "largest error [m]": ("error_max", 1),
    "called degraded [%]": ("reported_degraded", 1),
    "called lost [%]": ("reported_lost", 1),
    "reported [%]": ("reported", 0),
    "longest time over 1 m off [s]": ("divergence_time", 1),
    "longest way over 1 m off [m]": ("divergence_distance", 0),
}
_WORST: Final = ("error_max", "divergence_time", "divergence_distance")
_MEASURED: Final = (
    *("rmse", "size", "missed", "closed_at_end", "lost_at_end"),
    *("reported_degraded", "reported_lost", *_WORST),
)
_NAME: Final = re.compile(r"(?P<kind>.+): (?P<value>[-+]?\d+(\.\d+)?)( (?P<unit>\S+))?")


class Fault(NamedTuple):
    """A fault of a kind, and its strength."""

    kind: str
    value: float
    unit: str


def fault_of(noise: str) -> Fault:
    """Return the fault of a noise such as `latency: 20 ms`; SettingsError for any other name."""
    if noise == CLEAN:
        return Fault(CLEAN, 0.0, "")
    match = _NAME.fullmatch(noise)
    if match is None:
        raise SettingsError(f"noise: expected a name such as 'latency: 20 ms', found '{noise}'")
    return Fault(match["kind"], float(match["value"]), match["unit"] or "")


def suite() -> Study:
    return read_study_file(find_study(Path("faults")))


def by_kind(study: Study) -> list[list[str]]:
    """Return the noises of each kind of fault, in ascending strength."""
    return [list(noises) for _, noises in groupby(study.noise, lambda noise: fault_of(noise).kind)]


def kinds(study: Study) -> list[str]:
    return [fault_of(noises[0]).kind for noises in by_kind(study) if noises != [CLEAN]]


def only(study: Study, wanted: Sequence[str]) -> Study:
    """Return the suite with the clean run and the faults of these kinds; all of them where none is named."""
    for kind in wanted:
        check_name(kind, kinds(study), "--only: expected a known fault")
    keep = {CLEAN, *(wanted or kinds(study))}
    return _with(study, [noise for noise in study.noise if fault_of(noise).kind in keep])


def at_strength(study: Study, share: float) -> Study:
    """Return the suite with one strength of each fault: the middle one at 0.5, the greatest at 1."""
    groups = ((noises, len(noises)) for noises in by_kind(study))
    return _with(study, [noises[min(int(share * count), count - 1)] for noises, count in groups])


def _with(study: Study, noises: Sequence[str]) -> Study:
    return replace(study, noise={noise: study.noise[noise] for noise in noises})


# --- outcomes --------------------------------------------------------------------------------------------


def outcomes(study: Study, frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Return plain values of every noise of a suite at the end of the last lap; NaN is unknown."""
    every, failures = beside_clean(frame), frame.loc[frame["failure"] != "", "noise"].value_counts()
    of = ((fault_of(noise), every[every["noise"] == noise], failures.get(noise, 0)) for noise in study.noise)
    return [_outcome(fault, runs, int(failed)) for fault, runs, failed in of]


def _outcome(fault: Fault, runs: pd.DataFrame, failed: int) -> dict[str, Any]:
    ratios = runs["ratio"].dropna()
    sigmas = {key: float(runs[key].astype(float).mean()) for key in runs if key.endswith("_by_prior")}
    titles = {key: METRICS[key].title.removesuffix(" by its prior's sigma") for key in sigmas}
    return {
        **{"fault": fault.kind, "strength": fault.value, "unit": fault.unit},
        **{"runs": len(runs), "failed": failed, "with_map": len(ratios)},
        **{f"ratio_{name}": float(ratios.agg(name)) for name in ("mean", "min", "max")},
        "size_ratio": float(runs["size_ratio"].mean()),
        "missed": float(runs["missed"].mean()),
        "closed": int((runs["closed_at_end"] == 1.0).sum()),
        "lost": int((runs["lost_at_end"] == 1.0).sum()),
        **{name: float(runs[name].max()) for name in _WORST},
        "reported": int(runs["reported"].sum()),
        "reported_degraded": float(runs["reported_degraded"].mean()),
        "reported_lost": float(runs["reported_lost"].mean()),
        "calibration": {titles[key]: value for key, value in sigmas.items() if abs(value) > PRIOR_LIMIT},
        "notices": dict(Counter(text for text in runs["notices"] if text).most_common()),
    }


def beside_clean(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the last laps of the runs that finished, beside the clean run of the same track and seed.

    `ratio` (of rmse) and `size_ratio` are to that run, NaN without a map; `told`: anything was said.
    """
    last = last_laps(frame)
    last = last.reindex(columns=[*dict.fromkeys([*last, *_MEASURED])]).astype(dict.fromkeys(_MEASURED, float))
    clean = last[last["noise"] == CLEAN].set_index([*RUN])
    own = pd.MultiIndex.from_frame(last[[*RUN]])
    for name, ratio in (("rmse", "ratio"), ("size", "size_ratio")):
        last[ratio] = last[name] / clean[name].where(clean[name] > 0.0).reindex(own).to_numpy()
    return last.assign(reported=(last["notices"] != "") | (last["reported_lost"] > 0.0))


def fault_table(study: Study, found: Sequence[Values]) -> Table:
    """Return the cost of each fault relative to the clean run of its track, and how often it is reported."""
    rows = []
    for noise, values in zip(study.noise, found, strict=True):
        runs = max(values["runs"], 1)
        shares = {name: values[name] / runs for name in ("closed", "lost", "reported")}
        known = {**values, **shares}
        figures = [100.0 * known[key] if "%" in title else known[key] for title, (key, _) in COLUMNS.items()]
        rows.append((noise, *Quantity.row(figures, *(digits for _, digits in COLUMNS.values()))))
    title = (
        f"{study.name}: {study.question} {len(study.tracks)} tracks, {len(study.seeds)} seeds, "
        f"{study.laps} laps, {', '.join(study.estimators)}. The rmse is the map's at the end by that "
        "of the clean run on the same track and with the same seed. Lost means more than 5 m off in the last "
        "second."
    )
    return Table(("fault", *COLUMNS), tuple(rows), title)


def with_notices(table: Table, found: Sequence[Values]) -> Table:
    """Return the table with what was said: calibrations far from their prior (sigmas), and notices."""
    calibrations = (", ".join(f"{k} {v:+.1f}" for k, v in values["calibration"].items()) for values in found)
    told = zip(table.rows, calibrations, map(_notices, found), strict=True)
    header = (*table.header, "calibration by its prior's sigma", "notices")
    return replace(table, header=header, rows=tuple((*row, *texts) for row, *texts in told))


def _notices(values: Values) -> str:
    """Return how many runs said what, shortened to 60 characters; the JSON file has all of it."""
    short = {text: text if len(text) <= 60 else f"{text[:60].rstrip()} …" for text in values["notices"]}
    said = (f"{number} of {values['runs']}: {short[text]}" for text, number in values["notices"].items())
    return "; ".join(said) or "nothing"


# --- files ---------------------------------------------------------------------------------------------


def write_suite(study: Study, frame: pd.DataFrame, out: Path) -> str:
    """Write the results of every run, the table and the values; return the table's text."""
    faults = outcomes(study, frame)
    table = with_notices(fault_table(study, faults), faults)
    write_results(frame, out)
    table.write(out, "faults", "txt", "md", "tex")
    about = {"estimator": study.estimators, "seeds": study.seeds, "laps": study.laps}
    write_json(out / "faults.json", {"format": "pathspace-faults/1", **about, "faults": faults}, indent=1)
    flat = pd.DataFrame(faults)
    for key in ("calibration", "notices"):  # as JSON texts
        flat[key] = [json.dumps(value, ensure_ascii=False) for value in flat[key]]
    write_csv(out / "faults.csv", flat)
    return table.text()
